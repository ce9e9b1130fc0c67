# SPDX-License-Identifier: Apache-2.0
"""Live view: a growing map on a page, updated as often as mapping can spare the time."""

from __future__ import annotations

import threading
import warnings
from collections import deque
from time import monotonic
from typing import Any

from stereovox.frame import AnyFrame, UpdateReport
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.maps.record.health import STALE
from stereovox.maps.record.history import History
from stereovox.maps.storage.cubes import in_cubes
from stereovox.viewer.frame import FramePanel, describe_frame
from stereovox.viewer.panel import plain
from stereovox.viewer.serve import HERE, PORT
from stereovox.viewer.viewer import open_viewer

HEALTH_S = 0.5
"""Seconds between two updates of the map's health, also while no frame arrives."""
MIN_S = 0.5
"""Minimum seconds between two updates."""
COPY_REST, DRAW_REST = 25, 4
"""Minimum pause in durations of a copy and of a drawing: at most 4 % of mapping, 20 % of a core."""
PATIENCE_S = 10.0


class LiveView:
    """Page that shows the map of a `Mapper` while it grows. Pass each frame to `add` instead of the mapper's.

    It is also an `Observer` for `map_recording`. Between two frames the map is copied, and the page is drawn from the
    copy in its own thread: nothing reads the map while a kernel writes it. The page shows the map's health, also while
    no frame arrives.

    Args:
        mapper: The mapper whose map is shown.
        name: Heading of the page.
        host: Name or address to serve at, as for `open_viewer`.
        port: Port of the page; 0: any free one.
        token: Secret of the link, as for `open_viewer`.

    Attributes:
        viewer: The page, as returned by `open_viewer`.

    Raises:
        StereovoxError: As for `open_viewer`.
    """

    def __init__(
        self, mapper: Mapper, name: str = "live map", host: str = HERE, port: int = PORT, token: str | None = None
    ):
        self._mapper = mapper
        self.viewer = open_viewer(_copy(mapper), name, host, port, token=token)
        gui = self.viewer.server.gui
        with gui.add_folder("Now", order=0.5):
            self.health = gui.add_markdown("")
            self.frame = FramePanel(self.viewer.server, mapper.config)
        self._arrivals: deque[float] = deque(maxlen=200)
        self._due = 0.0
        self._last: tuple[AnyFrame, UpdateReport] | None = None
        self._waiting: tuple[VoxelMap, AnyFrame, str] | None = None
        self._ask, self._free, self._stopped = (threading.Event() for _ in range(3))
        self._free.set()
        self._thread = threading.Thread(target=self._run, name="stereovox-live-view", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Link to the page."""
        return self.viewer.url

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Add a frame to the map, and update the page if an update is due.

        Args:
            frame: As for `Mapper.add`.

        Returns:
            The report of `Mapper.add`.
        """
        report = self._mapper.add(frame)
        self.after(frame, report)
        return report

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Update the page if an update is due. Call it between frames, from the thread that maps.

        Args:
            frame: The frame that was offered to the mapper.
            report: What `Mapper.add` returned for it.
        """
        start = monotonic()
        self._arrivals.append(start)
        self._last = frame, report
        if start >= self._due and self._free.is_set() and not self._stopped.is_set():
            self._hand_over(frame, report)
            done = monotonic()
            self._due = done + max(MIN_S, COPY_REST * (done - start))

    def finish(self) -> None:
        """Show the complete map. Call it after the last frame."""
        if self._stopped.is_set():
            return
        self._free.wait(PATIENCE_S)
        if self._last is not None:
            self._hand_over(*self._last)

    def close(self) -> None:
        """Close the page."""
        self._stopped.set()
        self._ask.set()
        self._thread.join()
        self.viewer.close()

    def __enter__(self) -> LiveView:
        """Return itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Close the page."""
        self.close()

    def _hand_over(self, frame: AnyFrame, report: UpdateReport) -> None:
        copy = _copy(self._mapper)
        waiting = copy, frame, f"{describe_frame(frame, report)}\n\n{self._progress(copy.history)}"
        self._free.clear()
        self._waiting = waiting
        self._ask.set()

    def _run(self) -> None:
        """Draw each copy, then leave the processor to mapping for a while."""
        while True:
            while not self._ask.wait(HEALTH_S):
                self._show_health()
            self._ask.clear()
            if self._stopped.is_set() or self._waiting is None:
                return
            start = monotonic()
            try:
                self._draw(*self._waiting)
            except Exception as error:  # a failed drawing must stop neither the next one nor mapping
                warnings.warn(f"the live view could not be drawn ({type(error).__name__}: {error})", stacklevel=1)
            end = monotonic() + min(DRAW_REST * (monotonic() - start), PATIENCE_S / 2)
            while (left := end - monotonic()) > 0 and not self._stopped.wait(min(left, HEALTH_S)):
                self._show_health()
            self._free.set()

    def _draw(self, voxel_map: VoxelMap, frame: AnyFrame, text: str) -> None:
        self._show_health()
        self.frame.show(frame, text)
        self.viewer.update(voxel_map)
        self.viewer.follow()

    def _show_health(self) -> None:
        """Show the map's age, in bold if it is too old to act on."""
        health = self._mapper.health()
        text = plain(health.text)
        self.health.content = f"**{text}**" if health.state in STALE else text

    def _progress(self, history: History) -> str:
        """Describe the progress of mapping as Markdown."""
        times = self._arrivals
        rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        rows = [
            ("frames a second", f"{rate:.1f}"),
            ("frames in the map", f"{history.frames:,}"),
            ("refused", ", ".join(f"{n:,} {plain(why)}" for why, n in history.refused.most_common(5)) or "none"),
        ]
        return "\n".join(["| now | |", "|:--|:--|", *(f"| {name} | {value} |" for name, value in rows)])


def _copy(mapper: Mapper) -> VoxelMap:
    return in_cubes(mapper.map.snapshot())
