# SPDX-License-Identifier: Apache-2.0
"""A recording on the page: whatever way the timeline goes, the map is as of its frame."""

import threading
import time
from contextlib import closing
from dataclasses import replace

import made_along as made
import numpy as np
import pytest

import stereovox as sv
from stereovox.depth.cloud import checked_cloud
from stereovox.frame import Reason
from stereovox.viewer.frame import MAX_WIDTH_PX, REASON_COLOURS, Replay, cloud_picture, depth_picture, describe_frame
from stereovox.viewer.live import LiveView
from stereovox.viewer.viewer import open_viewer

SETTINGS = {"voxel_size": 0.1, "max_range": 4.0}
SOURCE = made.Along()


def mapped(number, **settings):
    """The map of the first frames, made in the plain way."""
    mapper = sv.Mapper(**SETTINGS, **settings)
    for i in range(number):
        mapper.add(SOURCE.frame(i))
    return mapper.map


def solid(viewer):
    return sorted(map(tuple, viewer.cells.solid.tolist()))


def occupied(voxel_map):
    return sorted(map(tuple, np.rint(voxel_map.occupied() / 0.1 - 0.5).astype(int).tolist()))


def test_a_depth_picture_tells_why_a_pixel_has_no_value():
    depth = np.array([[1.0, 3.0, np.nan, -np.inf, np.inf, np.nan]], np.float32)
    reasons = [Reason.VALID, Reason.VALID, Reason.UNMATCHED, Reason.TOO_NEAR, Reason.TOO_FAR, Reason.MASKED]
    image = sv.DepthImage(depth, np.array([reasons], np.uint8), made.CAMERA, np.eye(4))
    near, far, *others = depth_picture(image, 4.0)[0].astype(int)
    assert near[0] > near[2]
    assert far[2] > far[0]
    for colour, why in zip(others, reasons[2:], strict=True):
        assert "#" + bytes(colour.tolist()).hex() == REASON_COLOURS[why]


def test_a_picture_of_a_cloud_shows_what_is_nearest_all_round():
    points = np.array([[4.0, 0, 0], [2.0, 0, 0], [0, 3.0, 0], [0, 0, -1.0]])
    cloud = checked_cloud(sv.Cloud(points, np.eye(4)), sv.load_config())
    picture = cloud_picture(cloud, 4.0)
    seen = picture.any(axis=2)
    assert seen.sum() == 3
    ahead, left = picture[0, MAX_WIDTH_PX // 2], picture[0, MAX_WIDTH_PX // 4]
    assert ahead.any()
    assert left.any()
    assert (ahead != left).any()  # 2 m and 3 m
    assert describe_frame(sv.Cloud(points, np.eye(4), name="a/b"), None) == "b"


@pytest.mark.parametrize("window", [{}, {"window.size": [2.5, 2.5, 2.5]}])
def test_the_timeline_goes_to_any_frame(window):
    whole = mapped(made.FRAMES, **window)  # cells that left a window are seen again
    with closing(open_viewer(whole.snapshot(), port=0)) as viewer:
        assert len(whole.history.path.stops["camera"]) == made.FRAMES - 1
        replay = Replay(viewer, SOURCE, whole.config)
        assert len(occupied(mapped(3))) < len(occupied(mapped(8)))
        for number in (3, 8, 2, 7, 12, 1):
            replay.at.value = number
            assert solid(viewer) == occupied(mapped(number))
            camera = viewer.server.scene.get_handle_by_name("/camera")
            last = SOURCE.frame(number - 1).T_world_sensor[:3, 3]
            assert np.allclose(camera.position, last)
        images = []
        for number in (7, 8):
            replay.at.value = number
            images.append(replay.frame.image.image.copy())
        assert (images[0] != images[1]).any()
        replay.at.value = 6
        assert "frame 5" in replay.frame.text.content
        assert "no" in replay.frame.text.content


def test_playing_ends_with_the_last_frame():
    with closing(open_viewer(mapped(2).snapshot(), port=0)) as viewer:
        replay = Replay(viewer, SOURCE, sv.load_config(**SETTINGS))
        replay.at.value = 9
        replay.play.value = True
        until = time.monotonic() + 30
        while replay.play.value and time.monotonic() < until:
            time.sleep(0.02)
        assert (replay.at.value, replay.play.value) == (made.FRAMES, False)
        assert solid(viewer) == occupied(mapped(made.FRAMES))


def test_a_growing_map_is_copied_between_frames_and_shown():
    mapper = sv.Mapper(**SETTINGS)
    with LiveView(mapper, port=0) as live:
        assert not len(live.viewer.cells.solid)
        for i in range(6):
            report = live.add(SOURCE.frame(i))
            assert (report.refused is None) == (i != 5)
        live.finish()
        until = time.monotonic() + 30
        while solid(live.viewer) != occupied(mapper.map) and time.monotonic() < until:
            time.sleep(0.02)
        assert solid(live.viewer) == occupied(mapper.map) == occupied(mapped(6)) != []
        while "1 no" not in live.frame.text.content and time.monotonic() < until:
            time.sleep(0.02)
        assert "frames in the map | 5" in live.frame.text.content
        middle = mapper.map.occupied().mean(axis=0)  # whoever opens the page now looks at the map
        assert np.linalg.norm(live.viewer.server.initial_camera.look_at - middle) < 1
    assert "stereovox-live-view" not in {thread.name for thread in threading.enumerate()}


def test_what_is_no_frame_is_told_and_the_page_goes_on():
    mapper = sv.Mapper(**SETTINGS)
    with LiveView(mapper, port=0) as live:
        for offered in (None, replace(SOURCE.frame(0), name=5), SOURCE.frame(0)):
            live.finish()
            live._due = 0.0
            live.add(offered)
        live.finish()
        until = time.monotonic() + 30
        while solid(live.viewer) != occupied(mapper.map) and time.monotonic() < until:
            time.sleep(0.02)
        assert solid(live.viewer) == occupied(mapper.map)
        assert "2 bad" in live.frame.text.content


def test_a_snapshot_stays_as_it_was():
    mapper = sv.Mapper(**SETTINGS, **{"map.keep_times": True, "window.size": [3.0, 3.0, 3.0]})
    mapper.add(SOURCE.frame(0))
    copy = mapper.map.snapshot()
    cells, log_odds, ages, stops = *copy.cells(), copy.ages(0), copy.history.path.until()
    for one, other in zip(mapper.map.cells(), (cells, log_odds), strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(mapper.map.ages(0), ages)
    mapper.add(SOURCE.frame(4))
    assert len(mapper.map.cells()[0]) > len(cells)
    assert np.array_equal(copy.cells()[1], log_odds)
    assert len(copy.history.path.until()) == len(stops) == 1
