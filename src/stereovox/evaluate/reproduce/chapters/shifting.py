# SPDX-License-Identifier: Apache-2.0
"""Experiment 6 told: the map that shifts with the camera (Chien 2020, 3.6)."""

from __future__ import annotations

from collections.abc import Sequence

from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Shown
from stereovox.evaluate.reproduce.shifting import Flight
from stereovox.view.reproduce.shifting import flight_png

SAID = (
    "Once the camera hits the trigger boundary, the whole map shifts one unit; the dynamic region moves with the "
    "vehicle and is the only one that is updated. Cells outside are eliminated and can be stored in another memory, "
    "or removed."
)
OURS = (
    "The flight from above: the window at four moments (blue, the last one orange), in it the trigger box (red); grey "
    "squares are the tiles of 32 cells a side that went to disk. Right: what a move costs."
)
WAYS = {"drop": "Cells that leave are dropped", "keep": "Cells that leave are kept in tiles"}


def chapter(flights: Sequence[Flight]) -> Chapter:
    """Return the chapter; the last flight is drawn."""
    figures = {flight.outside: flight.figures() for flight in flights}
    claims = [claim for flight in flights for claim in _claims(flight)]
    kept, dropped = figures["keep"]["occupied"], figures["drop"]["occupied"]
    claims.append(
        Claim("Cells outside can be stored elsewhere", "yes",
              f"{kept:,} occupied cells known at the end, {dropped:,} where they are dropped", kept > dropped)
    )  # fmt: skip
    return Chapter(
        "shifting",
        "Map shifting",
        f"A flight of {figures['keep']['metres']:.0f} m out and back through a hall at 5 m/s, with the window of "
        "Table 4.1: 20x6x20 m, trigger box 1 m to all sides. Images are 212 pixels wide and downsampled 2x2, so a "
        "frame has as many rays as 8x8 of a D435.",
        claims,
        [Shown("Fig 3.14 to 3.16", SAID, OURS, flight_png(flights[-1]))],
        numbers=figures,
    )


def _claims(flight: Flight) -> list[Claim]:
    figures, way = flight.figures(), WAYS[flight.outside]
    move, stay = 1e3 * figures["shift_ms_median"], 1e3 * figures["stay_ms_median"]
    return [
        Claim(f"{way}: a move of one cell", "no time given",
              f"{move:.0f} microseconds (median of {figures['shifts']}), {stay:.0f} where nothing moves", None),
        Claim(f"{way}: memory does not grow", "not unboundedly",
              f"{figures['memory_bytes'] / 1e6:.2f} MB from the first frame to the last",
              figures["memory_changed_bytes"] == 0),
        Claim(f"{way}: the camera stays in the trigger box", "1 m (Table 4.1)",
              f"{flight.most_off_m:.2f} m off the window's middle at most", flight.most_off_m < 1.001),
    ]  # fmt: skip
