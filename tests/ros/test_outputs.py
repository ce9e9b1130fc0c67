# SPDX-License-Identifier: Apache-2.0
"""Maps are published as often as they are wanted."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from stereovox.config import load_config
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.options import Options
from stereovox.ros.outputs import MAP, Outputs, cloud_message, occupancy_message


class Publisher:
    def __init__(self):
        self.sent, self.heard = [], 0

    def get_subscription_count(self) -> int:
        return self.heard

    def publish(self, message):
        self.sent.append(message)


@pytest.mark.parametrize(("heard", "expected"), [(1, (58, 61)), (0, (2, 4))])
def test_every_frame_has_its_map_while_somebody_listens(heard, expected):
    publishers: dict[str, Publisher] = {}
    node = SimpleNamespace(
        create_publisher=lambda kind, topic, qos: publishers.setdefault(topic, Publisher()),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0)),
        get_fully_qualified_name=lambda: "/stereovox",
        get_logger=lambda: SimpleNamespace(info=print),
    )
    grid = OccupancyGrid(np.zeros((3, 4), np.int8), 0.1)
    health = SimpleNamespace(state="current", text="current", as_dict=dict)
    asked: list[bool] = []
    mapping = SimpleNamespace(
        config=load_config(), grid=lambda last=False: asked.append(last) or grid, health=lambda: health,
        snapshot=lambda: None,
    )  # fmt: skip
    times = [100.0]
    outputs = Outputs(node, mapping, Options(map_rate=30.0), dict, lambda: times[0])
    publishers[MAP].heard = heard
    random = np.random.default_rng(0)
    for k in range(60):  # two seconds of a camera that is up to 3 ms late
        times[0] = 100.0 + k / 30 + random.uniform(0, 0.003)
        outputs.changed(k, "map")
        outputs.update()
    low, high = expected
    assert low <= len(publishers[MAP].sent) <= high
    assert len(publishers["/diagnostics"].sent) in (2, 3)
    outputs.close()
    assert publishers[MAP].sent[-1].header.stamp.nanosec == 59
    if heard == 0:  # a map is left over for the end, whose floor is found anew
        assert asked[-1]
    assert not any(asked[:-1])


def test_messages_carry_frame_and_time_and_clouds_only_occupied_cells():
    cells, log_odds = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]], [3.0, -3.0, -1.5, 3.0]  # the third is tentative
    cloud = cloud_message(VoxelMap.from_cells(load_config(voxel_size=0.1), cells, np.array(log_odds)), 7, "world")
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 4)
    np.testing.assert_allclose(sorted(points[:, 0]), [0.05, 0.95], atol=1e-6)
    np.testing.assert_allclose(points[:, 3], 1 / (1 + np.exp(-3)), atol=1e-3)
    grid = occupancy_message(OccupancyGrid(np.zeros((3, 4), np.int8), 0.1), 8, "hall")
    for message, frame, stamp in ((cloud, "world", 7), (grid, "hall", 8)):
        assert (message.header.frame_id, message.header.stamp.nanosec) == (frame, stamp)


def test_a_map_that_no_second_frame_has_confirmed_is_not_published(monkeypatch):
    publishers: dict[str, Publisher] = {}
    node = SimpleNamespace(
        create_publisher=lambda kind, topic, qos: publishers.setdefault(topic, Publisher()),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0)),
        get_fully_qualified_name=lambda: "/stereovox",
        get_logger=lambda: SimpleNamespace(info=print),
    )
    health = SimpleNamespace(state="waiting", text="waiting", as_dict=dict)
    grid = OccupancyGrid(np.zeros((3, 4), np.int8), 0.1)
    mapping = SimpleNamespace(
        config=load_config(), grid=lambda last: grid, health=lambda: health, snapshot=lambda: None
    )
    outputs = Outputs(node, mapping, Options(), dict, lambda: 100.0)
    outputs.changed(1, "map")
    outputs.update()
    assert not publishers[MAP].sent
    health.state = "current"
    outputs.update()
    assert len(publishers[MAP].sent) == 1
