# SPDX-License-Identifier: Apache-2.0
"""Frames with tracked poses: which are held back, which are lost, and that it is the same each time."""

from dataclasses import replace

import numpy as np
import pytest
from made_unposed import ROOM, room, unposed

from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.sources.base import Excerpt
from stereovox.track.stream import LOST, TrackedStream, follow
from stereovox.track.tracker import LEVEL, Tracked, Tracker

BEGUN, DARK = "the first image; poses count later", "dark"


class Script:
    """Says of one frame after another what it is told to."""

    def __init__(self, *said):
        self._said, self.seen, self.expected = list(said), [], []

    def add(self, frame):
        self.seen.append(frame)
        T = np.eye(4)
        T[0, 3] = len(self.seen)
        said = self._said.pop(0)
        return Tracked(T, np.eye(6), said, begins=said == BEGUN)

    def expect(self, frame):
        self.expected.append(frame)


def followed(*said, frames=None):
    """Fault and x of each frame that comes out."""
    found = [frame for frame, _ in follow(frames or room(len(said)), Script(*said))]
    return [(frame.fault, float(frame.T_world_sensor[0, 3])) for frame in found]


def lost(pairs):
    return [fault == LOST and bool(np.isnan(x)) for fault, x in pairs]


def test_the_first_image_has_the_start_pose_once_the_next_one_is_tracked():
    assert followed(BEGUN, "", "") == [(None, 1.0), (None, 2.0), (None, 3.0)]


def test_the_first_image_is_lost_where_the_next_one_is():
    assert lost(followed(BEGUN, DARK, "")) == [True, True, False]
    assert lost(followed(BEGUN, BEGUN, "")) == [True, False, False]
    assert lost(followed(BEGUN)) == [True]


def test_frames_come_in_order_and_none_is_missing():
    found = [frame for frame, _ in follow(room(4), Script(BEGUN, "", DARK, ""))]
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in room(4)]


def test_a_recording_s_next_frame_is_expected_before_each_is_tracked():
    script = Script(BEGUN, "", "", "")
    source = open_images(ROOM, ":4")
    found = list(TrackedStream(source, lambda: script))
    assert len(found) == len(script.seen) == 4
    assert [id(frame) for frame in script.expected] == [id(frame) for frame in script.seen[1:]]


def test_a_lost_frame_says_why_and_what_helps():
    (frame, tracked), *_ = follow(room(1), Script(DARK))
    assert (frame.fault, tracked.lost) == (LOST, DARK)
    assert frame.fault_detail == f"{frame.name}: dark; move slower, or back to what was seen before"


def test_frames_tell_how_well_their_pose_is_known():
    _, frame = (frame for frame, _ in follow(room(2), Script(BEGUN, "")))
    assert frame.pose_sigma == (1.0, 1.0)


def test_a_damaged_image_keeps_its_own_fault_and_is_not_tracked():
    damaged = replace(room(2)[1], fault="unreadable", fault_detail="b.png: cut off")
    tracker = Script(BEGUN, "")
    found = list(follow([room(2)[0], damaged, room(3)[2]], tracker))
    assert [frame.fault for frame, _ in found] == [LOST, "unreadable", None]
    assert found[1][1].lost == "b.png: cut off"
    assert len(tracker.seen) == 2


@pytest.mark.parametrize("fault", ["no_pose", "bad_pose_file", "low_confidence", "pose_jump"])
def test_poses_that_frames_bring_do_not_count(fault):
    frames = [replace(frame, fault=fault, fault_detail="no pose", pose_off_ns=9) for frame in room(2)]
    tracker = Script(BEGUN, "")
    found = [frame for frame, _ in follow(frames, tracker)]
    assert [(frame.fault, frame.fault_detail, frame.pose_off_ns) for frame in found] == [(None, "", 0)] * 2


def test_a_camera_is_stopped_when_the_consumer_stops():
    stopped = []

    def camera():
        try:
            yield from room(3)
        finally:
            stopped.append(True)

    found = follow(camera(), Script(BEGUN, "", ""))
    next(found)
    found.close()
    assert stopped


def test_a_good_recording_loses_nothing_and_is_where_it_should_be(tmp_path):
    source = TrackedStream(open_images(unposed(tmp_path)), Tracker)
    found = list(source)
    assert [frame.fault for frame in found] == [None] * 10
    np.testing.assert_array_equal(found[0].T_world_sensor, LEVEL)
    T_world_true = LEVEL @ np.linalg.inv(room(10)[0].T_world_sensor)
    for frame, true in zip(found, room(10), strict=True):
        assert np.linalg.norm((T_world_true @ true.T_world_sensor - frame.T_world_sensor)[:3, 3]) < 0.02
    assert (source.length, source.name) == (10, f"{tmp_path.name}, tracked")


def test_what_comes_after_some_frames_is_the_same_and_so_is_a_second_run(tmp_path):
    source = TrackedStream(open_images(unposed(tmp_path, 8, covered=[1])), Tracker)
    whole, rest = list(source), source.after(2).after(1)
    assert rest.length == 5
    assert [frame.fault for frame in whole] == [LOST, LOST, *[None] * 6]
    for frame, again in zip([*whole, *whole[3:]], [*source, *rest], strict=True):
        np.testing.assert_array_equal(frame.T_world_sensor, again.T_world_sensor)
        assert (frame.name, frame.fault) == (again.name, again.fault)
    with pytest.raises(SourceError, match="no more than 8 frames"):
        source.after(8)


def test_a_live_camera_has_no_past():
    live = TrackedStream(Excerpt(open_source(ROOM), ":2"), Tracker)
    assert live.length is None
    with pytest.raises(SourceError, match="begin a new one"):
        live.after(1)


def test_a_tracker_says_that_it_begins():
    assert Tracker().add(room(1)[0]).begins


def test_the_first_image_is_lost_for_the_reason_of_the_next():
    (_, first), *_ = follow(room(3), Script(BEGUN, DARK, ""))
    assert first.lost == DARK
