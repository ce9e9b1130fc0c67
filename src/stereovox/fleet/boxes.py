# SPDX-License-Identifier: Apache-2.0
"""The boxes of a fleet's map: the frames of each, and the task that maps one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.files.places import Place
from stereovox.files.safe_io import sealed, unsealed
from stereovox.fleet.recordings import digest, frames_of, read_frame
from stereovox.mapping.deadline import Levels
from stereovox.maps import VoxelMap
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.cells.pyramid import coarser_layout, families, names_of
from stereovox.maps.files.boxed_manifest import read_boxed_manifest
from stereovox.maps.files.store import MANIFEST
from stereovox.maps.storage.blocks import CELLS
from stereovox.maps.storage.boxes import BOXES, BoxEntry, BoxLayout, Index, is_there, write_box

DONE = "done"
"""Folder of the entries of boxes that no manifest names yet, named by their inputs."""
MAX_DONE = 1 << 20
"""Most bytes of an entry."""


class Piece(NamedTuple):
    """Frames of one recording that see a box: its key, their indices in it, and the number of frames before it."""

    recording: str
    numbers: tuple[int, ...]
    before: int


class Box(NamedTuple):
    """A box to be mapped: its index, pieces in the order of their frames, and the origin of cell times."""

    at: Index
    pieces: tuple[Piece, ...]
    start_ns: int | None

    @property
    def frames(self) -> int:
        """Number of frames that see it."""
        return sum(len(piece.numbers) for piece in self.pieces)

    def inputs(self, layout: BoxLayout) -> str:
        """Return a name derived from all inputs of the cells; recordings' keys include the settings."""
        cells = layout.config.map
        rounded = cells.cell != "int16"  # depends on the frame's number, see `Storage`
        pieces = [(piece.recording, piece.numbers, piece.before if rounded else 0) for piece in self.pieces]
        return digest([self.at, layout.side, pieces, self.start_ns if cells.keep_times else None])


class DoneBox(NamedTuple):
    """A mapped box: its entry, None if no cell of it is known, and the seconds it took."""

    entry: BoxEntry | None
    seconds: float


def boxes_of(recordings: Sequence[tuple[str, NDArray[np.int32], int]], start_ns: int | None) -> list[Box]:
    """Return the boxes that frames see.

    recordings: for each its key, the boxes seen by its frames as from `boxes_seen`, and its number of frames.
    """
    found: dict[Index, list[Piece]] = {}
    before = 0
    for key, rows, frames in recordings:
        rows = rows[np.lexsort(rows[:, ::-1].T[[3, 0, 1, 2]])]  # by box, then by number
        ends = np.flatnonzero((np.diff(rows[:, 1:], axis=0) != 0).any(axis=1)) + 1
        for part in np.split(rows, ends) if len(rows) else ():
            i, j, k = part[0, 1:].tolist()
            found.setdefault((i, j, k), []).append(Piece(key, tuple(part[:, 0].tolist()), before))
        before += frames
    return [Box(index, tuple(pieces), start_ns) for index, pieces in sorted(found.items())]


def map_box(place: Place, layout: BoxLayout, box: Box) -> DoneBox:
    """Map one box, write it, and then its entry; a worker's task.

    Raises MapFileError if a frame is damaged or the place cannot be written.
    """
    started, (low, high) = perf_counter(), layout.blocks_of(box.at)
    storage, levels = VoxelMap(layout.config).storage, Levels(layout.config)
    if layout.config.map.keep_times:
        nothing = np.empty((0, 3), np.int32), np.empty((0, CELLS), np.uint32)
        storage.set_times(*nothing, box.start_ns)
    for piece in box.pieces:
        with frames_of(place, piece.recording, piece.numbers) as frames:
            for frame in frames:
                level = levels(frame.quality)
                image = level.prepare(read_frame(place, piece.recording, frame)).image
                storage.history.frames = piece.before + frame.number
                storage.set_viewpoint(image.viewpoint)
                storage.add(_within(level.integrator.evidence(image), low, high))
    done = DoneBox(write_box(place, layout, box.at, storage), perf_counter() - started)
    place.write(f"{DONE}/{box.inputs(layout)}.json", sealed({"done": saved(done)}))
    return done


class BoxesBefore:
    """Usable boxes from earlier runs at a place: boxes whose files exist, whoever removed others.

    A killed run, or an abandoned task, may have left entries of boxes that were swept.
    """

    def __init__(self, place: Place):
        self._place, self._sizes = place, place.sizes(f"{BOXES}/")
        self._manifest = None if place.find(MANIFEST) is None else read_boxed_manifest(place)

    def boxes(self, layout: BoxLayout, wanted: Iterable[str]) -> dict[str, DoneBox]:
        """Return the existing boxes of `wanted`, by their inputs."""
        files = {file.rpartition("/")[2].removesuffix(".json") for file in self._place.names(f"{DONE}/")}
        named = self._named()
        found = {
            inputs: named[inputs] if inputs in named else _done_before(self._place, layout, inputs)
            for inputs in wanted
            if inputs in named or inputs in files
        }
        return {
            inputs: box
            for inputs, box in found.items()
            if box is not None and (box.entry is None or is_there(layout, box.entry, self._sizes))
        }

    def parents(self, layout: BoxLayout) -> dict[frozenset[str], BoxEntry | None]:
        """Return boxes of the level above `layout` by the names of boxes they cover; None: no cell is known."""
        if self._manifest is None or len(self._manifest.levels) <= layout.level:
            return {}
        level, above = [self._manifest.boxes, *self._manifest.levels][layout.level :][:2]
        there, coarser = {entry.box: entry for entry in above}, coarser_layout(layout)
        found = {names_of(family): there.get(box) for box, family in families(level).items()}
        return {names: box for names, box in found.items() if box is None or is_there(coarser, box, self._sizes)}

    def _named(self) -> dict[str, DoneBox]:
        """Return the boxes that the manifest names, by their inputs."""
        if self._manifest is None:
            return {}
        entries = {entry.box: entry for entry in self._manifest.boxes}
        try:
            known = self._manifest.extra["fleet"]["boxes"].items()
            return {inputs: DoneBox(None if box is None else entries[tuple(box)], 0.0) for inputs, box in known}
        except (KeyError, TypeError, AttributeError):
            return {}  # all are mapped


def saved(done: DoneBox) -> list[object]:
    """Return a box as plain values for JSON, which `loaded` reads."""
    return [None if done.entry is None else done.entry.saved(), done.seconds]


def loaded(values: list[Any], layout: BoxLayout) -> DoneBox:
    """Return a saved box. Raises KeyError, TypeError or ValueError for invalid values."""
    entry, seconds = values
    return DoneBox(None if entry is None else BoxEntry.loaded(entry, layout), float(seconds))


def _done_before(place: Place, layout: BoxLayout, inputs: str) -> DoneBox | None:
    """Return a box that an earlier run mapped from the same frames, None if missing."""
    data = place.find(f"{DONE}/{inputs}.json", MAX_DONE)
    try:
        return None if data is None else loaded(unsealed(data)["done"], layout)
    except (KeyError, TypeError, ValueError):
        return None  # it is mapped again


def _within(evidence: Evidence, low: NDArray[np.int64], high: NDArray[np.int64]) -> Evidence:
    """Return the evidence on blocks from `low` (3,) to below `high`."""
    mixed, free = (((coords >= low) & (coords < high)).all(axis=1) for coords in (evidence.coords, evidence.uniform))
    return Evidence(
        evidence.coords[mixed], evidence.values[mixed], evidence.uniform[free], evidence.uniform_values[free]
    )
