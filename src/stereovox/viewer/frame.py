# SPDX-License-Identifier: Apache-2.0
"""Panel of the viewer with the depth image of one frame and a line about it.

Replay of a recording in the viewer: a timeline, the depth image of a frame, and the map at that time.
"""

from __future__ import annotations

import threading
from time import monotonic, sleep
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, WindowConfig
from stereovox.depth import DepthPipeline
from stereovox.depth.cloud import checked_cloud, cloud_of
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, CheckedCloud, DepthImage, Rays, Reason, UpdateReport, name_of
from stereovox.kernels.threads import Newest
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.maps.storage.cubes import in_cubes
from stereovox.view.plain import colour_depth
from stereovox.viewer.panel import plain
from stereovox.viewer.viewer import Viewer

if TYPE_CHECKING:
    from viser import ViserServer

    from stereovox.opening import Source


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


KEPT = 16
"""Number of maps kept along the recording, so that going back need not start at the first frame."""
MAX_KEPT_BYTES = 1 << 30
SLOWEST_S = 0.1
"""Seconds per frame of a recording without times."""
NOTICE_S = 0.5


class Replay:
    """Maps a recording again up to the frame chosen on the timeline.

    at: slider with the number of the last frame in the map, from 1. play: check box.
    """

    def __init__(self, viewer: Viewer, source: Source, config: Config):
        if not len(source):
            raise StereovoxError(f"{source.name}: holds no frames to replay")
        self._viewer, self._source, self._config = viewer, source, _as_shown(config)
        self._mapper, self._done = Mapper(self._config), 0
        self._report: UpdateReport | None = None
        self._kept: dict[int, VoxelMap] = {}
        self.draw = Newest(self._draw)
        gui = viewer.server.gui
        with gui.add_folder("Recording", order=0.5):
            self.at = gui.add_slider("frame", 1, len(source), 1, len(source))
            self.play = gui.add_checkbox("play", False)
            self.frame = FramePanel(viewer.server, self._config)
        self.at.on_update(lambda _: self.draw())
        self.play.on_update(lambda _: self._start())
        self.frame.show(source.frame(len(source) - 1), "the last frame; move the timeline or tick play")

    def _draw(self) -> None:
        """Show the map as of the slider's frame."""
        number = int(self.at.value)
        self._go_to(number)
        frame = self._source.frame(number - 1)
        self.frame.show(frame, describe_frame(frame, self._report))
        self._viewer.update(in_cubes(self._mapper.map.snapshot()))

    def _go_to(self, number: int) -> None:
        before = self._nearest(number - 1)  # the frame itself is added last: the page shows its effect
        if number < self._done or before > self._done:
            self._start_from(before)
        due = monotonic() + NOTICE_S
        while self._done < number:
            self._report = self._mapper.add(self._source.frame(self._done))
            self._done += 1
            self._keep()
            if monotonic() > due:
                self.frame.text.content = f"mapping frame {self._done:,} on the way to {number:,}"
                due = monotonic() + NOTICE_S

    def _nearest(self, number: int) -> int:
        return max((kept for kept in self._kept if kept <= number), default=0)

    def _start_from(self, number: int) -> None:
        earlier = self._kept[number].snapshot() if number else None
        self._mapper, self._done, self._report = Mapper(self._config, resume=earlier), number, None

    def _keep(self) -> None:
        """Keep occasional copies, as memory allows."""
        room = MAX_KEPT_BYTES // max(self._mapper.map.memory_bytes, 1)
        apart = max(1, len(self._source) // max(1, min(KEPT, room)))
        if self._done % apart == 0 and self._done not in self._kept:
            self._kept[self._done] = self._mapper.map.snapshot()

    def _start(self) -> None:
        if self.play.value:
            threading.Thread(target=self._play, daemon=True).start()

    def _play(self) -> None:
        """Move the timeline in real time, skipping frames that would be late."""
        seconds = self._seconds_a_frame()
        if self.at.value >= len(self._source):
            self.at.value = 1
        duration = 0.0
        while self.play.value and self.at.value < len(self._source):
            start = monotonic()
            self.at.value = min(self.at.value + max(1, int(duration / seconds)), len(self._source))
            duration = monotonic() - start
            sleep(max(0.0, seconds - duration))
        self.play.value = False

    def _seconds_a_frame(self) -> float:
        count = len(self._source)
        seconds = 1e-9 * (self._source.frame(count - 1).stamp_ns - self._source.frame(0).stamp_ns) / max(count - 1, 1)
        return seconds if 0 < seconds < 10 else SLOWEST_S


def _as_shown(config: Config) -> Config:
    """Return settings that drop no cell and no frame."""
    return config.model_copy(update={"window": WindowConfig.model_validate({}), "deadline_ms": None})
