# SPDX-License-Identifier: Apache-2.0
"""Fly a simulated camera through a built-in room; make a map, a picture and a report in under a minute.

The report compares the map with the scene's exact occupancy.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import cells_line, milliseconds, progress_of_steps, say, say_about_compiling

EXAMPLES = """stereovox demo --out my-first-map
stereovox demo --voxel-size 0.1 --json"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--out", default="stereovox-demo", metavar="DIR", help="folder for the results (%(default)s)")
    parser.add_argument("--voxel-size", type=float, default=0.05, metavar="M", help="cell size in metres (%(default)s)")


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the demo and print the paths of its results."""
    from stereovox.runs.demo import demo

    say_about_compiling()
    with progress_of_steps("starting") as progress:
        result = demo(arguments.out, voxel_size=arguments.voxel_size, progress=progress)
    _print_result(result)
    return result


def _print_result(result: dict[str, Any]) -> None:
    accuracy = result["accuracy"]
    parts = [f"{result[name]['median']:.2f} ms" for name in ("depth_ms", "integrate_ms")]
    say(f"{result['frames']} frames; per frame: {milliseconds(result['frame_ms'])}")
    say(f"medians of its parts: {parts[0]} to prepare the depth image, {parts[1]} to map it")
    say(cells_line(result))
    say(
        f"against the exact scene, within one cell: precision {accuracy['tolerance_precision']:.3f}, "
        f"recall {accuracy['tolerance_recall']:.3f}"
    )
    say(f"missing parts: {', '.join(result['missing']) or 'none'}")
    for name, path in result["files"].items():
        say(f"{name:>8}: {path}")
