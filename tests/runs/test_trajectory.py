# SPDX-License-Identifier: Apache-2.0
"""A camera's trajectory from its own images, by one call."""

import numpy as np
import pytest
from made_unposed import ROOM, room, unposed

import stereovox as sv
from stereovox.errors import SourceError, StereovoxError
from stereovox.opening import Stream
from stereovox.runs.trajectory import _own_poses
from stereovox.sources.poses.trajectory import Trajectory
from stereovox.sources.rgbd.folder import DepthFolder


def test_the_poses_are_those_of_the_map_and_are_written(tmp_path):
    where, seen = unposed(tmp_path / "a", 6), []

    class Watch:
        def after(self, frame, report):
            seen.append(frame.T_world_sensor)

    sv.map_recording(where, tmp_path / "m.svox", observers=[Watch()])
    found = sv.track_recording(where, tmp_path / "way.tum")
    np.testing.assert_array_equal(found.T_world_sensor, seen)
    written = Trajectory(tmp_path / "way.tum")
    np.testing.assert_array_equal(written.stamps_ns, found.stamps_ns)
    np.testing.assert_allclose(written.T_world_body, found.T_world_sensor, atol=2e-6)
    assert found.tracked.all()
    assert np.isfinite(found.covariances).all()
    assert (found.covariances[0] == 0).all()
    true = np.array([frame.T_world_sensor[:3, 3] for frame in room(6)])
    assert found.length_m == pytest.approx(np.linalg.norm(np.diff(true, axis=0), axis=1).sum(), rel=0.05)
    assert found.score is None


def test_lost_frames_have_no_pose(tmp_path):
    found = sv.track_recording(unposed(tmp_path / "a", 8, covered=[1, 6]), tmp_path / "way.tum")
    np.testing.assert_array_equal(found.tracked, [False, False, True, True, True, True, False, False])
    assert np.isnan(found.T_world_sensor[~found.tracked]).all()
    assert np.isposinf(found.covariances[~found.tracked]).all()
    assert [(span.first, span.last) for span in found.lost] == [(0, 1), (6, 7)]
    assert len(Trajectory(tmp_path / "way.tum")) == len(found.poses()) == 4
    summary = found.summary()
    assert (summary["frames"], summary["tracked"], summary["frames_lost"]) == (8, 4, 4)
    assert [doubt["kind"] for doubt in summary["doubts"]] == ["tracking_lost"] * 2


@pytest.mark.parametrize("where", ["folder", "simulation", "stream"])
def test_poses_that_the_recording_has_are_compared_with_and_not_used(tmp_path, where):
    source = {
        "folder": lambda: unposed(tmp_path / "a", 8, poses=True),
        "simulation": lambda: ROOM,
        "stream": lambda: sv.open_source(ROOM, ":8"),
    }[where]()
    found = sv.track_recording(source, frames=":8" if isinstance(source, str) else None)
    assert found.score is not None
    assert len(found.score.pairs) == 8
    assert 0 < found.score.position_m.rmse < 0.01


def test_settings_and_notes(tmp_path):
    lines = []
    where = unposed(tmp_path / "a", 4)
    whole = sv.track_recording(where, notify=lines.append)
    near = sv.track_recording(where, max_range=2.0)
    assert not np.array_equal(whole.T_world_sensor, near.T_world_sensor)
    assert all(line.startswith("note: ") for line in lines)
    done = []
    sv.track_recording(where, frames="::2", progress=lambda *steps: done.append(steps))
    assert done == [(1, 2, "tracking"), (2, 2, "tracking")]


def test_pictures_that_are_not_used_are_told(tmp_path):
    lines, where = [], unposed(tmp_path / "a", 4)
    (where / "rgb").mkdir()
    for image in (where / "depth").iterdir():
        (where / "rgb" / image.name).write_bytes(b"no picture")
    sv.track_recording(where, notify=lines.append)
    sv.map_recording(where, tmp_path / "a.svox", poses="track", notify=lines.append)
    told = [line for line in lines if line.startswith("note: 4 of 4 pictures next to depth images are not used")]
    assert len(told) == 2


def test_what_is_wrong_is_one_line_and_leaves_the_file(tmp_path):
    (tmp_path / "way.tum").write_text("as it was")
    dark = unposed(tmp_path / "dark", 3, covered=range(3))
    for source, out, said in (
        (dark, "way.tum", "not one frame could be tracked; nothing is written"),
        (tmp_path / "nowhere", "way.tum", "no such folder"),
        (dark, "way.svox", r"way\.svox"),
    ):
        with pytest.raises(StereovoxError, match=said):
            sv.track_recording(source, tmp_path / out)
    assert (tmp_path / "way.tum").read_text() == "as it was"


class Falling(Stream):
    """A camera that falls silent."""

    name, camera = "live", room(1)[0].camera

    def __iter__(self):
        yield from room(4)
        raise SourceError("live: no frame for 5 s")


def test_what_was_tracked_before_a_failure_is_saved(tmp_path):
    lines = []
    with pytest.raises(SourceError, match="no frame for 5 s"):
        sv.track_recording(Falling(), tmp_path / "way.tum", notify=lines.append)
    assert len(Trajectory(tmp_path / "way.tum")) == 4
    assert lines == [f"stopped after 4 frames; their poses are saved in {tmp_path / 'way.tum'}"]


@pytest.mark.parametrize("frames", [None, "1:7:2"])
def test_the_recording_s_own_poses_are_read_without_its_images(tmp_path, monkeypatch, frames):
    where, read, plain = unposed(tmp_path / "a", 8, poses=True), [], DepthFolder.read

    def noted(self, i):
        read.append(i)
        return plain(self, i)

    monkeypatch.setattr(DepthFolder, "read", noted)
    source = sv.open_source(where, frames)
    looks, poses = len(read), [frame.T_world_sensor for frame in source]
    read.clear()
    np.testing.assert_array_equal(_own_poses(source), poses)
    assert (looks > 0, read) == (True, [])


def test_a_frame_without_a_pose_has_none_to_compare_with(tmp_path):
    where = unposed(tmp_path / "a", 8, poses=True)
    lines = (where / "groundtruth.txt").read_text().splitlines()
    (where / "groundtruth.txt").write_text("\n".join(lines[:-4]) + "\n")
    found = _own_poses(sv.open_source(where))
    expected = [frame.T_world_sensor for frame in sv.open_source(where)]
    assert np.isnan(found[-1]).all()
    np.testing.assert_array_equal(found, expected)
