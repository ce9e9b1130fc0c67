# SPDX-License-Identifier: Apache-2.0
"""Messages of localisation: what AMCL of Nav2 publishes and listens to, and the error next to the map."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from made_chain import floor, reference

pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_scores import score_grids
from stereovox.ros.mapping import Mapping
from stereovox.ros.obstacles import Score
from stereovox.ros.options import Options
from stereovox.ros.poses import location_topics as topics
from stereovox.ros.poses.localization import LocalizedPoses, Localizer, Located, MapLocalization
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import read_transforms

POSE = np.array([1.5, -2.0, np.pi / 2])


class Node:
    """Stands for rclpy's: keeps what is published, offered and said."""

    def __init__(self):
        self.sent, self.said, self.heard, self.served = {}, [], {}, {}

    def create_publisher(self, kind, topic, _):
        self.sent[topic] = []
        return SimpleNamespace(publish=self.sent[topic].append, get_subscription_count=lambda: 1)

    def create_subscription(self, kind, topic, callback, _):
        self.heard[topic] = callback

    def create_service(self, kind, name, callback):
        self.served[name] = callback

    def get_logger(self):
        return self

    def warning(self, text, **_):
        self.said.append(text)

    info = warning


def located(settled=True, moved=True) -> Located:
    covariance = np.diag([0.01, 0.02, 0.03])
    return Located(7_000_000_009, POSE, np.array([0.5, 0.0, 0.0]), covariance, np.tile(POSE, (5, 1)), moved, settled)


def test_pose_and_particles_have_the_fields_of_ros():
    message = topics.pose_message(located(), "map")
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == ("map", 7, 9)
    pose, std = topics.pose_of_message(message)
    np.testing.assert_allclose(pose, POSE, atol=1e-12)
    np.testing.assert_allclose(std, np.sqrt([0.01, 0.02, 0.03]))
    assert np.reshape(message.pose.covariance, (6, 6))[5, 5] == 0.03
    assert len(topics.particles_message(located(), "map").poses) == 5


@pytest.fixture
def out(monkeypatch):
    monkeypatch.setattr("stereovox.ros.poses.location_topics.tf_message", lambda: SimpleNamespace)
    node, poses = Node(), LocalizedPoses("map", "", 0.1, "odom")
    return node, poses, topics.LocationTopics(node, poses, Options(tf_tolerance_s=0.25))


def test_the_transform_is_dated_ahead_and_known_again(out):
    node, poses, published = out
    published.publish(located())
    (data,) = node.sent["/tf"]
    (one,) = read_transforms(Wire(data, cdr=True))
    assert (one.stamp_ns, one.parent, one.child) == (7_250_000_009, "map", "odom")
    assert one.numbers[:2] == (0.5, 0.0)
    poses.on_tf(data, fixed=False)
    assert not poses.rival
    assert (len(node.sent["amcl_pose"]), len(node.sent["particlecloud"])) == (1, 1)


def test_nothing_is_said_on_tf_while_the_place_is_not_sure_or_others_say_it(out):
    node, poses, published = out
    published.publish(located(settled=False))
    poses.rival = True
    published.publish(located())
    published.publish(located(moved=False))
    assert node.sent["/tf"] == []
    assert len(node.sent["amcl_pose"]) == 2
    assert "another node publishes map -> odom" in node.said[0]


@pytest.fixture
def placing():
    node, poses = Node(), LocalizedPoses("map", "", 0.1, "odom")
    localization = MapLocalization(reference(), load_config("ist2019"))
    localizer = Localizer(localization, poses, lambda found: None)
    topics.InitialPose(node, localizer, localization)
    return node, localizer


def test_an_initial_pose_places_the_robot(placing):
    node, localizer = placing
    start = located()._replace(pose_map_base=np.zeros(3), covariance=np.diag([0.01, 0.01, 0.0025]))
    node.heard["initialpose"](topics.pose_message(start, "map"))
    found = localizer.locate(floor().scans[0])
    assert found.settled
    assert np.hypot(*found.pose_map_base[:2]) < 0.2
    node.served["reinitialize_global_localization"](None, None)
    assert not localizer.locate(floor().scans[1]).settled
    assert "may be anywhere" in node.said[-1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frame": "odom"}, "in frame 'odom'; send it in 'map'"),
        ({"x": 500.0}, "outside of the map"),
        ({"x": np.nan}, "its pose is invalid"),
        ({"w": 5.0}, "its pose is invalid"),
        ({"variance": -1.0}, "send finite ones"),
        ({"variance": np.inf}, "send finite ones"),
    ],
)
def test_initial_poses_that_are_none_are_ignored_and_told(placing, change, said):
    node, localizer = placing
    before = localizer.localization._localiser
    message = topics.pose_message(located(), change.get("frame", "map"))
    message.pose.pose.position.x = change.get("x", 0.0)
    message.pose.pose.orientation.w = change.get("w", message.pose.pose.orientation.w)
    covariance = message.pose.covariance.copy()
    covariance[0] = change.get("variance", 0.1)
    message.pose.covariance = covariance
    node.heard["initialpose"](message)
    assert said in node.said[-1]
    assert localizer.localization._localiser is before


def test_the_error_is_that_of_eval_and_follows_the_map():
    node, now = Node(), [0.0]
    mapping = Mapping(load_config("ist2019"))
    score = Score(node, mapping, reference(), clock=lambda: now[0])
    score.update()
    assert node.sent["map_error"] == []  # there is no map yet
    assert score.final() == {}
    for i, scan in enumerate(floor().scans[:20]):
        mapping.add(scan)
        now[0] = float(i)
        score.update()
    list(score._work.rest())
    found = score.final()
    expected = score_grids(mapping.grid(), reference(), align=False).eq7_percent
    assert found["eq7_percent"] == pytest.approx(expected)
    assert found["eq7_coverage_percent"] + found["eq7_contradiction_percent"] == pytest.approx(expected)
    assert node.sent["map_error"][-1].data == pytest.approx(expected, rel=1e-6)
    assert len(node.sent["map_error"]) > 1
    assert score.counts() == found


def test_regions_that_do_not_count_are_left_out():
    mapping = Mapping(load_config("ist2019"))
    for scan in floor().scans[:20]:
        mapping.add(scan)
    whole, half = (Score(Node(), mapping, reference(), exclude).final() for exclude in ((), [(0, -50, 50, 50)]))
    assert half["eq7_percent"] < whole["eq7_percent"]


def test_a_reference_without_known_cells_is_told_once_and_stops_nothing():
    from dataclasses import replace

    empty = replace(reference(), cells=np.full_like(reference().cells, -1))
    node, mapping = Node(), Mapping(load_config("ist2019"))
    mapping.add(floor().scans[0])
    with pytest.raises(StereovoxError):
        score_grids(mapping.grid(), empty, align=False)
    assert Score(node, mapping, empty).final() == {}
    assert "no score" in node.said[-1]
