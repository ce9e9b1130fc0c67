# SPDX-License-Identifier: Apache-2.0
"""A recording in another world: all poses turned by the same motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from stereovox.frame import AnyFrame
from stereovox.se3 import Transform
from stereovox.sources.base import Source, Stream


class Turned(Stream):
    """The frames of `stream` in a new world; T_new_world (4, 4) maps the recording's world into it."""

    def __init__(self, stream: Stream, T_new_world: Transform):
        self._stream, self._T_new_world = stream, T_new_world
        self.name, self.camera, self.notes = stream.name, stream.camera, stream.notes

    @property
    def length(self) -> int | None:
        """Number of frames of the stream."""
        return self._stream.length

    @property
    def dropped(self) -> int:
        """Frames dropped by the stream."""
        return self._stream.dropped

    def after(self, count: int) -> Stream:
        """Return the remaining frames after `count`, in the same world."""
        return Turned(self._stream.after(count), self._T_new_world)

    def __iter__(self) -> Iterator[AnyFrame]:
        frames = iter(self._stream)
        try:
            for frame in frames:
                yield replace(frame, T_world_sensor=self._T_new_world @ frame.T_world_sensor)
        finally:
            close = getattr(frames, "close", None)
            if close:  # a generator: a live camera is to stop now
                close()


class TurnedRecording(Source):
    """The same of a recording, whose frames can still be read in any order."""

    def __init__(self, source: Source, T_new_world: Transform):
        self._source, self._T_new_world = source, T_new_world
        self.name, self.camera, self.notes = source.name, source.camera, source.notes

    def __len__(self) -> int:
        return len(self._source)

    def frame(self, i: int) -> AnyFrame:
        """Return frame `i` in the new world."""
        frame = self._source.frame(i)
        return replace(frame, T_world_sensor=self._T_new_world @ frame.T_world_sensor)
