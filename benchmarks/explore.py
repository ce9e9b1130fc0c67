# SPDX-License-Identifier: Apache-2.0
"""Missions of a simulated quadrotor: explore halls at random, or find the middle of a room and look round.

    python benchmarks/explore.py [frontiers|middle] --seeds 0:20 [--seconds 300] [--jobs 1] [--json]

Each seed is another hall and start. One depth camera (10 Hz, a D435's field of view, 212 pixels wide) looks ahead; the
vehicle flies at one height at up to 0.6 m/s, by ways on which a ball of 35 cm touches only what is known to be free.
Told: collisions (a ball of 25 cm touches a surface), the share of the hall's air that is known to be free over time,
and how far it flew. `room_m`: from where it ends to the nearest thing but floor and ceiling; `best_room_m`: the most
that there is anywhere in the hall at that height, which may be out of sight.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np

from stereovox.lab.flights.explore import Cruise, Explored, Frontiers, MiddleOfRoom, explore
from stereovox.lab.flights.flight import World
from stereovox.simulate.clearance import Clearance
from stereovox.simulate.scene import Scene

TIMES = (10, 30, 60, 90, 120, 180, 240, 300)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("mission", nargs="?", default="frontiers", choices=("frontiers", "middle"))
    parser.add_argument("--seeds", default="0:20", metavar="A:B")
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="the summary alone")
    given = parser.parse_args()
    first, _, last = given.seeds.partition(":")
    cruise, rows = replace(Cruise(), seconds=given.seconds), []
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        for row in pool.map(partial(one, mission=given.mission, cruise=cruise), range(int(first), int(last))):
            rows.append(row)
            if not given.json:
                print(json.dumps(row), flush=True)
    print(json.dumps({"mission": given.mission, "seeds": given.seeds, **told(rows)}))


def one(seed: int, mission: str, cruise: Cruise) -> dict[str, Any]:
    world = World(cruise.scene.format(seed=seed))
    middle = MiddleOfRoom()
    explored = explore(seed, Frontiers() if mission == "frontiers" else middle, cruise, world)
    row = {**explored.as_dict(), "coverage": {str(t): round(at(explored, t), 3) for t in TIMES}}
    room, best = rooms(world, np.array(explored.place))
    return {**row, "room_m": round(room, 3), "best_room_m": round(best, 3)}


def rooms(world: World, place: np.ndarray) -> tuple[float, float]:
    """Return the room about a place, and the most there is at its height on a grid of 25 cm, level."""
    scene = world.camera.scene
    upright = Clearance(Scene([solid for solid in scene.solids if solid.part not in ("floor", "ceiling")]))
    walls = np.concatenate([solid.bounds for solid in scene.part("walls")])
    x, y = (np.arange(walls[:, k].min() + 0.5, walls[:, k].max() - 0.5, 0.25) for k in (0, 1))
    grid = np.array([[a, b, place[2]] for a in x for b in y])
    free = ~np.any([solid.contains(grid) for solid in scene.solids], axis=0)
    return upright.at(place), max(upright.at(point) for point in grid[free])


def at(explored: Explored, seconds: float) -> float:
    """Return the coverage by a time; what a mission that ended before had in the end."""
    return max(share for when, share in explored.coverage if when <= seconds)


def told(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what all missions come to."""
    return {
        "missions": len(rows),
        "collisions": sum(row["collided_s"] is not None for row in rows),
        "done": sum(row["done"] for row in rows),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "metres": {"sum": round(sum(r["metres"] for r in rows), 1), "least": round(min(r["metres"] for r in rows), 2)},
        "goals": sum(row["goals"] for row in rows),
        "clearance_least_m": round(min(row["clearance_m"] for row in rows), 3),
        "room_m_median": float(np.median([row["room_m"] for row in rows])),
        "best_room_m_median": float(np.median([row["best_room_m"] for row in rows])),
        "room_share_median": round(float(np.median([row["room_m"] / row["best_room_m"] for row in rows])), 3),
        "coverage_median": {str(t): float(np.median([row["coverage"][str(t)] for row in rows])) for t in TIMES},
        "coverage_least_at_the_end": min(row["coverage"][str(TIMES[-1])] for row in rows),
    }


if __name__ == "__main__":
    main()
