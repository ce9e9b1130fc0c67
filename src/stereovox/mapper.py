# SPDX-License-Identifier: Apache-2.0
"""The whole flow: a frame is made a depth image or a scan, is checked, becomes evidence, and the map takes it in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import monotonic_ns, perf_counter
from typing import Any, Protocol, TypeVar

from stereovox.comparison import Comparison
from stereovox.config import Config, load_config
from stereovox.deadline import Pace
from stereovox.depth import DepthPath
from stereovox.frame import AnyFrame, Scan
from stereovox.frame import UpdateReport as UpdateReport
from stereovox.intake import Intake
from stereovox.integrate.beams import make_beams
from stereovox.maps import VoxelMap, make_map
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.trust.health import Health
from stereovox.trust.validate import trusted

SeenT = TypeVar("SeenT", contravariant=True)


class AnyMapper(Protocol[SeenT]):
    """What builds a map from frames or scans: `Mapper`, `GridMapper`.

    Attributes:
        config: The settings.
    """

    config: Config

    @property
    def map(self) -> VoxelMap | GridMap:
        """The map so far; `map.history` is what it remembers of its frames."""
        ...

    def add(self, frame: SeenT, /) -> UpdateReport:
        """Take one frame into the map, or refuse it, which changes nothing.

        Args:
            frame: Where it was taken is in it.

        Returns:
            What the frame did, or why it was refused.

        Raises:
            StereovoxError: This thread holds the map's `lock`.
        """
        ...

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is; `now_ns`: by the mapper's clock, None for now."""
        ...

    def save(self, path: str | Path) -> None:
        """Save the map, all or nothing; an older one there stays whole until then.

        Raises:
            MapFileError: It cannot be written, or there is nothing to write.
        """
        ...

    def close(self) -> None:
        """Give back what the map holds outside memory."""
        ...


class Mapper:
    """Builds a map from frames. A frame that cannot be trusted is refused and changes nothing.

    Give a profile name, a TOML file or a Config; settings by name on top (`voxel_size=0.1`,
    `**{"sensor.p_free": 0.3}`).
    `resume` is a map to go on with; what its cells mean must not change. `tiles` is the folder for cells that leave a
    window (`window.outside = "keep"`). `clock`: nanoseconds now. Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: VoxelMap | None = None,
        tiles: Path | None = None,
        clock: Callable[[], int] = monotonic_ns,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._pace = Pace(self.config)
        self.map = make_map(self.config, resume, tiles)  # it may leave tiles on the disk: what could fail comes before
        self._intake = Intake(self.config, self.map, clock)
        self._comparison = Comparison(self.config, self._intake.gate)

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Take one frame into the map and tell what it did. Several threads may call: frames go in one by one.

        Raises StereovoxError for a thread that holds the map's `lock`.
        """
        with self._intake.offer(frame) as offer:
            start = perf_counter()
            way = self._pace.way()
            matched = way.depth.matched(frame)
            between = start if matched is frame else perf_counter()
            image = way.depth.image(matched)
            prepared = perf_counter()
            passed = offer.check(image)
            evidence, passed = self._comparison.evidence(frame, image, passed, way.integrator, self.map)
            with self.map.lock:
                self.map.storage.check_room(evidence)
                self.map.storage.look_from(image.viewpoint)
                cells = self.map.add(evidence)
                offer.took(passed, way.name)
                self.map.history.ways[way.name] += 1
                self.map.history.path.walk(passed.sensor, passed.seen)
            done = perf_counter()
            match_ms, depth_ms, map_ms = 1e3 * (between - start), 1e3 * (prepared - between), 1e3 * (done - prepared)
            offer.report = UpdateReport(depth_ms, map_ms, cells, detail=passed.told, match_ms=match_ms, way=way.name)
            self._pace.took(match_ms + depth_ms + map_ms)
            self._pace.rehearse(frame, matched.camera)
        return offer.report

    def __repr__(self) -> str:
        return _described(self)

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is; `now_ns`: by `clock`, None for now."""
        return self._intake.watch.health(now_ns)

    def save(self, path: str | Path) -> None:
        """Save the map to the folder `path`, as `VoxelMap.save`."""
        self.map.save(path)

    def close(self) -> None:
        """Give back what the map holds outside memory (nothing, unless it keeps tiles on disk)."""
        self.map.close()


class GridMapper:
    """Builds a floor's map from lidar scans and depth images. What cannot be trusted is refused and changes nothing.

    Poses must be in the map's frame: `Track.corrected` turns those of the odometry into such. Give a profile name, a
    TOML file or a Config; settings by name on top (`voxel_size=0.02`, `**{"grid.update": "every"}`).
    `resume` is a map to go on with, in its own frame. `clock`: nanoseconds now. Raises ConfigError for bad settings.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: GridMap | OccupancyGrid | None = None,
        clock: Callable[[], int] = monotonic_ns,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._depth = DepthPath(self.config)
        self._beams = make_beams(self.config)
        self.map = _grid_map(self.config, resume)
        self._intake = Intake(self.config, self.map, clock)

    def add(self, seen: Scan | AnyFrame) -> UpdateReport:
        """Take one scan or depth image into the map and tell what it did; `depth_ms` is what the scan took.

        Several threads may call: scans go in one by one. Raises StereovoxError for one that holds the map's `lock`.
        """
        with self._intake.offer(seen) as offer:
            start = perf_counter()
            scan = trusted(seen if isinstance(seen, Scan) else self._scan_of(seen), self.config)
            passed = offer.check(scan)
            prepared = perf_counter()
            evidence = self._beams.evidence(scan, self.map.origin)
            with self.map.lock:
                self.map.storage.check_room(evidence)
                cells = self.map.add(evidence)
                offer.took(passed)
            done = perf_counter()
            offer.report = UpdateReport(1e3 * (prepared - start), 1e3 * (done - prepared), cells, detail=passed.told)
        return offer.report

    def __repr__(self) -> str:
        return _described(self)

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is; `now_ns`: by `clock`, None for now."""
        return self._intake.watch.health(now_ns)

    def occupancy(self) -> OccupancyGrid:
        """Return the map so far as plain numbers, as ROS publishes it."""
        return self.map.occupancy()

    def save(self, path: str | Path, mode: str = "trinary") -> None:
        """Save the map: exactly to a `.npz`, as `GridMap.save`, or as files of map_server, as `write_map_server`."""
        if Path(path).suffix.lower() == ".npz":
            return self.map.save(path)
        from stereovox.formats.map_server import write_map_server

        write_map_server(self.map.occupancy(), path, mode=mode)

    def close(self) -> None:
        """Do nothing: all of the map is in memory."""

    def _scan_of(self, frame: AnyFrame) -> Scan:
        from stereovox.depth.scan import scan_of

        return scan_of(self._depth.image(self._depth.matched(frame)), self.config)


def _grid_map(config: Config, resume: GridMap | OccupancyGrid | None) -> GridMap:
    if resume is None:
        return GridMap(config)
    if isinstance(resume, OccupancyGrid):
        return GridMap.from_occupancy(resume, config)
    resume.storage.continue_with(config)
    return resume


def _described(mapper: AnyMapper[Any]) -> str:
    """Return what `repr` says of a mapper."""
    return f"<{type(mapper).__name__}: profile '{mapper.config.profile}'; {mapper.map!r}>"
