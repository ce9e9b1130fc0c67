# SPDX-License-Identifier: Apache-2.0
"""The lateness of messages by the node's clock, if their stamps are by it: a bag may be played without its clock."""

from __future__ import annotations

from typing import Any

from stereovox.frame.stamp_clock import AHEAD_NS, EPOCH_NS


class StampsByNode:
    """The node's clock (it obeys `use_sim_time`), once a stamp has arrived that can be by it. node: rclpy's."""

    def __init__(self, node: Any, stale_s: float):
        self._node, self._stale_s, self._is_it = node, stale_s, False

    def heard(self, stamp_ns: int) -> None:
        """Record a stamp that arrived now."""
        if not self._is_it:
            self._is_it = -AHEAD_NS <= self._now_ns() - stamp_ns <= EPOCH_NS

    def now_ns(self) -> int | None:
        """Return the present time by the clock of the stamps; None if it is unknown."""
        return self._now_ns() if self._is_it else None

    def late(self, stamp_ns: int) -> str:
        """Return why data with this stamp are too old to be published; "" if they are not, or if it is unknown."""
        self.heard(stamp_ns)
        age_s = (self._now_ns() - stamp_ns) / 1e9
        old = self._is_it and age_s > self._stale_s
        return f"it is {age_s:.2f} s old (trust.stale_s {self._stale_s:g})" if old else ""

    def _now_ns(self) -> int:
        return self._node.get_clock().now().nanoseconds
