# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

from made_unposed import room

from stereovox.frame import UpdateReport
from stereovox.track.stream import LostSpans, TrackingGap


def spans(words, number=0):
    found = LostSpans(number)
    for k, why in enumerate(words):
        found.add(100 * k, why)
    return found


def test_frames_in_a_row_are_one_span_with_the_first_reason():
    found = spans(["", "dark", "bare", "", "", "dark"])
    assert found.spans == [TrackingGap(1, 2, 100, 200, "dark"), TrackingGap(5, 5, 500, 500, "dark")]
    assert (found.lost, found.frames) == (3, 6)


def test_numbers_go_on_where_a_run_does():
    assert spans(["dark", "dark"], 7).spans == [TrackingGap(7, 8, 0, 100, "dark")]


def test_a_span_is_one_line():
    assert TrackingGap(5, 5, 0, 0, "dark").line() == "lost in frame 5: dark"
    assert TrackingGap(5, 19, 10**9, 3 * 10**9, "dark").line() == "lost from frame 5 to 19 (2.0 s): dark"


def test_a_frame_without_a_pose_is_lost_and_one_that_the_map_refuses_is_not():
    found, (frame,) = LostSpans(), room(1)
    found.after(frame, UpdateReport(refused="too_few_pixels", detail="few"))
    found.after(replace(frame, fault="tracking_lost"), UpdateReport(refused="tracking_lost", detail="dark"))
    assert [(span.first, span.why) for span in found.spans] == [(1, "dark")]
