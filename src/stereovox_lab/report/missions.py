# SPDX-License-Identifier: Apache-2.0
"""The result of `stereovox explore` as tables: for the terminal and on a page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereovox.view.evaluation import coverage_png
from stereovox.view.report import page

HEADS = ("scene", "flights", "collisions", "ended by itself", "metres", "goals", "least clearance, m",
         "air known: median", "air known: least", "50 % known after, s", "80 % known after, s", "goals left",
         "room at the end, m", "most room there is, m")  # fmt: skip
FLIGHT_HEADS = ("scene", "seed", "collided, s", "seconds", "ended by itself", "metres", "goals", "clearance, m",
                "air known", "goals left", "room, m")  # fmt: skip
MISSIONS = {
    "frontiers": "Go to the frontier nearest along the path and look at it; if none can be reached, look all round.",
    "middle": "Find the middle of the room as it is known, look round there, until it stays where it is.",
    "waypoints": "Visit the places in order, through known free space, and return.",
}
WHAT = (
    "A collision: a surface of the scene is nearer to the vehicle's middle than its radius. Clearance: the least "
    "distance from its middle to a surface. Air: the cells of the scene that touch nothing, have something above and "
    "below them, and are connected with the start; known: the map calls them free. Ended by itself: no goal was left; "
    "else time was up, or it collided. Goals left: frontiers (known air next to unknown) or "
    "waypoints if it ended by itself, and why it did not go there; if there is no path, a smaller margin or smaller "
    "cells may find one. Room: horizontal distance to the nearest surface in the vehicle's heights."
)


def rows_of(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a row below HEADS for each scene."""
    return [
        (
            one["scene"],
            str(one["flights"]),
            str(one["collisions"]),
            str(one["done"]),
            f"{one['metres']:.0f}",
            str(one["goals"]),
            f"{one['clearance_least_m']:.2f}",
            f"{one['coverage_median']:.1%}",
            f"{one['coverage_least']:.1%}",
            *(_seconds(one["seconds_to_share"][share]) for share in ("0.5", "0.8")),
            _left(one["left"]),
            f"{one['room_m_median']:.2f}",
            f"{one['most_room_m_median']:.2f}",
        )
        for one in result["scenes"]
    ]


def write_missions(folder: str | Path, result: dict[str, Any]) -> dict[str, str]:
    """Write `explore.html`, `explore.json` and `coverage.png` into `folder`; return their paths.

    Raises StereovoxError, one line, if one cannot be written.
    """
    png = coverage_png(result["flights"])
    contents = {
        "explore.html": missions_page(result, png).encode(),
        "explore.json": (json.dumps(result, indent=1, allow_nan=False) + "\n").encode(),
        "coverage.png": png,
    }
    page.write_files(folder, contents)
    return {name.partition(".")[2]: str(Path(folder) / name) for name in contents}


def missions_page(result: dict[str, Any], png: bytes) -> str:
    """Return the page as text; `png` is the picture of the coverage."""
    scenes, flights = result["scenes"], result["flights"]
    collisions = sum(one["collisions"] for one in scenes)
    boxes = (
        (f"{collisions}", "collisions"),
        (f"{len(flights)}", "flights"),
        (f"{sum(one['metres'] for one in scenes):,.0f} m", "flown"),
        (f"{min(one['clearance_least_m'] for one in scenes):.2f} m", "least clearance"),
    )
    settings = [(name, f"{value:g}") for name, value in result["settings"].items()]
    return page.page(
        "What became of the missions?",
        f"{MISSIONS[result['mission']]} Simulated flights that nobody steers, by the map that they make.",
        page.tiles(boxes),
        page.section("Coverage over time", "Grey: each flight; black: the median.", page.figure(png, "Coverage")),
        page.section("Scenes", WHAT, page.table(HEADS, rows_of(result))),
        page.section("Flights", "", page.table(FLIGHT_HEADS, map(_flight, flights))),
        page.section("Settings", "Metres and seconds.", page.table(("name", "value"), settings)),
    )


def _flight(one: dict[str, Any]) -> Sequence[str]:
    return (
        one["scene"],
        str(one["seed"]),
        "-" if one["collided_s"] is None else f"{one['collided_s']:.1f}",
        f"{one['seconds']:.0f}",
        "yes" if one["done"] else "no",
        f"{one['metres']:.1f}",
        str(one["goals"]),
        f"{one['clearance_m']:.2f}",
        f"{one['coverage'][-1][1]:.1%}",
        _left(one["left"]),
        f"{one['room_m']:.2f}",
    )


def _left(left: Mapping[str, int]) -> str:
    """Return how many frontiers were left, and why."""
    return ", ".join(f"{number} {why}" for why, number in left.items() if number) or "-"


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"
