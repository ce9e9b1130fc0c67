# SPDX-License-Identifier: Apache-2.0
"""Fly missions in simulations: a quadrotor explores, or finds the middle of a room, by the map it makes.

The flights are autonomous. The report lists collisions, coverage over time, and every flight.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import progress_of_steps, say, say_about_compiling, say_table
from stereovox.errors import StereovoxError

GROUP = "Prove"
EXAMPLES = """stereovox explore sim:room 'sim:hall?plan={seed}' --seeds 0:20 --out missions
stereovox explore sim:room --mission middle --seeds 0:3 --out middle"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "scenes", metavar="SCENE", nargs="*", help="simulation; {seed} is replaced by the seed (sim:hall?plan={seed})"
    )
    parser.add_argument(
        "--mission",
        choices=("frontiers", "middle", "waypoints"),
        default="frontiers",
        help="explore until no frontier can be reached, find the middle of the room and look around, or visit "
        "--waypoints and return (%(default)s)",
    )
    parser.add_argument(
        "--waypoints", metavar="X,Y;...", default="", help="places to visit, metres (--waypoints=-2,3;2,1)"
    )
    parser.add_argument("--seeds", default="0:5", metavar="A:B", help="starts, each flown in each scene (%(default)s)")
    parser.add_argument("--seconds", type=float, default=300.0, metavar="S", help="longest flight (%(default)s)")
    parser.add_argument("--speed", type=float, default=0.6, metavar="M/S", help="along paths, m/s (%(default)s)")
    parser.add_argument("--voxel-size", type=float, default=0.1, metavar="M", help="cell size in metres (%(default)s)")
    parser.add_argument(
        "--margin",
        type=float,
        default=0.1,
        metavar="M",
        help="metres between the propellers and cells not known to be free (%(default)s)",
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="flights at a time (%(default)s)")
    parser.add_argument(
        "--out", metavar="DIR", help="folder for explore.html, explore.json, and the map of each scene's first flight"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Fly the missions; print the table and write the report."""
    from stereovox.view.report.page import out_folder
    from stereovox_lab.flights.campaign import SCENES, explore
    from stereovox_lab.flights.explore import Cruise
    from stereovox_lab.report import missions as report

    seeds = _seeds(arguments.seeds)
    cruise = Cruise(
        seconds=arguments.seconds, speed=arguments.speed, voxel_size=arguments.voxel_size, margin=arguments.margin
    )
    folder = out_folder(arguments.out) if arguments.out is not None else None
    say_about_compiling()

    def so_far(result: dict[str, Any]) -> None:
        if folder is not None:
            report.write_missions(folder, result)

    with progress_of_steps("starting") as progress:
        result = explore(
            arguments.scenes or SCENES,
            arguments.mission,
            seeds,
            cruise,
            waypoints=_places(arguments.waypoints),
            jobs=arguments.jobs,
            maps=folder,
            progress=progress,
            so_far=so_far,
        )
    say_table(report.HEADS, report.rows_of(result))
    if folder is None:
        say("nothing is written; --out DIR writes a page of all flights, and the map of each scene's first")
        return result
    files = report.write_missions(folder, result)
    say(f"written: {', '.join([*files.values(), *result['maps']])}")
    return {**result, "files": files}


def _places(text: str) -> list[tuple[float, float]]:
    try:
        return [(float(x), float(y)) for x, y in (one.split(",") for one in text.split(";") if one.strip())]
    except ValueError:
        raise StereovoxError(f"--waypoints {text}: give X,Y of each place in metres, such as '2,1;4,-1.5'") from None


def _seeds(text: str) -> range:
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise StereovoxError(f"--seeds {text}: give the first seed and the one after the last, such as 0:20")
    return range(int(first), int(end))
