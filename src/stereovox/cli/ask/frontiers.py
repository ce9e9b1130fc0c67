# SPDX-License-Identifier: Apache-2.0
"""List the frontiers of a map: groups of free cells next to unknown ones, each with a viewpoint to see it from."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import open_map
from stereovox.cli.options import check_ending, heights_of, point
from stereovox.cli.terminal import say, thousands

if TYPE_CHECKING:
    from stereovox.products.frontiers import Frontier

EXAMPLES = """stereovox frontiers room.svox --heights 0.1:1.8 --picture frontiers.png
stereovox frontiers room.svox --json"""
MAX_PRINTED = 12
"""Only the largest frontiers are printed."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument(
        "--smallest", type=int, default=10, metavar="CELLS", help="smallest frontier that counts, in cells (10)"
    )
    parser.add_argument(
        "--longest", type=float, default=2.0, metavar="M", help="longer frontiers are split in half (2 metres)"
    )
    parser.add_argument("--heights", metavar="LO:HI", help="metres above the floor between which cells count (all)")
    parser.add_argument(
        "--start", type=point, metavar="X,Y,Z", help="position of the robot, in metres (the camera of the last frame)"
    )
    parser.add_argument("--radius", type=float, default=0.25, metavar="M", help="free radius that it needs (0.25)")
    parser.add_argument("--out", metavar="FILE.npz", help="file for the cells, centroids and viewpoints")
    parser.add_argument("--picture", metavar="FILE.png", help="picture from above")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and list its frontiers."""
    from stereovox.products.frontiers import frontiers, write_frontiers

    check_ending("--out", arguments.out, ".npz")
    check_ending("--picture", arguments.picture, ".png")
    heights = heights_of(arguments.heights)
    voxel_map = open_map(arguments.map)
    found = frontiers(voxel_map, arguments.smallest, arguments.longest, heights, arguments.start, arguments.radius)
    _print_frontiers(found)
    if arguments.out:
        write_frontiers(found, arguments.out)
        say(f"saved {arguments.out}")
    if arguments.picture:
        from stereovox.view.above import draw_frontiers
        from stereovox.view.figures import save

        save(draw_frontiers(voxel_map, found, f"{Path(arguments.map).stem}: frontiers"), arguments.picture)
        say(f"saved {arguments.picture}")
    return {"frontiers": [_as_dict(frontier) for frontier in found]}


def _as_dict(frontier: Frontier) -> dict[str, Any]:
    look_from = None if frontier.look_from is None else frontier.look_from.round(4).tolist()
    return {"cells": len(frontier.cells), "centroid": frontier.centroid.round(4).tolist(), "look_from": look_from}


def _print_frontiers(found: list[Frontier]) -> None:
    say(f"{len(found)} frontiers" if found else "no frontier: no free cell is next to an unknown one")
    for n, frontier in enumerate(found[:MAX_PRINTED], 1):
        summary = _as_dict(frontier)
        where = "no reachable place" if summary["look_from"] is None else _format_point(summary["look_from"])
        centroid = _format_point(summary["centroid"])
        say(f"{n:4}: {thousands(summary['cells']):>7} cells around {centroid}; view from {where}")
    if len(found) > MAX_PRINTED:
        say(f"      and {len(found) - MAX_PRINTED} smaller ones")


def _format_point(point: list[float]) -> str:
    return "({})".format(", ".join(f"{number:.2f}" for number in point))
