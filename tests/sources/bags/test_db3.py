# SPDX-License-Identifier: Apache-2.0
"""Recordings of pyrealsense2 itself: what it recorded from a software device is what comes out."""

from __future__ import annotations

import sys

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this Python", exc_type=ImportError)

from made_realsense import HEIGHT, UNIT, WIDTH, depth, record, stamp_ns  # noqa: E402

from stereovox.opening import open_source  # noqa: E402
from stereovox.sources.bags.recording import Bag  # noqa: E402


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return record(rs, tmp_path_factory.mktemp("db3") / "walk.db3", 6)


def played_back(path):
    """The slow reference: pyrealsense2 plays the file, not in real time, and waits until a frame is taken."""
    device = rs.context().load_device(str(path))
    device.as_playback().set_real_time(False)
    sensor = device.query_sensors()[0]
    queue = rs.frame_queue(100)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
    frames = {}
    while len(frames) < 6:
        arrived, frame = queue.try_wait_for_frame(5000)
        assert arrived
        frames[frame.get_frame_number()] = (np.array(frame.get_data()), frame.get_timestamp())
    sensor.stop()
    sensor.close()
    return [frames[k] for k in sorted(frames)]


def test_the_recorded_frames_come_out_in_any_order(recording):
    source = open_source(f"{recording}?pose=fixed")
    assert isinstance(source, Bag)
    assert len(source) == 6
    told = source.camera
    assert (told.width, told.height, told.fx, told.cx) == (WIDTH, HEIGHT, 24.0, 15.5)
    assert (told.cy, told.baseline) == (12.0, pytest.approx(0.05))
    for k in (4, 0, 5, 2, -1):
        frame = source.frame(k)
        k %= 6
        np.testing.assert_array_equal(frame.depth, depth(k))
        assert frame.stamp_ns == stamp_ns(k)
        assert frame.depth_scale == pytest.approx(UNIT)
        assert frame.fault is None


def test_the_same_as_pyrealsense2_plays_back(recording):
    for frame, (image, timestamp_ms) in zip(open_source(recording), played_back(recording), strict=True):
        np.testing.assert_array_equal(frame.depth, image)
        assert frame.stamp_ns == pytest.approx(timestamp_ms * 1e6, abs=1000)


def test_neither_pyrealsense2_nor_rosbags_is_needed(recording, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    np.testing.assert_array_equal(open_source(recording).frame(1).depth, depth(1))
