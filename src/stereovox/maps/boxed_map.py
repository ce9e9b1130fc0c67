# SPDX-License-Identifier: Apache-2.0
"""Maps in boxes: opened without loading, and made from other maps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.places import Place
from stereovox.maps.cells.cell_format import State
from stereovox.maps.cells.pyramid import write_levels
from stereovox.maps.files.boxed_manifest import (
    BoxedManifest,
    bounds_of,
    only_writer_at,
    sweep_boxes,
    write_boxed_manifest,
)
from stereovox.maps.files.lock import LOCK
from stereovox.maps.files.store import MANIFEST
from stereovox.maps.query import queries
from stereovox.maps.query.queries import NearestCells, QueryTarget, RayHits
from stereovox.maps.storage.blocks import SIDE
from stereovox.maps.storage.boxed_storage import CACHE_BYTES, BoxedStorage, Wanted, any_box
from stereovox.maps.storage.boxes import BOXES, MAX_SIDE, BoxLayout, read_box, write_box
from stereovox.maps.voxel_map import VoxelMap, unbounded

USUAL_SIDE = 256
"""Cells along the side of a box by default."""
OURS = (f"{BOXES}/", MANIFEST, LOCK, ".writer")
"""Prefixes of the names of all files of a map in boxes."""


class BoxedMap(VoxelMap):
    """A map in boxes, in a folder or an object store, used without loading it.

    Every `VoxelMap` query gives the same answer as on a map in memory. Only the boxes it needs are read, and recently
    used ones stay in a cache of bounded size; a single ray, box or capsule that needs more than the cache holds is
    refused with the cure. `counts` and `bounds` read nothing. Nothing can be added to it.
    """

    storage: BoxedStorage  # pyrefly: ignore[bad-override-mutable-attribute] - set once

    def __init__(self, place: Place, manifest: BoxedManifest, cache_bytes: int = CACHE_BYTES):
        super().__init__(manifest.layout.config, storage=BoxedStorage(place, manifest, cache_bytes))

    @property
    def manifest(self) -> BoxedManifest:
        """The map's boxes, and the levels of the pyramid."""
        return self.storage.manifest

    @property
    def memory_bytes(self) -> int:
        """Approximate bytes of the whole map in memory; the cache stays within its own size."""
        return self.storage.bytes_of_all

    def counts(self) -> dict[str, int]:
        """Return the number of cells in each known state: `free`, `tentative`, `occupied`."""
        boxes = self.manifest.boxes
        return {name: sum(getattr(box, name) for box in boxes) for name in ("free", "tentative", "occupied")}

    def bounds(self) -> NDArray[np.float64] | None:
        """Return the lowest and highest corner (2, 3) in metres of all known cells; None for an empty map."""
        return np.stack(bounds_of(self.manifest.boxes)) * self.config.cell if self.manifest.boxes else None

    def overview(self, most: int = 4_000_000) -> VoxelMap:
        """Return the whole map in memory, in cells large enough that about `most` are known; see `VoxelMap`.

        Args:
            most: Most known cells to load.

        Returns:
            The map of one level of the pyramid, with the history of this one.

        Raises:
            StereovoxError: Even the coarsest level has far more.
            MapFileError: A box is missing or damaged.
        """
        levels = [self.manifest.boxes, *self.manifest.levels]
        known = [sum(entry.known for entry in level) for level in levels]
        level = next((n for n, cells in enumerate(known) if cells <= most), len(levels) - 1)
        if known[level] > max(4 * most, 1_000_000):
            raise StereovoxError(f"{self.storage.place}: has no level coarse enough to show; cut it into boxes again")
        if level == 0:
            return unbounded(self)
        layout = self.manifest.layout_of(level)
        coarse = VoxelMap(layout.config)
        for entry in levels[level]:
            coarse.storage.insert(*read_box(self.storage.place, layout, entry)[:2])
        coarse.storage.take_history(self.storage)
        return coarse

    def cast_rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_distance: float,
        stop_at: Iterable[State] = (State.OCCUPIED,),
    ) -> RayHits:
        """Find where rays stop, box by box along them; see `VoxelMap.cast_rays`."""
        stop_at = _as_list(stop_at)
        number = len(queries.cast_rays(self._asked, origins, directions, 0.0, stop_at).distance)  # validates the input
        hits, longest = RayHits.none(number), queries.distance_of(max_distance)
        starts, ways = (np.array(queries.points_of(values), float) for values in (origins, directions))
        starts = np.broadcast_to(starts, ways.shape)
        units = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        through, step = State.UNKNOWN not in stop_at, float(self.manifest.layout.metres.min())
        last = np.minimum(self._exits(starts, units, through), longest)
        left, begin = np.flatnonzero(last >= 0), 0.0
        while len(left):
            end = min(begin + step, longest)
            ends = [starts[left] + units[left] * metres for metres in (begin if through else 0.0, end)]
            for part in self._parts(np.minimum(*ends), np.maximum(*ends), stop_at):
                rays = left[part]
                found = queries.cast_rays(self._asked, starts[rays], ways[rays], end, stop_at)
                for mine, theirs in zip(hits, found, strict=True):
                    mine[rays] = theirs
            left = left[~np.isfinite(hits.distance[left]) & (last[left] > end)]
            begin = end
        return hits

    def check_boxes(self, low: ArrayLike, high: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst state in boxes; see `VoxelMap.check_boxes`."""
        number = len(queries.check_boxes(self._nothing, low, high))  # validates the input
        lows, highs = (np.array(queries.points_of(values), float) for values in (low, high))
        worst = np.empty(number, np.uint8)
        for part in self._parts(lows, highs):
            worst[part] = queries.check_boxes(self._asked, lows[part], highs[part])
        return worst

    def check_capsules(self, start: ArrayLike, end: ArrayLike, radius: ArrayLike) -> NDArray[np.uint8]:
        """Return the worst state that capsules touch; see `VoxelMap.check_capsules`."""
        number = len(queries.check_capsules(self._nothing, start, end, radius))  # validates the input
        starts, ends = (np.array(queries.points_of(values), float) for values in (start, end))
        reach = np.broadcast_to(np.atleast_1d(np.asarray(radius, float)), number)
        worst = np.empty(number, np.uint8)
        low, high = np.minimum(starts, ends) - reach[:, None], np.maximum(starts, ends) + reach[:, None]
        for part in self._parts(low, high):
            worst[part] = queries.check_capsules(self._asked, starts[part], ends[part], reach[part])
        return worst

    def nearest_obstacle(
        self, points: ArrayLike, max_distance: float = np.inf, obstacles: Iterable[State] = (State.OCCUPIED,)
    ) -> NearestCells:
        """Find the nearest obstacle cell, in growing radii; see `VoxelMap.nearest_obstacle`."""
        obstacles = _as_list(obstacles)
        number = len(queries.nearest(self._nothing, points, 0.0, obstacles).distance)  # validates the input
        nearest, longest = NearestCells.none(number), queries.distance_of(max_distance)
        places = np.array(queries.points_of(points), float)
        last = np.minimum(self._farthest(places), longest)
        left, reach = np.arange(number), float(self.manifest.layout.metres.min()) / 4
        while len(left):
            reach = min(reach, longest)
            for part in self._parts(places[left] - reach, places[left] + reach, obstacles):
                asked = left[part]
                found = queries.nearest(self._asked, places[asked], reach, obstacles)
                for mine, theirs in zip(nearest, found, strict=True):
                    mine[asked] = theirs
            left = left[~np.isfinite(nearest.distance[left]) & (last[left] > reach)]
            reach *= 2
        return nearest

    def _repr_html_(self, title: str | None = None) -> str:
        """Return the notebook view: a picture of the whole map in coarse cells."""
        return self.overview()._repr_html_(title or type(self).__name__)

    @property
    def _asked(self) -> QueryTarget:
        return QueryTarget(self.storage.cells_here, self.storage.rules, self.config.cell)

    @property
    def _nothing(self) -> QueryTarget:
        """An empty map, queried only to validate input."""
        return VoxelMap(self.config)._asked

    def _parts(
        self, low: NDArray[np.float64], high: NDArray[np.float64], states: list[State] | None = None
    ) -> Iterator[NDArray[np.int64]]:
        """Yield items (m,) as `BoxedStorage.parts` does, for extents in metres (N, 3), padded by one cell.

        states: the relevant ones; boxes without them are skipped. None: all, including UNKNOWN.
        """
        cell = np.array(self.config.cell)
        first, last = np.floor(low / cell) - 1, np.floor(high / cell) + 1
        ends = -queries.INDEX_LIMIT, queries.INDEX_LIMIT
        first, last = (np.clip(cells, *ends).astype(np.int64) for cells in (first, last))
        return self.storage.parts(first, last, _holding(states))

    def _exits(self, starts: NDArray[np.float64], units: NDArray[np.float64], through: bool) -> NDArray[np.float64]:
        """Return the length (N,) along rays to the last known cell, and if not `through`, to the unknown one after it.

        -1 if a ray meets none.
        """
        beside = 3 * max(self.config.cell)
        bounds = self.bounds()
        if bounds is None:
            return np.full(len(starts), -1.0 if through else beside)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = np.sort(
                [(corner + off - starts) / units for corner, off in zip(bounds, (-beside, beside), strict=True)], axis=0
            )
        inside = (starts >= bounds[0] - beside) & (starts <= bounds[1] + beside)
        crossings[:, units == 0] = np.where(inside[units == 0], [[-np.inf], [np.inf]], [[np.inf], [-np.inf]])
        first, last = crossings[0].max(axis=1), crossings[1].min(axis=1)
        leaves = np.where((first <= last) & (last >= 0), last, -1.0)
        return leaves if through else np.maximum(leaves, 0) + beside

    def _farthest(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the largest distance (N,) of any known cell, plus a margin that includes an unknown one."""
        bounds = self.bounds()
        if bounds is None:
            return np.zeros(len(places))
        return np.linalg.norm(np.abs(places - bounds[:, None]).max(axis=0), axis=1) + 3 * max(self.config.cell)


def save_boxed(voxel_map: VoxelMap, where: str | Path | Place, box_m: float | None = None) -> BoxedMap:
    """Save a map in boxes, with a pyramid of coarser levels; an older map there stays intact until this is complete.

    The depth images of a map that keeps them are not saved with it.

    Args:
        voxel_map: The map, which must not change during the call.
        where: Folder, or URL in an object store (`s3://bucket/city.svox`).
        box_m: Side of a box in metres, rounded up to whole blocks of 8 cells; None: 256 cells.

    Returns:
        The map in boxes.

    Raises:
        MapFileError: It cannot be written, something else is there, or another run is writing it.
        StereovoxError: `box_m` is too large or not positive.
        MissingExtra: A URL is given, and obstore is not installed.
    """
    place = Place.of(where)
    config = load_config(
        voxel_map.config, map=voxel_map.config.map.model_copy(update={"keep_frames": False}).model_dump()
    )
    layout = BoxLayout(config, side_of(box_m, config.cell))
    check_boxed_target(place)
    source = unbounded(voxel_map) if voxel_map.storage.tile_store is not None else voxel_map
    storage = source.storage
    with only_writer_at(place), source.lock:
        sweep_boxes(place)
        there = {
            tuple(box) for coords, _ in storage.slabs() for box in np.unique(layout.indices_of(coords), axis=0).tolist()
        }
        entries = [entry for box in sorted(there) if (entry := write_box(place, layout, box, storage)) is not None]
        manifest = BoxedManifest(
            layout, entries, write_levels(place, layout, entries),
            storage.history.copied(), storage.viewpoint, storage.times_start_ns,
        )  # fmt: skip
        write_boxed_manifest(place, manifest)
        sweep_boxes(place)
    return BoxedMap(place, manifest)


def check_boxed_target(place: Place, ours: tuple[str, ...] = ()) -> None:
    """Raise MapFileError if a place holds anything but a map in boxes, or the remains of one from a killed writer.

    ours: prefixes of the names of other files that belong to it.
    """
    other = next((name for name in place.names() if not name.startswith((*OURS, *ours))), None)
    if other is not None:
        raise MapFileError(
            f"{place}: holds {other}, which is no part of a map in boxes; choose another name or remove it"
        )


def side_of(box_m: float | None, cell: tuple[float, float, float]) -> int:
    """Return the side of a box in cells; raises StereovoxError if it is not positive or too large."""
    if box_m is None:
        return USUAL_SIDE
    most = MAX_SIDE * min(cell)
    if not 0 < box_m <= most:
        raise StereovoxError(f"boxes of {box_m:g} m: give more than 0 and at most {most:g} m, {MAX_SIDE} cells")
    return SIDE * int(np.ceil(box_m / min(cell) / SIDE - 1e-6))


def _as_list(states: Iterable[State]) -> list[State]:
    return [State(states)] if isinstance(states, int) else list(states)


def _holding(states: list[State] | None) -> Wanted:
    """Return a test of whether a box may contain a cell in one of these states."""
    if states is None or State.UNKNOWN in states:
        return any_box
    return lambda box: any(getattr(box, State(state).name.lower()) for state in states)
