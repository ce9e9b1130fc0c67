# SPDX-License-Identifier: Apache-2.0
"""Replay of a recording in the viewer: a timeline, the depth image of a frame, and the map at that time."""

from __future__ import annotations

import threading
from time import monotonic, sleep
from typing import TYPE_CHECKING

from stereovox.config import Config, WindowConfig
from stereovox.errors import StereovoxError
from stereovox.kernels.threads import Newest
from stereovox.frame import UpdateReport
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.maps.storage.cubes import in_cubes
from stereovox.viewer.frame import FramePanel, describe_frame
from stereovox.viewer.viewer import Viewer

if TYPE_CHECKING:
    from stereovox.opening import Source

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
