# SPDX-License-Identifier: Apache-2.0
"""Check that a map clears a person who has passed, and keeps a thin pole that is often missed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.truth import touched_cells
from stereovox.frame import Frame
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.mapper import Mapper
from stereovox.maps import State
from stereovox_lab.checks.passer_by import BEFORE, HZ, TALL, WALK_FROM, WALK_X, WIDE, PasserBy

GONE = (State.FREE, State.TENTATIVE, State.UNKNOWN)
"""States in which a cell is no longer an obstacle."""
NOISE = 0.3
"""Metres around the person in which cells are followed: six standard deviations of the depth."""


@dataclass(frozen=True, eq=False)
class ClearTimes:
    """Frames until cells that had been wrongly occupied were clear.

    frames: (N,) float64, 1 if the first frame that saw the cell free cleared it, inf if it was never cleared,
    NaN if the cell was not occupied when first seen free, or never seen free.
    """

    frames: NDArray[np.float64]

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the number of cells, the share cleared, and median, 90th percentile and longest time of these."""
        asked = self.frames[~np.isnan(self.frames)]
        cleared = asked[np.isfinite(asked)]
        values = np.percentile(cleared, [50, 90, 100]).tolist() if len(cleared) else [None] * 3
        share = len(cleared) / len(asked) if len(asked) else None
        return {"cells": len(asked), "cleared": share, **dict(zip(("median", "p90", "longest"), values, strict=True))}


def time_to_clear(
    states: ArrayLike, seen_free: ArrayLike, clear: Sequence[State] = (State.FREE,), before: ArrayLike | None = None
) -> ClearTimes:
    """Count, for each truly free cell, the frames from when it is first seen free until it is free in the map.

    states: (F, N) `State` of each of N cells after each of F frames; seen_free: (F, N) whether that frame really sees
    through the cell. before: (N,) states before the first frame, by default unknown. The clock starts at the first
    frame that sees the cell free while the map, before that frame, calls it occupied, and stops at the first frame
    after which its state is one of `clear`; frames that do not see the cell count too. Give only cells that stay
    free from then on. Raises StereovoxError if the arrays do not fit together.
    """
    after, seen = np.asarray(states), np.asarray(seen_free, bool)
    if after.ndim != 2 or seen.shape != after.shape:
        raise StereovoxError(f"states {after.shape} and seen_free {seen.shape} do not fit; give both as (F, N)")
    first = np.full(after.shape[1:], State.UNKNOWN) if before is None else np.asarray(before)
    earlier = np.concatenate([first[None], after[:-1]]) if len(after) else after
    start = first_true(seen & (earlier == State.OCCUPIED))
    frame = np.arange(len(after))[:, None]
    end = first_true(np.isin(after, [int(state) for state in clear]) & (frame >= start))
    return ClearTimes(np.where(np.isfinite(start), end - np.where(np.isfinite(start), start, 0) + 1, np.nan))


def first_true(flags: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return, for each column of (F, N), the first true row, inf if there is none."""
    if not len(flags):
        return np.full(flags.shape[1], np.inf)
    return np.where(flags.any(axis=0), flags.argmax(axis=0), np.inf)


@dataclass(frozen=True, eq=False)
class Ghosts:
    """Outcome for the cells where a person was, and for static objects.

    number: (F,) ghosts after each frame: occupied cells that the frame truly sees through.
    gone: frames until a cell that is seen free was no longer occupied; free: until it was free.
    left: cells still occupied in the last frame; unseen: the ones of them that no frame ever saw free.
    after_leaving: frames, from the first that does not show the person, until no seen cell is a ghost; inf:
        never.
    pole_lost: of the layers of cells in which the pole was found in the first second, the share in which it later has
        no occupied cell; mean over all frames. 1 if it was not found at all.
    pole_free: the same for single cells that were occupied and are free; the pole may only have grazed them.
    static_lost: share of the wall's and floor's cells, occupied before the person came, that were not at the end.
    """

    number: NDArray[np.int64]
    gone: ClearTimes
    free: ClearTimes
    left: int
    unseen: int
    after_leaving: float
    pole_lost: float
    pole_free: float
    static_lost: float

    def as_dict(self) -> dict[str, Any]:
        """Return all as plain numbers; times in seconds, None for never."""
        gone, free = self.gone.as_dict(), self.free.as_dict()
        seconds = {
            "gone_median_s": gone["median"],
            "gone_longest_s": gone["longest"],
            "free_longest_s": free["longest"],
            "after_leaving_s": self.after_leaving,
        }
        return {
            "cells": gone["cells"],
            "cleared": gone["cleared"],
            **{name: _finite(frames) for name, frames in seconds.items()},
            "left": self.left,
            "unseen": self.unseen,
            "pole_lost": self.pole_lost,
            "pole_free": self.pole_free,
            "static_lost": self.static_lost,
        }


def ghosts(source: PasserBy, frames: list[Frame] | None = None, **settings: Any) -> Ghosts:
    """Map the frames of `source` and follow all cells where the person passes, and the pole's.

    frames: the source's, if several maps use the same ones. settings: of the mapper.
    """
    frames = frames or [source.frame(i) for i in range(len(source))]
    mapper = Mapper(**settings)
    side = mapper.config.voxel_size
    passed, pole = passed_cells(side), touched_cells(source.pole.triangles, side)
    centers, pole_centers = mapper.map.centers(passed), mapper.map.centers(pole)
    stay = np.empty((0, 3))
    states, poles = [], []
    for i, frame in enumerate(frames):
        if i == BEFORE:
            stay = mapper.map.occupied()
        mapper.add(frame)
        states.append(mapper.map.state(centers))
        poles.append(mapper.map.state(pole_centers))
    static_lost = float((mapper.map.state(stay) != State.OCCUPIED).mean()) if len(stay) else 0.0
    return _judged(source, mapper, np.array(states), centers, _pole(np.array(poles), pole), static_lost)


def passed_cells(side: float) -> NDArray[np.int32]:
    """Return the indices (N, 3) of all cells with sides `side` where the person passes, or its noise may be."""
    deep, half = WIDE / 2 + NOISE, WALK_FROM + WIDE
    low, high = (WALK_X - deep, -half, 2 * side), (WALK_X + deep, half, TALL + NOISE)  # keep the floor
    axes = [np.arange(np.floor(a / side), np.ceil(b / side)) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)


def seen_free(
    source: PasserBy, i: int, centers: NDArray[np.float64], side: float, max_range: float
) -> NDArray[np.bool_]:
    """Return which cells (N,) with sides `side` frame `i` truly sees through; the person must be a cell away."""
    camera = source.camera
    points = transform_points(inverse(source.T_world_camera), centers)
    z, half = points[:, 2], side * np.sqrt(3) / 2
    ahead = np.maximum(z, 1e-3)
    u = np.rint(points[:, 0] / ahead * camera.fx + camera.cx).astype(int)
    v = np.rint(points[:, 1] / ahead * camera.fy + camera.cy).astype(int)
    inside = (z > half) & (z + half < max_range) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    depth = source.true_depth(i)[np.where(inside, v, 0), np.where(inside, u, 0)]
    seen, person = inside & (depth > z + half), source.person(i)
    if person is not None:
        seen[seen] = ~person.contains(centers[seen], margin=side + half)
    return seen


def _judged(
    source: PasserBy,
    mapper: Mapper,
    states: NDArray[np.uint8],
    centers: NDArray[np.float64],
    pole: tuple[float, float],
    static_lost: float,
) -> Ghosts:
    frames, side, reach = len(states), mapper.config.voxel_size, mapper.config.max_range
    seen = np.array([seen_free(source, i, centers, side, reach) for i in range(frames)])
    ever_seen = seen[BEFORE:].any(axis=0)
    left = states[-1] == State.OCCUPIED
    empty_from = next(i for i in range(frames - 1, 0, -1) if source.shows_person(i - 1))
    ghost = ((states[empty_from:] == State.OCCUPIED) & ever_seen).any(axis=1)
    return Ghosts(
        ((states == State.OCCUPIED) & seen).sum(axis=1),
        time_to_clear(states, seen, GONE),
        time_to_clear(states, seen),
        int(left.sum()),
        int((left & ~ever_seen).sum()),
        np.inf if ghost[-1] else float(len(ghost) - ghost[::-1].argmax() + 1 if ghost.any() else 0),
        *pole,
        static_lost,
    )


def _pole(states: NDArray[np.uint8], pole: NDArray[np.int32]) -> tuple[float, float]:
    """Return the pole's figures of `Ghosts` from the states (F, N) of its cells (N, 3)."""
    occupied, layers = states == State.OCCUPIED, pole[:, 2]
    stands = np.stack([occupied[:, layers == layer].any(axis=1) for layer in np.unique(layers)], axis=1)
    found, once = stands[:BEFORE].any(axis=0), occupied[:BEFORE].any(axis=0)
    return _share(~stands[BEFORE:, found]), _share(states[BEFORE:, once] == State.FREE)


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if flags.size else 1.0


def _finite(frames: float | None) -> float | None:
    return None if frames is None or not np.isfinite(frames) else round(float(frames) / HZ, 3)
