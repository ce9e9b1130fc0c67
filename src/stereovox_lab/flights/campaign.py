# SPDX-License-Identifier: Apache-2.0
"""Missions in several scenes, many seeds of each: collisions, coverage over time, and where the vehicle ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import SourceError, StereovoxError, did_you_mean
from stereovox.products.level_ways import Waypoints
from stereovox.simulate.simulation import Simulation
from stereovox_lab.flights.explore import Cruise, Frontiers, MiddleOfRoom, Mission, fly
from stereovox_lab.flights.flight import World

Places = tuple[tuple[float, float], ...]
WAYPOINTS = "waypoints"
MISSIONS: dict[str, Callable[[Places], Mission]] = {
    "frontiers": lambda places: Frontiers(),
    "middle": lambda places: MiddleOfRoom(),
    WAYPOINTS: lambda places: Waypoints(np.array(places)),
}
SCENES = ("sim:hall?plan={seed}",)
IMAGE_WIDTH = 212
"""Default image width in pixels."""


@dataclass(frozen=True)
class _Flight:
    """The inputs of one process. save: path of the map; None: not saved."""

    scene: str
    seed: int
    mission: str
    waypoints: Places
    cruise: Cruise
    save: Path | None


def explore(
    scenes: Sequence[str] = SCENES,
    mission: str = "frontiers",
    seeds: Iterable[int] = range(10),
    cruise: Cruise | None = None,
    *,
    waypoints: Sequence[tuple[float, float]] = (),
    jobs: int = 1,
    maps: str | Path | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    so_far: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Fly a simulated quadrotor autonomously by its own map, and return the results.

    Args:
        scenes: Simulations (`sim:...`); `{seed}` in them is replaced by the flight's seed. Images are 212 pixels wide
            unless a scene gives `image_width`.
        mission: `frontiers`: explore until no frontier can be reached; `middle`: find the middle of the room and look
            round there (Chien 2020, 5.1); `waypoints`: visit the places and return (`stereovox.Waypoints`).
        seeds: Of start, heading and noise; each is flown in each scene.
        cruise: Flight settings; its `scene` is ignored. By default `Cruise()`.
        waypoints: x, y in metres of the places of that mission.
        jobs: Processes; with more than one, call this under `if __name__ == "__main__":`. The result is the same.
        maps: Folder for the map of each scene's first flight; None: maps are not kept.
        progress: Called with flights done, all flights, and the current one.
        so_far: Called with the result after each flight.

    Returns:
        `mission`, `settings` of the flights, `maps` (paths written), `scenes`: the summary of each, and
        `flights`: `Explored.as_dict()` of each with its `scene`. Plain types for JSON.

    Raises:
        StereovoxError: An unknown mission, no seed, or invalid values.
        SourceError: An unknown scene, or one without room to start.
    """
    cruise, numbers = cruise or Cruise(), [int(seed) for seed in seeds]
    _check(scenes, mission, numbers, cruise, jobs)
    places = tuple((float(x), float(y)) for x, y in waypoints)
    if bool(places) != (mission == WAYPOINTS):
        raise StereovoxError("waypoints and the mission `waypoints` need each other; give both")
    folder = None if maps is None else Path(maps)
    flights = [
        _Flight(_narrow(scene), seed, mission, places, cruise, _map_of(folder, i) if seed == numbers[0] else None)
        for i, scene in enumerate(scenes)
        for seed in numbers
    ]
    rows: list[dict[str, Any]] = []
    result: dict[str, Any] = {}
    for flight, row in zip(flights, _flown(flights, jobs), strict=True):
        rows.append({"scene": flight.scene, **row})
        written = [str(one.save) for one in flights[: len(rows)] if one.save is not None]
        result = {
            "mission": mission,
            "settings": _settings(cruise),
            "maps": written,
            "scenes": [summary(scene, rows) for scene in dict.fromkeys(one["scene"] for one in rows)],
            "flights": list(rows),
        }
        if progress is not None:
            progress(len(rows), len(flights), f"{flight.scene}, seed {flight.seed}")
        if so_far is not None:
            so_far(result)
    return result


def summary(scene: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of all flights in one scene; medians are over flights.

    `seconds_to_share`: median seconds until a flight knew that share of the air, None if fewer than half reached it.
    `left`: goals left in all flights together, by the reason they were not visited. `reached`, `home`: number of
    waypoints reached, and of flights that returned; None for other missions.
    """
    mine = [row for row in rows if row["scene"] == scene]
    last, tours = [row["coverage"][-1][1] for row in mine], mine[0].get("reached") is not None
    return {
        "scene": scene,
        "flights": len(mine),
        "collisions": sum(row["collided_s"] is not None for row in mine),
        "done": sum(row["done"] for row in mine),
        "seconds_median": _median(row["seconds"] for row in mine),
        "metres": round(sum(row["metres"] for row in mine), 1),
        "goals": sum(row["goals"] for row in mine),
        "reached": sum(row["reached"] for row in mine) if tours else None,
        "home": sum(row["home"] for row in mine) if tours else None,
        "left": dict(sum((Counter(row["left"]) for row in mine), Counter())),
        "clearance_least_m": round(min(row["clearance_m"] for row in mine), 3),
        "coverage_median": _median(last),
        "coverage_least": round(min(last), 3),
        "seconds_to_share": {str(share): _time_to(share, mine) for share in (0.5, 0.7, 0.8, 0.9)},
        "room_m_median": _median(row["room_m"] for row in mine),
        "most_room_m_median": _median(row["most_room_m"] for row in mine),
    }


def _time_to(share: float, rows: Sequence[dict[str, Any]]) -> float | None:
    times = [next((s for s, known in row["coverage"] if known >= share), np.inf) for row in rows]
    middle = float(np.median(times))
    return round(middle, 1) if np.isfinite(middle) else None


def _median(values: Iterable[float]) -> float:
    return round(float(np.median(list(values))), 3)


def _settings(cruise: Cruise) -> dict[str, float]:
    names = ("seconds", "speed", "voxel_size", "camera_hz", "delay_s", "margin", "half_height", "own_radius")
    return {**{name: getattr(cruise, name) for name in names}, "radius": cruise.airframe.radius}


def _flown(flights: Sequence[_Flight], jobs: int) -> Iterator[dict[str, Any]]:
    if jobs == 1:
        yield from map(_fly, flights)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        yield from pool.map(_fly, flights)


def _fly(flight: _Flight) -> dict[str, Any]:
    world = World(flight.scene.format(seed=flight.seed))
    explored, voxel_map = fly(flight.seed, MISSIONS[flight.mission](flight.waypoints), flight.cruise, world)
    if flight.save is not None:
        flight.save.parent.mkdir(parents=True, exist_ok=True)
        voxel_map.save(flight.save)
    row = explored.as_dict()
    return {**row, "coverage": [[round(seconds, 2), round(share, 4)] for seconds, share in explored.coverage]}


def _map_of(folder: Path | None, number: int) -> Path | None:
    return None if folder is None else folder / f"scene{number + 1}.svox"


def _narrow(scene: str) -> str:
    """Return the scene with narrow images, unless it or its design gives their width."""
    name, _, options = scene.partition("?")
    if name == "sim:hall" or "image_width=" in options:
        return scene
    return f"{scene}{'&' if options else '?'}image_width={IMAGE_WIDTH}"


def _check(scenes: Sequence[str], mission: str, seeds: Sequence[int], cruise: Cruise, jobs: int) -> None:
    if mission not in MISSIONS:
        raise StereovoxError(f"unknown mission '{mission}'{did_you_mean(mission, tuple(MISSIONS))}")
    if isinstance(scenes, str) or not scenes or len(set(scenes)) < len(scenes):
        raise StereovoxError(f"scenes {scenes!r}: give a list of simulations, each once")
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise StereovoxError(f"seeds {list(seeds)}: give whole numbers from 0 on, each once")
    if jobs < 1:
        raise StereovoxError(f"jobs {jobs}: give 1 or more")
    for name in ("seconds", "speed", "voxel_size", "margin"):
        value = getattr(cruise, name)
        if not (np.isfinite(value) and (value > 0 or (name == "margin" and value == 0))):
            raise StereovoxError(f"{name} {value}: give a number above 0")
    for scene in scenes:
        if not Simulation.recognises(scene):
            raise SourceError(f"{scene}: missions are flown in simulations; name one, such as {SCENES[0]}")
        try:
            named = scene.format(seed=seeds[0])
        except (KeyError, IndexError, ValueError, AttributeError):
            raise SourceError(f"{scene}: only {{seed}} may stand in braces") from None
        simulation = Simulation(named)
        if simulation.up != "z":
            raise SourceError(f"{scene}: z is not up; leave axes=optical out")
