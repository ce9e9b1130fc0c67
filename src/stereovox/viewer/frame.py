# SPDX-License-Identifier: Apache-2.0
"""Panel of the viewer with the depth image of one frame and a line about it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.depth import DepthPipeline
from stereovox.depth.cloud import checked_cloud
from stereovox.depth.ranges import cloud_of
from stereovox.errors import FrameRefused
from stereovox.frame import (
    AnyFrame,
    CheckedCloud,
    DepthImage,
    Rays,
    Reason,
    UpdateReport,
    name_of,
)
from stereovox.view.plain import colour_depth
from stereovox.viewer.panel import plain

if TYPE_CHECKING:
    from viser import ViserServer

REASON_COLOURS = {
    Reason.UNMATCHED: "#1a1a1a",
    Reason.TOO_NEAR: "#e6399b",
    Reason.TOO_FAR: "#cfe3f7",
    Reason.MASKED: "#b9a16b",
    Reason.UNKNOWN: "#7d7d7d",
}
SHARED = "near red, far blue"
MAX_WIDTH_PX = 480
CLOUD_ROWS, HIGHEST_DEG, DEG_PER_ROW = 90, 45.0, 1.0
"""Picture of a cloud: number of rows, elevation of the first, and degrees per row."""
EMPTY = np.full((180, 240, 3), 128, np.uint8)


def depth_picture(image: DepthImage, max_range: float) -> NDArray[np.uint8]:
    """Return a depth image as RGB (rows, columns, 3), at most `MAX_WIDTH_PX` wide: near red, far blue.

    Invalid pixels have the colour of their reason. max_range: metres; farther pixels have the colour of that distance.
    """
    step = -(-image.depth_m.shape[1] // MAX_WIDTH_PX)
    depth_m, reason = image.depth_m[::step, ::step], image.reason[::step, ::step]
    picture = colour_depth(np.where(reason == Reason.VALID, depth_m, np.nan), max_range)
    for why, colour in REASON_COLOURS.items():
        picture[reason == why] = tuple(bytes.fromhex(colour[1:]))
    return picture


def cloud_picture(cloud: CheckedCloud, max_range: float) -> NDArray[np.uint8]:
    """Return a cloud as all-round RGB (rows, columns, 3): the nearest range in each direction, ahead in the middle."""
    points = cloud.ends[cloud.hits]
    ranges = np.linalg.norm(points, axis=1)
    left = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    up = np.degrees(np.arcsin(np.clip(points[:, 2] / ranges, -1, 1)))
    columns = np.clip((180 - left) / 360 * MAX_WIDTH_PX, 0, MAX_WIDTH_PX - 1).astype(int)
    rows = np.clip((HIGHEST_DEG - up) / DEG_PER_ROW, 0, CLOUD_ROWS - 1).astype(int)
    nearest = np.full((CLOUD_ROWS, MAX_WIDTH_PX), np.inf)
    np.minimum.at(nearest, (rows, columns), ranges)
    seen = slice(rows.min(), rows.max() + 1) if len(rows) else slice(CLOUD_ROWS)
    return colour_depth(np.where(np.isfinite(nearest), nearest, np.nan)[seen], max_range)


def reasons_key() -> str:
    """Return a line of HTML with the legend of the colours."""
    swatch = '<span style="display:inline-block;width:.8em;height:.8em;border:1px solid #888;background:{}"></span> {}'
    text = [swatch.format(colour, why.name.lower().replace("_", " ")) for why, colour in REASON_COLOURS.items()]
    body = " &nbsp; ".join([SHARED, *text])
    return f'<div style="font-size:.75em;line-height:1.7;padding:0 1em .6em">{body}</div>'


class FramePanel:
    """The depth image as used for the map. image, text: the elements of the page."""

    def __init__(self, server: ViserServer, config: Config):
        self._config, self._path = config, DepthPipeline(config)
        self.image = server.gui.add_image(EMPTY, format="jpeg", jpeg_quality=85)
        server.gui.add_html(reasons_key())
        self.text = server.gui.add_markdown("")

    def show(self, frame: AnyFrame, text: str) -> None:
        """Show the depth image or the cloud of a frame, even a refused one, with `text` below."""
        try:
            self.image.image = self._picture(frame)
        except FrameRefused:
            self.image.image = EMPTY
        self.text.content = text

    def _picture(self, frame: AnyFrame) -> NDArray[np.uint8]:
        far = self._config.max_range
        if isinstance(frame, Rays):
            return cloud_picture(checked_cloud(cloud_of(frame, self._config), self._config), far)
        return depth_picture(self._path.image(self._path.matched(frame)), far)


def describe_frame(frame: AnyFrame, report: UpdateReport | None) -> str:
    """Return name and outcome of a frame, or of any object offered as one, as Markdown."""
    called = name_of(frame) if isinstance(frame, AnyFrame) else type(frame).__name__
    name = plain(str(called).rpartition("/")[2])
    if report is None:
        return name
    return f"{name}: {plain(report.detail)}" if report.refused else f"{name}: {report.cells:,} cells changed"
