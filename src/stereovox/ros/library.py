# SPDX-License-Identifier: Apache-2.0
"""ROS 2's own packages, of the wheels on PyPI or of a sourced distribution; imported when they are needed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from stereovox.errors import MissingExtra, StereovoxError

NAME = "stereovox"


@contextmanager
def running_node(words: Sequence[str]) -> Iterator[Any]:
    """Give a node of rclpy with the parameters that `words` name, which stand behind --ros-args.

    Signals are left alone. Raises StereovoxError, one line, for words that ROS does not know.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    try:
        rclpy.init(args=["--ros-args", *words], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(NAME, automatically_declare_parameters_from_overrides=True)
    except Exception as error:  # rclpy's C library has many
        raise StereovoxError(f"--ros-args {' '.join(words)}: {error}") from None
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


ALWAYS = ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs", "diagnostic_msgs", "std_srvs")
"""Packages that the node needs in any case."""


def check_installed() -> None:
    """Raise MissingExtra, one line, where a package that the node cannot do without is not there."""
    for package in ALWAYS:
        try:
            import_module(package)
        except ImportError:
            raise MissingExtra(f"{package} of ROS 2 (source a distribution, or take the wheels)", "ros2") from None


def optional_message(package: str, name: str) -> Any | None:
    """Return a message class of a package that need not be there, else None."""
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except ImportError:
        return None
