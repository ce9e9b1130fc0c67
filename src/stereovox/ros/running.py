# SPDX-License-Identifier: Apache-2.0
"""Begin and end with ROS 2."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from stereovox.errors import StereovoxError

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
