# SPDX-License-Identifier: Apache-2.0
"""What every source of frames offers, reading ahead in the background, and picking some of the frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from stereovox.cameras import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame

T = TypeVar("T")
AHEAD = 4
"""Frames read before they are asked for: enough to even out slow ones, at 0.6 MB each for 640x480."""


class Source(Protocol):
    """Frames that can be counted, asked for one by one in any order, or run through in time order.

    name: short name for messages and reports.
    camera: the camera of all frames.
    notes: lines a user should see, for example a calibration that had to be assumed.
    layout: how to recognise this kind of source, for messages.

    A class that is registered also has `recognises(where: str) -> bool`, which is cheap and never raises, and is made
    from that `where` alone; it raises SourceError where the recording as a whole cannot be used.
    """

    name: str
    camera: PinholeCamera
    notes: tuple[str, ...] = ()
    layout: str = ""

    def __len__(self) -> int: ...

    def frame(self, i: int) -> Frame:
        """Return frame `i` (negative: from the end); never fails for bad files: the frame then has a `fault`.

        Raises IndexError for a frame that does not exist.
        """
        ...

    def __iter__(self) -> Iterator[Frame]:
        return prefetch(self.frame, len(self))


class Selection(Source):
    """The frames of `source` that the Python slice text `frames` (`A:B:S`) picks, in its order.

    Raises SourceError for text that is no slice and where not one frame is picked.
    """

    def __init__(self, source: Source, frames: str):
        self._source = source
        self._picked = range(len(source))[parse_slice(frames)]
        if not self._picked:
            raise SourceError(f"frames '{frames}' picks none of the {len(source)} frames of {source.name}; widen it")
        self.name, self.camera = source.name, source.camera
        self.notes = getattr(source, "notes", ())

    def __len__(self) -> int:
        return len(self._picked)

    def frame(self, i: int) -> Frame:
        """Return the frame that was picked as number `i`."""
        return self._source.frame(self._picked[i])


def parse_slice(text: str) -> slice:
    """Return the slice that `A:B:S` means, as in Python; raises SourceError for anything else."""
    parts = text.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or numbers[2:] == [0]:
        raise SourceError(f"frames '{text}' is no slice; write A:B:S with whole numbers, for example 0:100:2") from None
    return slice(*numbers)


def prefetch(read: Callable[[int], T], count: int, ahead: int = AHEAD) -> Iterator[T]:
    """Yield `read(0)` to `read(count - 1)` in order while one background thread reads up to `ahead` further ones.

    What `read` raises is raised here, in its turn. When the consumer stops early, so does the reading.
    """
    reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="stereovox-source")
    waiting = deque(reader.submit(read, i) for i in range(min(ahead, count)))
    try:
        for i in range(count):
            item = waiting.popleft().result()
            if i + ahead < count:
                waiting.append(reader.submit(read, i + ahead))
            yield item
    finally:
        reader.shutdown(wait=True, cancel_futures=True)
