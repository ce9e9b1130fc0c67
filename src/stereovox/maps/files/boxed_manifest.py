# SPDX-License-Identifier: Apache-2.0
"""The manifest of a map in boxes: its boxes, the coarser levels of its pyramid, and how it was made.

It is written last and replaced as a whole, so readers see either the older or the newer map. Boxes that no manifest
names belong to killed writers or to older maps; the next writer sweeps them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from os import getpid
from socket import gethostname
from typing import Any

import numpy as np

from stereovox.config import load_config
from stereovox.errors import MapFileError, one_line
from stereovox.files.places import Folder, Place
from stereovox.files.safe_io import sealed
from stereovox.frame import Viewpoint
from stereovox.maps.cells.pyramid import coarser_layout
from stereovox.maps.files.lock import only_writer_in
from stereovox.maps.files.store import FORMAT, MANIFEST, as_number, manifest_from, viewpoint_from, viewpoint_to
from stereovox.maps.record.history import History
from stereovox.maps.storage.boxes import BOXES, BoxEntry, BoxLayout

VERSION = 5
"""Version of this manifest; maps in one piece have another."""
MAX_MANIFEST = 1 << 27
"""Largest size of a manifest in bytes; a box takes about 300."""
MAX_LEVELS = 24
LOCK = ".writer"
"""The lock object for writing to a place in a store; it names its holder."""
MAX_HOLDER = 1000


@dataclass
class BoxedManifest:
    """The manifest of a map in boxes.

    layout: settings and side of a box. boxes: those of the map. levels: those of coarser levels, each with half as many
    cells along an axis as the one before; may be empty. history: the map's record of its frames. viewpoint: the last
    camera pose. times_start_ns: origin of cell times. extra: plain JSON values that the map's maker keeps with it.
    """

    layout: BoxLayout
    boxes: list[BoxEntry]
    levels: list[list[BoxEntry]] = field(default_factory=list)
    history: History = field(default_factory=History)
    viewpoint: Viewpoint | None = None
    times_start_ns: int | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    def layout_of(self, level: int) -> BoxLayout:
        """Return the layout of a level; 0 is the map itself."""
        layout = self.layout
        for _ in range(level):
            layout = coarser_layout(layout)
        return layout

    @property
    def names(self) -> set[str]:
        """Names of all boxes, including the levels'."""
        return {entry.name for level in (self.boxes, *self.levels) for entry in level}


def write_boxed_manifest(place: Place, manifest: BoxedManifest) -> None:
    """Publish the boxes in a place as its map, replacing an older one atomically.

    Raises MapFileError if it cannot be written, or has too many boxes to be readable; the older map is then
    unchanged.
    """
    layout = manifest.layout
    saved = {
        "format": FORMAT,
        "version": VERSION,
        **manifest.history.saved(),
        "viewpoint": viewpoint_to(manifest.viewpoint),
        "times_start_ns": manifest.times_start_ns,
        "config": layout.config.model_dump(),
        "box_side": layout.side,
        "boxes": [entry.saved() for entry in sorted(manifest.boxes)],
        "levels": [[entry.saved() for entry in sorted(level)] for level in manifest.levels],
        "extra": manifest.extra,
    }
    data = sealed(saved, as_number)
    if len(data) > MAX_MANIFEST:
        raise MapFileError(f"{place}: a manifest of {len(manifest.boxes)} boxes is too large; choose larger boxes")
    place.write(MANIFEST, data)


def read_boxed_manifest(place: Place) -> BoxedManifest:
    """Read a manifest. Raises MapFileError: one line with the place and what is wrong."""
    data = place.find(MANIFEST, MAX_MANIFEST)
    if data is None:
        raise MapFileError(f"{place}: no stereovox map here (no {MANIFEST}); check the name")
    saved = manifest_from(data, VERSION, f"{place}/{MANIFEST}")
    try:
        return _manifest_of(saved)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise MapFileError(f"{place}: damaged map ({type(error).__name__}: {error}); make it again") from None


def sweep_boxes(place: Place, keep: Iterable[str] = ()) -> None:
    """Remove the boxes that neither the manifest nor `keep` names. Nobody else may be writing here.

    keep: names of boxes (`BoxEntry.name`) that a later manifest will name.
    """
    place.tidy()
    named = set(keep)
    with suppress(MapFileError):
        if place.find(MANIFEST, MAX_MANIFEST) is not None:
            named |= read_boxed_manifest(place).names
            unnamed = [file for file in place.names(f"{BOXES}/") if "/".join(file.split("/")[:3]) not in named]
            place.remove(unnamed)
            return
    if not place.names(MANIFEST):  # a damaged map is left alone
        place.remove([file for file in place.names(f"{BOXES}/") if "/".join(file.split("/")[:3]) not in named])


@contextmanager
def only_writer_at(place: Place) -> Iterator[None]:
    """Hold the right to write to a place. Raises MapFileError if another run has it.

    The system releases a folder's lock however its holder ends. A store cannot: the lock of a run that `kill -9` ended
    must be removed by hand, as the error says, which names that run.
    """
    if isinstance(place, Folder):
        with only_writer_in(place.path):
            yield
        return
    if not place.create(LOCK, f"process {getpid()} on {gethostname()}".encode()):
        holder = one_line((place.find(LOCK, MAX_HOLDER) or b"it has just ended").decode(errors="replace"))
        raise MapFileError(
            f"{place}: is being written by another run ({holder}); wait for its end, or remove {place}/{LOCK} if it "
            "was killed"
        )
    try:
        yield
    finally:
        place.remove([LOCK])


def _manifest_of(saved: dict[str, Any]) -> BoxedManifest:
    config, history = load_config(saved["config"]), History.loaded(saved)
    start_ns, extra = saved.get("times_start_ns"), saved["extra"]
    if type(start_ns) not in (int, type(None)) or not isinstance(extra, dict) or len(saved["levels"]) > MAX_LEVELS:
        raise ValueError("times_start_ns, extra or levels are not what stereovox writes")
    manifest = BoxedManifest(
        BoxLayout(config, saved["box_side"]), [], [], history, viewpoint_from(saved.get("viewpoint")), start_ns, extra
    )
    manifest.boxes = _entries(saved["boxes"], manifest.layout)
    for number, level in enumerate(saved["levels"], 1):
        manifest.levels.append(_entries(level, manifest.layout_of(number)))
    return manifest


def _entries(saved: Sequence[dict[str, Any]], layout: BoxLayout) -> list[BoxEntry]:
    entries = [BoxEntry.loaded(entry, layout) for entry in saved]
    if len({entry.box for entry in entries}) != len(entries):
        raise ValueError("a box that is named twice")
    return entries


def bounds_of(entries: Sequence[BoxEntry]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest known cell (3,) of boxes, and the first cell beyond the highest."""
    return np.min([entry.low for entry in entries], axis=0), np.max([entry.high for entry in entries], axis=0)
