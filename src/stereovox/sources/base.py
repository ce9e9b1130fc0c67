# SPDX-License-Identifier: Apache-2.0
"""What every source of frames offers, reading ahead in the background, and picking some of the frames."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Protocol, TypeVar, overload

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import AnyFrame, Frame

T = TypeVar("T")


class Lazy(Sequence[T]):
    """The items `read(k)` of the numbers `k`, each read anew whenever it is asked for; a slice is as lazy."""

    def __init__(self, read: Callable[[int], T], numbers: range):
        self._read, self._numbers = read, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, i: int) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> Lazy[T]: ...
    def __getitem__(self, i: int | slice) -> T | Lazy[T]:
        if isinstance(i, slice):
            return Lazy(self._read, self._numbers[i])
        return self._read(self._numbers[i])


AHEAD = 4
"""Frames read before they are asked for: enough to even out slow ones, at 0.6 MB each for 640x480."""


class Stream(Protocol):
    """Frames one after the other in time order: a recording, or a live camera, which nobody can count or rewind.

    name: short name for messages and reports.
    camera: the camera of all frames; of stereo pairs the rectified left eye of the first (of a wide one its `middle`).
    notes: lines a user should see, for example a calibration that had to be assumed.
    layout: how to recognise this kind of source, for messages.

    A class that is registered also has `recognises(where: str) -> bool`, which is cheap and never raises, and is made
    from that `where` alone; it raises SourceError where the recording or device as a whole cannot be used.
    """

    name: str
    camera: PinholeCamera
    notes: tuple[str, ...] = ()
    layout: str = ""

    @property
    def length(self) -> int | None:
        """Number of frames; None where more come for as long as somebody asks for them."""
        return None

    @property
    def dropped(self) -> int:
        """Frames that a live camera delivered and nobody took in time; of a recording none."""
        return 0

    def after(self, count: int) -> Stream:
        """Return what is left after `count` frames; of a live camera that is itself, its past frames are gone."""
        return self

    def __iter__(self) -> Iterator[AnyFrame]: ...


class Source(Stream, Protocol):
    """A stream that is recorded: its frames can be counted, and asked for one by one in any order."""

    @property
    def length(self) -> int | None:
        """Number of frames."""
        return len(self)

    def after(self, count: int) -> Stream:
        """Return the frames from number `count` on; raises SourceError where there is none."""
        return Selection(self, f"{count}:")

    def __len__(self) -> int: ...

    def frame(self, i: int) -> AnyFrame:
        """Return frame `i` (negative: from the end); never fails for bad files: the frame then has a `fault`.

        Raises IndexError for a frame that does not exist.
        """
        ...

    def __iter__(self) -> Iterator[AnyFrame]:
        return prefetch(self.frame, len(self))

    @classmethod
    def depth_only(cls, where: str) -> Source:
        """Open `where` for its depth images alone; a recording that can do without its poses says so here."""
        return cls(where)  # pyright: ignore[reportCallIssue] - what is registered is made from its place


class DepthSource(Source, Protocol):
    """A source of depth images, not of stereo pairs."""

    def frame(self, i: int) -> Frame:
        """Return frame `i` as `Source.frame` does."""
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

    def frame(self, i: int) -> AnyFrame:
        """Return the frame that was picked as number `i`."""
        return self._source.frame(self._picked[i])


class Excerpt(Stream):
    """Of the frames that a live camera delivers from now on those that the Python slice text `frames` (`A:B:S`) picks.

    Raises SourceError for text that is no slice, that picks none, or that counts from an end which does not exist.
    """

    def __init__(self, stream: Stream, frames: str):
        picked = parse_slice(frames)
        start, step = picked.start or 0, 1 if picked.step is None else picked.step
        if start < 0 or step < 0 or (picked.stop is not None and picked.stop <= start):
            raise SourceError(f"frames '{frames}' of a live camera: count forwards from its first, for example :300")
        self._stream, self._bounds = stream, (start, picked.stop, step)
        if max(start, picked.stop or 0, step) > sys.maxsize:
            raise SourceError(f"frames '{frames}' of a live camera: so many never come; give smaller numbers")
        self.name, self.camera = stream.name, stream.camera
        self.notes = getattr(stream, "notes", ())

    @property
    def dropped(self) -> int:
        """Frames that the camera delivered and nobody took in time."""
        return self._stream.dropped

    def __iter__(self) -> Iterator[AnyFrame]:
        frames = iter(self._stream)
        try:
            yield from islice(frames, *self._bounds)
        finally:
            close = getattr(frames, "close", None)
            if close:  # a generator: the camera is to stop now, not when it happens to be collected
                close()


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
