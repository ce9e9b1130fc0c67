# SPDX-License-Identifier: Apache-2.0
"""Rebuild the part of a map that corrected poses change, from the frames it kept.

The value of a cell depends only on the frames that see it, and on their order. So only blocks that a moved frame saw
before, or sees now, are rebuilt, in a map of their own, from all kept frames that see them; then they replace the old
ones. If nearly all frames see them, the whole map is rebuilt without a search. So are bounded maps: every pose decides
where their window was, and what had room. So is a map that kept only some frames: the result then is the map of these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import FORWARD, AnyImage, Cloud, Frame, Viewpoint, viewpoint_of
from stereovox.frame.validate import rigid_pose
from stereovox.geometry.se3 import Transform
from stereovox.integrate import Integration
from stereovox.kernels.threads import Ahead, uninterrupted
from stereovox.maps import make_map
from stereovox.maps.cells import _pool
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.record.camera_path import StampedPose
from stereovox.maps.record.corrected import correct_history, matrix_of
from stereovox.maps.record.kept_frames import KeptFrame, KeptFrames, blocks_seen
from stereovox.maps.storage.blocks import CELLS, BlockPool
from stereovox.maps.storage.storage import Storage

TO_LOOK = 2
"""Cost of finding the blocks that a moved frame sees, before and after; the unit is mapping one frame."""
FEW, ROUNDS = 2, 20
"""Backlog of frames at which new ones are made to wait, and most rounds until they are in any case."""
CORRECTED = ", poses corrected"
"""Suffix of the name of a corrected map's recording: the poses of its next frames would not fit."""
FrameKey = int | tuple[str, int]
"""Names a frame: its stamp in nanoseconds, or sensor and stamp."""
FramePoses = Mapping[int, Transform] | Mapping[tuple[str, int], Transform] | Mapping[FrameKey, Transform]
"""Poses (4, 4) by frame."""


@dataclass(frozen=True)
class CorrectionReport:
    """What a correction of poses did to the map.

    Attributes:
        moved: Number of frames that got another pose.
        ignored: Number of poses for which no frame is kept.
        mapped: Number of frames that were mapped again.
        blocks: Number of blocks of 8x8x8 cells that were rebuilt.
        all_frames: Whether all frames of the map are kept. If not, the map now holds only the kept ones.
    """

    moved: int = 0
    ignored: int = 0
    mapped: int = 0
    blocks: int = 0
    all_frames: bool = True


class Prepared(Protocol):
    """A frame that is ready for the integrator."""

    @property
    def image(self) -> AnyImage:
        """Its depth image."""
        ...


class Level(Protocol):
    """A quality level; see `deadline.Quality`."""

    @property
    def prepare(self) -> Callable[[Frame | Cloud], Prepared]:
        """Turns a frame into a checked image or cloud."""
        ...

    @property
    def integrator(self) -> Integration:
        """Turns a depth image into evidence."""
        ...


def correct(
    storage: Storage,
    level: Callable[[str], Level],
    poses: FramePoses,
    no_frame_comes: AbstractContextManager[object],
    tiles: Path | None,
) -> CorrectionReport:
    """Give frames of a map new poses, as `Mapper.correct` describes.

    level: returns the quality level of a name; called by this thread, and by another one that prepares frames ahead.
    no_frame_comes: entered while the result is put into the map; until then the map may accept frames. tiles: as in
    `make_map`.
    """
    kept = need_frames(storage.kept, "the map")
    moved, ignored = moved_frames(kept.frames, poses, storage.config)
    if not moved:
        return CorrectionReport(ignored=ignored, all_frames=kept.are_all(storage.history.frames))
    rebuild = Rebuild(storage, level, moved, tiles)
    try:
        for _ in range(ROUNDS):
            if rebuild.behind > FEW:
                rebuild.catch_up()
        with no_frame_comes, storage.lock:
            if rebuild.outdated:
                rebuild.close()
                rebuild = Rebuild(storage, level, moved, tiles)
            rebuild.catch_up()
            with uninterrupted():
                report = rebuild.finish()
            return replace(report, ignored=ignored)
    except BaseException:
        rebuild.close()
        raise


def begin_anew(storage: Storage, tiles: Path | None) -> None:
    """Empty a map, and its history, whose frames none has confirmed; the lock must be held. tiles: as above."""
    changed = storage.coords_in_memory.copy()
    storage.replace_contents(make_map(_without_frames(storage.config), None, _other_than(tiles, storage)).storage)
    storage.history.begin_anew()
    if storage.kept is not None:
        storage.kept.clear()
    _notify(storage, changed)


def _notify(storage: Storage, changed: NDArray[np.int32]) -> None:
    """Notify the listeners that blocks at (n, 3) were replaced."""
    blocks, zeros = np.empty((0, 3), np.int32), np.zeros(len(changed), np.int16)
    for listener in storage.listeners:
        listener(Evidence(blocks, np.empty((0, CELLS), np.int16), changed, zeros))


def need_frames(kept: KeptFrames | None, where: str) -> KeptFrames:
    """Return the kept frames of a map. Raises StereovoxError if there are none; `where`: names the map."""
    if kept is None or not len(kept):
        raise StereovoxError(f"{where} did not keep its frames; map again with map.keep_frames=true")
    return kept


def moved_frames(frames: Sequence[KeptFrame], poses: FramePoses, config: Config) -> tuple[dict[int, Transform], int]:
    """Return the new poses by frame number, and how many poses belong to no kept frame.

    Poses that a frame already has are omitted. Raises StereovoxError if no pose belongs to a kept frame, if a stamp
    without a sensor fits several frames, and for poses that are no rigid motions.
    """
    given: dict[FrameKey, Transform] = {key: pose for key, pose in poses.items()}  # noqa: C416 - a type checker refuses dict(poses)
    by_key: dict[FrameKey, list[KeptFrame]] = {}
    for frame in frames:
        by_key.setdefault(frame.stamp_ns, []).append(frame)
        by_key.setdefault((frame.sensor, frame.stamp_ns), []).append(frame)
    named = {key: by_key[key] for key in given if key in by_key}
    if not named:
        first, last = frames[0].stamp_ns, frames[-1].stamp_ns
        raise StereovoxError(
            f"none of the {len(poses)} poses has the stamp of a kept frame; their stamps are from {first} to {last} ns"
        )
    moved: dict[int, Transform] = {}
    for key, found in named.items():
        frame, sensors = found[0], sorted({frame.sensor for frame in found})
        if len(found) > 1:
            is_same = len(sensors) < len(found)
            cure = "such a map cannot be corrected" if is_same else "name them (sensor, stamp)"
            names = ", ".join(f"'{sensor}'" for sensor in sensors)
            raise StereovoxError(f"{len(found)} frames have the stamp {frame.stamp_ns} ({names}); {cure}")
        if (frame.sensor, frame.stamp_ns) in named and key == frame.stamp_ns:
            raise StereovoxError(
                f"the frame of '{frame.sensor}' at {frame.stamp_ns} ns has two poses, one by its stamp and one by "
                "sensor and stamp; give one"
            )
        posed = Frame(np.empty((0, 0), np.float32), FORWARD, given[key], name=frame.name)
        rigid_pose(posed, config.pose_rigidity_tolerance)  # raises if it is not rigid
        if not np.array_equal(given[key], frame.T_world_sensor):
            moved[frame.number] = np.array(given[key], float)
    return moved, len(poses) - len(named)


def as_corrected(recording: str) -> str:
    """Return the recording's name for a map whose poses were corrected; "" if it has none."""
    return f"{recording.removesuffix(CORRECTED)}{CORRECTED}" if recording else ""


class Rebuild:
    """A map whose poses are being corrected: `catch_up` maps kept frames again, `finish` puts the result into it.

    Args:
        storage: The map; it may accept frames until `finish`.
        level: As in `correct`.
        moved: New poses (4, 4) by frame number.
        tiles: As in `correct`.
        whole: Whether to rebuild all blocks in any case.
    """

    def __init__(
        self,
        storage: Storage,
        level: Callable[[str], Level],
        moved: Mapping[int, Transform],
        tiles: Path | None = None,
        *,
        whole: bool = False,
    ):
        assert storage.kept is not None
        self._storage, self._level, self._moved = storage, level, moved
        self._kept: KeptFrames = storage.kept
        self._before, self._after, self._mapped = self._kept.frames, list[KeptFrame](), 0
        self._is_in_place = False
        self._loaded = Ahead(partial(_prepared, level))
        self._dirty = None if whole or self._is_whole() else self._seen_by_moved()
        self._scratch = make_map(_without_frames(storage.config), None, _other_than(tiles, storage)).storage
        if self._dirty is not None and storage.times_start_ns is not None:
            nothing = np.empty((0, 3), np.int32), np.empty((0, CELLS), np.uint32)
            self._scratch.set_times(*nothing, storage.times_start_ns)

    @property
    def behind(self) -> int:
        """How many kept frames have not been mapped again yet."""
        return len(self._kept) - len(self._after)

    @property
    def outdated(self) -> bool:
        """Whether the result is useless, because not all new frames could be kept."""
        dropped = self._dirty is not None and not self._kept.are_all(self._storage.history.frames)
        return dropped or self._kept.frames[: len(self._before)] != self._before

    def catch_up(self) -> None:
        """Map again all frames kept by now that have not been."""
        if self.outdated:
            return
        self._before = self._kept.frames
        frames = [self._posed(frame) for frame in self._before[len(self._after) :]]
        again = [frame for frame in frames if self._must_be_mapped(frame)]
        coming, again = iter(again[1:]), {frame.number for frame in again}
        for frame in frames:
            self._scratch.history.frames = frame.number  # 8-bit cells are rounded by it
            if frame.number in again:
                self._expect(next(coming, None))
                frame = self._mapped_again(frame)
            else:
                self._scratch.set_viewpoint(_viewpoint(frame))
            self._after.append(frame)

    def finish(self) -> CorrectionReport:
        """Put the result into the map, notify its listeners and return a report. The lock must be held."""
        changed, self._is_in_place = self._swap(), True
        before, after = ([(frame.sensor, frame.seen) for frame in frames] for frames in (self._before, self._after))
        self._kept.replace(self._after)
        history = self._storage.history
        correct_history(history, before, after)
        if self._moved:
            history.recording = as_corrected(history.recording)
        _notify(self._storage, changed)
        all_frames = self._kept.are_all(self._storage.history.frames)
        return CorrectionReport(len(self._moved), 0, self._mapped, len(changed), all_frames)

    def close(self) -> None:
        """Release the result, unless `finish` has put it into the map."""
        if not self._is_in_place:
            self._scratch.close()

    def _is_whole(self) -> bool:
        """Return whether all blocks are rebuilt."""
        storage, first = self._storage, self._before[0]
        partly_kept = not self._kept.are_all(storage.history.frames)
        starts_anew = storage.config.map.keep_times and (first.number in self._moved or not first.blocks.any())
        return storage.bounded or partly_kept or starts_anew or self._is_less_work()

    def _is_less_work(self) -> bool:
        """Return whether mapping all frames again is likely less work than finding which ones must be."""
        low, high = np.stack([frame.blocks for frame in self._before], axis=1)
        near = np.zeros(len(low), bool)
        for n, frame in enumerate(self._before):
            if frame.number in self._moved:
                near |= ((low < high[n]) & (low[n] < high)).all(axis=1)
        return TO_LOOK * len(self._moved) + int(np.count_nonzero(near)) >= len(near)

    def _seen_by_moved(self) -> BlockPool:
        """Return the blocks on which moved frames had evidence, or now have it."""
        seen = BlockPool(np.uint8, cells=1)
        for frame in self._before:
            if frame.number in self._moved:
                offered, level = frame.frame(), self._level(frame.quality)
                for pose in (frame.T_world_sensor, self._moved[frame.number]):
                    evidence = level.integrator.evidence(level.prepare(replace(offered, T_world_sensor=pose)).image)
                    seen.insert(evidence.coords)
                    seen.insert(evidence.uniform)
        return seen

    def _posed(self, frame: KeptFrame) -> KeptFrame:
        """Return a frame at its new pose, or unchanged if it has none."""
        pose = self._moved.get(frame.number)
        return frame if pose is None else replace(frame, T_world_sensor=pose)

    def _must_be_mapped(self, frame: KeptFrame) -> bool:
        """Return whether a frame may have evidence on blocks that are rebuilt."""
        if self._dirty is None or frame.number in self._moved:
            return True
        coords, (low, high) = self._dirty.coords[: len(self._dirty)], frame.blocks
        return bool(((coords >= low) & (coords < high)).all(axis=1).any())

    def _expect(self, frame: KeptFrame | None) -> None:
        """Begin to prepare the frame that will be mapped next, if a thread is free for it."""
        if frame is not None and self._storage.config.threads > 1:
            self._loaded.begin(frame)

    def _mapped_again(self, frame: KeptFrame) -> KeptFrame:
        """Map a frame, and return it with the blocks that it sees from its pose."""
        image = self._loaded(frame).image
        evidence = self._level(frame.quality).integrator.evidence(image)
        seen = StampedPose(frame.seen.stamp_ns, tuple(image.T_world_sensor.ravel().tolist()[:12]))
        frame = replace(frame, seen=seen, blocks=blocks_seen(evidence))
        evidence = self._part(evidence)
        self._check_room(evidence)
        self._scratch.set_viewpoint(image.viewpoint)
        self._scratch.add(evidence)
        self._mapped += 1
        return frame

    def _part(self, evidence: Evidence) -> Evidence:
        """Return the evidence on blocks that are rebuilt."""
        if self._dirty is None:
            return evidence
        mixed, free = (_is_in(self._dirty, coords) for coords in (evidence.coords, evidence.uniform))
        return Evidence(
            evidence.coords[mixed], evidence.values[mixed], evidence.uniform[free], evidence.uniform_values[free],
            evidence.weak,
        )  # fmt: skip

    def _check_room(self, evidence: Evidence) -> None:
        try:
            self._scratch.check_room(evidence)
        except FrameRefused as error:
            raise StereovoxError(f"from the corrected poses, {error}; nothing was changed") from None

    def _swap(self) -> NDArray[np.int32]:
        """Put the rebuilt blocks into the map; return their coordinates (n, 3)."""
        storage, scratch, last = self._storage, self._scratch, self._before[-1]
        if self._dirty is not None:
            changed = self._dirty.coords[: len(self._dirty)].copy()
            storage.replace_blocks(changed, scratch)
            if last.number in self._moved:
                storage.viewpoint = scratch.viewpoint
            return changed
        changed = np.concatenate([storage.coords_in_memory, scratch.coords_in_memory])
        storage.replace_contents(scratch)
        return np.unique(changed, axis=0)


def _prepared(level: Callable[[str], Level], frame: KeptFrame) -> Prepared:
    return level(frame.quality).prepare(frame.frame())


def _without_frames(config: Config) -> Config:
    """Return the settings for a map of the same cells that keeps no frames."""
    cells = config.map.model_copy(update={"keep_frames": False, "frames_budget": None})
    return config.model_copy(update={"map": cells})


def _other_than(tiles: Path | None, storage: Storage) -> Path | None:
    """Return a folder for tiles next to the one that a map uses."""
    store = storage.tile_store
    return tiles.with_name(f"{tiles.name}-anew") if tiles and store and store.folder == tiles else tiles


def _viewpoint(frame: KeptFrame) -> Viewpoint:
    return viewpoint_of(frame.camera, matrix_of(frame.seen), frame.seen.stamp_ns)


def _is_in(blocks: BlockPool, coords: NDArray[np.int32]) -> NDArray[np.bool_]:
    places = np.empty(len(coords), np.int64)
    _pool.find_all(blocks.table, blocks.coords, np.ascontiguousarray(coords), places)
    return places >= 0
