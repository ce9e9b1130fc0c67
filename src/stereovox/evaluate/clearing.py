# SPDX-License-Identifier: Apache-2.0
"""How long does a map need to forget what is no longer there?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import State


@dataclass(frozen=True, eq=False)
class ClearTimes:
    """Frames until cells that had been wrongly occupied were clear.

    frames: (N,) float64, 1 where the first frame that saw the cell free cleared it, inf where it never was cleared,
    NaN where the cell was not occupied when it was first seen free, or never seen free.
    """

    frames: NDArray[np.float64]

    def as_dict(self) -> dict[str, float | int | None]:
        """Return cells asked, share of them that was cleared, median, 90th percentile and longest time of those."""
        asked = self.frames[~np.isnan(self.frames)]
        cleared = asked[np.isfinite(asked)]
        values = np.percentile(cleared, [50, 90, 100]).tolist() if len(cleared) else [None] * 3
        share = len(cleared) / len(asked) if len(asked) else None
        return {"cells": len(asked), "cleared": share, **dict(zip(("median", "p90", "longest"), values, strict=True))}


def time_to_clear(
    states: ArrayLike, seen_free: ArrayLike, clear: Sequence[State] = (State.FREE,), before: ArrayLike | None = None
) -> ClearTimes:
    """Count for each truly free cell the frames from when it is first seen free until the map says so.

    states: (F, N) `State` of each of N cells after each of F frames; seen_free: (F, N) whether that frame really sees
    through the cell. before: (N,) states before the first frame, by default unknown. The clock starts at the first
    frame that sees the cell free while the map, before that frame, calls it occupied, and stops at the first frame
    after which its state is one of `clear`; frames that do not see the cell count as well. Give only cells that stay
    free from then on. Raises StereovoxError where the arrays do not fit together.
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
    """Return for each column of (F, N) the first row that is true, inf where none is."""
    if not len(flags):
        return np.full(flags.shape[1], np.inf)
    return np.where(flags.any(axis=0), flags.argmax(axis=0), np.inf)
