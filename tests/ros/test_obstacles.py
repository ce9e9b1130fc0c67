# SPDX-License-Identifier: Apache-2.0
"""Obstacles and free rays: what a costmap of Nav2 makes of them, by a twin of its obstacle layer."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_chain import floor

from stereovox.config import load_config
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.mapping import Mapping
from stereovox.ros.obstacles import Obstacles, free_ends, obstacle_points
from stereovox.ros.options import Options

SIDE = 0.05
PLACE = np.array([0.0, 0.0])
FREE, MARKED, UNTOUCHED = 0, 254, 255


def room() -> OccupancyGrid:
    """A free square of 6 m with walls around it, the robot in its middle, unknown cells at its feet."""
    cells = np.full((160, 160), -1, np.int8)
    cells[20:140, 20:140] = 0
    cells[[20, 139], 20:140] = 100
    cells[20:140, [20, 139]] = 100
    cells[72:88, 72:88] = -1
    return OccupancyGrid(cells, SIDE, (-4.0, -4.0, 0.0))


def with_box(grid: OccupancyGrid, value: int = 100) -> OccupancyGrid:
    cells = grid.cells.copy()
    cells[95:105, 110:116] = value
    return replace(grid, cells=cells)


class Costmap:
    """Nav2's ObstacleLayer: clears along Bresenham's line to each point, including the last cell, then marks."""

    def __init__(self):
        self.cells = np.full((160, 160), UNTOUCHED, np.uint8)

    def update(self, grid):
        for end in self._cells(free_ends(grid, PLACE, 5.0, 1.0)):
            count = int(np.abs(end - 80).max())
            steps = np.rint(80 + (end - 80) * np.arange(count + 1)[:, None] / max(count, 1)).astype(int)
            self.cells[tuple(steps.T)] = FREE
        self.cells[tuple(self._cells(obstacle_points(grid, PLACE, 5.0)).T)] = MARKED

    @staticmethod
    def _cells(points):
        return np.floor((points[:, ::-1] + 4.0) / SIDE).astype(int)


def test_what_is_gone_is_cleared_and_nothing_else():
    costmap = Costmap()
    costmap.update(with_box(room()))
    assert (costmap.cells[95:105, 110] == MARKED).all()
    behind = costmap.cells[103:111, 120:130]
    assert (behind == UNTOUCHED).mean() > 0.9  # its shadow is not called free
    costmap.update(room())
    assert not (costmap.cells[95:105, 110:116] == MARKED).any()
    free = room().cells == 0
    assert (costmap.cells[free] == FREE).mean() > 0.97
    assert (costmap.cells[20, 20:140] == MARKED).all()
    assert (costmap.cells[:19] == UNTOUCHED).all()


def test_a_cell_that_is_in_doubt_is_neither_marked_nor_cleared():
    costmap = Costmap()
    costmap.update(with_box(room()))
    costmap.update(with_box(room(), value=50))
    assert (costmap.cells[95:105, 110] == MARKED).all()


def test_rays_end_where_nothing_is_known():
    grid = room()
    cells = grid.cells.copy()
    cells[:, 100:] = -1
    ends = free_ends(replace(grid, cells=cells), PLACE, 5.0, 1.0)
    assert ends[:, 0].max() < 1.0  # columns from 100 on lie at x = 1 and beyond
    assert len(free_ends(grid, PLACE, 5.0, 0.0)) == 0  # it is unknown at its feet
    with pytest.raises(AssertionError):
        np.testing.assert_array_equal(free_ends(grid, PLACE, 5.0, 1.0), np.empty((0, 2)))


def test_a_map_that_is_turned_has_the_same_obstacles():
    grid = with_box(room())
    turned = replace(grid, origin=(4.0, -4.0, np.pi / 2))
    expected = obstacle_points(grid, PLACE, 2.5) @ np.array([[0, 1], [-1, 0]])
    np.testing.assert_allclose(obstacle_points(turned, PLACE, 2.5), expected, atol=1e-9)
    assert len(expected) == 60


@pytest.fixture
def published():
    pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    sent, heard, now = {}, [1], [0.0]

    def create_publisher(kind, topic, _):
        sent[topic] = []
        return SimpleNamespace(publish=sent[topic].append, get_subscription_count=lambda: heard[0])

    mapping = Mapping(load_config("ist2019"))
    for scan in floor().scans[:15]:
        mapping.add(scan)
    said = []
    logger = SimpleNamespace(error=lambda line, **_: said.append(line))
    node = SimpleNamespace(create_publisher=create_publisher, get_logger=lambda: logger)
    options = Options(obstacle_rate=5.0, obstacle_range=2.0)
    obstacles = Obstacles(node, mapping, options, clock=lambda: now[0])
    obstacles.said = said
    return sent, heard, now, mapping, obstacles


def test_nothing_is_published_while_one_of_several_sensors_is_silent(published, monkeypatch):
    sent, _, _, mapping, obstacles = published
    ages_s = {"front": 0.1, "back": 0.6}
    monkeypatch.setattr(mapping, "health", lambda: SimpleNamespace(ages_s=ages_s, state="current"))
    obstacles.seen(1, "map", np.eye(4))
    obstacles.update()
    assert sent["obstacles"] == sent["free_rays"] == []
    assert "frame of back is 0.60 s old" in obstacles.said[0]
    ages_s["back"] = 0.4
    obstacles.update()
    assert len(sent["obstacles"]) == len(sent["free_rays"]) == 1


def test_nothing_is_published_of_a_map_that_no_second_frame_has_confirmed(published, monkeypatch):
    sent, _, _, mapping, obstacles = published
    monkeypatch.setattr(mapping, "health", lambda: SimpleNamespace(ages_s={}, state="waiting", text="waiting: why"))
    obstacles.seen(1, "map", np.eye(4))
    obstacles.update()
    assert sent["obstacles"] == sent["free_rays"] == []
    assert "waiting: why" in obstacles.said[0]


def test_clouds_have_one_stamp_and_frame_and_come_with_frames_alone(published):
    sent, heard, now, mapping, obstacles = published
    obstacles.update()
    assert sent["obstacles"] == []  # no frame yet
    obstacles.seen(3_000_000_001, "map", np.eye(4))
    obstacles.update()
    (marks,), (rays,) = sent["obstacles"], sent["free_rays"]
    assert (marks.header.frame_id, marks.header.stamp.nanosec, marks.header) == ("map", 1, rays.header)
    points = np.frombuffer(marks.data, "<f4").reshape(-1, 3)
    expected = obstacle_points(mapping.grid(), PLACE, 2.0)
    assert len(expected) > 20
    np.testing.assert_allclose(points[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(points[:, 2], sum(mapping.config.scan.heights) / 2)
    now[0] = 1.0
    obstacles.update()
    assert len(sent["obstacles"]) == 1  # no frame since: who listens sees an old stamp
    obstacles.seen(4, "map", np.eye(4))
    heard[0] = 0
    obstacles.update()
    assert len(sent["obstacles"]) == 1
    heard[0] = 1
    obstacles.update()
    obstacles.seen(5, "map", np.eye(4))
    obstacles.update()
    assert len(sent["obstacles"]) == 2  # not more often than asked for
