# SPDX-License-Identifier: Apache-2.0
"""Lazy imports of ROS 2 packages, from PyPI wheels or from a sourced distribution."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from stereovox.errors import MissingExtra, StereovoxError

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
