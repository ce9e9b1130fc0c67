# SPDX-License-Identifier: Apache-2.0
"""The protocol of recordings of ROS messages: `.bag` (ROS 1), `.db3` and `.mcap` (ROS 2), and rosbag2 folders.

Every message of every topic can be read by its number. Any damage gives a one-line error, and no allocation trusts a
size that the file declares: reads are bounded by the size of the file, decompression by `MAX_BYTES`. Written by hand,
because in the usual readers a hostile file determines the size of buffers.
"""

from __future__ import annotations

import os
import re
from glob import escape, glob
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.sources.bags.messages import Wire

MAX_BYTES = 256 * 1024 * 1024
"""Largest message or chunk after decompression; anything larger is treated as damaged."""
UNFINISHED = ".unfinished"
"""Ending of a folder with a growing recording; after a kill, its contents can be read from an `.mcap`."""


class BagFile(Protocol):
    """Recorded messages by topic and number, in order of their recording time.

    Attributes:
        path: The file or folder.
        types: Message type of each topic that has messages, as `sensor_msgs/Image`.
        notes: Defects of a file that is still readable, one line each.
    """

    path: Path
    types: dict[str, str]
    notes: tuple[str, ...] = ()

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return when the messages of a topic were recorded.

        Args:
            topic: A topic of `types`.

        Returns:
            (N,) int64 nanoseconds, ascending.

        Raises:
            SourceError: The file is damaged.
        """
        ...

    def read(self, topic: str, i: int) -> Wire:
        """Read one message.

        Args:
            topic: A topic of `types`.
            i: Number of the message, in the order of `stamps`.

        Returns:
            The serialised message.

        Raises:
            FrameRefused: `unreadable`, if the file is damaged.
        """
        ...


def one_line(error: object) -> str:
    """Return the text of an error or name on one line, without a full stop."""
    plain = re.sub(r"\('(.*?)',?\)", r"\1", str(error))  # some print an exception's arguments as a tuple
    return " ".join(plain.split()).rstrip(".") or f"damaged ({type(error).__name__})"


def cut_off(path: str) -> str:
    """Return the file that a killed recorder left, empty if missing."""
    pattern = f"{escape(path)}.*{UNFINISHED}/*/{escape(os.path.basename(path))}"
    return max(glob(pattern), default="", key=os.path.getmtime)
