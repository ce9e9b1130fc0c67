# SPDX-License-Identifier: Apache-2.0
"""`simulate`, `slam`, `localize`, `grid`, and `map` under a 2-D profile: a robot's bag becomes a map."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.cli.map.slam import _pace
from stereovox.formats.map_server import read_map_server
from stereovox.localize.slam.graph import MapDoubt
from stereovox.opening import open_robot
from stereovox.sources.bags import open_bag
from stereovox.sources.bags.messages import read_pose
from stereovox.sources.poses.trajectory import Trajectory

DRIVE = "sim:floor?plan=testbed&seconds=24&scan_hz=4&depth_hz=2&image_width=160"


def run(capsys, *words):
    assert main([*map(str, words), "--json"]) == 0
    said = capsys.readouterr()
    return json.loads(said.out.splitlines()[-1]), said.err


def refused(capsys, *words):
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    return said[-1]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "floor.bag"
    assert main(["simulate", DRIVE, "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def reference(bag):
    out = bag.with_name("reference.yaml")
    assert main(["slam", str(bag), "--out", str(out)]) == 0
    return out


def test_simulate_writes_what_the_robot_saw(bag):
    robot, simulated = open_robot(bag), open_robot(DRIVE)
    assert (len(robot.scans), len(robot.frames)) == (len(simulated.scans), len(simulated.frames))
    np.testing.assert_allclose(robot.scans[20].ranges, simulated.scans[20].ranges)
    np.testing.assert_allclose(robot.scans[20].pose_world_base, simulated.scans[20].pose_world_base, atol=1e-6)


def test_slam_saves_map_and_way(bag, reference, tmp_path, capsys):
    floor = read_map_server(reference)
    assert (floor.cells == 100).sum() > 100
    assert (floor.cells == 0).sum() > 3000
    way = Trajectory(reference.with_suffix(".tum"))
    assert len(way) == len(open_robot(bag).scans)
    result, _ = run(capsys, "slam", DRIVE, "--out", tmp_path / "again.pgm")  # the simulation knows the truth
    assert result["position_rms_m"] < 0.1
    assert result["scans"] == len(way)
    np.testing.assert_array_equal(read_map_server(tmp_path / "again.yaml").cells, floor.cells)


@pytest.mark.parametrize("command", ["slam", "localize"])
def test_scans_that_are_mostly_lost_are_told_last(command, bag, reference, tmp_path, capsys, monkeypatch):
    robot, out = open_robot(bag), tmp_path / ("a.yaml" if command == "slam" else "a.tum")
    scans = [
        one if k % 3 == 0 else replace(one, ranges=np.full_like(one.ranges, np.nan))
        for k, one in enumerate(robot.scans)
    ]
    robot.scans = scans
    monkeypatch.setattr(f"stereovox.cli.map.{command}.open_noting", lambda source: robot)
    files = [] if command == "slam" else [reference, "--start=0,0,0"]
    assert main([command, str(bag), *map(str, files), "--out", str(out), "--json"]) == 3
    said = capsys.readouterr()
    kept = len(scans[::3])
    assert f", but only {kept} of {len(scans)} scans" in said.err.splitlines()[-1]
    assert "mostly_lost" in [doubt["kind"] for doubt in json.loads(said.out.splitlines()[-1])["doubts"]]


@pytest.mark.parametrize(
    ("recorded", "seconds", "words"),
    [
        (0.0, 2.0, ""),
        (0.05, 2.0, ""),
        (1.0, 2.0, " (0.5 times"),
        (9.0, 2.0, " (4.5 times"),
        (274.0, 2.0, " (137 times"),
    ],
)
def test_slam_says_its_pace_only_where_stamps_tell(recorded, seconds, words):
    assert _pace(recorded, seconds, False).startswith(words)
    assert bool(_pace(recorded, seconds, False)) == bool(words)


@pytest.mark.parametrize("command", [("slam",), ("grid", "--use", "lidar"), ("map", "--set", "dimensions=2")])
def test_a_doubted_map_is_written_with_a_warning_and_status_3(command, monkeypatch, tmp_path, capsys):
    doubt = MapDoubt("bent", 3.0, 9.0, 0.84)
    monkeypatch.setattr("stereovox.localize.slam.pipeline.doubts_of", lambda keyframes, edges: [doubt])
    out, drive = tmp_path / "a.yaml", "sim:floor?plan=testbed&seconds=3&scan_hz=4&depth_hz=1&image_width=16"
    assert main([command[0], drive, "--out", str(out), *command[1:], "--json"]) == 3
    said = capsys.readouterr()
    assert "warning: this map may be wrong" in said.err
    assert "bent, 3 to 9 s: loops bent 20 m of the trajectory by 0.8 m" in said.err
    assert json.loads(said.out.splitlines()[-1])["doubts"] == [doubt.as_dict()]
    assert read_map_server(out).cells.size


def test_slam_scores_relations(tmp_path, capsys):
    scans = open_robot(DRIVE).scans
    first, second = scans[8], scans[40]
    from stereovox.geometry import se2

    x, y, yaw = se2.relative(*(one.pose_world_base for one in (first, second)))
    line = f"{first.stamp_ns / 1e9:.6f} {second.stamp_ns / 1e9:.6f} {x} {y} 0 0 0 {yaw}\n"
    (tmp_path / "floor.relations").write_text(line)
    result, said = run(capsys, "slam", DRIVE, "--out", tmp_path / "a.yaml", "--relations", tmp_path / "floor.relations")
    assert result["relations"]
    assert "relations" in said


def test_localize_says_where_the_robot_was(bag, reference, tmp_path, capsys):
    result, _ = run(capsys, "localize", bag, reference, "--out", tmp_path / "way.tum", "--start=0,0,0")
    found, known = Trajectory(tmp_path / "way.tum"), Trajectory(reference.with_suffix(".tum"))
    assert result["poses"] == len(found)
    gap = np.linalg.norm(found.T_world_body[:, :2, 3] - known.T_world_body[:, :2, 3], axis=1)
    assert np.sqrt(np.mean(gap**2)) < 0.15
    assert result["last"][:2] == pytest.approx(found.T_world_body[-1, :2, 3], abs=1e-5)


def test_a_start_outside_of_the_map_is_refused_and_the_fit_is_told(bag, reference, tmp_path, capsys):
    words = ("localize", bag, reference, "--out", tmp_path / "a.tum")
    assert "lies outside of the map" in refused(capsys, *words, "--start=900,0,0")
    right, said = run(capsys, *words, "--start=0,0,0")
    assert right["fit"] > 0.8
    assert "is it the right map" not in said


def test_grid_maps_depth_images_where_the_map_says_the_robot_was(bag, reference, tmp_path, capsys):
    out = tmp_path / "kinect.yaml"
    result, _ = run(capsys, "grid", bag, "--poses", reference, "--start=0,0,0", "--out", out)
    assert result["frames"] + result["frames_refused"] == len(open_robot(bag).frames)
    score, _ = run(capsys, "eval", out, reference)
    assert score["known_error_percent"] < 12


def test_grid_finds_the_way_itself_and_goes_on_with_a_map(bag, tmp_path, capsys):
    half, whole, both = tmp_path / "half.yaml", tmp_path / "whole.yaml", tmp_path / "both.yaml"
    lidar = ("grid", bag, "--use", "lidar", "--poses", "odometry", "--mode", "raw")
    run(capsys, *lidar, "--out", half, "--frames", ":40")
    run(capsys, *lidar, "--out", both, "--frames", "40:", "--resume", half)
    run(capsys, *lidar, "--out", whole)
    cells = [read_map_server(path).states for path in (whole, both)]
    assert cells[0].shape == cells[1].shape
    assert (cells[0] == cells[1]).mean() > 0.98  # per cents are rounded in between
    result, said = run(capsys, "grid", bag, "--use", "both", "--out", tmp_path / "a.yaml", "--frames", "::8")
    assert "SLAM" in said
    assert result["occupied"] > 50


def test_grid_takes_both_kinds_of_readings(tmp_path, capsys):
    drive = "sim:floor?plan=testbed&seconds=8&scan_hz=1&depth_hz=3&image_width=80"
    robot = open_robot(drive)
    result, _ = run(capsys, "grid", drive, "--use", "both", "--poses", "odometry", "--out", tmp_path / "a.yaml")
    assert len(robot.frames) > len(robot.scans) > 4
    assert result["frames"] + result["frames_refused"] == len(robot.frames) + len(robot.scans)


def test_going_on_localises_in_the_map_and_takes_its_cells(bag, reference, tmp_path, capsys):
    out = tmp_path / "more.yaml"
    _, said = run(capsys, "grid", bag, "--resume", reference, "--start=0,0,0", "--out", out, "--profile", "ist2019")
    assert f"localising the robot in {reference}" in said
    assert read_map_server(out).resolution == read_map_server(reference).resolution
    assert "SLAM starts a new frame" in refused(
        capsys, "grid", bag, "--resume", reference, "--poses", "slam", "--out", out
    )


def test_localize_writes_what_amcl_would_publish(bag, reference, tmp_path, capsys):
    out = tmp_path / "way.bag"
    run(capsys, "localize", bag, reference, "--out", out, "--start=0,0,0")
    run(capsys, "localize", bag, reference, "--out", tmp_path / "way.tum", "--start=0,0,0")
    file, way = open_bag(out), Trajectory(tmp_path / "way.tum")
    assert file.types == {"/amcl_pose": "geometry_msgs/PoseWithCovarianceStamped", "/tf": "tf2_msgs/TFMessage"}
    pose = read_pose(file.read("/amcl_pose", 30), file.types["/amcl_pose"])
    assert pose.stamp_ns == way.stamps_ns[30]
    assert pose.numbers[:2] == pytest.approx(way.T_world_body[30, :2, 3], abs=1e-5)


def test_map_under_profile_ist2019_is_a_grid(bag, tmp_path, capsys):
    result, _ = run(capsys, "map", bag, "--profile", "ist2019", "--out", tmp_path / "floor.yaml", "--frames", "::4")
    assert result["free"] > 1000
    assert read_map_server(tmp_path / "floor.yaml").resolution == 0.02
    words = ("map", bag, "--profile", "ist2019", "--out")
    assert "ends in .yaml" in refused(capsys, *words, tmp_path / "floor.svox")
    assert "--integrator: does not apply" in refused(capsys, *words, tmp_path / "a.yaml", "--integrator", "ray")
    assert "no map to continue" in refused(capsys, *words, tmp_path / "a.yaml", "--resume")
    run(capsys, "map", bag, "--set", "dimensions=2", "--out", tmp_path / "b.yaml", "--frames", "::8")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("slam", "nowhere.bag", "--out", "a.yaml"), "nowhere.bag: no such file"),
        (("slam", DRIVE, "--out", "a.yaml", "--relations", "nope"), "nope"),
        (("slam", DRIVE, "--out", "a.svox"), "give a name that ends in .yaml"),
        (("grid", DRIVE, "--out", "a.yaml", "--poses", "gps"), "poses gps: give slam, odometry, or the .yaml"),
        (("grid", DRIVE, "--out", "a.yaml", "--frames", "9999:"), "selects none"),
        (("grid", DRIVE, "--out", "a.yaml", "--set", "grid.thick=1"), "did you mean 'grid.thickness'"),
        (("localize", DRIVE, "nowhere.yaml", "--out", "a.tum"), "nowhere.yaml"),
        (("grid", DRIVE, "--out", "a.yaml", "--poses", "odometry", "--start", "0,0,0"), "is a pose in a map"),
        (("grid", DRIVE, "--out", "a.pgm", "--mode", "scale"), "mode scale has no grey for unknown cells"),
        (("map", "sim:room", "--out", "a.yaml"), "names a floor's map"),
        (("map", "sim:room", "--out", "a.svox", "--rerun", "notes.txt"), "end the file's name with .rrd"),
        (("localize", DRIVE, ".", "--out", "a.tum"), ".: not a map of a floor; make one"),
        (("slam", "sim:room", "--out", "a.yaml"), "there is sim:floor"),
        (("localize", DRIVE, "nowhere.yaml", "--out", "a.tum", "--start", "1,2"), "--start 1,2: give X,Y,DEG"),
        (("simulate", "sim:floor?plan=castle", "--out", "a.bag"), "castle"),
        (("simulate", DRIVE, "--out", "a.txt"), "ends in .bag or .mcap or .db3"),
    ],
)
def test_mistakes_end_in_one_line(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(list(words)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith(("note:", "compiling"))]
    assert len(lines) == 1
    assert said in lines[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mode", "--set mode: this is not a setting; use --mode"),
        ("checkpoint_s", "--set checkpoint_s: this is not a setting; use --checkpoint"),
        ("notify", "--set notify: this is not a setting; leave it out"),
        ("source", "unknown setting 'source'"),
    ],
)
def test_arguments_are_not_settings(bag, tmp_path, capsys, name, said):
    assert said in refused(capsys, "grid", bag, "--out", tmp_path / "a.yaml", "--set", f"{name}=x")
