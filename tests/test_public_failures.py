# SPDX-License-Identifier: Apache-2.0
"""What hurt users of other systems, done to this one from outside: by its commands, or by what the docs call public.

Each test names the report it replays: repository and number of an issue or pull request.
"""

import json
import struct

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker, planar_numbers

import stereovox as sv
from stereovox.cli import main
from stereovox.errors import MapFileError
from stereovox.formats import export, read_octomap
from stereovox.formats.map_server import read_map_server
from stereovox.geometry.se3 import look_at
from stereovox.maps import State

CAMERA = sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.05)
FORWARD = look_at([0.03, 0.02, 0.51], [1.03, 0.02, 0.51])
AHEAD = np.array([[x, 0.02, 0.51] for x in np.arange(0.35, 4, 0.1)])
INTEGRATORS = pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
NOTHING = {
    "+inf": (np.inf, np.float32), "-inf": (-np.inf, np.float32), "NaN": (np.nan, np.float32), "0": (0, np.uint16),
    "65535": (65535, np.uint16), "double inf": (np.inf, np.float64),
}  # fmt: skip


def run(capsys, *words):
    """Run a command; return its JSON and what it told."""
    assert main([*map(str, words), "--json"]) == 0
    said = capsys.readouterr()
    return json.loads(said.out.splitlines()[-1]), said.err


def refused(capsys, *words):
    """Run a command that must end in one line and status 2; return the line."""
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    line = said.err.strip().splitlines()[-1]
    assert "Traceback" not in said.err
    return line


def frame_of(depth, value=None, share=0.0, dtype=np.float32):
    """A wall straight ahead; `value` in a share of the columns."""
    image = np.full((60, 80), depth * (1000 if dtype == np.uint16 else 1)).astype(dtype)
    image[:, 80 - round(80 * share) :] = dtype(value) if share else 0
    return sv.Frame(image, CAMERA, FORWARD, depth_scale=0.001 if dtype == np.uint16 else 1.0)


def robot_bag(folder, messages):
    """A robot that stands still and has a lidar: `messages` of /points or /scan, whatever they are."""
    with RobotBagMaker(folder / "robot.bag") as bag:
        bag.tf(START_NS, "base_link", "lidar", planar_numbers(0, 0, 0, 0.5), "/tf_static")
        for k, (topic, kind, message) in enumerate(messages(bag)):
            stamp_ns = START_NS + k * 100 * MS
            bag.add("/odom", "nav_msgs/Odometry", stamp_ns, bag.odometry(stamp_ns, planar_numbers(0, 0, 0)))
            bag.add(topic, kind, stamp_ns, message)
    return bag.path


def wall_of_points():
    y, z = np.mgrid[-1:1:41j, -0.3:0.5:9j]
    return np.column_stack([np.full(y.size, 2.0), y.ravel(), z.ravel()])


def mapped(capsys, bag, out, *more):
    """Map a bag by its odometry; return the result, what was reported, and the floor's map."""
    result, said = run(capsys, "grid", bag, "--out", out, "--poses", "odometry", "--use", "lidar", *more)
    return result, said, read_map_server(out)


BROKEN_CLOUDS = {
    "no fields": {"fields": []},
    "no x, y, z": "abc",
    "no z": "xy",
    "x twice": "xxz",
    "overflow to 0": {"width": 65536, "height": 65536, "row_step": 0},
    "overflow": {"width": 2**31, "height": 2, "row_step": 2**32 - 1},
    "lying width": {"width": 10**9},
    "lying step": {"point_step": 2**32 - 1},
    "step of 0": {"point_step": 0, "row_step": 0},
    "nothing": {"width": 0, "data": np.empty(0, np.uint8)},
    "unknown type": 99,
    "offset beyond": 7,
}


@pytest.mark.parametrize("wrong", BROKEN_CLOUDS)
def test_one_odd_cloud_ends_nothing(tmp_path, capsys, wrong):
    """navigation2#6166 (a PointCloud2 without x/y/z), navigation2#5612 (width times height overflows to 0)."""

    def messages(bag):
        change = BROKEN_CLOUDS[wrong]
        if isinstance(change, str):
            change = {"fields": [bag.field(name, 4 * k, 7) for k, name in enumerate(change)]}
        elif change == 99:
            change = {"fields": [bag.field(name, 4 * k, 99) for k, name in enumerate("xyz")]}
        elif change == 7:
            change = {"fields": [bag.field(name, 2**31 + 4 * k, 7) for k, name in enumerate("xyz")]}
        for k in range(6):
            cloud = bag.cloud(START_NS + k * 100 * MS, wall_of_points(), **(change if k in (0, 3) else {}))
            yield "/points", "sensor_msgs/PointCloud2", cloud

    result, _, floor = mapped(capsys, robot_bag(tmp_path, messages), tmp_path / "floor.yaml")
    assert (result["frames"], result["frames_refused"]) == (4, 2)
    assert floor.states[tuple(floor.indices([[2.02, 0.0]])[0])] == State.OCCUPIED


def test_an_image_whose_size_overflows_is_refused(tmp_path, capsys):
    """navigation2#5612, for depth images: 65536 x 65536 pixels are 0 in 32 bits."""
    with RobotBagMaker(tmp_path / "robot.bag") as bag:
        bag.tf(START_NS, "base_link", "optical", [0, 0, 0.5, -0.5, 0.5, -0.5, 0.5], "/tf_static")
        for k in range(4):
            stamp_ns = START_NS + k * 100 * MS
            bag.add("/odom", "nav_msgs/Odometry", stamp_ns, bag.odometry(stamp_ns, planar_numbers(0, 0, 0)))
            image = bag.image(stamp_ns, np.full((6, 8), 1500, np.uint16), "optical")
            if k == 2:
                image.width = image.height = 65536
                image.step = 0
            bag.add("/camera/depth/image", "sensor_msgs/Image", stamp_ns, image)
            bag.add("/camera/depth/camera_info", "sensor_msgs/CameraInfo", stamp_ns, bag.camera_info(stamp_ns, 8, 6))
    result, _ = run(capsys, "map", bag.path, "--out", tmp_path / "a.svox", "--voxel-size", 0.2)
    assert (result["frames"], result["frames_refused"]) == (3, 1)


def test_a_scan_of_infinities_marks_nothing(tmp_path, capsys):
    """depthimage_to_laserscan#91 (+Inf passes into the scan): what each of them means is reported and marks nothing.

    +inf is free; what is beyond range_max is discarded (LaserScan.msg), and all others say nothing.
    """

    def messages(bag):
        for k in range(4):
            ranges = np.array([2.0, np.inf, np.nan, -np.inf, 0.0, -1.0, 3.4e38], np.float32)
            scan = bag.scan(
                START_NS + k * 100 * MS, ranges, "lidar", angle_min=-0.9, angle_max=0.9, angle_increment=0.3,
            )  # fmt: skip
            yield "/scan", "sensor_msgs/LaserScan", scan

    _, _, floor = mapped(capsys, robot_bag(tmp_path, messages), tmp_path / "floor.yaml", "--max-range", 4)
    occupied = np.argwhere(floor.states == State.OCCUPIED)
    angle = -0.9 + 0.3 * np.arange(7)
    for beam, free in enumerate((True, True, False, False, False, False, False)):
        spot = floor.indices([[1.5 * np.cos(angle[beam]), 1.5 * np.sin(angle[beam])]])[0]
        inside = (spot >= 0).all() and (spot < floor.cells.shape).all()
        assert (inside and floor.states[tuple(spot)] == State.FREE) == free
    assert 0 < len(occupied) < 4


@pytest.mark.parametrize("nothing", NOTHING)
@pytest.mark.parametrize("method", ["rows", "cloud"])
def test_a_depth_image_of_infinities_clears_no_floor(nothing, method):
    """depthimage_to_laserscan#91 and #61: what a camera writes for "no value" must not be free space in a scan."""
    value, dtype = NOTHING[nothing]
    mapper = sv.GridMapper(voxel_size=0.1, **{"scan.method": method, "grid.prior": 0.5})
    for _ in range(4):
        assert mapper.add(frame_of(2.0, value, 0.5, dtype)).refused is None
    right = [[1.0, -0.4], [1.5, -0.6], [2.5, -1.0], [4.0, -1.5]]
    assert (mapper.map.state(right) == State.UNKNOWN).all()
    assert mapper.map.state([[1.0, 0.3]])[0] == State.FREE


@INTEGRATORS
@pytest.mark.parametrize("nothing", NOTHING)
def test_a_wall_that_is_too_near_stays(integrator, nothing):
    """ROG-Map#18: before a wall the driver reports "infinite" depth, ray casting erases it, the planner flies on."""
    value, dtype = NOTHING[nothing]
    mapper = sv.Mapper(voxel_size=0.1, integrator=integrator)
    for _ in range(8):
        mapper.add(frame_of(1.0))
    wall = mapper.map.occupied()
    assert len(wall) > 50
    reports = [mapper.add(frame_of(4.5, value, 0.97, dtype)) for _ in range(30)]
    assert {report.refused for report in reports} == {None}
    hidden = wall[wall[:, 1] < 0.4]  # all but what the two columns that have a value look at
    assert len(hidden) > 50
    assert (mapper.map.state(hidden) == State.OCCUPIED).all()
    all_of_it = mapper.add(frame_of(4.5, value, 1.0, dtype))
    assert all_of_it.refused == "no_valid_depth"


@INTEGRATORS
def test_rays_that_end_too_far_away_still_clear(integrator):
    """octomap#301, octomap_mapping#28, rtabmap_ros#467: beyond the maximum range is free up to it, and not unknown."""
    mapper = sv.Mapper(voxel_size=0.1, integrator=integrator, max_range=3.0)
    for _ in range(4):
        mapper.add(frame_of(9.0))
    states = mapper.map.state(AHEAD)
    assert (states[(AHEAD[:, 0] > 0.4) & (AHEAD[:, 0] < 2.8)] == State.FREE).all()  # nearer, nothing is cleared
    assert (states[AHEAD[:, 0] > 3.2] == State.UNKNOWN).all()


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_a_saved_octomap_is_not_empty(tmp_path, capsys, ending):
    """octomap_mapping#123 and #130: a map is saved, and the .bt is then "empty"; here, in OctoMap too."""
    octomap = pytest.importorskip("octomap")
    mapper = sv.Mapper(voxel_size=0.1)
    for _ in range(6):
        mapper.add(frame_of(2.0))
    mapper.map.save(tmp_path / "a.svox")
    run(capsys, "export", tmp_path / "a.svox", tmp_path / f"a{ending}")
    tree = octomap.OcTree(0.1)
    path = str(tmp_path / f"a{ending}").encode()
    if ending == ".bt":
        assert tree.readBinary(path)
    else:
        tree = octomap.OcTree.read(path)
    known = {
        tuple(np.floor(np.array(leaf.getCoordinate()) / 0.1).astype(int)): tree.isNodeOccupied(leaf)
        for leaf in tree.begin_leafs() if leaf.getSize() < 0.15
    }  # fmt: skip
    occupied = np.floor(mapper.map.occupied() / 0.1).astype(int)
    assert len(occupied) > 50
    assert all(known[tuple(cell)] for cell in occupied.tolist())
    ours = read_octomap(tmp_path / f"a{ending}")
    assert np.allclose(ours.occupied(), mapper.map.occupied())
    assert len(ours.free()) == len(mapper.map.free())


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_a_damaged_octomap_is_not_taken_for_an_empty_one(tmp_path, ending):
    """octomap_mapping#123: a file that cannot be read whole must say so and not load as nothing."""
    voxel_map = sv.VoxelMap.from_cells(
        sv.load_config(voxel_size=0.1), np.argwhere(np.ones((5, 5, 5))), np.full(125, 2.0)
    )
    export(voxel_map, tmp_path / f"a{ending}")
    whole = (tmp_path / f"a{ending}").read_bytes()
    start = whole.index(b"data\n") + 5
    for damaged in (whole[:start], whole[: start + 1], whole[:-1], whole[:20], b"", whole.replace(b"size ", b"size 9")):
        (tmp_path / f"b{ending}").write_bytes(damaged)
        with pytest.raises(MapFileError, match=rf"b{ending}"):
            read_octomap(tmp_path / f"b{ending}")


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (b"P5\n65536 65536\n255\n", bytes(64)),
        (b"P5\n4294967296 4294967296\n255\n", bytes(64)),
        (b"P5\n8 8\n255\n", bytes(63)),
        (b"P5\n-8 -8\n255\n", bytes(64)),
        (b"P5\n8 8\n0\n", bytes(64)),
        (b"P2\n99999 99999\n255\n", b"1 2 3"),
        (b"P5\n0 0\n255\n", b""),
    ],
)
def test_a_floor_map_with_less_data_than_it_says(tmp_path, capsys, head, body):
    """navigation2#6232: the map saver and server trust the size that the message tells."""
    (tmp_path / "floor.pgm").write_bytes(head + body)
    (tmp_path / "floor.yaml").write_text(
        "image: floor.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    line = refused(capsys, "info", tmp_path / "floor.yaml")
    assert "floor" in line


def test_a_png_that_is_much_larger_than_its_file(tmp_path, capsys):
    """navigation2#6232, as a picture: a header of 60000 x 60000 pixels and nothing behind it."""
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0))
    (tmp_path / "floor.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(9))) + chunk(b"IEND", b"")
    )
    (tmp_path / "floor.yaml").write_text(
        "image: floor.png\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    assert "floor.png" in refused(capsys, "info", tmp_path / "floor.yaml")


@pytest.mark.parametrize(
    "setting", ["voxel_size=nan", "voxel_size=-1", "max_range=inf", "min_range=1e999", "threads=99999999999999999999",
                "window.size=[1e308,1e308,1e308]", "map.log_odds_min=nan", "voxel_size=[[[[[[", "sensor.p_free=nan"]
)  # fmt: skip
def test_settings_that_are_nonsense(tmp_path, capsys, setting):
    """navigation2#3231 and #6430: parameters out of a fuzzer crash the node."""
    line = refused(capsys, "map", "sim:room?frames=2", "--out", tmp_path / "a.svox", "--set", setting)
    assert setting.partition("=")[0].partition(".")[2] in line
    assert not (tmp_path / "a.svox").exists()
