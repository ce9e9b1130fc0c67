# SPDX-License-Identifier: Apache-2.0
"""The whole flow in one file: a frame becomes a depth image, is checked, becomes evidence and enters the map.

Read `Mapper.add` (voxel maps) or `GridMapper.add` (2-D grids) first: each step is a call into the module that does it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import monotonic_ns, perf_counter
from typing import Any, Protocol, TypeVar

from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline
from stereovox.depth.cloud import level_range
from stereovox.depth.quality import checked_scan
from stereovox.errors import ConfigError, MapFileError
from stereovox.frame import AnyFrame, Cloud, Frame, Range, Scan
from stereovox.frame import UpdateReport as UpdateReport
from stereovox.frame.stamp_clock import StampsBy
from stereovox.frame.validate import validate_upright_scan
from stereovox.integrate.beams import cone_evidence, make_beams
from stereovox.kernels.device import check_on_processor, on_usable_device
from stereovox.kernels.threads import MapLock, uninterrupted
from stereovox.mapping.comparison import Comparison
from stereovox.mapping.deadline import Deadline, Levels
from stereovox.mapping.floor_comparison import FloorComparison
from stereovox.mapping.gate import GateResult
from stereovox.mapping.intake import Aged, Intake
from stereovox.mapping.rebuild import CorrectionReport, FramePoses, begin_anew, correct
from stereovox.maps import VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.record.health import Health
from stereovox.maps.record.kept_frames import Packed, PackedCloud, kept_frame, packed_of

SeenT = TypeVar("SeenT", contravariant=True)


class AnyMapper(Protocol[SeenT]):
    """A mapper: builds a map from frames or scans. Implemented by `Mapper` and `GridMapper`.

    Attributes:
        config: The settings.
    """

    config: Config

    @property
    def stamp_clock(self) -> StampsBy:
        """By which clock frames are stamped; it may be set at any time."""
        ...

    @stamp_clock.setter
    def stamp_clock(self, clock: StampsBy) -> None: ...

    @property
    def map(self) -> VoxelMap | GridMap:
        """The map so far; `map.history` records the frames that made it."""
        ...

    def add(self, frame: SeenT, /) -> UpdateReport:
        """Add one frame to the map, or refuse it, which changes nothing.

        Args:
            frame: The frame, with the pose it was taken at.

        Returns:
            What the frame changed, or why it was refused.

        Raises:
            StereovoxError: This thread holds the map's `lock`.
        """
        ...

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is.

        Args:
            now_ns: Nanoseconds by the mapper's clock; None for now.

        Returns:
            State, age and recent refusals of the map.
        """
        ...

    def save(self, path: str | Path) -> None:
        """Save the map, all or nothing: an older map at `path` stays whole until the new one is complete.

        Args:
            path: Where to save it.

        Raises:
            MapFileError: It cannot be written, or there is nothing to write.
        """
        ...

    def close(self) -> None:
        """Release what the map holds outside memory."""
        ...


class Mapper(Aged):
    """Builds a voxel map from depth images, stereo pairs, clouds of lidars or distances of sonars.

    A frame that cannot be trusted is refused and changes nothing but the count of refusals.

    Args:
        profile: Profile name, TOML file or `Config`.
        resume: Map to continue; the settings that give its cells their meaning must not change.
        tiles: Folder for cells that leave a window (`window.outside = "keep"`).
        clock: Returns the time in nanoseconds; used for `health`.
        stamp_clock: By which clock frames are stamped, as the attribute `stamp_clock`.
        **overrides: Settings that replace those of the profile (`voxel_size=0.1`, `**{"sensor.p_free": 0.3}`).

    Attributes:
        config: The resolved settings.
        map: The map so far.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.

    Warns:
        RuntimeWarning: `device` is "cuda" and there is no graphics card to use; the map is made on the processor.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: VoxelMap | None = None,
        tiles: Path | None = None,
        clock: Callable[[], int] = monotonic_ns,
        stamp_clock: StampsBy = None,
        **overrides: Any,
    ):
        self.config = on_usable_device(load_config(profile, **overrides))
        self._deadline = Deadline(self.config)
        self._levels, self._tiles, self._correcting = Levels(self.config), tiles, MapLock()
        self.map = make_map(self.config, resume, tiles)  # may leave tiles on disk, so whatever can fail comes first
        self._intake = Intake(self.config, self.map, clock, stamp_clock, is_new=resume is None)
        self._comparison = Comparison(self.config, self._intake.gate)

    def add(self, frame: AnyFrame) -> UpdateReport:
        """Add one frame to the map, or refuse it. Threads may call this concurrently; frames enter one at a time.

        Args:
            frame: Depth image, stereo pair, cloud or range, with the pose it was taken at.

        Returns:
            What the frame changed and how long each step took, or why it was refused.

        Raises:
            StereovoxError: This thread holds the map's `lock`.
        """
        with self._intake.offer(frame) as offer:  # a FrameRefused ends here and becomes the report
            quality = self._deadline.quality()
            depth_frame, image, match_ms, depth_ms = quality.prepare(frame)
            prepared = perf_counter()
            passed = offer.check(image)
            evidence = quality.integrator.evidence(image)
            if passed.repeats:
                evidence = replace(evidence, again=True)
            passed = self._comparison.check(frame, image, evidence, passed, self.map)
            packed = self._packed(depth_frame, passed)
            with self.map.lock, uninterrupted():
                self.map.storage.check_room(evidence)
                if passed.takes_out:
                    begin_anew(self.map.storage, self._tiles)
                self.map.storage.set_viewpoint(image.viewpoint)
                cells = self.map.add(evidence)
                self._keep(depth_frame, packed, passed, quality.name, evidence)
                offer.accept(passed, quality.name)
                self.map.history.quality[quality.name] += 1
                self.map.history.path.walk(passed.sensor, passed.seen)
            map_ms = 1e3 * (perf_counter() - prepared)
            offer.report = UpdateReport(
                depth_ms, map_ms, cells, None, passed.note, match_ms, quality.name, passed.takes_out
            )
            self._deadline.record(match_ms + depth_ms + map_ms)
            self._deadline.warm_up(frame, depth_frame.camera)
        return offer.report

    def correct(self, poses: FramePoses) -> CorrectionReport:
        """Give frames of the map new poses, as after a loop closure; needs `map.keep_frames`.

        The map is then bit for bit the one that a new run makes of the same frames at these poses. Frames that were
        refused are not judged again. Other threads may add frames and read the map meanwhile; it changes at once. The
        gate compares the next frames of a sensor with the corrected pose of its last one.

        If `map.frames_budget` did not hold all frames, the map is made of those that are kept.

        Args:
            poses: T_world_sensor (4, 4) by the frame's stamp in nanoseconds, or by sensor and stamp if several
                frames have it. Poses of frames that are not kept, such as refused ones, are ignored and counted.

        Returns:
            How many frames moved and how much was made anew.

        Raises:
            StereovoxError: No frame was kept, no pose is of one that was, a pose is no rigid motion, the corrected map
                does not fit into `max_memory`, or this thread holds the map's `lock`. The map is then as it was.
            MapFileError: Kept frames of a map that was loaded are gone from the disk.
        """
        self.map.lock.refuse_holder("poses cannot be corrected")
        with self._correcting:
            return correct(self.map.storage, self._levels, poses, self._intake.closed(), self._tiles)

    def expect(self, frame: AnyFrame) -> None:
        """Begin to prepare the frame that will be added next, in the background, while this one is added.

        Call it before `add` of the frame before; the map is the same without. Nothing happens with one thread
        (`threads`), or with `deadline_ms`, where the time that is left decides how a frame is prepared.

        Args:
            frame: The very object that `add` will get. It must not change meanwhile.
        """
        if self.config.threads > 1:
            self._deadline.expect(frame)

    def __repr__(self) -> str:
        return _summary(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the map's picture and facts."""
        return self.map._repr_html_(f"Mapper, profile '{self.config.profile}'")

    def save(self, path: str | Path) -> None:
        """Save the map to a folder, all or nothing, as `VoxelMap.save` does.

        Args:
            path: The folder.

        Raises:
            MapFileError: It cannot be written.
        """
        self.map.save(path)

    def close(self) -> None:
        """Release what the map holds outside memory: nothing, unless it keeps tiles on disk."""
        self.map.close()

    def _packed(self, frame: Frame | Cloud, passed: GateResult) -> Packed | PackedCloud | None:
        """Return the frame's depth image or cloud to be kept; None if it is not."""
        kept = self.map.storage.kept
        wanted = kept is not None and not passed.repeats and kept.wants(passed.sensor, passed.seen)
        return packed_of(frame) if wanted else None

    def _keep(
        self,
        frame: Frame | Cloud,
        packed: Packed | PackedCloud | None,
        passed: GateResult,
        quality: str,
        evidence: Evidence,
    ) -> None:
        kept = self.map.storage.kept
        if kept is not None and packed is not None:
            kept.keep(kept_frame(frame, packed, self.map.frames, passed.sensor, passed.seen, quality, evidence))


class GridMapper(Aged):
    """Builds a 2-D occupancy grid of a floor from lidar scans, depth images and distances of sonars.

    A scan that cannot be trusted is refused and changes nothing but the count of refusals. Poses must be in the map's
    frame; `Track.corrected` brings odometry poses into it.

    Args:
        profile: Profile name, TOML file or `Config`.
        resume: Map to continue, in its own frame.
        clock: Returns the time in nanoseconds; used for `health`.
        stamp_clock: By which clock frames are stamped, as the attribute `stamp_clock`.
        **overrides: Settings that replace those of the profile (`voxel_size=0.02`, `**{"grid.update": "every"}`).

    Attributes:
        config: The resolved settings.
        map: The map so far.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        resume: GridMap | OccupancyGrid | None = None,
        clock: Callable[[], int] = monotonic_ns,
        stamp_clock: StampsBy = None,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        check_on_processor(self.config)
        self._depth = DepthPipeline(self.config)
        self._beams = make_beams(self.config)
        self.map = _grid_map(self.config, resume)
        self._intake = Intake(self.config, self.map, clock, stamp_clock, is_new=resume is None)
        self._comparison = FloorComparison(self.config, self._intake.gate, isinstance(resume, OccupancyGrid))

    def add(self, frame: Scan | AnyFrame) -> UpdateReport:
        """Add one scan to the map, or refuse it. Threads may call this concurrently; scans enter one at a time.

        Args:
            frame: Lidar scan, a depth image or stereo pair that is turned into one, or a range.

        Returns:
            What the scan changed, or why it was refused. `depth_ms` is the time to prepare the scan.

        Raises:
            StereovoxError: This thread holds the map's `lock`.
        """
        with self._intake.offer(frame) as offer:  # a FrameRefused ends here and becomes the report
            started = perf_counter()
            scan = level_range(frame, self.config) if isinstance(frame, Range) else self._to_scan(frame)
            passed = offer.check(scan)
            prepared = perf_counter()
            if isinstance(scan, Range):  # it is not compared, for it yields to the map
                evidence = replace(cone_evidence(scan, self.config, self.map.origin), again=passed.repeats)
            else:
                evidence = self._beams.evidence(scan, self.map.origin)
                passed = self._comparison.check(frame, scan, evidence, passed, self.map)
            with self.map.lock, uninterrupted():
                self.map.storage.check_room(evidence)
                if passed.takes_out:
                    self.map.storage.begin_anew()
                cells = self.map.add(evidence)
                offer.accept(passed)
            depth_ms, map_ms = 1e3 * (prepared - started), 1e3 * (perf_counter() - prepared)
            offer.report = UpdateReport(depth_ms, map_ms, cells, detail=passed.note, taken_out=passed.takes_out)
        return offer.report

    def __repr__(self) -> str:
        return _summary(self)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the map's picture and facts."""
        return self.map._repr_html_(f"GridMapper, profile '{self.config.profile}'")

    def occupancy(self) -> OccupancyGrid:
        """Return the map so far as an occupancy grid, in the form that ROS publishes.

        Returns:
            Cells from 0 (free) to 100 (occupied), -1 for unknown.
        """
        return self.map.occupancy()

    def save(self, path: str | Path, mode: str = "trinary") -> None:
        """Save the map: without loss to a `.npz` (`GridMap.save`), else as map_server files (`write_map_server`).

        Args:
            path: The file; its ending chooses the format.
            mode: Mode of the map_server files; has no meaning for `.npz`.

        Raises:
            MapFileError: It cannot be written, or there is nothing to write.
        """
        if Path(path).suffix.lower() == ".npz":
            return self.map.save(path)
        from stereovox.formats.map_server import write_map_server

        if not any(self.map.counts().values()):
            raise MapFileError(f"{path}: nothing is mapped so far; save it later")
        write_map_server(self.map.occupancy(), path, mode=mode)

    def close(self) -> None:
        """Do nothing: the whole map is in memory."""

    def _to_scan(self, frame: Scan | AnyFrame) -> Scan:
        if isinstance(frame, Scan):
            return checked_scan(frame, self.config)
        from stereovox.depth.scan import check_floor, scan_of

        image = self._depth.image(self._depth.matched(frame))
        check_floor(image, self.config)
        return validate_upright_scan(scan_of(image, self.config), self.config)


def _grid_map(config: Config, resume: GridMap | OccupancyGrid | None) -> GridMap:
    if config.map.keep_frames:
        raise ConfigError("map.keep_frames is for maps in space; leave it out for the map of a floor")
    if resume is None:
        return GridMap(config)
    if isinstance(resume, OccupancyGrid):
        return GridMap.from_occupancy(resume, config)
    resume.storage.continue_with(config)
    return resume


def _summary(mapper: AnyMapper[Any]) -> str:
    """Return the `repr` of a mapper."""
    return f"<{type(mapper).__name__}: profile '{mapper.config.profile}'; {mapper.map!r}>"
