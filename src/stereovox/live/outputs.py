# SPDX-License-Identifier: Apache-2.0
"""Outputs of a growing map: a 2-D map in files, and the distances in all directions around the body.

Each is an observer of the run: `after` for each frame, `finish` once the last one is in the map, `close` at the end.

The latency of images from the camera into the map, and to all outputs of the map.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from time import monotonic, monotonic_ns
from typing import Any, Protocol

import numpy as np

from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline
from stereovox.depth.sphere import SphereGrid, SphereLayout, accumulate
from stereovox.depth.sphere.vehicle import together
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.evaluate.metrics import percentiles
from stereovox.files.safe_io import FLOOR_ENDINGS, check_file
from stereovox.formats.map_server import write_map_server
from stereovox.frame import Rays, UpdateReport
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.geometry.se3 import Transform, inverse
from stereovox.live.stream import Moment
from stereovox.mapper import Mapper
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.context import context_of
from stereovox.products.floor_axes import Heights
from stereovox.products.projection import LiveProjection
from stereovox.sources.poses.live_poses import LivePoses

GRID_S = 1.0
"""Seconds between two writes of the 2-D map."""
STEP_DEG = 2.0
"""Width of a cell of the spherical grid unless the settings choose one."""


class Output(Protocol):
    """An observer with work at the end of a run."""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Process a frame that was offered to the map."""
        ...

    def finish(self) -> None:
        """Show or write the result after the last frame."""
        ...

    def close(self) -> None:
        """Release everything, whether the run ended well or not."""
        ...


class GridFile:
    """Keeps the 2-D map of a growing map in map_server files, rewritten in a thread of its own.

    While the map is waiting, stale or lost (`Mapper.health`) the files stay as they are; at the end they are complete.
    Unknown cells are never free.

    Args:
        mapper: The mapper whose map is projected.
        file: `.yaml`, `.pgm` or `.png`.
        heights: As for `project`.
        period_s: Seconds between two writes.
        notify: Called with a line if the files could not be written, and once if the map shows no floor.

    Attributes:
        written: How often the files were written.
        failure: Why the files do not hold the newest 2-D map; "" if they do.

    Raises:
        StereovoxError: The file cannot be written, or the map is not level.
    """

    def __init__(
        self,
        mapper: Mapper,
        file: str | Path,
        heights: Heights | None = None,
        period_s: float = GRID_S,
        notify: Callable[[str], None] = lambda line: None,
    ):
        self._file = check_file(file, FLOOR_ENDINGS)
        self._projection = LiveProjection(mapper.map, heights, notify=lambda line: notify(f"{file}: {line}"))
        self._period_s, self._notify = period_s, notify
        self._worker = ThreadPoolExecutor(1, "stereovox-grid")
        self._busy: Future[None] | None = None
        self._mapper, self._stale = mapper, False
        self._due, self._new = 0.0, False
        self.written, self.failure = 0, ""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Write the 2-D map if that is due and the last write is done."""
        self._new |= not report.refused
        now = monotonic()
        if self._new and now >= self._due and (self._busy is None or self._busy.done()) and self._current():
            self._due = now + self._period_s
            self._write()

    def finish(self) -> None:
        """Write the complete 2-D map, by the floor that the whole run has shown."""
        self._write(last=True)
        if self._busy is not None:
            self._busy.result()

    def close(self) -> None:
        """Wait for the last write."""
        self._worker.shutdown()

    def _current(self) -> bool:
        """Return whether the map is fit to be written; notify the user once if it is too old."""
        why = context_of(self._mapper).stale
        was, self._stale = self._stale, bool(why) and not why.startswith("waiting")  # as every run begins
        if self._stale and not was:
            self._notify(f"{self._file}: is not updated, since the map is {why}")
        return not why

    def _write(self, last: bool = False) -> None:
        self._new = False
        try:
            grid = self._projection.grid(last)
        except StereovoxError as error:
            self._fail(str(error))
            return
        if grid is not None:
            self._busy = self._worker.submit(self._save, grid)
        elif not self.written:
            self.failure = f"{self._file}: nothing is known between these heights; no 2-D map is written"

    def _save(self, grid: OccupancyGrid) -> None:
        try:
            write_map_server(grid, self._file)
            self.written, self.failure = self.written + 1, ""
        except StereovoxError as error:
            self._fail(str(error))

    def _fail(self, why: str) -> None:
        """Notify the user of each problem once: a full disk recurs every second."""
        why = why if why.startswith(f"{self._file}:") else f"{self._file}: {why}"
        if why != self.failure:
            self._notify(why)
        self.failure = why


class LiveSphere:
    """The distances to the nearest surfaces in all directions from the body, by the last image of each camera.

    Args:
        config: Settings of the map; cells are `sphere.step_deg` wide, 2 degrees by default.
        mounts: T_body_camera (4, 4) by the name of the sensor; body x forward, y left, z up.
        picture: PNG to draw at the end; None for no picture.
        mapper: The mapper that takes the images; None: their age is not checked.
        poses: Source of newer poses of the body; None: the poses of the images are the newest.

    Attributes:
        failure: Why a requested picture is missing; "" if there is no problem.

    Raises:
        StereovoxError: The picture cannot be written.
    """

    def __init__(
        self,
        config: Config,
        mounts: Mapping[str, Transform],
        picture: str | Path | None = None,
        mapper: Mapper | None = None,
        poses: LivePoses | None = None,
    ):
        self._mapper, self._poses, self._finished = mapper, poses, False
        self._picture = None if picture is None else check_file(picture, (".png",))
        self._config = load_config(config, **{"sphere.step_deg": config.sphere.step_deg or STEP_DEG})
        self._layout = SphereLayout.configured(self._config.sphere)
        self._mounts, self._pipeline = mounts, DepthPipeline(self._config)
        self._last: dict[str, tuple[SphereGrid, Transform]] = {}
        self.failure = ""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Accumulate the image of a camera, unless the map refused it; lidar clouds and ranges are skipped."""
        if report.refused or isinstance(frame, Rays):
            return
        try:
            image = self._pipeline.checked(self._pipeline.matched(frame))
        except FrameRefused:
            return  # the map accepted it at another quality
        mount = self._mounts[frame.sensor]
        T_world_body = image.T_world_sensor @ inverse(mount)
        self._last[frame.sensor] = accumulate(image, mount, self._config, self._layout), T_world_body

    @property
    def known(self) -> bool:
        """Whether any camera has seen anything."""
        return bool(self._last)

    def grid(self) -> tuple[SphereGrid, int]:
        """Return the grid of all cameras, seen from the newest pose of the body, and its time in nanoseconds.

        Each cell has its own stamp: views of other cameras may be older. Once the run has ended, it is always the grid
        at the last image.

        Raises:
            StereovoxError: Nothing has been seen yet, or the map is waiting, stale or lost (`Mapper.health`).
        """
        if not self._last:
            raise StereovoxError("no image has been mapped yet; try again later")
        if self._mapper is not None and not self._finished and (why := context_of(self._mapper).stale):
            raise StereovoxError(f"the distances may be wrong, since the map is {why}; try again later")
        now = None if self._poses is None or self._finished else self._poses.newest
        return together(self._last, now[:2] if now is not None and np.isfinite(now.T_world_body).all() else None)

    def finish(self) -> None:
        """Draw the picture; `failure` says why it could not be written."""
        self._finished = True
        if self._picture is None:
            return
        from stereovox.view.sphere import sphere_picture

        try:
            grid, now_ns = self.grid()
            sphere_picture(grid, self._picture, now_ns=now_ns)
        except StereovoxError as error:
            self.failure = f"{self._picture}: no picture is written ({error})"

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


STAMP, ARRIVAL = "stamp", "arrival"


class Latency:
    """Milliseconds since the stamp of each mapped image, or since its arrival if the stamp is by another clock.

    Args:
        moment: Returns when the newest image was taken and arrived.
    """

    def __init__(self, moment: Callable[[], Moment]):
        self._moment = moment
        self._map_ms, self._outputs_ms = array("d"), array("d")
        self._since: set[str] = set()
        self.mapped = _Mark(self._map)
        self.sent = _Mark(self._sent)

    def summary(self) -> dict[str, Any]:
        """Return median, p90, p99 and max of `map` and `outputs`, and `since`: `stamp`, `arrival` or both."""
        return {
            "map": percentiles(self._map_ms.tolist()),
            "outputs": percentiles(self._outputs_ms.tolist()),
            "since": " and ".join(sorted(self._since, reverse=True)),
        }

    def _map(self, report: UpdateReport) -> None:
        if not report.refused:
            self._map_ms.append(self._age_ms())

    def _sent(self, report: UpdateReport) -> None:
        if not report.refused:
            self._outputs_ms.append(self._age_ms())

    def _age_ms(self) -> float:
        moment = self._moment()
        if moment.taken_ns is None:
            self._since.add(ARRIVAL)
            return (monotonic_ns() - moment.arrived_ns) / 1e6
        self._since.add(STAMP)
        return (epoch_ns() - moment.taken_ns) / 1e6


class _Mark:
    """An observer that records the time."""

    def __init__(self, note: Callable[[UpdateReport], None]):
        self._note = note

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Record a frame."""
        self._note(report)
