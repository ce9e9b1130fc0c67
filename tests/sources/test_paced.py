# SPDX-License-Identifier: Apache-2.0
"""Recordings that are played as if their camera were connected now."""

from time import monotonic, time_ns

import numpy as np

from stereovox.opening import open_camera, open_source
from stereovox.sources.paced import Paced

NAME = "sim:room?frames=4&image_width=32"


def test_frames_come_when_they_are_due_and_are_stamped_so():
    source = open_source(NAME)
    period_ns = source.frame(1).stamp_ns
    rate = period_ns / 50e6  # a frame each 50 ms
    began, before_ns = monotonic(), time_ns()
    arrivals = []
    frames = []
    for frame in Paced(source, rate):
        arrivals.append(monotonic() - began)
        frames.append(frame)
    assert all(at >= 0.05 * k for k, at in enumerate(arrivals))  # never too early
    assert np.diff([frame.stamp_ns for frame in frames]).tolist() == [50_000_000] * 3
    assert before_ns <= frames[0].stamp_ns <= time_ns()
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.depth, source.frame(k).depth)


def test_stamps_can_be_kept():
    source = open_source(NAME)
    assert [frame.stamp_ns for frame in Paced(source, 1e3, restamp=False)] == [
        source.frame(k).stamp_ns for k in range(4)
    ]


def test_a_recording_is_opened_as_a_camera_that_ends():
    camera = open_camera(NAME)
    assert isinstance(camera, Paced)
    assert camera.length is None
    assert camera.posed
