# SPDX-License-Identifier: Apache-2.0
"""A recording in another world: all poses rotated by the same motion."""

from __future__ import annotations

from dataclasses import replace

from stereovox.frame import AnyFrame
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Changed, Source, Stream
from stereovox.sources.imu import Imu


class Turned(Changed):
    """The frames of `stream` in a new world; T_new_world (4, 4) maps the recording's world into it."""

    def __init__(self, stream: Stream, T_new_world: Transform):
        super().__init__(stream)
        self._T_new_world = T_new_world

    def change(self, frame: AnyFrame) -> AnyFrame:
        """Return a frame with its pose in the new world."""
        return _in_world(frame, self._T_new_world)


class TurnedRecording(Source):
    """A recording in a new world, whose frames can still be read in any order."""

    def __init__(self, source: Source, T_new_world: Transform):
        self._source, self._T_new_world = source, T_new_world
        self.name, self.camera, self.notes = source.name, source.camera, source.notes

    def imu(self) -> Imu | None:
        """Return the IMU of the recording."""
        return self._source.imu()

    def __len__(self) -> int:
        return len(self._source)

    def frame(self, i: int) -> AnyFrame:
        """Return frame `i` in the new world."""
        return _in_world(self._source.frame(i), self._T_new_world)


def _in_world(frame: AnyFrame, T_new_world: Transform) -> AnyFrame:
    return replace(frame, T_world_sensor=T_new_world @ frame.T_world_sensor)
