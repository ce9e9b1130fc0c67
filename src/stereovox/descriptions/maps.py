# SPDX-License-Identifier: Apache-2.0
"""Maps in space and maps of floors, as `describe` reports them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.config import Config, load_config, profile_names
from stereovox.descriptions.files import Description, command_line, picture_name, size, thousands
from stereovox.errors import MapFileError
from stereovox.files.safe_io import FLOOR_READABLE, read_part
from stereovox.formats.map_server import read_map_server
from stereovox.maps import State, VoxelMap, load_map
from stereovox.maps.boxed_map import BoxedMap
from stereovox.maps.files.store import FORMAT, MANIFEST, is_map
from stereovox.maps.record.health import FULL
from stereovox.view.grid import known_bounds

ALWAYS_PRINTED = ("profile", "voxel_size", "integrator", "max_range")
"""Settings that are always printed."""


def describe_map(path: str) -> Description | None:
    """Describe a folder of a map in space; None for anything else. Raises MapFileError if it is damaged."""
    if not is_map(path):
        _refuse_manifest(Path(path))
        return None
    voxel_map = load_map(path)
    bounds, config, kept = voxel_map.bounds(), voxel_map.config, voxel_map.kept_frames
    result = {
        "kind": "map",
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
        "quality": dict(voxel_map.history.quality),
        "boxes": _boxes(voxel_map),
        "kept_frames": None if kept is None else {"frames": len(kept), "bytes": kept.bytes},
        "loops": None if voxel_map.history.loops is None else voxel_map.history.loops.counts(),
        "last_stamps_ns": {sensor: frame.stamp_ns for sensor, frame in voxel_map.history.trusted.items()},
        "profile": config.profile,
        "up": config.up,
        "up_direction": config.up_direction,
        "settings": config.model_dump(mode="json"),
        "changed": _changed(config),
    }
    commands = [command_line("picture", path, picture_name(path)), command_line("view", path)]
    return Description("map", _lines(result), result, commands)


def _refuse_manifest(path: Path) -> None:
    """Raise MapFileError if a map is named by its manifest, whose numbers resemble a calibration's."""
    if path.name == MANIFEST and path.is_file() and FORMAT.encode() in read_part(path, 0, 100):
        raise MapFileError(
            f"{path}: is a file inside a map, which is the folder; type: {command_line('info', path.parent)}"
        )


def _boxes(voxel_map: VoxelMap) -> dict[str, Any] | None:
    """Return the boxes and levels of a boxed map; None for others."""
    if not isinstance(voxel_map, BoxedMap):
        return None
    manifest = voxel_map.manifest
    stored = sum(entry.bytes for level in (manifest.boxes, *manifest.levels) for entry in level)
    sides = manifest.layout.metres.tolist()
    return {"number": len(manifest.boxes), "metres": sides, "bytes": stored, "levels": len(manifest.levels)}


def describe_floor(path: str) -> Description | None:
    """Describe a floor map in map_server files, with the keys of a map in space if they apply; None for others.

    Raises MapFileError if it is damaged.
    """
    if Path(path).suffix.lower() not in FLOOR_READABLE or not _has_metadata(Path(path)):
        return None
    grid = read_map_server(path)
    counts = np.bincount(grid.states.ravel(), minlength=len(State)).tolist()
    bounds = known_bounds(grid)
    rows, columns = grid.cells.shape
    result = {
        "kind": "floor map",
        "dimensions": 2,
        "voxel_size": grid.resolution,
        "bounds": None if bounds is None else bounds.round(6).tolist(),
        **{state.name.lower(): counts[state] for state in (State.OCCUPIED, State.FREE, State.TENTATIVE, State.UNKNOWN)},
        "memory_bytes": grid.cells.nbytes,
        "frames": None,
        "profile": None,
        "rows": rows,
        "columns": columns,
        "origin": list(map(float, grid.origin)),
        "free_below": grid.free_below,
        "occupied_above": grid.occupied_above,
        "note": grid.note,
    }
    commands = [command_line("picture", path, picture_name(path)), command_line("localize", "ROBOT", "--map", path)]
    return Description("floor map", _floor_lines(result), result, commands)


def _has_metadata(path: Path) -> bool:
    """Return whether a file is a map_server .yaml, or an image with one next to it."""
    if path.suffix.lower() in (".yaml", ".yml"):
        try:
            return {b"image", b"resolution"} <= set(
                re.findall(rb"^(\w+)\s*:", path.read_bytes()[:10_000], re.MULTILINE)
            )
        except OSError:
            return False
    return any(os.path.isfile(path.with_suffix(ending)) for ending in (".yaml", ".yml"))


def _lines(result: dict[str, Any]) -> list[str]:
    """Return lines about a map."""
    lines: list[str] = []
    settings, of_frames = result["settings"], result["imported"] is None or result["frames"] > 0
    lines.append(result["made_of"] + (f", profile {result['profile']}" if of_frames else ""))
    how = f", {settings['integrator']}, depth up to {settings['max_range']:g} m" if of_frames else ""
    lines.append(f"cells of {result['voxel_size']:g} m{how}")
    if result["changed"] and of_frames:
        lines.append(f"changed: {', '.join(f'{name} = {value}' for name, value in result['changed'].items())}")
    if result["bounds"]:
        (x0, y0, z0), (x1, y1, z1) = result["bounds"]
        lines.append(f"from ({x0:g}, {y0:g}, {z0:g}) to ({x1:g}, {y1:g}, {z1:g}) m")
    lines.append(", ".join(f"{thousands(result[state])} {state}" for state in ("occupied", "free", "tentative")))
    window = "" if settings["window"]["size"] is None else ", in addition to its window's reserve"
    loaded = "in memory once loaded" + window
    frames = f"{result['frames']} frames ({result['frames_refused']} refused), " if of_frames else ""
    lines.append(f"{frames}{size(result['memory_bytes'])} {loaded}")
    if boxes := result["boxes"]:
        lines.append(
            f"in {thousands(boxes['number'])} boxes of {max(boxes['metres']):g} m, {boxes['levels'] + 1} levels of "
            f"detail, {size(boxes['bytes'])}: only requested ones are read"
        )
    if kept := result["kept_frames"]:
        lines.append(f"keeps {kept['frames']} of its frames, {size(kept['bytes'])}: poses can be corrected (remap)")
    if loops := result["loops"]:
        lines.append(f"loops: {thousands(loops['closed'])} closed, {thousands(loops['refused'])} refused")
    for reason, number in result["refused"].items():
        lines.append(f"  {number} x {reason}")
    for reason, number in result["settled"].items():
        lines.append(f"  {number} x accepted again after {reason}")
    reduced = {quality: number for quality, number in result["quality"].items() if quality != FULL}
    if reduced:
        lines.append(
            f"mapped at reduced quality: {', '.join(f'{number} x {quality}' for quality, number in reduced.items())}"
        )
    for sensor, stamp_ns in result["last_stamps_ns"].items():
        lines.append(f"last trusted frame of '{sensor}' at {stamp_ns / 1e9:.3f} s")
    return lines


def _changed(config: Config) -> dict[str, Any]:
    """Return the settings that differ from the map's profile, or that a profile file changed."""
    profile = config.profile if config.profile in profile_names() else {}  # a file is laid over Config's own defaults
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


def _floor_lines(result: dict[str, Any]) -> list[str]:
    """Return lines about a floor map."""
    lines: list[str] = []
    side = result["voxel_size"]
    lines.append(f"a floor's map, {result['columns']} x {result['rows']} cells of {side:g} m")
    x, y, yaw = result["origin"]
    turned = f", turned by {np.degrees(yaw):.2f} degrees" if yaw else ""
    lines.append(f"its lower left corner is at ({x:g}, {y:g}) m{turned}")
    if result["bounds"]:
        (x0, y0), (x1, y1) = result["bounds"]
        lines.append(f"known from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) m")
    lines.append(
        ", ".join(f"{thousands(result[state])} {state}" for state in ("occupied", "free", "tentative", "unknown"))
    )
    if result["note"]:
        lines.append(f"note: {result['note']}")
    if result["tentative"]:
        lines.append(f"free: p < {result['free_below']:g}; occupied: p > {result['occupied_above']:g}")
    return lines
