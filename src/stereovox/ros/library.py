# SPDX-License-Identifier: Apache-2.0
"""Lazy imports of ROS 2 packages, from PyPI wheels or from a sourced distribution.

Work in a thread of its own, while the node's thread keeps receiving messages. The lateness of messages by the node's
clock, if their stamps are by it: a bag may be played without its clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Generic, TypeVar

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.frame.stamp_clock import AHEAD_NS, EPOCH_NS

NAME = "stereovox"
REQUIRED = ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs", "diagnostic_msgs", "std_srvs")
"""Packages that the node needs."""


@contextmanager
def running_node(arguments: Sequence[str], make: Callable[..., Any] | None = None) -> Iterator[Any]:
    """Yield an rclpy node with the parameters in `arguments`, those after --ros-args.

    make: makes the node from its name and rclpy's arguments; None: a plain one. Signal handlers stay unchanged. Raises
    StereovoxError, one line, for arguments unknown to ROS.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    try:
        rclpy.init(args=["--ros-args", *arguments], signal_handler_options=SignalHandlerOptions.NO)
        node = (make or rclpy.create_node)(NAME, automatically_declare_parameters_from_overrides=True)
    except Exception as error:  # rclpy's C library raises many kinds
        raise StereovoxError(f"--ros-args {' '.join(arguments)}: {error}") from None
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def check_installed() -> None:
    """Raise MissingExtra, one line, if a required package is not installed."""
    for package in REQUIRED:
        try:
            import_module(package)
        except ImportError:
            raise MissingExtra(f"{package} of ROS 2 (source a distribution, or install the wheels)", "ros2") from None


def optional_message(package: str, name: str) -> Any | None:
    """Return a message class of an optional package, None if it is not installed."""
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        return None


T = TypeVar("T")


class Background(Generic[T]):
    """Runs tasks in order. One thread, the node's, calls all methods.

    name: of the thread.
    """

    def __init__(self, name: str):
        self._pool = ThreadPoolExecutor(1, name)
        self._waiting: deque[Callable[[], T]] = deque()
        self._running: Future[T] | None = None

    def put(self, work: Callable[[], T], newest_only: bool = False) -> None:
        """Add a task; newest_only: it replaces all tasks that have not begun yet."""
        if newest_only:
            self._waiting.clear()
        self._waiting.append(work)
        if self._running is None:
            self._begin()

    def poll(self) -> Future[T] | None:
        """Return the task that has ended, if any, and begin the next one."""
        if self._running is None or not self._running.done():
            return None
        ended = self._running
        self._begin()
        return ended

    def rest(self) -> Iterator[Future[T]]:
        """Run all remaining tasks; yield each when it has ended."""
        while self._running is not None:
            wait([self._running])
            ended = self.poll()
            if ended is not None:
                yield ended

    def drop(self) -> None:
        """Discard all tasks that have not begun, and wait for the one that has."""
        self._waiting.clear()
        if self._running is not None:
            wait([self._running])
            self._running = None

    def _begin(self) -> None:
        self._running = self._pool.submit(self._waiting.popleft()) if self._waiting else None


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
