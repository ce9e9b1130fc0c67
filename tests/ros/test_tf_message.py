# SPDX-License-Identifier: Apache-2.0
"""/tf without `tf2_msgs`: the bytes, and that rclpy accepts the class as the package's own."""

from __future__ import annotations

import time

import numpy as np
import pytest
import wire

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from rclpy.executors import SingleThreadedExecutor  # noqa: E402

from stereovox.geometry.se3 import from_quaternion  # noqa: E402
from stereovox.ros.poses import tf_message as module  # noqa: E402

PATIENCE_S = 30.0
POSES = [
    ("map", "odom", from_quaternion((1.0, -2.0, 0.5), (0.0, 0.0, 0.6, 0.8))),
    ("a_much_longer_name", "b", from_quaternion((0.0, 0.0, 7.25), (0.5, 0.5, 0.5, 0.5))),
]


def by_rosbags(stamp_ns: int):
    return wire.packed(wire.messages().transforms(stamp_ns, POSES))


def test_the_bytes_are_those_of_another_writer():
    ours, theirs = module.packed_transforms(7_000_000_009, POSES), by_rosbags(7_000_000_009)
    kind = "tf2_msgs/msg/TFMessage"
    mine, other = (wire.store().deserialize_cdr(data, kind) for data in (ours, theirs))
    assert len(ours) == len(theirs)
    for one, two in zip(mine.transforms, other.transforms, strict=True):
        assert (one.header, one.child_frame_id) == (two.header, two.child_frame_id)
        np.testing.assert_allclose(numbers(one), numbers(two), atol=1e-12)


def numbers(one) -> list[float]:
    place, turn = one.transform.translation, one.transform.rotation
    return [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def test_the_hash_is_that_of_the_definition():
    assert wire.store().hash_rihs01("tf2_msgs/msg/TFMessage") == f"RIHS01_{module.HASH}"


@pytest.fixture
def made():
    if not module._structs_known():
        pytest.skip("rclpy is not that of the wheels of the extra ros2")
    return module._made()


def test_what_is_published_arrives_and_tells_the_type_of_the_package(made, monkeypatch, domains, capfd):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domains[1]))
    rclpy.init(args=[])
    node, came = rclpy.create_node("transforms"), []
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        node.create_subscription(made, "/tf", came.append, 10, raw=True)
        publisher = node.create_publisher(made, "/tf", 10)
        sent, end = module.packed_transforms(5, POSES), time.monotonic() + PATIENCE_S
        while not came:
            assert time.monotonic() < end, "nothing came"
            publisher.publish(sent)
            executor.spin_once(timeout_sec=0.1)
        assert came[0] == sent
        (told,) = node.get_publishers_info_by_topic("/tf")
        assert told.topic_type == "tf2_msgs/msg/TFMessage"
        assert str(told.topic_type_hash) == f"RIHS01_{module.HASH}"
        assert (
            described(node, executor)
            == wire.store().generate_msgdef("tf2_msgs/msg/TFMessage", ros_version=2)[0].splitlines()[0]
        )
    finally:
        node.destroy_node()
        rclpy.shutdown()
    assert "error state" not in capfd.readouterr().err


def described(node, executor) -> str:
    """The field of the message, by the node's type description service."""
    from type_description_interfaces.srv import GetTypeDescription

    client = node.create_client(GetTypeDescription, "/transforms/get_type_description")
    request = GetTypeDescription.Request(type_name="tf2_msgs/msg/TFMessage", type_hash=f"RIHS01_{module.HASH}")
    future, end = client.call_async(request), time.monotonic() + PATIENCE_S
    while not future.done():
        assert time.monotonic() < end, "no answer"
        executor.spin_once(timeout_sec=0.1)
    told = future.result().type_description
    assert len(told.referenced_type_descriptions) == 6
    (field,) = told.type_description.fields
    return f"{field.type.nested_type_name.replace('/msg/', '/')}[] {field.name}"


def test_other_wheels_have_no_stand_in(monkeypatch):
    monkeypatch.setattr(module, "VERSIONS", {**module.VERSIONS, "ros-rclpy": "0.0."})
    assert not module._structs_known()
    monkeypatch.setattr(module, "VERSIONS", {"no-such-wheel": ""})
    assert not module._structs_known()
