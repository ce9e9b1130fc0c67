# SPDX-License-Identifier: Apache-2.0
"""The kinds of files that hold recorded ROS messages: `.bag` (ROS 1), `.db3` and `.mcap` (ROS 2), and rosbag2 folders.

All give any message of any topic by its number. Whatever is wrong with a file ends in one line, and nothing is
allocated because a damaged file says so: reads are bounded by the size of the file, unpacking by `MAX_BYTES`.
By hand, because in the usual readers a hostile file sizes the buffers.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.sources.bags.messages import Wire

MAX_BYTES = 256 * 1024 * 1024
"""A message or chunk that unpacks to more than this is taken for damaged."""


class BagFile(Protocol):
    """Recorded messages by topic and number, in order of the time at which they were recorded.

    types: message type of every topic that has messages, as `sensor_msgs/Image`.
    notes: what is wrong with the file though it can be read, one line each.
    """

    path: Path
    types: dict[str, str]
    notes: tuple[str, ...] = ()

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the (N,) times in nanoseconds at which the messages of `topic` were recorded, in order."""
        ...

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` where the file is damaged."""
        ...


def one_line(error: object) -> str:
    """Return the text of an error or name in one line, without a full stop."""
    plain = re.sub(r"\('(.*?)',?\)", r"\1", str(error))  # some print the arguments of an exception as they are
    return " ".join(plain.split()).rstrip(".") or f"damaged ({type(error).__name__})"
