# SPDX-License-Identifier: Apache-2.0
"""Maps that commands are given or make: open them, write them, tell about them."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.terminal import cells_line, command_line, say, thousands
from stereovox.errors import MapFileError, StereovoxError
from stereovox.safe_io import FLOOR_READABLE, check_in_space

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap
    from stereovox.maps.occupancy import OccupancyGrid


def check_new(out: str, *made_of: str) -> None:
    """Raise StereovoxError where no map can be saved to `out`, or it would take the place of one it is made of."""
    from stereovox.maps.store import check_target

    if os.path.realpath(out) in map(os.path.realpath, made_of):
        raise StereovoxError(f"{out}: is what the new map is made of; give the new one another name")
    check_in_space(out)
    check_target(Path(out))


def save_new(voxel_map: VoxelMap, out: str) -> dict[str, Any]:
    """Save a map and say what it holds; return that as `info` tells it."""
    voxel_map.save(out)
    bounds = voxel_map.bounds()
    result = {
        "out": out,
        "voxel_size": voxel_map.voxel_size,
        "bounds": None if bounds is None else bounds.round(6).tolist(),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "frames": voxel_map.frames,
    }
    say(cells_line(result))
    say(f"saved in {out}; look at it with: {command_line('view', out)}")
    return result


def open_grid(path: str) -> OccupancyGrid:
    """Return the map of map_server files; raises MapFileError, one line that names the file."""
    from stereovox.formats.map_server import read_map_server

    return read_map_server(path)


def check_not_its_own(file: str, path: str) -> None:
    """Raise StereovoxError where writing `file` would destroy the map at `path`, whose cells lie in a picture."""
    from stereovox.formats.map_server import read_metadata

    own = [Path(path), Path(path).with_suffix(".png")]
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        own = [read_metadata(Path(path)).image]
    if os.path.realpath(file) in map(os.path.realpath, own):
        raise StereovoxError(f"{file}: holds the cells of the map {path}; give the picture another name")


def about(path: str) -> dict[str, Any]:
    """Tell what a floor's map holds, and return it with the keys of a map in space where they mean something."""
    from stereovox.maps import State
    from stereovox.view.grid import known_bounds

    grid = open_grid(path)
    counts = np.bincount(grid.states.ravel(), minlength=len(State)).tolist()
    bounds = known_bounds(grid)
    rows, columns = grid.cells.shape
    result = {
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
    }
    _tell(result)
    return result


def _tell(result: dict[str, Any]) -> None:
    side = result["voxel_size"]
    say(f"a floor's map, {result['columns']} x {result['rows']} cells of {side:g} m")
    x, y, yaw = result["origin"]
    turned = f", turned by {np.degrees(yaw):.2f} degrees" if yaw else ""
    say(f"its lower left corner lies at ({x:g}, {y:g}) m{turned}")
    if result["bounds"]:
        (x0, y0), (x1, y1) = result["bounds"]
        say(f"known from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) m")
    say(", ".join(f"{thousands(result[state])} {state}" for state in ("occupied", "free", "tentative", "unknown")))
    if result["tentative"]:
        say(f"free: p < {result['free_below']:g}; occupied: p > {result['occupied_above']:g}")


def dimensions(path: str) -> int:
    """Return 2 for the name of a map_server file, and 3 for all else."""
    return 2 if Path(path).suffix.lower() in FLOOR_READABLE and not os.path.isdir(path) else 3


def refuse_options(arguments: Namespace, names: Iterable[str], why: str) -> None:
    """Raise StereovoxError for the first of these options that was given although it says nothing here."""
    for name in names:
        if getattr(arguments, name) not in (None, False, []):
            raise StereovoxError(f"--{name.replace('_', '-')}: {why}; leave the option out")


def open_cubes(path: str) -> VoxelMap:
    """Return the map saved at `path` for those who know only cubes; raises MapFileError as `open_map`."""
    from stereovox.maps.cubes import in_cubes

    return in_cubes(open_map(path))


def open_map(path: str) -> VoxelMap:
    """Return the map saved at `path`; raises MapFileError, one line that names the map or recording perhaps meant."""
    from stereovox.maps import load_map
    from stereovox.maps.store import is_map

    if not is_map(path):
        raise MapFileError(f"{path}: {_instead(Path(path))}")
    return load_map(path)


def _instead(path: Path) -> str:
    from stereovox.maps.store import is_map
    from stereovox.opening import is_recording

    if not os.path.exists(path):
        return "no stereovox map here, nor anything else; check the name"
    if dimensions(str(path)) == 2:
        return "is the map of a floor; eval, info, picture and grid take it, this command wants one in space"
    below = sorted(path.iterdir()) if path.is_dir() else []
    meant = next((folder for folder in below if is_map(folder)), None)
    if meant:
        return f"no stereovox map here (did you mean {meant}?)"
    if is_recording(path):
        make = command_line("map", path, "--out", f"{path.resolve().stem}.svox")
        return f"no stereovox map here but a recording; make a map of it with: {make}"
    return "no stereovox map here (a map is a folder with a manifest.json); make one with: stereovox map"
