# SPDX-License-Identifier: Apache-2.0
"""Each stereo pair is matched once for all settings, as long as the results fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from stereovox.config import Config
from stereovox.depth import DepthPath
from stereovox.errors import FrameRefused
from stereovox.evaluate.reproduce.valenti.recordings import Drive
from stereovox.frame import Frame
from stereovox.sources.base import prefetch

PIXEL_BYTES = 5
"""Depth and reason of a pixel."""


class Matched:
    """The frames of a drive as depth images, for as many passes as one likes; refused pairs are left out.

    numbers: which frames. config: how pairs are matched. room: bytes that may be kept from one pass to the next; a
    recording that needs more is matched anew in each pass.
    """

    def __init__(self, drive: Drive, numbers: Sequence[int], config: Config, room: float = 1e9):
        self._drive, self._numbers, self._depth = drive, numbers, DepthPath(config)
        camera = drive.camera
        self._keep = len(numbers) * camera.width * camera.height * PIXEL_BYTES <= room
        self._kept: list[tuple[int, Frame]] | None = None

    def __iter__(self) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame, each with float32 depth."""
        if self._kept is not None:
            yield from self._kept
            return
        kept = []
        for found in self._match():
            if self._keep:
                kept.append(found)
            yield found
        self._kept = kept if self._keep else None

    def _match(self) -> Iterator[tuple[int, Frame]]:
        pairs = prefetch(lambda n: self._drive.frame(self._numbers[n]), len(self._numbers))
        for number, pair in zip(self._numbers, pairs, strict=True):
            try:
                yield number, self._depth.matched(pair)
            except FrameRefused:
                continue
