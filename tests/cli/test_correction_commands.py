# SPDX-License-Identifier: Apache-2.0
"""remap, and merge of maps that kept their frames: what they write and say, and how they refuse."""

import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.sources.poses.trajectory import write_trajectory

SETTINGS = {"voxel_size": 0.2, "map.keep_frames": True, "trust.max_disagreement": 1}


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """Folders of the first and the second half of a short recording, of all of it without frames, and its poses."""
    folder = tmp_path_factory.mktemp("maps")
    frames = list(sv.open_source("sim:room?image_width=96", frames=":8"))
    for name, part, keep in (("a", frames[:4], True), ("b", frames[4:], True), ("bare", frames, False)):
        mapper = sv.Mapper("default", **{**SETTINGS, "map.keep_frames": keep})
        for frame in part:
            assert mapper.add(frame).refused is None
        mapper.save(folder / f"{name}.svox")
    poses = np.array([frame.T_world_sensor for frame in frames])
    poses[:, 0, 3] += 0.4
    write_trajectory(folder / "all.tum", [frame.stamp_ns for frame in frames], poses, "camera")
    far = poses + 1e12 * (np.arange(16).reshape(4, 4) == 3)
    write_trajectory(folder / "far.tum", [frame.stamp_ns for frame in frames], far, "camera")
    write_trajectory(folder / "two.tum", [frames[0].stamp_ns, frames[2].stamp_ns], poses[[0, 2]], "camera")
    return folder


def test_map_and_info_tell_of_kept_frames(tmp_path, told_with_notes, capsys):
    """The same line, with their number and size; nothing if none are kept."""
    out, line = tmp_path / "m.svox", "keeps 8 of its frames, "
    words = ["map", "sim:room?image_width=96", "--frames", ":8", "--voxel-size", 0.2, "--out", out]
    assert "keeps" not in told_with_notes(*words)[1]
    _, said = told_with_notes(*words, "--set", "map.keep_frames=true")
    assert main(["info", str(out)]) == 0
    shown = "".join(capsys.readouterr())
    (kept,) = (one for one in said.splitlines() if line in one)
    assert kept in shown


def test_remap(maps, tmp_path, told_with_notes, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result, said = told_with_notes("remap", maps / "a.svox", "--poses", maps / "all.tum")
    assert (result["moved"], result["posed"], result["between"], result["outside"]) == (4, 4, 0, 0)
    assert result["out"] == "a-corrected.svox"
    before, after = sv.load_map(maps / "a.svox"), sv.load_map(tmp_path / "a-corrected.svox")
    assert np.allclose(after.path[:, 0] - before.path[:, 0], 0.4, atol=1e-5)
    assert result["frames"] == 4
    assert result["moved_m"] == pytest.approx({"median": 0.4, "max": 0.4})
    assert "4 frames moved, by 0.40 m and 0.0 degrees (median), at most 0.40 m and 0.0 degrees" in said
    assert (result["repeated"], result["beyond"]) == (0, 1)
    assert "note: 1 poses are from before the first frame or after the last" in said
    assert "a large rotation" not in said
    assert "4 frames have a pose" in said
    assert "stayed" not in said


def test_remap_tells_of_frames_without_a_pose(maps, tmp_path, told_with_notes):
    result, said = told_with_notes("remap", maps / "a.svox", "--poses", maps / "two.tum", "--out", tmp_path / "n.svox")
    assert (result["posed"], result["between"], result["outside"]) == (2, 1, 1)
    assert "1 frames before the first or after the last of them keep their poses" in said


def test_remap_tells_of_lines_with_one_stamp_and_of_frames_that_turn_far(maps, tmp_path, told_with_notes):
    """As if quaternions were written with w first."""
    lines = [line.split() for line in (maps / "all.tum").read_text().splitlines()[1:]]
    turned = [[*line[:4], line[7], *line[4:7]] for line in lines]
    (tmp_path / "p.tum").write_text("\n".join(" ".join(line) for line in [*turned, *lines[:2]]))
    result, said = told_with_notes(
        "remap", maps / "a.svox", "--poses", tmp_path / "p.tum", "--out", tmp_path / "n.svox"
    )
    assert result["repeated"] == 2
    assert "note: 2 lines of" in said
    assert result["turned_deg"]["median"] > 45
    assert "note: that is a large rotation" in said


@pytest.mark.parametrize(("scale", "notes"), [(1000, 1), (1, 0)])
def test_remap_tells_of_poses_that_are_not_in_metres(maps, tmp_path, told_with_notes, scale, notes):
    frames = sv.load_map(maps / "a.svox").kept_frames.frames
    poses = np.array([frame.T_world_sensor for frame in frames])
    poses[:, :3, 3] *= scale
    write_trajectory(tmp_path / "p.tum", [frame.stamp_ns for frame in frames], poses, "camera")
    _, said = told_with_notes("remap", maps / "a.svox", "--poses", tmp_path / "p.tum", "--out", tmp_path / "m.svox")
    assert said.count("poses must be in metres") == notes


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["bare.svox", "--poses", "all.tum", "--out", "no.svox"], "map.keep_frames=true"),
        (["a.svox", "--poses", "far.tum", "--out", "no.svox"], "far.tum: a pose cannot be used"),
        (["a.svox", "--poses", "gone.tum", "--out", "no.svox"], "gone.tum"),
        (["a.svox", "--poses", "all.tum", "--out", "a.svox"], "another name"),
        (["a.svox", "--poses", "all.tum", "--out", "no.svox", "--sensor", "left"], "'camera'"),
        (["all.tum", "--poses", "all.tum", "--out", "no.svox"], "no stereovox map"),
    ],
)
def test_remap_refuses_in_one_line(maps, capsys, monkeypatch, words, said):
    monkeypatch.chdir(maps)
    assert main(["remap", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err
    assert not (maps / "no.svox").exists()


def test_merge_says_whether_it_is_exact(maps, tmp_path, told_with_notes):
    result, said = told_with_notes("merge", maps / "a.svox", maps / "b.svox", "--out", tmp_path / "both.svox")
    assert result["exact"] is True
    assert "added up" not in said
    assert "in both" not in said
    assert len(sv.load_map(tmp_path / "both.svox").kept_frames) == 8
    _, said = told_with_notes("merge", tmp_path / "both.svox", maps / "b.svox", "--out", tmp_path / "again.svox")
    assert "note: 4 frames are in both maps and count once" in said
    result, said = told_with_notes("merge", maps / "a.svox", maps / "bare.svox", "--out", tmp_path / "added.svox")
    assert result["exact"] is False
    assert "evidence is added up, since a map did not keep its frames" in said


def test_loops_draws_what_it_did(maps, tmp_path, told_with_notes, capsys):
    """Few frames hold no loop; the picture and the map say so."""
    out, picture = tmp_path / "closed.svox", tmp_path / "loops.png"
    result, said = told_with_notes("loops", maps / "a.svox", "--out", out, "--picture", picture)
    assert result["loops"] == 0
    assert f"saved {picture}" in said
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["info", str(out)]) == 0
    assert "loops: 0 closed, 0 refused" in "".join(capsys.readouterr())


@pytest.mark.parametrize(
    ("option", "name"),
    [("--picture", "loops.gif"), ("--picture", "nowhere/loops.png"), ("--trajectory", "way.csv")],
)
def test_loops_refuses_a_file_that_cannot_be_before_any_work(maps, tmp_path, capsys, option, name):
    assert main(["loops", str(maps / "a.svox"), "--out", str(tmp_path / "c"), option, str(tmp_path / name)]) == 2
    assert name in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_loops_joins_a_second_odometry(tmp_path, told_with_notes, monkeypatch):
    pytest.importorskip("gtsam")
    monkeypatch.chdir(tmp_path)
    frames = list(sv.open_source("sim:room?image_width=96", frames="::8"))
    mapper = sv.Mapper("default", **SETTINGS)
    for frame in frames:
        mapper.add(frame)
    mapper.save(tmp_path / "room.svox")
    poses = np.array([frame.T_world_sensor for frame in frames])
    write_trajectory(tmp_path / "wheels.tum", [frame.stamp_ns for frame in frames], poses, "camera")
    result, said = told_with_notes("loops", "room.svox", "--odometry", "wheels.tum")
    assert result["odometry"]["used"] > 0
    assert result["odometry"]["contradicted"] == 0
    assert f"was used in {result['odometry']['used']} steps" in said
    write_trajectory(tmp_path / "later.tum", [10**15 + frame.stamp_ns for frame in frames], poses, "camera")
    assert main(["loops", "room.svox", "--odometry", "later.tum", "--out", "no.svox"]) == 2
    assert not (tmp_path / "no.svox").exists()
