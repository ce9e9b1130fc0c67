# SPDX-License-Identifier: Apache-2.0
"""Show what a map contains and how it was made.

MAP is a folder written by stereovox, or a floor map in map_server files (.yaml).
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import dimensions, open_map
from stereovox.cli.terminal import say, size, thousands

if TYPE_CHECKING:
    from stereovox.config import Config

EXAMPLE = "stereovox info kitchen.svox"
ALWAYS_PRINTED = ("profile", "voxel_size", "integrator", "max_range")
"""Settings that are printed in any case."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map, or the .yaml of a floor map")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and print what it contains."""
    return DESCRIBE[dimensions(arguments.map)](arguments.map)


def _describe_cells(path: str) -> dict[str, Any]:
    voxel_map = open_map(path)
    bounds, config = voxel_map.bounds(), voxel_map.config
    result = {
        "voxel_size": voxel_map.voxel_size,
        "bounds": None if bounds is None else bounds.round(6).tolist(),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "frames": voxel_map.frames,
        "frames_refused": voxel_map.frames_refused,
        "recording": voxel_map.recording,
        "imported": None if voxel_map.history.imported is None else voxel_map.history.imported._asdict(),
        "made_of": voxel_map.history.made_of(),
        "refused": dict(voxel_map.history.refused.most_common()),
        "settled": dict(voxel_map.history.settled),
        "ways": dict(voxel_map.history.ways),
        "last_stamps_ns": {sensor: frame.stamp_ns for sensor, frame in voxel_map.history.trusted.items()},
        "profile": config.profile,
        "settings": config.model_dump(mode="json"),
        "changed": _changed(config),
    }
    _print_result(result)
    return result


def _describe_grid(path: str) -> dict[str, Any]:
    from stereovox.cli.maps import describe_grid

    return describe_grid(path)


DESCRIBE = {2: _describe_grid, 3: _describe_cells}


def _print_result(result: dict[str, Any]) -> None:
    from stereovox.trust.health import FULL

    settings, of_frames = result["settings"], result["imported"] is None or result["frames"] > 0
    say(result["made_of"] + (f", profile {result['profile']}" if of_frames else ""))
    how = f", {settings['integrator']}, depth up to {settings['max_range']:g} m" if of_frames else ""
    say(f"cells of {result['voxel_size']:g} m{how}")
    if result["changed"] and of_frames:
        say(f"changed: {', '.join(f'{name} = {value}' for name, value in result['changed'].items())}")
    if result["bounds"]:
        (x0, y0, z0), (x1, y1, z1) = result["bounds"]
        say(f"from ({x0:g}, {y0:g}, {z0:g}) to ({x1:g}, {y1:g}, {z1:g}) m")
    say(", ".join(f"{thousands(result[state])} {state}" for state in ("occupied", "free", "tentative")))
    loaded = "in memory once loaded" + ("" if settings["window"]["size"] is None else ", whatever its window took")
    frames = f"{result['frames']} frames ({result['frames_refused']} refused), " if of_frames else ""
    say(f"{frames}{size(result['memory_bytes'])} {loaded}")
    for reason, number in result["refused"].items():
        say(f"  {number} x {reason}")
    for reason, number in result["settled"].items():
        say(f"  {number} x believed again after {reason}")
    reduced = {quality: number for quality, number in result["ways"].items() if quality != FULL}
    if reduced:
        say(f"looked at less thoroughly: {', '.join(f'{number} x {quality}' for quality, number in reduced.items())}")
    for sensor, stamp_ns in result["last_stamps_ns"].items():
        say(f"last trusted frame of '{sensor}' at {stamp_ns / 1e9:.3f} s")


def _changed(config: Config) -> dict[str, Any]:
    """Return the settings that differ from the map's profile, or that a profile file changed."""
    from stereovox.config import load_config, profile_names

    profile = config.profile if config.profile in profile_names() else {}  # a file lies on what is built into Config
    usual = dict(_flat(load_config(profile).model_dump(mode="json")))
    return {
        name: value
        for name, value in _flat(config.model_dump(mode="json"))
        if name not in ALWAYS_PRINTED and (name not in usual or usual[name] != value)
    }


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
