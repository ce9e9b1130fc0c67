# SPDX-License-Identifier: Apache-2.0
"""Make a floor's map from a robot's lidar and odometry, where there is no map yet.

Scans are matched, loops closed, and the way and the map made to agree. The way is saved beside the map (`.tum`).
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from stereovox.cli.robots import add_robot, opened, picture_line, settings_of, way_error
from stereovox.cli.terminal import progress_of_steps, say, say_about_compiling
from stereovox.safe_io import FLOOR_ENDINGS, check_file

if TYPE_CHECKING:
    from stereovox.localize.slam.pipeline import SlamResult
    from stereovox.sources.robots.robot import Robot

EXAMPLE = "stereovox slam floor.bag --out reference.yaml"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument(
        "--out",
        required=True,
        metavar="MAP",
        help="map_server files to write, for example floor.yaml; floor.tum beside it holds the way",
    )
    parser.add_argument("--relations", metavar="FILE", help="true relations between places, to score the way with")


def run(arguments: Namespace) -> dict[str, Any]:
    """Map, save map and way, and tell how it went."""
    from stereovox.maps.lock import only_writer_of_floor

    out = check_file(arguments.out, FLOOR_ENDINGS)
    with only_writer_of_floor(out):
        return _mapped(arguments, out)


def _mapped(arguments: Namespace, out: Path) -> dict[str, Any]:
    from stereovox.evaluate.trajectory import read_relations
    from stereovox.formats.map_server import write_map_server
    from stereovox.localize.robot_track import slam_robot

    config = settings_of(arguments)
    if arguments.relations is not None:
        read_relations(Path(arguments.relations))  # what is wrong with it shows before the work
    robot = opened(arguments.source)
    say_about_compiling()
    start = perf_counter()
    with progress_of_steps("matching scans") as progress:
        found = slam_robot(robot, config, progress)
    seconds = perf_counter() - start
    write_map_server(found.grid, out)
    found.track.save(out.with_suffix(".tum"))
    result = {**_told(robot, found, seconds), **_scored(found, arguments.relations)}
    say(f"saved in {out}, the way in {out.with_suffix('.tum')}; look at it with: {picture_line(out)}")
    return result


def _told(robot: Robot, found: SlamResult, seconds: float) -> dict[str, Any]:
    from stereovox.localize.robot_track import refused_line

    track = found.track
    recorded = 1e-9 * float(track.stamps_ns[-1] - track.stamps_ns[0])
    say(f"{len(track.stamps_ns)} scans, {found.closures} loops closed, in {seconds:.1f} s "
        f"({recorded / seconds:.0f} times as fast as recorded)")  # fmt: skip
    if found.refused:
        say(refused_line(found.refused))
    told = {"scans": len(track.stamps_ns), "scans_refused": sum(found.refused.values()), "refused": found.refused}
    times = {"closures": found.closures, "seconds": seconds, "recorded_s": recorded}
    return {**told, **times, **way_error(track, robot)}


def _scored(found: SlamResult, relations: str | None) -> dict[str, Any]:
    if relations is None:
        return {}
    from stereovox.evaluate.trajectory import score_relations

    score = score_relations(found.track, Path(relations))
    say(score.line())
    return {"relations": score.as_dict()}
