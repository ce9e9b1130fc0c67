# SPDX-License-Identifier: Apache-2.0
"""Make a floor map from a robot's lidar and odometry by SLAM.

Scans are matched, loops closed, and trajectory and map optimised together. The trajectory is saved next to the map
(`.tum`). A map that its own scans contradict is written too, with warnings and exit status 3.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from stereovox.cli.recordings import add_robot, open_noting, picture_line, print_trajectory_error, settings_of
from stereovox.cli.terminal import but_few, progress_of_steps, say, say_about_compiling
from stereovox.files.safe_io import FLOOR_ENDINGS, check_file

if TYPE_CHECKING:
    from stereovox.localize.slam.pipeline import SlamResult
    from stereovox.sources.robots.robot import Robot

EXAMPLES = """stereovox slam floor.bag --out reference.yaml
stereovox slam robot.log --set slam.voxel_size=0.1 --out office.yaml"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_robot(parser)
    parser.add_argument(
        "--out",
        required=True,
        metavar="MAP",
        help="map_server files to write, for example floor.yaml; floor.tum next to it holds the trajectory",
    )
    parser.add_argument("--relations", metavar="FILE", help="true relations between poses, to score the trajectory")


def run(arguments: Namespace) -> dict[str, Any]:
    """Make and save map and trajectory, and print a summary."""
    from stereovox.maps.files.lock import only_writer_of_floor

    out = check_file(arguments.out, FLOOR_ENDINGS)
    with only_writer_of_floor(out):
        return _map(arguments, out)


def _map(arguments: Namespace, out: Path) -> dict[str, Any]:
    from stereovox.evaluate.trajectory import read_relations
    from stereovox.formats.map_server import write_map_server
    from stereovox.localize.robot_track import doubt_lines, slam_robot

    config = settings_of(arguments)
    if arguments.relations is not None:
        read_relations(Path(arguments.relations))  # raises for a bad file before the work
    robot = open_noting(arguments.source)
    compiling = say_about_compiling()
    start = perf_counter()
    with progress_of_steps("matching scans") as progress:
        found = slam_robot(robot, config, progress)
    seconds = perf_counter() - start
    write_map_server(found.grid, out)
    found.track.save(out.with_suffix(".tum"))
    result = {**_print_result(robot, found, seconds, compiling), **_score(found, arguments.relations)}
    for line in doubt_lines(found.doubts):
        say(line)
    files = f"{out}, the trajectory in {out.with_suffix('.tum')}{but_few(result)}"
    say(f"saved in {files}; look at it with: {picture_line(out)}")
    return result


def _print_result(robot: Robot, found: SlamResult, seconds: float, compiling: bool) -> dict[str, Any]:
    from stereovox.evaluate.metrics import mostly_lost
    from stereovox.localize.robot_track import refused_line

    track, refused = found.track, sum(found.refused.values())
    recorded = 1e-9 * float(track.stamps_ns[-1] - track.stamps_ns[0])
    pace = _pace(recorded, seconds, compiling)
    say(f"{len(track.stamps_ns)} scans, {found.closures} loops closed, in {seconds:.1f} s{pace}")
    if found.refused:
        say(refused_line(found.refused))
    scans = {"scans": len(track.stamps_ns), "scans_refused": refused, "refused": found.refused}
    doubts = [doubt.as_dict() for doubt in found.doubts]
    doubts += mostly_lost(len(track.stamps_ns), len(track.stamps_ns) + refused, "scans")
    times = {"closures": found.closures, "seconds": seconds, "recorded_s": recorded, "doubts": doubts}
    return {**scans, **times, **print_trajectory_error(track, robot)}


def _pace(recorded: float, seconds: float, compiling: bool) -> str:
    """Return the speed as a multiple of the robot's; "" for a recording whose stamps do not advance."""
    times = recorded / seconds if seconds > 0 else 0.0
    if times < 0.05:
        return ""
    return f" ({times:.{0 if times >= 10 else 1}f} times as fast as recorded{', compiling included' * compiling})"


def _score(found: SlamResult, relations: str | None) -> dict[str, Any]:
    if relations is None:
        return {}
    from stereovox.evaluate.trajectory import score_relations

    score = score_relations(found.track, Path(relations))
    say(score.line())
    return {"relations": score.as_dict()}
