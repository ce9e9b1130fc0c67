# SPDX-License-Identifier: Apache-2.0
"""Make a floor's map from a ground robot's depth images or lidar, as map_server files.

Where the robot was: --poses slam finds out by itself, --poses MAP.yaml localises in that map, --poses odometry
believes the wheels. Without --poses it is slam where there is a lidar.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.localize import add_start, localised, parse_start
from stereovox.cli.robots import GRID_ENDINGS, add_robot, check_file, opened, settings_of
from stereovox.cli.slam import mapped
from stereovox.cli.terminal import (
    cells_line,
    command_line,
    interrupt_between_steps,
    milliseconds,
    say,
    say_about_compiling,
    tracked,
)
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.frame import Frame, Scan
    from stereovox.grid_mapper import GridMapper
    from stereovox.localize.track import Track
    from stereovox.mapper import UpdateReport
    from stereovox.sources.robot import Robot

EXAMPLE = "stereovox grid floor.bag --poses reference.yaml --out kinect.yaml"
MODES = ("trinary", "scale", "raw")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument("--out", required=True, metavar="MAP", help="map_server files to write, for example floor.yaml")
    parser.add_argument("--poses", metavar="HOW", help="slam, odometry, or a MAP.yaml to localise in")
    parser.add_argument("--use", choices=("depth", "lidar", "both"), help="what to map (depth images if there are any)")
    parser.add_argument("--frames", metavar="A:B:S", help="map only these of them, as a Python slice")
    parser.add_argument("--voxel-size", type=float, metavar="M", help="cell size in metres")
    parser.add_argument("--max-range", type=float, metavar="M", help="metres up to which readings count")
    parser.add_argument("--mode", choices=MODES, default="trinary", help="how the file tells probabilities (trinary)")
    parser.add_argument("--resume", metavar="MAP", help="go on with this map; the poses must be in its frame")
    add_start(parser)


def defaults() -> dict[str, Any]:
    """Return the options that nobody gave, for commands that end up here."""
    return {"poses": None, "use": None, "frames": None, "mode": MODES[0], "resume": None, "start": None}


def run(arguments: Namespace) -> dict[str, Any]:
    """Find the way, map along it, save the map and tell what was done."""
    out = check_file(arguments.out, GRID_ENDINGS)
    start, config = parse_start(arguments.start), settings_of(arguments)
    robot = opened(arguments.source)
    seen, count = _chosen(robot, arguments.use, arguments.frames)
    mapper = _mapper(config, arguments.resume)
    say_about_compiling()
    track = _track(robot, arguments.poses, config, start)
    reports = _add_all(mapper, (track.corrected(one) if track else one for one in seen), count)
    return _finished(mapper, reports, out, arguments.mode)


def _chosen(robot: Robot, use: str | None, frames: str | None) -> tuple[Iterator[Scan | Frame], int]:
    """Return what is to be mapped in order of time, and how much that is."""
    from stereovox.sources import parse_slice
    from stereovox.sources.robot import in_time_order

    use = use or ("depth" if len(robot.frames) else "lidar")
    kinds: dict[str, Sequence[Any]] = {"depth": robot.frames, "lidar": robot.scans}
    wanted = {name: kinds[name] for name in (kinds if use == "both" else (use,))}
    missing = [name for name, there in wanted.items() if not len(there)]
    if missing:
        what = {"depth": "depth images", "lidar": "lidar scans"}[missing[0]]
        raise StereovoxError(
            f"{robot.name}: holds no {what}; use --use {'lidar' if missing[0] == 'depth' else 'depth'}"
        )
    picked = {name: range(len(there))[parse_slice(frames or ":")] for name, there in wanted.items()}
    if not all(picked.values()):
        raise StereovoxError(f"--frames {frames}: picks none of {robot.name}; widen it")
    streams = [(wanted[name][i] for i in numbers) for name, numbers in picked.items()]
    return in_time_order(*streams), sum(map(len, picked.values()))


def _track(robot: Robot, how: str | None, config: Config, start: Any) -> Track | None:
    """Return the robot's way in the map; None: as its odometry has it."""
    from stereovox.products.map_server import read_map_server

    how = how or ("slam" if len(robot.scans) else "odometry")
    if how == "odometry":
        return None
    if how == "slam":
        say("finding the robot's way by SLAM; --poses MAP.yaml would localise it in a map, --poses odometry not at all")
        return mapped(robot, config).track
    if Path(how).suffix.lower() not in GRID_ENDINGS:
        raise StereovoxError(f"--poses {how}: give slam, odometry, or the .yaml of a map to localise in")
    return localised(robot, read_map_server(how), config, start)


def _mapper(config: Config, resume: str | None) -> GridMapper:
    from stereovox.grid_mapper import GridMapper
    from stereovox.products.map_server import read_map_server

    return GridMapper(config, resume=None if resume is None else read_map_server(resume))


def _add_all(mapper: GridMapper, seen: Iterator[Scan | Frame], count: int) -> list[UpdateReport]:
    reports: list[UpdateReport] = []
    with interrupt_between_steps() as check:
        for one in tracked(seen, count, "mapping"):
            reports.append(mapper.add(one))
            check()
    return reports


def _finished(mapper: GridMapper, reports: list[UpdateReport], out: Path, mode: str) -> dict[str, Any]:
    from stereovox.evaluate.summary import summarise
    from stereovox.products.map_server import write_map_server

    result = summarise(mapper.map, reports)
    if not result["frames"]:
        raise StereovoxError(f"not one reading could be used, no map is written ({reports[0].detail})")
    write_map_server(mapper.occupancy(), out, mode=mode)
    say(f"{result['frames']} readings mapped, {result['frames_refused']} refused")
    for reason, number in result["refused"].items():
        say(f"  {number} x {reason}, first: {next(one.detail for one in reports if one.refused == reason)}")
    say(f"a reading: scan {milliseconds(result['depth_ms'])}; map {milliseconds(result['integrate_ms'])}")
    say(cells_line(result))
    yaml = out.with_suffix(".yaml")
    say(f"saved in {yaml}; look at it with: {command_line('picture', yaml, f'{out.stem}.png')}")
    return result
