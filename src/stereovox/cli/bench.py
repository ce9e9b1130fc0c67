# SPDX-License-Identifier: Apache-2.0
"""Time stereovox and other mapping libraries on the same frames, in one process."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import say
from stereovox.errors import MissingExtra

EXAMPLE = "stereovox bench recordings/kitchen --voxel-size 0.1 --voxel-size 0.05 --peers octomap,pyoctomap"
VOXEL_SIZES = (0.2, 0.1, 0.05, 0.02)
USUAL_PEERS = ("octomap", "pyoctomap")


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="SOURCE", help="recorded folder or file, or a simulation (sim:room)")
    parser.add_argument(
        "--voxel-size", type=float, action="append", metavar="M", help="cell size in metres; repeatable"
    )
    parser.add_argument(
        "--peers",
        metavar="A,B",
        help="other libraries: octomap, pyoctomap, octomap-rays (default: the first two, where installed)",
    )
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="threads for stereovox (%(default)s)")
    parser.add_argument("--max-range", type=float, metavar="M", help="depth in metres up to which pixels count (5)")
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames, as a Python slice")


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the comparison and print its table."""
    from stereovox.cli.terminal import progress_bar
    from stereovox.evaluate.bench import bench, format_table
    from stereovox.sources import open_source

    source = open_source(arguments.source, arguments.frames)
    peers = _installed() if arguments.peers is None else _named(arguments.peers)
    with progress_bar() as bar:
        task = bar.add_task("loading", note="")
        result = bench(
            source,
            arguments.voxel_size or VOXEL_SIZES,
            peers,
            threads=arguments.threads,
            max_range=arguments.max_range,
            progress=lambda done, total, text: bar.update(task, completed=done, total=total, description=text),
        )
    say(format_table(result))
    return result


def _named(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _installed() -> list[str]:
    """Return the usual peers that are here, and say what to install for the others."""
    from stereovox.evaluate.peers import find_peer

    here = []
    for name in USUAL_PEERS:
        try:
            find_peer(name)(1.0)
            here.append(name)
        except MissingExtra as missing:
            say(f"note: without {name}: {missing}")
    return here
