# SPDX-License-Identifier: Apache-2.0
"""`sim:floor?plan=testbed`: an open hall with obstacles of many heights, after the 8th floor of IST 2019 (IV-C)."""

from __future__ import annotations

from stereovox.sources.floor_drive import Stop
from stereovox.sources.floor_layout import SHIFT, Layout
from stereovox.sources.floor_plan import CEILING, FloorPlan, Rectangle, Thing, block, post
from stereovox.sources.floor_things import chair, shelf, table

FREE: tuple[Rectangle, ...] = (
    (0.0, 0.0, 12.0, 9.0),  # hall
    (12.0, 6.2, 13.2, 8.2),  # alcove
    (-5.0, 3.6, -0.15, 5.4),  # corridor that leads there
    (-0.15, 3.9, 0.0, 5.1),
    (-3.3, 5.4, -2.4, 5.5),  # shut doors in the corridor
    (-4.2, 3.5, -3.3, 3.6),
)


def layout(shut: bool) -> Layout:
    """Return the hall and a drive of about 75 m. There is no door to shut: `shut` changes nothing."""
    del shut
    return Layout(FloorPlan(FREE, _things()), STOPS).moved(*SHIFT)


def _things() -> list[Thing]:
    return [
        block("pillars", "pillar west", (3.8, 4.3, 4.2, 4.7), (0.0, CEILING)),
        block("pillars", "pillar east", (7.8, 4.3, 8.2, 4.7), (0.0, CEILING)),
        *table("table 1", 2.4, 7.6, turn_deg=12),
        *chair("chair 1", 2.2, 6.95, 100),
        *chair("chair 2", 3.6, 7.9, -160),
        *table("table 2", 6.3, 7.7),
        *table("table 3", 7.9, 7.7),
        *chair("chair 3", 6.9, 7.05, 80),
        *table("table 4", 9.6, 1.5, turn_deg=75),
        *chair("chair 4", 8.9, 1.3, 10),
        *shelf("shelf", (2.6, 0.03, 4.4, 0.4)),
        block("boxes", "pallet", (1.45, 2.0, 2.25, 2.7), (0.0, 0.15), 20),
        block("boxes", "crate", (6.1, 1.7, 6.9, 2.3), (0.0, 0.5), 35),
        block("boxes", "carton, low", (5.5, 5.6, 5.9, 6.0), (0.0, 0.2), 15),
        block("boxes", "carton, high", (10.4, 5.0, 10.9, 5.5), (0.0, 0.8), -25),
        block("boxes", "stack, below", (11.3, 0.1, 11.9, 0.9), (0.0, 0.4)),
        block("boxes", "stack, above", (11.35, 0.15, 11.8, 0.8), (0.4, 0.9)),
        block("cabinets", "cabinet", (11.5, 2.6, 11.98, 4.2), (0.0, 1.5)),
        block("boxes", "hung panel", (0.02, 6.6, 0.3, 8.2), (0.6, 1.4)),
        post("posts", "column", (12.75, 7.8), 0.3, 2.0),
        post("posts", "barrel", (0.6, 0.6), 0.55, 0.9),
    ]


STOPS = tuple(Stop(*numbers) for numbers in [
    (-4.3, 4.5, 360), (-3.5, 4.5), (-2.4, 4.8), (-1.2, 4.3), (0.7, 4.5, 180), (0.8, 3.4, -90), (0.75, 1.5),
    (2.6, 1.2, 90), (3.2, 3.0), (4.8, 1.3, 90), (5.4, 3.2), (7.6, 3.4), (7.7, 1.2, -180), (7.9, 3.0),
    (9.6, 3.3, -360), (11.0, 1.9), (10.9, 3.0), (11.05, 4.7), (11.4, 5.4), (11.4, 6.4), (12.3, 7.1, 360),
    (11.2, 7.0), (9.6, 7.9), (9.4, 6.2), (7.4, 5.8, 180), (6.6, 4.6), (4.9, 4.9), (4.8, 6.6), (4.7, 7.9, -360),
    (4.7, 6.5), (2.6, 5.9, 90), (0.9, 6.3), (0.9, 8.2, 180), (0.9, 6.0), (2.8, 3.7), (6.0, 3.7, 180),
    (7.4, 5.3), (9.2, 5.2, -180), (6.0, 5.0), (2.6, 5.2), (0.8, 4.5), (-1.2, 4.6), (-3.6, 4.5),
])  # fmt: skip
"""Criss-cross through the hall, with returns."""
