# SPDX-License-Identifier: Apache-2.0
"""The frames of a source with another camera than its own: one from a camera file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from stereovox.cameras import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame, StereoFrame
from stereovox.sources.base import Stream
from stereovox.sources.camera_file import read_camera
from stereovox.sources.intrinsics import correction_words


class WithCamera(Stream):
    """The frames of `stream`, all with `camera`, which has as many pixels; `notes` follow its own."""

    def __init__(self, stream: Stream, camera: PinholeCamera, notes: tuple[str, ...] = ()):
        self._stream, self.camera, self._notes = stream, camera, notes
        self.name, self.notes = stream.name, (*getattr(stream, "notes", ()), *notes)

    @property
    def length(self) -> int | None:
        """Number of frames, as the stream tells."""
        return self._stream.length

    @property
    def dropped(self) -> int:
        """Frames that nobody took in time, as the stream tells."""
        return self._stream.dropped

    def after(self, count: int) -> Stream:
        """Return what is left after `count` frames, with the same camera."""
        return WithCamera(self._stream.after(count), self.camera, self._notes)

    def __iter__(self) -> Iterator[Frame]:
        frames = iter(self._stream)
        try:
            for frame in frames:
                if isinstance(frame, StereoFrame):
                    raise SourceError(f"{self.name}: has stereo pairs, which no camera file fits; correct its rig file")
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
    note = f"{file} is used in place of the recording's own camera ({correction_words(camera)})"
    return WithCamera(stream, camera if camera.baseline else replace(camera, baseline=own.baseline), (note,))
