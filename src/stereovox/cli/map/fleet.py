# SPDX-License-Identifier: Apache-2.0
"""Map many recordings into one map in boxes, on all cores of this machine or on a Dask cluster.

RECORDING is a source as for `map`, a pattern ('drives/*'), a list (@drives.txt: one recording per line, followed by the
file of its corrected poses, if any; paths start at the list's folder) or an s3:// prefix. The map does not depend on
workers or boxes. Finished work is kept: --resume does the rest, and redoes what new recordings or poses change.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, add_usual, overrides
from stereovox.cli.terminal import (
    but_few,
    cells_line,
    command_line,
    progress_of_steps,
    say,
    say_about_compiling,
    size,
)
from stereovox.descriptions.files import many

if TYPE_CHECKING:
    from stereovox.fleet import FleetMap, FleetPlan

EXAMPLES = """stereovox fleet recordings/monday recordings/tuesday --out town.svox
stereovox fleet 'sim:town?drive=0' 'sim:town?drive=1' --out town.svox --workers 2 --voxel-size 0.2"""
SHOWN = 5
"""Recordings with refused frames that are listed."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recordings", metavar="RECORDING", nargs="+", help="recordings, patterns, @lists, s3:// prefixes"
    )
    parser.add_argument("--out", metavar="MAP", required=True, help="folder or s3://bucket/NAME.svox of the map")
    parser.add_argument("--profile", metavar="P", help="profile name or TOML file (default: as before, or default)")
    add_usual(parser, "voxel-size", "max-range")
    parser.add_argument("--box", type=float, metavar="M", help="side of a box in metres (256 or 512 cells, by reach)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes on this machine (one per core)")
    parser.add_argument("--scheduler", metavar="URL", help="Dask scheduler (tcp://host:8786) instead of these")
    parser.add_argument("--resume", action="store_true", help="continue the map at --out, with these recordings")
    parser.add_argument("--plan", action="store_true", help="estimate the cost, and do nothing")
    add_settings(parser, "sensor.model=andert")


def run(arguments: Namespace) -> dict[str, Any]:
    """Map the recordings and print the result of each."""
    from stereovox.fleet import map_fleet, plan_fleet

    settings = {"profile": arguments.profile, "box_m": arguments.box, **overrides(arguments)}
    say_about_compiling()
    if arguments.plan:
        with progress_of_steps("reading recordings") as progress:
            plan = plan_fleet(arguments.recordings, progress=progress, **settings)
        _say_plan(plan)
        return plan.summary()
    with progress_of_steps("recordings") as progress:
        made = map_fleet(
            arguments.recordings, arguments.out, resume=arguments.resume, workers=arguments.workers,
            scheduler=arguments.scheduler, progress=progress, notify=say, **settings,
        )  # fmt: skip
    _say_map(made)
    return {**made.summary(), **made.map.counts(), "out": made.out}


def _say_plan(plan: FleetPlan) -> None:
    say(f"{many(plan.frames, 'frame')} of {many(plan.recordings, 'recording')}")
    say(f"at least {_boxes(plan.boxes)} of {plan.box_m:g} m; each frame is in {plan.overlap:.1f} of them on average")
    say(f"{size(plan.bytes)} of depth images to keep; {_time(plan.core_hours)} of a core like one of this machine")
    for line in plan.unreadable:
        say(f"cannot be read: {line}")


def _boxes(number: int) -> str:
    return "1 box" if number == 1 else f"{number:,} boxes"


def _time(hours: float) -> str:
    """Format a time in the largest unit that keeps it at 1 or more."""
    if hours < 1 / 60:
        return f"{3600 * hours:.2g} s"
    return f"{60 * hours:.2g} minutes" if hours < 1 else f"{hours:.2g} hours"


def _say_map(made: FleetMap) -> None:
    boxes, mapped = made.boxes
    for one in made.recordings:
        if one.error:
            say(f"skipped: {one.recording}: {one.error}")
    refused = [one for one in made.recordings if one.refused]
    for one in refused[:SHOWN]:
        why = ", ".join(f"{number} x {reason}" for reason, number in one.refused.items())
        say(f"{one.recording}: {many(one.frames, 'frame')}, refused: {why}")
    if len(refused) > SHOWN:
        say(f"and {many(len(refused) - SHOWN, 'recording')} more with refused frames (--json)")
    frames, were = many(made.map.frames, "frame"), "was" if mapped == 1 else "were"
    say(f"{frames}, each in {made.overlap:.1f} of {_boxes(boxes)} on average; {mapped} of these {were} mapped now")
    say(cells_line({**made.map.counts(), "memory_bytes": made.map.memory_bytes}))
    say(f"saved in {made.out}{but_few(made.summary())}; look at it with: {command_line('view', made.out)}")
