# SPDX-License-Identifier: Apache-2.0
"""Make a floor's map from a robot's lidar and odometry, where there is no map yet.

Scans are matched, loops closed, and the way and the map made to agree. The way is saved beside the map (`.tum`).
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from stereovox.cli.robots import GRID_ENDINGS, add_robot, check_file, opened, settings_of
from stereovox.cli.terminal import command_line, progress_bar, say, say_about_compiling
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.localize.slam import SlamResult
    from stereovox.sources.robot import Robot

EXAMPLE = "stereovox slam floor.bag --out reference.yaml"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument("--out", required=True, metavar="MAP", help="map_server files to write, for example floor.yaml")
    parser.add_argument("--relations", metavar="FILE", help="true relations between places, to score the way with")


def run(arguments: Namespace) -> dict[str, Any]:
    """Map, save map and way, and tell how it went."""
    from stereovox.products.map_server import write_map_server

    out, config = check_file(arguments.out, GRID_ENDINGS), settings_of(arguments)
    robot = opened(arguments.source)
    say_about_compiling()
    start = perf_counter()
    found = mapped(robot, config)
    seconds = perf_counter() - start
    write_map_server(found.grid, out)
    found.track.save(out.with_suffix(".tum"))
    result = {**_told(robot, found, seconds), **_scored(found, arguments.relations)}
    say(f"saved in {out}, the way in {out.with_suffix('.tum')}; look at it with: "
        f"{command_line('picture', out.with_suffix('.yaml'), f'{out.stem}.png')}")  # fmt: skip
    return result


def mapped(robot: Robot, config: Config) -> SlamResult:
    """Return what SLAM makes of the robot's scans, with a progress bar."""
    from stereovox.localize.slam import map_scans

    if not len(robot.scans):
        raise StereovoxError(f"{robot.name}: holds no lidar scans to make a map of; give a bag with a LaserScan topic")
    with progress_bar() as bar:
        task = bar.add_task("matching scans", note="")
        return map_scans(
            robot.scans,
            config,
            lambda done, total, text: bar.update(task, completed=done, total=total, description=text),
        )


def _told(robot: Robot, found: SlamResult, seconds: float) -> dict[str, Any]:
    track = found.track
    recorded = 1e-9 * float(track.stamps_ns[-1] - track.stamps_ns[0])
    say(f"{len(track.stamps_ns)} scans, {found.closures} loops closed, in {seconds:.1f} s "
        f"({recorded / seconds:.0f} times as fast as recorded)")  # fmt: skip
    result = {"scans": len(track.stamps_ns), "closures": found.closures, "seconds": seconds, "recorded_s": recorded}
    if robot.truth is None:
        return result
    from stereovox.evaluate.trajectory_error import trajectory_error

    error = trajectory_error(track, robot.truth)
    say(f"the way is off by {100 * error.position_rms_m:.1f} cm (RMS) and {error.yaw_rms_deg:.2f} degrees")
    return {**result, "position_rms_m": error.position_rms_m, "yaw_rms_deg": error.yaw_rms_deg}


def _scored(found: SlamResult, relations: str | None) -> dict[str, Any]:
    if relations is None:
        return {}
    from stereovox.evaluate.relations import score_relations

    score = score_relations(found.track, Path(relations))
    say(score.line())
    return {"relations": score.as_dict()}
