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

from stereovox.cli.checkpoints import add_checkpoint
from stereovox.cli.localize import add_start, check_start, localised, parse_start, say_fit
from stereovox.cli.robots import (
    GRID_ENDINGS,
    GRID_FILES,
    add_robot,
    check_file,
    only_writer_of_floor,
    opened,
    picture_line,
    say_refused,
    settings_of,
)
from stereovox.cli.settings import overrides
from stereovox.cli.slam import mapped
from stereovox.cli.terminal import (
    cells_line,
    milliseconds,
    progress_of,
    say,
    say_about_compiling,
    say_refusals,
)
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    import numpy as np

    from stereovox.config import Config
    from stereovox.frame import Frame, Scan
    from stereovox.localize.track import Track
    from stereovox.mapper import GridMapper
    from stereovox.run import Checkpoints
    from stereovox.sources.robot import Robot
    from stereovox.update_report import UpdateReport

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
    parser.add_argument(
        "--resume", metavar="MAP", help="go on with this map; without --poses the robot is localised in it"
    )
    add_start(parser)
    add_checkpoint(parser)


def defaults() -> dict[str, Any]:
    """Return the options that nobody gave, for commands that end up here."""
    return {"poses": None, "use": None, "frames": None, "mode": MODES[0], "resume": None, "start": None}


def run(arguments: Namespace) -> dict[str, Any]:
    """Find the way, map along it, save the map and tell what was done."""
    out = check_file(arguments.out, GRID_ENDINGS)
    with only_writer_of_floor(out):
        return _mapped(arguments, out)


def _mapped(arguments: Namespace, out: Path) -> dict[str, Any]:
    from stereovox.run import Checkpoints, add_all, interrupt_between_steps

    if arguments.mode == "scale" and out.suffix.lower() == ".pgm":
        raise StereovoxError(f"--out {out}: mode scale has no grey for unknown cells; name a .yaml or .png")
    start, config = parse_start(arguments.start), settings_of(arguments)
    robot = opened(arguments.source)
    seen, count = _chosen(robot, arguments.use, arguments.frames)
    how = _poses(arguments.poses, robot, arguments.resume)
    if start is not None and how in ("slam", "odometry"):
        raise StereovoxError(f"--start {arguments.start}: says where in a map; give --poses MAP.yaml, or leave it out")
    mapper = _mapper(config, arguments.resume, any_size="voxel_size" not in overrides(arguments))
    say_about_compiling()
    track = _track(robot, how, config, start)
    checkpoints = Checkpoints(lambda: _save(mapper, out, arguments.mode), out, arguments.checkpoint)
    readings = (track.corrected(one) if track else one for one in seen)

    def stopped(done: int) -> None:
        say(f"stopped after {done} of {count} readings; they are saved in {out.with_suffix('.yaml')}")

    with interrupt_between_steps() as check:
        with progress_of(count, "mapping") as bar:
            reports = add_all(mapper, readings, checkpoints, check, [bar], stopped)
        return _finished(mapper, reports, out, checkpoints)


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
    streams = [map(wanted[name].__getitem__, numbers) for name, numbers in picked.items()]
    return in_time_order(*streams), sum(map(len, picked.values()))


def _poses(how: str | None, robot: Robot, resume: str | None) -> str:
    """Return whose poses to take: `slam`, `odometry`, or the file of a map to localise in."""
    if how == "slam" and resume:
        raise StereovoxError(
            f"--resume {resume}: SLAM makes a frame of its own; leave --poses out to localise in the map"
        )
    if how is None:
        how = (resume or "slam") if len(robot.scans) else "odometry"
    if how not in ("slam", "odometry") and Path(how).suffix.lower() not in GRID_FILES:
        raise StereovoxError(f"--poses {how}: give slam, odometry, or the .yaml of a map to localise in")
    return how


def _track(robot: Robot, how: str, config: Config, start: np.ndarray | None) -> Track | None:
    """Return the robot's way in the map; None: as its odometry has it."""
    from stereovox.products.map_server import read_map_server

    if how == "odometry":
        return None
    if how == "slam":
        say("finding the robot's way by SLAM; --poses MAP.yaml would localise it in a map, --poses odometry not at all")
        found = mapped(robot, config)
        say_refused(found.refused)
        return found.track
    say(f"finding the robot's way in {how}")
    floor = read_map_server(how)
    check_start(start, floor)
    track = localised(robot, floor, config, start)
    say_refused(track.refused, track.first_refusal)
    say_fit(robot, floor, track)
    return track


def _mapper(config: Config, resume: str | None, any_size: bool) -> GridMapper:
    from stereovox.config import load_config
    from stereovox.mapper import GridMapper
    from stereovox.products.map_server import read_map_server

    if resume is None:
        return GridMapper(config)
    before = read_map_server(resume)
    return GridMapper(load_config(config, voxel_size=before.resolution) if any_size else config, resume=before)


def _save(mapper: GridMapper, out: Path, mode: str) -> None:
    from stereovox.products.map_server import write_map_server

    write_map_server(mapper.occupancy(), out, mode=mode)


def _finished(mapper: GridMapper, reports: list[UpdateReport], out: Path, checkpoints: Checkpoints) -> dict[str, Any]:
    from stereovox.evaluate.summary import summarise

    result = summarise(mapper.map, reports)
    if not result["frames"]:
        raise StereovoxError(f"not one reading could be used, no map is written ({reports[0].detail})")
    checkpoints.save(len(reports))
    say_refusals(result, reports, "readings")
    say(f"a reading: scan {milliseconds(result['depth_ms'])}; map {milliseconds(result['integrate_ms'])}")
    say(cells_line(result))
    say(f"saved in {out.with_suffix('.yaml')}; look at it with: {picture_line(out)}")
    if not result["occupied"] and not result["free"]:
        say("note: no cell is known yet: one look decides nothing; map more readings")
    return result
