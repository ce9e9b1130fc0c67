# SPDX-License-Identifier: Apache-2.0
"""Tell what a map holds and how it was made."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import say, size, thousands

EXAMPLE = "stereovox info kitchen.svox"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and tell about it."""
    from stereovox.maps import load_map

    voxel_map = load_map(arguments.map)
    bounds = voxel_map.bounds()
    result = {
        "voxel_size": voxel_map.voxel_size,
        "bounds": None if bounds is None else bounds.round(6).tolist(),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "frames": voxel_map.frames,
        "frames_refused": voxel_map.frames_refused,
        "profile": voxel_map.config.profile,
        "settings": voxel_map.config.model_dump(),
    }
    _tell(result)
    return result


def _tell(result: dict[str, Any]) -> None:
    say(f"cells of {result['voxel_size']:g} m, profile {result['profile']}")
    if result["bounds"]:
        (x0, y0, z0), (x1, y1, z1) = result["bounds"]
        say(f"from ({x0:g}, {y0:g}, {z0:g}) to ({x1:g}, {y1:g}, {z1:g}) m")
    say(", ".join(f"{thousands(result[state])} {state}" for state in ("occupied", "free", "tentative")))
    say(f"{result['frames']} frames ({result['frames_refused']} refused), {size(result['memory_bytes'])} in memory")
