# SPDX-License-Identifier: Apache-2.0
"""Topics on which nothing comes: a name with a slip in it is heard for ever, and ROS says nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from stereovox.ros.inputs import Input

FIRST_S, AGAIN_S = 5.0, 30.0
"""Seconds after which it is told, and told again."""


class Silence:
    """Warns of topics on which nothing has come yet. received: messages so far, by topic."""

    def __init__(
        self,
        node: Any,
        inputs: Mapping[str, Input],
        received: Mapping[str, int],
        clock: Callable[[], float] = monotonic,
    ):
        self._node, self._inputs, self._received, self._clock = node, inputs, received, clock
        self._next = clock() + FIRST_S

    def update(self) -> None:
        """Warn if it is time."""
        now = self._clock()
        if now < self._next:
            return
        self._next = now + AGAIN_S
        for topic, one in self._inputs.items():
            if not self._received.get(topic):
                self._node.get_logger().warning(f"nothing has come on {topic}: {self._why(topic, one.kind)}")

    def _why(self, topic: str, kind: str) -> str:
        if self._node.count_publishers(topic):
            return "it is published, but no message gets here; see docs/ros2.md: large images need room"
        type_name = kind.replace("/", "/msg/")
        others = sorted(
            name
            for name, types in self._node.get_topic_names_and_types()
            if type_name in types and self._node.count_publishers(name)
        )
        if others:
            return f"nobody publishes it; {kind} is on {', '.join(others)}"
        return f"nobody publishes it, nor {kind} on any other topic; does the camera run, with the same ROS_DOMAIN_ID?"
