# SPDX-License-Identifier: Apache-2.0
"""Loops of a map are remembered by it, as lines between their places, until poses are corrected otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from made_robot_bags import RobotBagMaker

import stereovox as sv
from stereovox.cli.correct.loops import say_closure
from stereovox.correct.close_loops import close
from stereovox.correct.loops.closer import Loop, LoopCloser
from stereovox.correct.loops.drift import Positions
from stereovox.correct.loops.submaps import Match
from stereovox.maps.record.camera_path import LoopLines
from stereovox.products.moved import moved
from stereovox.sources.poses.trajectory import Trajectory, write_trajectory

MATCH = Match(np.eye(4), np.eye(6), 0.9, True)
SHIFT_M = 0.2


class MadeCloser(LoopCloser):
    """Closes a loop between the first and the last place, which moves all frames, and refuses one."""

    def finish(self, progress=lambda done, total: None, positions=None):
        super().finish(progress, positions)
        last = len(self.submaps) - 1
        self.loops, self.refused = [Loop(0, last, MATCH, 0.5, 0.0)], [Loop(0, 1, MATCH, 2.0, 0.0, "no")]
        for submap in self.submaps:
            submap.T_map_anchor = submap.T_map_anchor.copy()
            submap.T_map_anchor[1, 3] += SHIFT_M


@pytest.fixture(scope="module")
def frames():
    return list(sv.open_source("sim:room?image_width=96", frames="::8"))


@pytest.fixture
def mapper(frames):
    """Of a map with frames and several places."""
    mapper = sv.Mapper(voxel_size=0.2, **{"map.keep_frames": True, "trust.max_disagreement": 1})
    for frame in frames:
        assert mapper.add(frame).refused is None
    return mapper


@pytest.fixture
def closure(mapper, monkeypatch):
    """What was done to the map of `mapper`."""
    monkeypatch.setattr("stereovox.correct.close_loops.LoopCloser", MadeCloser)
    return close(mapper)


def test_places_are_those_of_the_middles_of_submaps(frames, closure):
    assert len(closure.places) == len(closure.anchors) > 2
    assert (np.diff(closure.anchors) > 0).all()
    before = np.array([frame.T_world_sensor[:3, 3] for frame in frames])[closure.anchors]
    np.testing.assert_allclose(closure.places, before + np.array([0, SHIFT_M, 0]), atol=1e-6)
    np.testing.assert_allclose(closure.ends(closure.loops, closure.T_world_before), [before[[0, -1]]], atol=1e-9)
    assert closure.ends([], closure.T_world_before).shape == (0, 2, 3)


def test_the_map_remembers_its_loops(mapper, closure, tmp_path):
    mapper.save(tmp_path / "closed.svox")
    loops = sv.load_map(tmp_path / "closed.svox").history.loops
    assert loops == closure.lines
    assert loops.counts() == {"closed": 1, "refused": 1}
    np.testing.assert_allclose(loops.closed.ends, [closure.places[[0, -1]]], atol=1e-5)
    np.testing.assert_allclose(loops.refused.ends, [closure.places[[0, 1]]], atol=1e-5)


def test_parts_and_moved_maps_remember_them_too(mapper, closure):
    voxel_map = mapper.map
    assert voxel_map.history.loops == closure.lines
    assert sv.crop(voxel_map, [-1, -1, -1], [1, 1, 1]).history.loops == voxel_map.history.loops
    T = np.eye(4)
    T[0, 3] = 2.0
    there = moved(voxel_map, T).history.loops
    np.testing.assert_allclose(there.closed.ends, voxel_map.history.loops.closed.ends + T[:3, 3], atol=1e-5)


def test_other_poses_and_merging_forget_them(mapper, closure):
    assert mapper.map.history.loops == closure.lines
    assert sv.merge(mapper.map, mapper.map).history.loops is None
    frame = mapper.map.kept_frames.frames[-1]
    mapper.correct({frame.stamp_ns: mapper.map.kept_frames.frames[-2].T_world_sensor})
    assert mapper.map.history.loops is None


def test_a_map_without_loops_says_that_none_were_found(mapper):
    assert mapper.map.history.loops is None
    closure = close(mapper)
    assert not closure.loops
    assert mapper.map.history.loops == LoopLines.between([], closure.ends(closure.refused, closure.T_world_sensor))


def test_a_recording_is_mapped_and_closed_and_not_gone_on_with(tmp_path, monkeypatch):
    monkeypatch.setattr("stereovox.correct.close_loops.LoopCloser", MadeCloser)
    out, settings = tmp_path / "room.svox", {"voxel_size": 0.2, "trust.max_disagreement": 1}
    made = sv.map_recording("sim:room?image_width=96", out, frames="::8", close_loops=True, **settings)
    saved = sv.load_map(out)
    assert saved.history.loops == made.loops.lines
    np.testing.assert_allclose(
        [frame.T_world_sensor for frame in saved.kept_frames.frames], made.loops.T_world_sensor, atol=1e-9
    )
    with pytest.raises(sv.StereovoxError, match="its poses were corrected"):
        sv.map_recording("sim:room?image_width=96", out, frames="::8", close_loops=True, resume=True, **settings)


def test_a_recording_without_loops_remembers_that_they_were_sought(tmp_path):
    out = tmp_path / "room.svox"
    made = sv.map_recording("sim:room?image_width=96", out, frames="::8", close_loops=True, voxel_size=0.2)
    assert not made.loops.loops
    assert sv.load_map(out).history.loops == made.loops.lines


def test_merged_recordings_are_no_single_way(mapper, tmp_path):
    sv.merge(mapper.map, mapper.map).save(tmp_path / "both")
    with pytest.raises(sv.StereovoxError, match="merged of 2 recordings"):
        sv.close_loops(tmp_path / "both", tmp_path / "closed")
    with pytest.raises(sv.StereovoxError, match="merged of 2 recordings"):
        sv.join(mapper.map, sv.load_map(tmp_path / "both"))


@pytest.mark.parametrize("budget", [None, 100_000])
def test_frames_that_come_while_loops_are_sought_move_as_the_last_one(frames, mapper, monkeypatch, budget):
    """Also where a budget drops others for them."""
    before = len(mapper.map.kept_frames)
    mapper.map.kept_frames.budget = budget
    T_world_sensor = frames[-1].T_world_sensor.copy()
    T_world_sensor[0, 3] += 2.0  # far enough to be kept
    later = replace(frames[-2], stamp_ns=frames[-1].stamp_ns + 10**9, T_world_sensor=T_world_sensor)

    class Meanwhile(MadeCloser):
        def finish(self, progress=lambda done, total: None, positions=None):
            assert mapper.add(later).refused is None
            super().finish(progress, positions)

    monkeypatch.setattr("stereovox.correct.close_loops.LoopCloser", Meanwhile)
    close(mapper)
    last = mapper.map.kept_frames.frames[-1]
    assert (len(mapper.map.kept_frames) <= before) == (budget is not None)
    assert last.stamp_ns == later.stamp_ns
    np.testing.assert_allclose(last.T_world_sensor[:3, 3] - later.T_world_sensor[:3, 3], [0, SHIFT_M, 0], atol=1e-6)


def test_too_few_positions_are_told_before_any_work(mapper, monkeypatch):
    monkeypatch.delattr(LoopCloser, "add")
    stamps_ns = np.array([frame.stamp_ns for frame in mapper.map.kept_frames.frames[:2]])
    with pytest.raises(sv.StereovoxError, match="2 places of the path have a position"):
        close(mapper, positions=Positions(stamps_ns, np.zeros((2, 3)), 1.0))


def test_what_the_closed_map_is_made_of_is_said(closure, capsys):
    say_closure(closure)
    assert "frames_budget" not in "".join(capsys.readouterr())
    say_closure(replace(closure, report=replace(closure.report, all_frames=False)))
    assert "only 30 frames were kept (map.frames_budget)" in "".join(capsys.readouterr())


def test_that_places_alike_may_be_mistaken_is_said_where_poses_were_far_off(closure, capsys):
    (loop, *_) = closure.loops
    for off_m, said in ((1.0, False), (4.0, True)):
        say_closure(replace(closure, loops=[replace(loop, off_m=off_m)]))
        assert ("may have been confused" in "".join(capsys.readouterr())) == said


def test_loops_are_sought_with_other_drift_than_the_map_was_made_with(mapper, tmp_path):
    mapper.save(tmp_path / "a.svox")
    closed = sv.close_loops(tmp_path / "a.svox", tmp_path / "b.svox", **{"loops.drift": 0.05})
    assert closed.map.config.loops.drift == 0.05
    assert len(sv.load_map(tmp_path / "b.svox").kept_frames) == len(mapper.map.kept_frames)
    with pytest.raises(sv.StereovoxError, match="was made with max_range"):
        sv.close_loops(tmp_path / "a.svox", tmp_path / "b.svox", max_range=2.0)


def test_loops_are_not_closed_without_frames(mapper, tmp_path):
    with pytest.raises(sv.StereovoxError, match="keep_frames=false: loops are closed by the frames"):
        sv.map_recording("sim:room", tmp_path / "room.svox", close_loops=True, **{"map.keep_frames": False})
    mapper.save(tmp_path / "a.svox")
    with pytest.raises(sv.StereovoxError, match="keep_frames=false: loops are closed by the frames"):
        sv.close_loops(tmp_path / "a.svox", tmp_path / "b.svox", **{"map.keep_frames": False})


def test_loops_are_closed_of_as_many_frames_as_may_be_kept(tmp_path):
    settings = {"map.frames_budget": "2 MB", "voxel_size": 0.2}
    made = sv.map_recording("sim:room?image_width=96", tmp_path / "r.svox", frames="::16", close_loops=True, **settings)
    assert made.map.config.map.frames_budget == 2_000_000


def test_a_second_odometry_and_fixes_of_a_bag_hold_the_way(tmp_path):
    """The walk stretched by a tenth: wheels and a receiver know how long it was."""
    out, settings = tmp_path / "room.svox", {"voxel_size": 0.2, "trust.max_disagreement": 1, "map.keep_frames": True}
    frames = list(sv.open_source("sim:room?image_width=96", frames="::8"))
    mapper = sv.Mapper(**settings)
    for frame in frames:
        stretched = frame.T_world_sensor.copy()
        stretched[:3, 3] *= 1.1
        mapper.add(replace(frame, T_world_sensor=stretched))
    mapper.save(out)
    stamps, poses = [frame.stamp_ns for frame in frames], np.array([frame.T_world_sensor for frame in frames])
    write_trajectory(tmp_path / "wheels.tum", stamps, poses, "camera")
    wheels = {"odometry": tmp_path / "wheels.tum", "loops.odometry_drift": 1e-3, "loops.drift": 0.1}
    closed = sv.close_loops(out, tmp_path / "w.svox", **wheels)
    assert closed.closure.odometry.used > 3
    assert closed.closure.summary()["odometry"] == {"used": closed.closure.odometry.used, "contradicted": 0}
    assert length(closed.closure.T_world_sensor) == pytest.approx(length(poses), rel=0.02)
    with RobotBagMaker(tmp_path / "drive.bag") as made:
        for stamp_ns, (x, y, z) in zip(stamps, poses[:, :3, 3], strict=True):
            made.fix(stamp_ns, 47 + y / 111_178, 8 + x / 76_061, 400 + z)
    positions = {"positions": tmp_path / "drive.bag", "positions_sigma": 0.02, "loops.drift": 0.1}
    closed = sv.close_loops(out, tmp_path / "p.svox", **positions)
    assert closed.closure.summary()["positions"]["used"] > 3
    assert length(closed.closure.T_world_sensor) == pytest.approx(length(poses), rel=0.03)


def length(poses):
    return np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()


def test_the_trajectory_of_a_rig_is_that_of_one_camera(frames, closure, tmp_path):
    """Poses of several would be taken for one way by whoever reads them, `remap` too."""
    second = np.arange(len(frames)) % 2 == 1
    rig = replace(closure, sensors=["rear" if one else "front" for one in second])
    rig.save(tmp_path / "way.tum")
    written = Trajectory(tmp_path / "way.tum")
    assert written.stamps_ns.tolist() == closure.stamps_ns[~second].tolist()
    np.testing.assert_allclose(written.T_world_body, closure.T_world_sensor[~second], atol=1e-5)
    assert list(closure.sensors) == ["camera"] * len(frames)
    closure.save(tmp_path / "all.tum")
    assert len(Trajectory(tmp_path / "all.tum")) == len(frames)
