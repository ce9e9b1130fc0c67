# SPDX-License-Identifier: Apache-2.0
"""Make a ground-truth map from a recording's lidar.

SOURCE is a KITTI recording with lidar: a raw drive, a tracking or odometry sequence, or stereo 2015 scenes. A cell is
occupied if at least one lidar point in it is inside the left image and in no annotated box.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_usual
from stereovox.cli.terminal import cells_line, command_line, say, thousands, tracked

if TYPE_CHECKING:
    from stereovox.evaluate.lidar_truth import TruthCounts

EXAMPLES = """stereovox truth 2011_09_26/2011_09_26_drive_0005_sync --out truth.svox --voxel-size 0.2 --max-range 20
stereovox truth sim:room --out truth.svox --voxel-size 0.1"""
DROPPED = {
    "outside_view": "outside the left image",
    "in_boxes": "in annotated boxes",
    "moving": "on something moving",
}


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="KITTI recording with lidar")
    parser.add_argument("--out", required=True, metavar="MAP", help="folder of the map to write, for example t.svox")
    parser.add_argument("--voxel-size", type=float, default=0.2, metavar="M", help="cell size in metres (0.2)")
    parser.add_argument(
        "--max-range", type=float, default=20.0, metavar="M", help="depth along the optical axis in metres (20)"
    )
    add_usual(parser, "frames")
    parser.add_argument(
        "--free",
        choices=("view", "rays", "box"),
        default="view",
        help="free cells: all others in view of a frame (view), only those that a lidar ray crosses (rays), or all "
        "others of the box around them (box: Valenti 2018, Table 8.1)",
    )
    parser.add_argument(
        "--box-margin", type=float, default=0.0, metavar="M", help="enlarge annotated boxes by this many metres (0)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Make the map, save it and print a summary."""
    from stereovox.evaluate.lidar_truth import lidar_truth
    from stereovox.maps.files.store import check_target
    from stereovox.opening import open_source

    out = Path(arguments.out)
    check_target(out)
    source: Any = open_source(arguments.source)
    for note in source.notes:
        say(f"note: {note}")
    voxel_map, counts = lidar_truth(
        source,
        arguments.voxel_size,
        arguments.max_range,
        arguments.free,
        arguments.frames,
        box_margin=arguments.box_margin,
        watch=_with_progress,
    )
    voxel_map.save(out)
    _print_result(counts, voxel_map.memory_bytes, out)
    return {**counts.as_dict(), "voxel_size": voxel_map.voxel_size, "memory_bytes": voxel_map.memory_bytes}


def _with_progress(numbers: Iterable[int], count: int) -> Iterator[int]:
    """Yield the frame numbers with a progress bar; Ctrl-C stops between two frames."""
    from stereovox.runs.engine import interrupt_between_steps

    with interrupt_between_steps() as check:
        for i in tracked(numbers, count, "scans"):
            yield i
            check()


def _print_result(counts: TruthCounts, memory_bytes: int, out: Path) -> None:
    say(f"{counts.frames} scans used, {counts.refused.total()} refused")
    for reason, number in counts.refused.items():
        say(f"  {number} x {reason}")
    if counts.first_refusal:
        say(f"  first: {counts.first_refusal}")
    far = f"{thousands(counts.out_of_range)} of them beyond the range of their own frame"
    say(f"{thousands(counts.used)} of {thousands(counts.points)} points used, {far}; dropped:")
    for name, text in DROPPED.items():
        say(f"  {thousands(getattr(counts, name)):>11} {text}")
    say(cells_line({"occupied": counts.occupied, "free": counts.free, "memory_bytes": memory_bytes}))
    say(f"saved in {out}; compare a map with it: {command_line('eval', 'MAP', out)}")
