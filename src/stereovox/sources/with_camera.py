# SPDX-License-Identifier: Apache-2.0
"""The frames of a source with another camera than its own: one from a camera file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from stereovox.cameras import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame
from stereovox.sources.base import Stream
from stereovox.sources.camera_file import read_camera


class WithCamera(Stream):
    """The frames of `stream`, all with `camera`, which has the same number of pixels."""

    def __init__(self, stream: Stream, camera: PinholeCamera):
        self._stream, self.camera = stream, camera
        self.name, self.notes = stream.name, getattr(stream, "notes", ())

    @property
    def length(self) -> int | None:
        """Number of frames, as the stream tells."""
        return self._stream.length

    def after(self, count: int) -> Stream:
        """Return what is left after `count` frames, with the same camera."""
        return WithCamera(self._stream.after(count), self.camera)

    def __iter__(self) -> Iterator[Frame]:
        frames = iter(self._stream)
        try:
            for frame in frames:
                yield replace(frame, camera=self.camera)
        finally:
            close = getattr(frames, "close", None)
            if close:  # a generator: a live camera is to stop now
                close()


def with_camera(stream: Stream, file: str | os.PathLike[str]) -> Stream:
    """Return `stream` with the camera in `file`; without a baseline there, the stream's own counts.

    Raises SourceError, one line, for a bad file and for a camera with another number of pixels.
    """
    camera, own = read_camera(Path(file)), stream.camera
    if (camera.width, camera.height) != (own.width, own.height):
        raise SourceError(
            f"{file}: is of a camera with {camera.width}x{camera.height} pixels, {stream.name} has "
            f"{own.width}x{own.height}; give the file of its own camera"
        )
    return WithCamera(stream, camera if camera.baseline else replace(camera, baseline=own.baseline))
