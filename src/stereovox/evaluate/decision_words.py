# SPDX-License-Identifier: Apache-2.0
"""The table of decisions in words, for the terminal and for pages."""

from __future__ import annotations

from collections.abc import Sequence

from stereovox.evaluate.decision_parts import Part
from stereovox.evaluate.decisions import Decisions
from stereovox.maps import State

STATES = tuple(state.name.lower() for state in sorted(State, reverse=True))
HEADS = ("what is there", "cells", *STATES)
ERROR_HEADS = ("of the", "cells", "share", "that")
PART_HEADS = ("part", "surface cells", *STATES, "free, alone", "near occupied", "called occupied", "rightly, near")
NOTHING = "-"


def state_rows(found: Decisions) -> list[tuple[str, ...]]:
    """Return the rows below `HEADS`: what the map calls the surface cells and the free cells of the truth."""
    return [
        ("a surface", f"{found.surface:,}", *(percent(getattr(found, f"surface_{state}")) for state in STATES)),
        ("free space", f"{found.air:,}", *(percent(getattr(found, f"air_{state}")) for state in STATES)),
    ]


def error_rows(found: Decisions, tolerance: int) -> list[tuple[str, ...]]:
    """Return the rows below `ERROR_HEADS`: the errors, the worst first."""
    cells = "1 cell" if tolerance == 1 else f"{tolerance} cells"
    surface, known, occupied, free = (f"{n:,}" for n in (found.surface, found.known, found.occupied, found.free))
    return [
        ("surface cells it knows", known, percent(found.known_free), "are called free"),
        ("", "", percent(found.known_free_alone), "the same, nothing tentative or occupied within 1 cell"),
        ("surface cells", surface, percent(found.surface_occupied_near), f"have an occupied cell within {cells}"),
        ("", "", percent(found.surface_near), f"have an occupied or tentative cell within {cells}"),
        ("cells called occupied", occupied, percent(found.occupied_hit), "hold a surface"),
        ("", "", percent(found.occupied_near), f"have a surface within {cells}"),
        ("", "", percent(found.occupied_air), "are free in the truth"),
        ("cells called free", free, percent(found.free_wrong), "hold a surface"),
    ]


def part_rows(parts: Sequence[Part]) -> list[tuple[str, ...]]:
    """Return the rows below `PART_HEADS`; cells called occupied are reported by range only."""
    return [
        (
            f"{part.by}: {part.name}",
            f"{one.surface:,}",
            *(percent(getattr(one, f"surface_{state}")) for state in STATES),
            percent(one.surface_free_alone),
            percent(one.surface_occupied_near),
            *((f"{one.occupied:,}", percent(one.occupied_near)) if part.by == "range" else (NOTHING, NOTHING)),
        )
        for part in parts
        for one in (part.decisions,)
    ]


def percent(share: float | None) -> str:
    """Format a share, with enough digits for rare errors."""
    if share is None:
        return NOTHING
    return f"{share:.1%}" if share >= 0.1 or share == 0 else f"{share:.2%}"
