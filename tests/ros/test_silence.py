# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import pytest

from stereovox.ros.inputs import DepthInput
from stereovox.ros.subscriptions import AGAIN_S, FIRST_S, Silence

IMAGE, OTHER = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


class Node:
    """Stands for rclpy's: topics by name, with their types and how many publish them."""

    def __init__(self, topics):
        self.topics, self.said = topics, []

    def count_publishers(self, topic):
        return self.topics[topic][1]

    def get_topic_names_and_types(self):
        return [(name, [kind]) for name, (kind, _) in self.topics.items()]

    def get_logger(self):
        return self

    def warning(self, text):
        self.said.append(text)


@pytest.mark.parametrize(
    ("others", "publishers", "said"),
    [
        ({"/c/depth": (IMAGE, 1), "/c/info": (OTHER, 1), "/x": (IMAGE, 0)}, 0, "sensor_msgs/Image is on /c/depth"),
        ({"/c/info": (OTHER, 1)}, 0, "ROS_DOMAIN_ID"),
        ({}, 1, "large images need larger buffers"),
    ],
)
def test_a_topic_on_which_nothing_comes_is_told_with_what_there_is(others, publishers, said):
    node, now, received = Node({"/depht": (IMAGE, publishers), **others}), [0.0], Counter()
    silence = Silence(node, {"/depht": DepthInput("/depht")}, received, lambda: now[0])
    told = []
    for now[0] in (FIRST_S - 1, FIRST_S, FIRST_S + 1, FIRST_S + AGAIN_S):
        silence.update()
        told.append(len(node.said))
    assert told == [0, 1, 1, 2]
    assert node.said[0].startswith("no message on /depht: ")
    assert said in node.said[0]
    received["/depht"] += 1
    now[0] += AGAIN_S
    silence.update()
    assert len(node.said) == 2
