# SPDX-License-Identifier: Apache-2.0
"""Maps with tracked poses: like those with given ones, without lost frames, the same after a resume."""

from threading import current_thread

import numpy as np
import pytest
from made_unposed import ROOM, room, unposed

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.mapping import deadline
from stereovox.opening import Stream
from stereovox.runs.survey import level_start
from stereovox.track.tracker import Tracker

CELLS = {"voxel_size": 0.1}


def true_start():
    return room(1)[0].T_world_sensor


class Stop:
    """Ends the run after some frames."""

    def __init__(self, frames):
        self._left = frames

    def after(self, frame, report):
        self._left -= 1
        if not self._left:
            raise KeyboardInterrupt


def mapped(where, out, **options):
    lines = []
    return sv.map_recording(where, out, notify=lines.append, **{**CELLS, **options}), lines


def same_cells(a, b):
    for mine, theirs in zip(a.cells(), b.cells(), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_on_two_threads_the_next_frame_is_tracked_while_one_is_prepared_and_the_map_is_the_same(tmp_path, monkeypatch):
    prepared_by, plain = [], deadline.prepared

    def prepare(*given):
        prepared_by.append(current_thread())
        return plain(*given)

    monkeypatch.setattr(deadline, "prepared", prepare)
    where = unposed(tmp_path / "a", covered=[5])
    one, two = (mapped(where, tmp_path / f"{n}.svox", threads=n)[0] for n in (1, 2))
    same_cells(one.map, two.map)
    assert [report.refused for report in one.reports] == [report.refused for report in two.reports]
    background = [thread for thread in prepared_by if thread is not current_thread()]
    assert len(background) >= two.map.frames - 1


def test_a_folder_without_poses_gives_the_map_that_it_gives_with_them(tmp_path):
    found, lines = mapped(unposed(tmp_path / "a"), tmp_path / "a.svox")
    given, said = mapped(unposed(tmp_path / "b", poses=True), tmp_path / "b.svox")
    assert (found.poses, found.lost, found.map.frames, given.poses) == ("track", [], 10, "given")
    assert [line for line in lines if "tracked by visual odometry" in line and "no poses" in line]
    assert not [line for line in said if "tracked" in line]
    T = true_start() @ np.linalg.inv(level_start(sv.open_source(ROOM), found.map.config))
    walls = found.map.occupied() @ T[:3, :3].T + T[:3, 3]
    near = given.map.nearest_obstacle(walls).distance
    assert np.mean(near <= 0.1) > 0.95
    assert len(walls) == pytest.approx(len(given.map.occupied()), rel=0.2)
    assert (
        np.mean(given.map.nearest_obstacle(walls + np.array([0.5, 0.3, 0.4])).distance <= 0.1) < 0.6
    )  # elsewhere they are not


def test_lost_frames_are_refused_and_reported_and_not_mapped(tmp_path):
    found, _ = mapped(unposed(tmp_path / "a", 14, covered=[4, 5]), tmp_path / "a.svox")
    (span,) = found.lost
    lost = found.reports[span.first : span.last + 1]
    assert (span.first, span.last >= 5) == (4, True)
    assert {report.refused for report in lost} == {"tracking_lost"}
    assert sum(report.cells for report in lost) == 0
    assert found.map.history.refused == {"tracking_lost": len(span)}
    assert found.map.frames == 14 - len(span)
    assert found.summary()["lost"] == [span.as_dict()]
    whole = unposed(tmp_path / "b", 14, covered=[4, 5])
    for file in sorted((whole / "depth").iterdir())[span.last + 1 :]:
        file.unlink()
    before, _ = mapped(whole, tmp_path / "b.svox", frames=f":{span.last + 1}")
    first, _ = mapped(unposed(tmp_path / "c", 4), tmp_path / "c.svox")
    same_cells(before.map, first.map)


@pytest.mark.parametrize("stop", [1, 5, 11])
def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path, stop):
    where, out = unposed(tmp_path / "a", 12, covered=[7]), tmp_path / "m.svox"
    whole, _ = mapped(where, tmp_path / "whole.svox")
    with pytest.raises(KeyboardInterrupt):
        mapped(where, out, observers=[Stop(stop)])
    rest, lines = mapped(where, out, resume=True)
    assert f"continuing after frame {stop}" in lines
    same_cells(whole.map, rest.map)
    assert [(span.first, span.last) for span in rest.lost] == [
        (max(span.first, stop), span.last) for span in whole.lost if span.last >= stop
    ]


def test_what_could_not_be_used_is_told_when_a_run_goes_on_too(tmp_path, monkeypatch):
    monkeypatch.setattr(Tracker, "picture_use", lambda tracker: "no picture is used")
    where, out = unposed(tmp_path / "a", 4), tmp_path / "m.svox"
    with pytest.raises(KeyboardInterrupt):
        mapped(where, out, observers=[Stop(2)])
    _, lines = mapped(where, out, resume=True)
    assert "note: no picture is used" in lines


def test_a_map_goes_on_with_the_poses_it_was_begun_with(tmp_path):
    where = unposed(tmp_path / "a", 6, poses=True)
    mapped(where, tmp_path / "m.svox", poses="track", frames=":3")
    rest, _ = mapped(where, tmp_path / "m.svox", resume=True)
    whole, _ = mapped(where, tmp_path / "n.svox", poses="track")
    assert rest.poses == "track"
    same_cells(whole.map, rest.map)
    with pytest.raises(StereovoxError, match=r"was made of 'a, tracked', not of 'a'"):
        mapped(where, tmp_path / "m.svox", resume=True, poses="given")


def test_what_cannot_be_had_is_one_line(tmp_path):
    where = unposed(tmp_path / "a", 4)
    with pytest.raises(StereovoxError, match="no poses; write poses"):
        mapped(where, tmp_path / "m.svox", poses="given")
    with pytest.raises(StereovoxError, match=r"^level: a map with tracked poses"):
        mapped(where, tmp_path / "m.svox", level=True)
    dark = unposed(tmp_path / "b", 4, covered=range(4))
    with pytest.raises(StereovoxError, match=r"not one frame could be used, so no map is written \(.*move slower"):
        mapped(dark, tmp_path / "m.svox")
    assert not (tmp_path / "m.svox").exists()


class Live(Stream):
    """A camera that sends the room without poses."""

    name, posed = "live", False

    @property
    def camera(self):
        return room(1)[0].camera

    def __iter__(self):
        yield from room(6)


def test_a_live_camera_is_tracked_and_its_map_cannot_go_on(tmp_path):
    found, lines = mapped(Live(), tmp_path / "m.svox")
    assert (found.poses, found.map.frames) == ("track", 6)
    assert [line for line in lines if "?pose=fixed" in line]
    with pytest.raises(StereovoxError, match="begin a new one"):
        mapped(Live(), tmp_path / "m.svox", resume=True)


@pytest.mark.parametrize(("up", "axis"), [("z", [0, 0, 1]), ("-y", [0, -1, 0]), ("x", [1, 0, 0])])
def test_what_is_level_in_the_first_image_is_level_in_the_map(tmp_path, up, axis):
    config = sv.load_config(up=up)
    T = level_start(sv.open_source(unposed(tmp_path, 2, poses=True)), config)
    upwards = T[:3, :3] @ true_start()[:3, :3].T @ [0, 0, 1]
    assert np.degrees(np.arccos(upwards @ axis)) < 1
    assert not T[:3, 3].any()
    pitch = np.degrees(np.arcsin(-true_start()[2, 2]))
    assert pitch > 5  # the camera looks down, so that this says something


def test_without_an_image_the_camera_is_level(tmp_path):
    T = level_start(sv.open_source(unposed(tmp_path, 2, covered=[0, 1], poses=True)), sv.load_config())
    np.testing.assert_array_equal(T[:3, :3] @ [0, -1, 0], [0, 0, 1])
    np.testing.assert_array_equal(level_start(Live(), sv.load_config()), T)


def test_given_poses_are_corrected_in_their_own_world(tmp_path):
    where, out = unposed(tmp_path / "a", 8, poses=True), tmp_path / "m.svox"
    given, _ = mapped(where, tmp_path / "g.svox")
    found, _ = mapped(where, tmp_path / "b.svox", poses="both")
    assert (found.poses, found.lost, found.map.frames, found.map.recording) == ("both", [], 8, "a, corrected")
    near = given.map.nearest_obstacle(found.map.occupied()).distance
    assert np.mean(near <= 0.1) > 0.95
    mapped(where, out, poses="both", frames=":3")
    rest, _ = mapped(where, out, resume=True)
    assert rest.poses == "both"
    same_cells(found.map, rest.map)
    with pytest.raises(StereovoxError, match="no poses; write poses"):
        mapped(unposed(tmp_path / "c", 2), tmp_path / "c.svox", poses="both")
