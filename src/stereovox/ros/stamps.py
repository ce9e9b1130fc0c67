# SPDX-License-Identifier: Apache-2.0
"""How late messages are by the node's clock, where their stamps are by it: a bag may be played without its clock."""

from __future__ import annotations

from typing import Any

from stereovox.frame.stamp_clock import AHEAD_NS, EPOCH_NS


class StampsByNode:
    """The node's clock (`use_sim_time` is obeyed), once a stamp has come that can be by it. node: rclpy's."""

    def __init__(self, node: Any, stale_s: float):
        self._node, self._stale_s, self._is_it = node, stale_s, False

    def heard(self, stamp_ns: int) -> None:
        """Take note of a stamp that came now."""
        if not self._is_it:
            self._is_it = -AHEAD_NS <= self._now_ns() - stamp_ns <= EPOCH_NS

    def now_ns(self) -> int | None:
        """Return the present time by the clock of the stamps; None if it is not known."""
        return self._now_ns() if self._is_it else None

    def late(self, stamp_ns: int) -> str:
        """Return why what is stamped so is too old to be published; "" if it is not, or nobody knows."""
        self.heard(stamp_ns)
        age_s = (self._now_ns() - stamp_ns) / 1e9
        old = self._is_it and age_s > self._stale_s
        return f"it shows what was {age_s:.2f} s ago (trust.stale_s {self._stale_s:g})" if old else ""

    def _now_ns(self) -> int:
        return self._node.get_clock().now().nanoseconds
