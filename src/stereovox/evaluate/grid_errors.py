# SPDX-License-Identifier: Apache-2.0
"""In which cells two 2-D maps differ and how: the error of IST 2019, Eq 7, and its difference image.

What counts (IST 2019, IV-B): a cell is wrong where "the occupation value" differs, so there are three values, and a
cell that only one of the maps knows is wrong too: the report says so itself of a corridor that its camera never saw,
which is white in Fig 6. An excluded region is "compensated in the error formula, as being, in fact, black": its cells
count as right, and still belong to the free and occupied cells of the reference that the number is divided by.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_lattice import NOTHING, Laid, three_states
from stereovox.evaluate.metrics import ratio
from stereovox.maps.voxel_map import State


class Difference(IntEnum):
    """What came of a cell.

    SAME: both maps say the same, or neither knows; MISSED: the reference knows it, the map does not; WRONGLY_OCCUPIED,
    WRONGLY_FREE: the map says so and the reference the other; EXTRA: the map knows it, the reference does not;
    FORGIVEN: differs in an excluded region.
    """

    SAME = 0
    MISSED = 1
    WRONGLY_OCCUPIED = 2
    WRONGLY_FREE = 3
    EXTRA = 4
    FORGIVEN = 5


def differences(laid: Laid) -> NDArray[np.uint8]:
    """Return `Difference` of each cell, (rows, columns) uint8."""
    table = np.full((4, 4), Difference.SAME, np.uint8)
    for known in (State.FREE, State.OCCUPIED):
        table[known, State.UNKNOWN] = Difference.MISSED
        table[State.UNKNOWN, known] = Difference.EXTRA
    table[State.FREE, State.OCCUPIED] = Difference.WRONGLY_OCCUPIED
    table[State.OCCUPIED, State.FREE] = Difference.WRONGLY_FREE
    found = table[three_states(laid.reference), three_states(laid.map)]
    found[laid.excluded & (found != Difference.SAME)] = Difference.FORGIVEN
    return found


def wrong(found: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return B of IST 2019, Eq 7: where `differences` tells of an error, (rows, columns) bool."""
    return (found != Difference.SAME) & (found != Difference.FORGIVEN)


@dataclass(frozen=True)
class CellErrors:
    """Cells counted by how they differ.

    eq7_percent: IST 2019, Eq 7: all that differ / (free and occupied cells of the reference) * 100; can be above 100.
    eq7_outside_percent: the same where excluded cells are taken out of the lower number too; never less.
    known_error_percent: of the cells that both maps know, those that differ; None where there are none.
    missed, wrongly_occupied, wrongly_free, extra: the cells that differ, see `Difference`; forgiven: those that differ
        in excluded regions and do not count.
    reference_occupied, reference_free: all such cells of the reference, excluded ones too.
    excluded: cells in excluded regions, whatever they hold; known_in_both: cells outside them that both maps know.
    """

    eq7_percent: float
    eq7_outside_percent: float | None
    known_error_percent: float | None
    missed: int
    wrongly_occupied: int
    wrongly_free: int
    extra: int
    forgiven: int
    reference_occupied: int
    reference_free: int
    excluded: int
    known_in_both: int


def cell_errors(laid: Laid, found: NDArray[np.uint8]) -> CellErrors:
    """Count what `differences` found. Raises StereovoxError for a reference without any known cell."""
    here, there = three_states(laid.map), three_states(laid.reference)
    missed, occupied, free, extra, forgiven = np.bincount(found.ravel(), minlength=len(Difference))[1:].tolist()
    known = there != State.UNKNOWN
    total, outside = int(known.sum()), int((known & ~laid.excluded).sum())
    if not total:
        raise StereovoxError(NOTHING)
    both = int((known & (here != State.UNKNOWN) & ~laid.excluded).sum())
    differ = missed + occupied + free + extra
    return CellErrors(
        eq7_percent=100 * differ / total,
        eq7_outside_percent=_percent(differ, outside),
        known_error_percent=_percent(occupied + free, both),
        missed=missed,
        wrongly_occupied=occupied,
        wrongly_free=free,
        extra=extra,
        forgiven=forgiven,
        reference_occupied=int((there == State.OCCUPIED).sum()),
        reference_free=int((there == State.FREE).sum()),
        excluded=int(laid.excluded.sum()),
        known_in_both=both,
    )


def _percent(part: int, whole: int) -> float | None:
    share = ratio(part, whole)
    return None if share is None else 100 * share
