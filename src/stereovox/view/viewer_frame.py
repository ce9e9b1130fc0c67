# SPDX-License-Identifier: Apache-2.0
"""The depth image of one frame in the viewer's panel, and a line about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from stereovox.config import Config
from stereovox.depth import DepthPath
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Frame, StereoFrame, name_of
from stereovox.update_report import UpdateReport
from stereovox.view.depth_colours import depth_picture, reasons_key
from stereovox.view.viewer_panel import plain

if TYPE_CHECKING:
    from viser import ViserServer

EMPTY = np.full((180, 240, 3), 128, np.uint8)


class FramePanel:
    """The depth image as the map saw it; image and told: what the page shows."""

    def __init__(self, server: ViserServer, config: Config):
        self._config, self._path = config, DepthPath(config)
        self.image = server.gui.add_image(EMPTY, format="jpeg", jpeg_quality=85)
        server.gui.add_html(reasons_key())
        self.told = server.gui.add_markdown("")

    def show(self, frame: AnyFrame, words: str) -> None:
        """Show the depth image of a frame, which may be one that is refused, with `words` below."""
        try:
            image = self._path.image(self._path.matched(frame))
            self.image.image = depth_picture(image, self._config.max_range)
        except FrameRefused:
            self.image.image = EMPTY
        self.told.content = words


def frame_words(frame: AnyFrame, report: UpdateReport | None) -> str:
    """Return name and fate of a frame, or of what was offered as one, as Markdown."""
    called = name_of(frame) if isinstance(frame, Frame | StereoFrame) else type(frame).__name__
    name = plain(str(called).rpartition("/")[2])
    if report is None:
        return name
    return f"{name}: {plain(report.detail)}" if report.refused else f"{name}: {report.cells:,} cells changed"
