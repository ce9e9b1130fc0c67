# SPDX-License-Identifier: Apache-2.0
"""Corrections from a file of poses, against a new run with these poses."""

from dataclasses import replace

import numpy as np
import pytest
from made_threads import frames_of

import stereovox as sv
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.geometry.se3 import interpolate, rotation_matrix
from stereovox.sources.poses.trajectory import Trajectory, write_trajectory

SETTINGS = {
    "voxel_size": 0.1, "map.keep_frames": True, "trust.max_disagreement": 1, "trust.frozen": False,
    "trust.max_speed_mps": 1e6, "trust.max_turn_dps": 1e9,
}  # fmt: skip


def frames(sensor=0, each=16):
    return [frame for frame in frames_of(sensor, each) if not frame.fault]


def mapped(some, **settings):
    mapper = sv.Mapper("default", **{**SETTINGS, **settings})
    for frame in some:
        assert mapper.add(frame).refused is None
    return mapper.map


def written(path, some):
    write_trajectory(path, [f.stamp_ns for f in some], np.array([f.T_world_sensor for f in some]), "camera")
    return path


def turned(some, seed=0):
    random = np.random.default_rng(seed)
    moved = []
    for frame in some:
        T = np.eye(4)
        T[:3, :3] = rotation_matrix(random.normal(0, 0.02, 3))
        T[:3, 3] = random.normal(0, 0.1, 3)
        moved.append(replace(frame, T_world_sensor=T @ frame.T_world_sensor))
    return moved


def as_read(some, path):
    """Return frames with the poses that a file of few digits holds."""
    poses = Trajectory(path)
    return [replace(frame, T_world_sensor=poses.at(frame.stamp_ns)) for frame in some]


def equal(a, b):
    return all(np.array_equal(x, y) for x, y in zip(a.storage.blocks(), b.storage.blocks(), strict=True))


@pytest.mark.parametrize("settings", [{}, {"window.size": [4, 4, 3], "window.outside": "keep"}])
def test_remapped_is_the_map_of_a_new_run(tmp_path, settings):
    first = frames()
    mapped(first, **settings).save(tmp_path / "m")
    poses = written(tmp_path / "corrected.tum", turned(first))
    done = sv.remap(tmp_path / "m", poses, tmp_path / "n")
    assert (done.posed, done.between, done.outside) == (len(first), 0, 0)
    assert done.report.moved == len(first)
    assert equal(sv.load_map(tmp_path / "n"), mapped(as_read(first, poses), **settings).snapshot()) or settings
    assert equal(sv.load_map(tmp_path / "n"), done.map)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["corrected.tum", "m", "n"]
    back = sv.remap(tmp_path / "n", written(tmp_path / "first.tum", first), tmp_path / "m")
    assert back.report.moved == len(first)


def test_tiles_of_a_remapped_map_are_those_of_a_new_run(tmp_path):
    settings = {"window.size": [3, 3, 2], "window.trigger": 0.2, "window.outside": "keep"}
    first = frames(each=30)
    mapped(first, **settings).save(tmp_path / "m")
    poses = written(tmp_path / "corrected.tum", turned(first))
    sv.remap(tmp_path / "m", poses, tmp_path / "n")
    mapped(as_read(first, poses), **settings).save(tmp_path / "new")
    assert equal(sv.load_map(tmp_path / "n"), sv.load_map(tmp_path / "new"))


def test_frames_between_move_as_their_neighbours_and_others_stay(tmp_path):
    first = frames()
    mapped(first).save(tmp_path / "m")
    chosen = turned([first[3], first[9]])
    poses = written(tmp_path / "few.tum", chosen)
    done = sv.remap(tmp_path / "m", poses, tmp_path / "n")
    assert (done.posed, done.between, done.outside) == (2, 5, len(first) - 7)
    read, wanted = as_read(chosen, poses), list(first)
    wanted[3], wanted[9] = read
    for n in range(4, 9):
        there = [
            T.T_world_sensor @ np.linalg.inv(f.T_world_sensor) @ first[n].T_world_sensor
            for T, f in zip(read, (first[3], first[9]), strict=True)
        ]
        share = (first[n].stamp_ns - first[3].stamp_ns) / (first[9].stamp_ns - first[3].stamp_ns)
        wanted[n] = replace(first[n], T_world_sensor=interpolate(*there, share))
    for kept, frame in zip(done.map.kept_frames.frames, wanted, strict=True):
        assert np.allclose(kept.T_world_sensor, frame.T_world_sensor, atol=1e-9)


def test_stamps_in_milliseconds_are_near_enough(tmp_path):
    first = [replace(frame, stamp_ns=frame.stamp_ns + 123_456) for frame in frames(each=4)]
    mapped(first).save(tmp_path / "m")
    lines = (f"{frame.stamp_ns / 1e9:.3f} 0.5 0 0 0 0 0 1" for frame in first)
    (tmp_path / "ms.tum").write_text("\n".join(lines))
    assert sv.remap(tmp_path / "m", tmp_path / "ms.tum", tmp_path / "n").posed == len(first)


def test_other_sensors_move_with_the_one_that_is_posed(tmp_path):
    both = sorted(frames(0, 8) + frames(1, 8), key=lambda frame: frame.stamp_ns)
    mapped(both).save(tmp_path / "m")
    shift = np.eye(4)
    shift[:3, 3] = 0.2, -0.1, 0.3
    of_one = [replace(f, T_world_sensor=shift @ f.T_world_sensor) for f in both if f.sensor == "camera 0"]
    poses = written(tmp_path / "one.tum", of_one)
    with pytest.raises(StereovoxError, match="'camera 0', 'camera 1'; say which one"):
        sv.remap(tmp_path / "m", poses, tmp_path / "n")
    with pytest.raises(StereovoxError, match="another name than 'left'"):
        sv.remap(tmp_path / "m", poses, tmp_path / "n", sensor="left")
    done = sv.remap(tmp_path / "m", poses, tmp_path / "n", sensor="camera 0")
    assert done.posed == len(of_one)
    assert done.outside == 1
    for kept, frame in list(zip(done.map.kept_frames.frames, both, strict=True))[:-1]:
        assert np.allclose(kept.T_world_sensor, shift @ frame.T_world_sensor, atol=2e-6)


def test_poses_of_a_levelled_map_are_turned_like_the_recording(tmp_path):
    first, up = frames(each=5), (0.0, -1.0, 0.0)
    mapped(first, levelled_from=up).save(tmp_path / "m")
    poses = written(tmp_path / "p.tum", first)
    done = sv.remap(tmp_path / "m", poses, tmp_path / "n")
    R = done.map.kept_frames.frames[0].T_world_sensor[:3, :3] @ first[0].T_world_sensor[:3, :3].T
    assert np.allclose(R @ up, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("", SourceError, "holds no pose"),
        ("12345 0 0 0 0 0 0 1", StereovoxError, "no pose has the stamp of a frame"),
        ("0 0 0 0 0 0 0 0\n0.1 0 0 0 0 0 0 1", FrameRefused, "p.tum:1"),
        ("0 0 0 0 nan 0 0 1", FrameRefused, "p.tum:1"),
        ("never 0 0 0 0 0 0 1", SourceError, "p.tum:1"),
    ],
)
def test_files_that_are_of_no_use_are_refused_in_one_line(tmp_path, text, error, said):
    mapped(frames(each=4)).save(tmp_path / "m")
    (tmp_path / "p.tum").write_text(text)
    with pytest.raises(error, match=said) as caught:
        sv.remap(tmp_path / "m", tmp_path / "p.tum", tmp_path / "n")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "n").exists()


def test_a_map_without_frames_is_refused(tmp_path):
    first = frames(each=4)
    mapped(first, **{"map.keep_frames": False}).save(tmp_path / "m")
    with pytest.raises(StereovoxError, match="did not keep its frames"):
        sv.remap(tmp_path / "m", written(tmp_path / "p.tum", first), tmp_path / "n")


def test_a_file_of_poses_that_is_not_there_is_said_to_be_none(tmp_path):
    mapped(frames(each=60)).save(tmp_path / "m")
    with pytest.raises(sv.StereovoxError, match=r"none\.tum: No such file or directory; give a readable file"):
        sv.remap(tmp_path / "m", tmp_path / "none.tum", tmp_path / "n")
