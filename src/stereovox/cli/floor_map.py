# SPDX-License-Identifier: Apache-2.0
"""A floor's map in map_server files: open it and tell about it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.terminal import say, thousands
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.maps.occupancy import OccupancyGrid


def open_grid(path: str) -> OccupancyGrid:
    """Return the map of map_server files; raises MapFileError, one line that names the file."""
    from stereovox.products.map_server import read_map_server

    return read_map_server(path)


def check_not_its_own(file: str, path: str) -> None:
    """Raise StereovoxError where writing `file` would destroy the map at `path`, whose cells lie in a picture."""
    from stereovox.products.map_yaml import read_meaning

    own = [Path(path), Path(path).with_suffix(".png")]
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        own = [read_meaning(Path(path)).image]
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
