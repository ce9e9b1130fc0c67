# SPDX-License-Identifier: Apache-2.0
"""The node's messages about the robot's motion: odometry and the transform."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from stereovox.ros.poses import location_topics
from stereovox.ros.poses.tracking import Moved
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import read_transforms

QUARTER = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
"""A quarter turn to the left about z, at (1, 2, 3)."""


def moved(rival: str = "") -> Moved:
    """Rotations of variances 1, 2, 3, positions of 4, 5, 6."""
    return Moved(7_000_000_009, "odom", "base_link", QUARTER, np.diag(np.arange(1.0, 7)), rival)


class Node:
    """Stands for rclpy's: keeps what is published and said."""

    def __init__(self):
        self.sent, self.said = {}, []

    def create_publisher(self, kind, topic, _):
        self.sent[topic] = []
        return SimpleNamespace(publish=self.sent[topic].append)

    def get_logger(self):
        return self

    def warning(self, text, **_):
        self.said.append(text)


def numbers(place, turn) -> list[float]:
    return [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def test_odometry_has_the_order_of_ros_and_no_speed():
    message = location_topics.odometry_message(moved())
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7, 9)
    pose = message.pose.pose
    half = math.sqrt(0.5)
    np.testing.assert_allclose(numbers(pose.position, pose.orientation), [1, 2, 3, 0, 0, half, half], atol=1e-12)
    np.testing.assert_array_equal(np.reshape(message.pose.covariance, (6, 6)), np.diag([4.0, 5, 6, 1, 2, 3]))
    assert min(np.reshape(message.twist.covariance, (6, 6)).diagonal()) >= 1e6


@pytest.fixture
def with_tf2(monkeypatch):
    """A class of messages is there; what is published are bytes."""
    monkeypatch.setattr(location_topics, "tf_message", lambda: SimpleNamespace)


def test_the_transform_is_that_of_the_odometry(with_tf2):
    node = Node()
    location_topics.MotionPublisher(node, with_tf=True).publish(moved())
    (data,) = node.sent["/tf"]
    (one,) = read_transforms(Wire(data, cdr=True))
    pose = node.sent["tracked_odometry"][0].pose.pose
    assert (one.stamp_ns, one.parent, one.child) == (7_000_000_009, "odom", "base_link")
    assert list(one.numbers) == numbers(pose.position, pose.orientation)


def test_a_transform_that_another_node_publishes_is_left_to_it(with_tf2):
    node = Node()
    location_topics.MotionPublisher(node, with_tf=True).publish(moved("wheels"))
    assert node.sent["/tf"] == []
    assert len(node.sent["tracked_odometry"]) == 1
    assert "wheels -> base_link" in node.said[0]


def test_without_tf2_msgs_or_where_it_is_not_wanted_there_is_odometry_alone(monkeypatch):
    monkeypatch.setattr(location_topics, "tf_message", lambda: None)
    node = Node()
    location_topics.MotionPublisher(node, with_tf=True).publish(moved())
    assert (list(node.sent), len(node.said)) == (["tracked_odometry"], 1)
    monkeypatch.setattr(location_topics, "tf_message", lambda: SimpleNamespace)
    node = Node()
    location_topics.MotionPublisher(node, with_tf=False).publish(moved())
    assert (list(node.sent), node.said) == (["tracked_odometry"], [])
