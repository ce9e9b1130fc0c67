# SPDX-License-Identifier: Apache-2.0
"""What sources of frames are and may have, reading ahead in the background, and selections of frames."""

from __future__ import annotations

import copy
import os
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.files.safe_io import shown
from stereovox.frame import AnyFrame, Frame
from stereovox.geometry.se3 import Transform
from stereovox.sources.imu import Imu

T = TypeVar("T")


class Lazy(Sequence[T]):
    """The items `read(k)` for the numbers `k`, read at each access; slices are lazy too."""

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


class Part(NamedTuple):
    """A part of a recording that a layout needs.

    patterns: names inside the folder as in `glob`, of which one must exist; the first is the usual one. what: its
    content, in words. cure: what to do if it is missing, other than adding it.
    """

    patterns: tuple[str, ...]
    what: str
    cure: str = ""

    def count(self, folder: str | os.PathLike[str]) -> int:
        """Return how many files or folders match; 0 if the folder is unreadable."""
        try:
            return max(sum(1 for _ in Path(folder).glob(pattern)) for pattern in self.patterns)
        except (OSError, ValueError):
            return 0


AHEAD = 4
"""Frames read ahead: enough to even out slow ones, at 0.6 MB each for 640x480."""


class Stream(ABC):
    """Frames in time order from a recording or a live camera; it need not have a length nor be rewindable.

    A class need not derive from this one, nor from `Source`: all but `name`, `camera` and the frames is optional, and
    what it lacks is then as it is here (`stream_of`). A registered class also has `recognises(where: str) -> bool`,
    which is cheap and never raises, and is constructed from `where` alone; it raises SourceError if the recording or
    device as a whole cannot be used.

    Attributes:
        name: Short name for messages and reports.
        camera: Camera of all frames; for stereo pairs the rectified left eye of the first (for a wide one its
            `middle`).
        notes: Lines the user should see, for example about an assumed calibration.
        layout: How to recognise this kind of source, for messages.
        parts: Contents of a folder of this layout, to report what is missing.
        up: The world's axis that points up (`z`, `-y`), if this kind of recording defines it; else None.
        posed: Whether anything is known about the camera's poses.
        unit: Unit of the depth images (`DepthUnit`); None if it is not known.
        composite: The class combines other recordings; its second argument is the function that opens them (see
            `CameraPair`).
    """

    name: str
    camera: PinholeCamera
    notes: tuple[str, ...] = ()
    layout: str = ""
    parts: tuple[Part, ...] = ()
    up: str | None = None
    posed: bool = True
    unit: Any = None
    composite: bool = False

    @property
    def length(self) -> int | None:
        """Number of frames; None for a live camera."""
        return None

    @property
    def dropped(self) -> int:
        """Frames that a live camera delivered but that were not consumed in time; 0 for a recording."""
        return 0

    @property
    def why_none(self) -> str:
        """Why no frame came, if none did, in words."""
        return "the source is empty"

    def after(self, count: int) -> Stream:
        """Skip frames, to resume a run.

        Args:
            count: Number of frames to skip.

        Returns:
            The remaining frames; a live camera returns itself, since its past frames are gone.

        Raises:
            SourceError: A recording has no more than `count` frames.
        """
        return self

    def imu(self) -> Imu | None:
        """Read the IMU next to the camera.

        Returns:
            Its readings, by the clock of the images; None if there is no IMU.

        Raises:
            SourceError: It is unusable.
        """
        return None

    @abstractmethod
    def __iter__(self) -> Iterator[AnyFrame]: ...


class Source(Stream):
    """A recorded stream: its frames can be counted and read in any order."""

    @property
    def length(self) -> int | None:
        """Number of frames."""
        return len(self)

    def after(self, count: int) -> Stream:
        """Return the frames from number `count` on; raises SourceError if missing."""
        return Selection(self, f"{count}:")

    def gravity(self) -> NDArray[np.float64] | None:
        """Measure the up direction by an accelerometer.

        Returns:
            Unit vector (3,) in the world of the poses; None if the recording does not contain it.
        """
        return None

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def frame(self, i: int) -> AnyFrame:
        """Read one frame.

        A bad file never raises: the frame has a `fault` instead.

        Args:
            i: Number of the frame; negative from the end.

        Returns:
            The frame.

        Raises:
            IndexError: There is no such frame.
        """
        ...

    def pose(self, i: int) -> Transform:
        """Read the pose of one frame; a recording that can do so without the image overrides this.

        Args:
            i: Number of the frame, 0 to len - 1.

        Returns:
            T_world_sensor (4, 4).

        Raises:
            FrameRefused: The frame has none.
        """
        frame = self.frame(i)
        if frame.fault:
            raise FrameRefused(frame.fault, frame.fault_detail)
        return frame.T_world_sensor

    def __iter__(self) -> Iterator[AnyFrame]:
        return prefetch(self.frame, len(self))

    @classmethod
    def depth_only(cls, where: str) -> Source:
        """Open only the depth images; a recording that can be read without poses overrides this.

        Args:
            where: As for the class itself.

        Returns:
            The source, perhaps without poses.

        Raises:
            SourceError: As for the class itself.
        """
        return cls(where)  # pyrefly: ignore[bad-argument-count] - registered classes are constructed from `where`


class DepthSource(Source):
    """A source of depth images rather than stereo pairs."""

    @abstractmethod
    def frame(self, i: int) -> Frame:
        """Read frame `i` as `Source.frame` does."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        return prefetch(self.frame, len(self))


class Changed(Stream):
    """The frames of `stream`, each passed through `change`; subclasses set any other differences."""

    def __init__(self, stream: Stream):
        self._stream = stream
        self.name, self.camera, self.notes = stream.name, stream.camera, tuple(stream.notes)
        self.posed = stream.posed

    def change(self, frame: AnyFrame) -> AnyFrame:
        """Return the frame to deliver for a frame of the stream."""
        raise NotImplementedError

    @property
    def length(self) -> int | None:
        """Number of frames of the stream."""
        return self._stream.length

    @property
    def dropped(self) -> int:
        """Frames dropped by the stream."""
        return self._stream.dropped

    def imu(self) -> Imu | None:
        """Return the IMU of the stream."""
        return self._stream.imu()

    def after(self, count: int) -> Stream:
        """Return the frames after `count`, changed in the same way."""
        rest = copy.copy(self)
        rest._stream = self._stream.after(count)
        return rest

    def __iter__(self) -> Iterator[AnyFrame]:
        with closing(self._stream) as frames:
            yield from map(self.change, frames)


class Selection(Source):
    """The frames of `source` that the Python slice `frames` (`A:B:S`, as text) selects, in its order.

    Raises SourceError for text that is not a slice and for an empty selection.

    Attributes:
        whole: The source.
        picked: Numbers of the frames in it.
    """

    def __init__(self, source: Source, frames: str):
        self.whole = source
        self.picked = range(len(source))[parse_slice(frames)]
        if not self.picked:
            raise SourceError(f"frames '{frames}' selects none of the {len(source)} frames of {source.name}; widen it")
        self.name, self.camera = source.name, source.camera
        self.notes, self.up = source.notes, source.up

    def gravity(self) -> NDArray[np.float64] | None:
        """Return which way is up in the whole recording."""
        return self.whole.gravity()

    def imu(self) -> Imu | None:
        """Return the IMU of the whole recording."""
        return self.whole.imu()

    def __len__(self) -> int:
        return len(self.picked)

    def frame(self, i: int) -> AnyFrame:
        """Return frame number `i` of the selection."""
        return self.whole.frame(self.picked[i])

    def pose(self, i: int) -> Transform:
        """Return the pose of frame number `i` of the selection, as `Source.pose` does."""
        return self.whole.pose(self.picked[i])


class Excerpt(Changed):
    """The frames that the Python slice `frames` (`A:B:S`, as text) selects from a live camera, counted from now.

    Raises SourceError if the text is not a slice, selects nothing, or counts from the end, which a live camera lacks.
    """

    def __init__(self, stream: Stream, frames: str):
        super().__init__(stream)
        picked = parse_slice(frames)
        start, step = picked.start or 0, 1 if picked.step is None else picked.step
        if start < 0 or step < 0 or (picked.stop is not None and picked.stop <= start):
            raise SourceError(f"frames '{frames}' of a live camera: count forwards from its first, for example :300")
        self._bounds = (start, picked.stop, step)
        if max(start, picked.stop or 0, step) > sys.maxsize:
            raise SourceError(f"frames '{frames}' of a live camera: numbers too large; give smaller ones")

    @property
    def length(self) -> None:
        """A live camera may end before all these frames have come, so that their number is unknown."""
        return None

    def __iter__(self) -> Iterator[AnyFrame]:
        with closing(self._stream) as frames:
            yield from islice(frames, *self._bounds)


class _Others(Stream):
    """A source of a class that does not derive from `Stream`: all that it has is its own."""

    def __init__(self, own: Any):
        self._own = own

    def __getattribute__(self, name: str) -> Any:
        if name in MEMBERS and hasattr(own := object.__getattribute__(self, "_own"), name):
            return getattr(own, name)
        return object.__getattribute__(self, name)

    def __iter__(self) -> Iterator[AnyFrame]:
        return iter(self._own)


class _OthersSource(_Others, Source):
    """The same of a recording, whose frames can be read in any order."""

    def __len__(self) -> int:
        return len(self._own) if hasattr(self._own, "__len__") else self._own.length

    def __iter__(self) -> Iterator[AnyFrame]:
        return iter(self._own) if hasattr(self._own, "__iter__") else Source.__iter__(self)

    def frame(self, i: int) -> AnyFrame:
        """Read a frame."""
        return self._own.frame(i)


MEMBERS = {"name", "camera", *(name for kind in (Stream, Source) for name in vars(kind) if not name.startswith("_"))}
"""What sources have; elsewhere nobody asks whether one has it."""


def stream_of(source: Any) -> Stream:
    """Return a source of frames with all that a `Stream`, or a `Source`, has; itself if it derives from one.

    Raises SourceError for what is none: without a name, a camera and frames.
    """
    if isinstance(source, Stream):
        return source
    counted = hasattr(source, "__len__") or isinstance(getattr(source, "length", None), int)
    recorded = counted and hasattr(source, "frame")
    if not (hasattr(source, "name") and hasattr(source, "camera") and (recorded or hasattr(source, "__iter__"))):
        raise SourceError(f"source {shown(source)}: give the name of a camera or recording, or a Stream")
    return _OthersSource(source) if recorded else _Others(source)


class _OthersKind:
    """A registered class that does not derive from `Stream`, with all that is asked of one."""

    def __init__(self, own: Any):
        self._own, self.recognises = own, own.recognises
        for name in ("layout", "parts", "composite"):
            setattr(self, name, getattr(own, name, getattr(Stream, name)))

    def __call__(self, *given: Any) -> Stream:
        return stream_of(self._own(*given))

    def depth_only(self, where: str) -> Stream:
        """Open only the depth images."""
        return stream_of(getattr(self._own, "depth_only", self._own)(where))


def kind_of(registered: Any) -> Any:
    """Return a registered class so that it, and what it opens, has all that `Source` has; itself if it derives."""
    return registered if issubclass(registered, Stream) else _OthersKind(registered)


@contextmanager
def closing(items: Iterable[T]) -> Iterator[Iterator[T]]:
    """Iterate, and close a generator at the end: a live camera is to stop now, not when it happens to be collected."""
    found = iter(items)
    try:
        yield found
    finally:
        close = getattr(found, "close", None)
        if close:
            close()


def parse_slice(text: str) -> slice:
    """Parse `A:B:S` as a Python slice; raises SourceError for anything else."""
    parts = text.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3) or numbers[2:] == [0]:
        raise SourceError(
            f"frames '{text}' is not a slice; write A:B:S with whole numbers, for example 0:100:2"
        ) from None
    return slice(*numbers)


def prefetch(read: Callable[[int], T], count: int, ahead: int = AHEAD) -> Iterator[T]:
    """Yield `read(0)` to `read(count - 1)` in order while a background thread reads up to `ahead` items in advance.

    An exception of `read` is raised here, at that item. Reading stops when the consumer does.
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
