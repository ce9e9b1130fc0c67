# SPDX-License-Identifier: Apache-2.0
"""Fly a simulated quadrotor with random stick inputs through random halls, guided by the map over MAVLink.

    python benchmarks/flights.py --seeds 0:100 [--without] [--scene sim:...] [--set name=value ...] [--jobs 1] [--json]

Each seed is another hall, start, stick sequence and noise. A depth camera (15 Hz, a D435's field of view, 212 pixels
wide) faces ahead; after one turn in place the sticks command up to 1.5 m/s in any direction for 40 s. The 72 sectors of
the growing map go to PX4's collision prevention as its documents describe it (`stereovox_lab.flights.px4`) ten times a
second. Reported are collisions (a ball of 25 cm touches a surface), the distance flown, and the least clearance.
`--without` flies the same seeds without prevention. `--set` changes the `Setup` (`speed=3`, `pose_sigma=[0.02,0.01]`),
its rules (`rules.half_height=0.2`), the autopilot's parameters (`parameters.cp_dist=0.8`), the airframe
(`airframe.radius=0.4`).

Margins were chosen on seeds 1000:1040; figures are of 0:100.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from time import perf_counter
from typing import Any

import numpy as np

from stereovox.config import parse_value
from stereovox.errors import StereovoxError
from stereovox_lab.flights.flight import Flight, Setup, fly


def main() -> None:
    given = arguments()
    first, _, last = given.seeds.partition(":")
    setup = changed(replace(Setup(), prevention=not given.without), given.set)
    setup = replace(setup, scene=given.scene) if given.scene else setup
    start, flights = perf_counter(), []
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        for flight in pool.map(partial(fly, setup=setup), range(int(first), int(last))):
            flights.append(flight)
            if not given.json:
                print(line(flight), flush=True)
    summary = {"seeds": given.seeds, "without": given.without, "scene": setup.scene, "set": given.set, **told(flights)}
    summary["wall_s"] = round(perf_counter() - start, 1)
    print(json.dumps(summary))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", default="0:100", metavar="A:B")
    parser.add_argument("--without", action="store_true", help="without collision prevention")
    parser.add_argument("--scene", help="a simulation; {seed} in it stands for the seed")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="the summary alone")
    return parser.parse_args()


def changed(setup: Setup, texts: list[str]) -> Setup:
    """Return a setup with values by name, one level deep."""
    for text in texts:
        name, _, value = text.partition("=")
        part, _, inner = name.partition(".")
        if not hasattr(setup, part) or (inner and not hasattr(getattr(setup, part), inner)):
            raise StereovoxError(f"--set {text}: a setup has no {name}")
        new = parse_value(value)
        setup = replace(setup, **{part: replace(getattr(setup, part), **{inner: new}) if inner else new})
    return setup


def line(flight: Flight) -> str:
    end = "no collision" if flight.collided_s is None else f"COLLISION after {flight.seconds:.1f} s"
    return (
        f"seed {flight.seed}: {end}, flew {flight.metres:.1f} m (asked for {flight.asked_m:.0f}), top speed "
        f"{flight.top_speed:.2f} m/s, least room {flight.clearance_m:.2f} m, {flight.frames} frames"
    )


def told(flights: list[Flight]) -> dict[str, Any]:
    """Return the summary of all flights."""
    metres = np.array([flight.metres for flight in flights])
    room = np.array([flight.clearance_m for flight in flights])
    return {
        "flights": len(flights),
        "collisions": sum(flight.collided_s is not None for flight in flights),
        "metres": {
            "sum": round(float(metres.sum()), 1),
            "median": round(float(np.median(metres)), 2),
            "least": round(float(metres.min()), 2),
            "under_1": int((metres < 1).sum()),
        },
        "seconds": round(sum(flight.seconds for flight in flights), 1),
        "asked_m": round(sum(flight.asked_m for flight in flights), 1),
        "top_speed": round(max(flight.top_speed for flight in flights), 2),
        "room_m": {"least": round(float(room.min()), 3), "median": round(float(np.median(room)), 3)},
        "refused": sum(flight.refused for flight in flights),
    }


if __name__ == "__main__":
    main()
