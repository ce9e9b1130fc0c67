# SPDX-License-Identifier: Apache-2.0
"""Maps as arguments and results of commands: open, check, save and describe them."""

from __future__ import annotations

import os
import shlex
from argparse import Namespace
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.terminal import but_few, cells_line, command_line, say
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.safe_io import FLOOR_READABLE, check_in_space

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap
    from stereovox.maps.occupancy import OccupancyGrid

Doubts = Sequence[dict[str, Any]]
"""Doubts as `mostly_lost` returns them."""


def check_new(out: str, *inputs: str) -> None:
    """Raise StereovoxError if no map can be saved to `out`, or it would overwrite one of its `inputs`."""
    from stereovox.maps.files.store import check_target

    if os.path.realpath(out) in map(os.path.realpath, inputs):
        raise StereovoxError(f"{out}: is an input of the new map; give the new one another name")
    check_in_space(out)
    check_target(Path(out))


def name_beside(path: str, what: str) -> str:
    """Return the name of a map made from another one, `NAME-what.svox` here. Raises StereovoxError if it exists."""
    out = f"{Path(path).resolve().stem}-{what}.svox"
    if Path(out).exists():
        raise StereovoxError(f"{out}: already exists; replace it with --out {shlex.quote(out)}, or give another name")
    return out


def save_new(voxel_map: VoxelMap, out: str, doubts: Doubts = ()) -> dict[str, Any]:
    """Save a map, print its contents, and return them with the keys of `info`, and any `doubts`."""
    voxel_map.save(out)
    return describe_saved(voxel_map, out, doubts)


def describe_saved(voxel_map: VoxelMap, out: str, doubts: Doubts = ()) -> dict[str, Any]:
    """Print the contents of a map saved to `out`, and return them with the keys of `info`, and any `doubts`."""
    bounds = voxel_map.bounds()
    result = {
        "out": out,
        "voxel_size": voxel_map.voxel_size,
        "bounds": None if bounds is None else bounds.round(6).tolist(),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "frames": voxel_map.frames,
        **({"doubts": list(doubts)} if doubts else {}),
    }
    say(cells_line(result))
    say(f"saved in {out}{but_few(result)}; look at it with: {command_line('view', out)}")
    return result


def open_grid(path: str) -> OccupancyGrid:
    """Read a map from map_server files, and print its note; raises MapFileError, one line that names the file."""
    from stereovox.formats.map_server import read_map_server

    grid = read_map_server(path)
    if grid.note:
        say(f"note: {path}: {grid.note}")
    return grid


def check_not_map_image(file: str, path: str) -> None:
    """Raise StereovoxError if writing `file` would overwrite the image with the cells of the map at `path`."""
    from stereovox.formats.map_server import read_metadata

    own = [Path(path), Path(path).with_suffix(".png")]
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        own = [read_metadata(Path(path)).image]
    if os.path.realpath(file) in map(os.path.realpath, own):
        raise StereovoxError(f"{file}: holds the cells of the map {path}; give the picture another name")


def check_new_floor(out: str, *inputs: str | Path) -> None:
    """Raise StereovoxError if the picture or .yaml of a new floor map would overwrite one of its `inputs`."""
    written = {os.path.realpath(Path(out).with_suffix(ending)) for ending in FLOOR_READABLE}
    if written & {os.path.realpath(file) for file in inputs}:
        raise StereovoxError(f"{out}: would overwrite its own input; give the new map another name")


def dimensions(path: str) -> int:
    """Return 2 for the name of a map_server file, and 3 for anything else."""
    return 2 if Path(path).suffix.lower() in FLOOR_READABLE and not os.path.isdir(path) else 3


def refuse_options(arguments: Namespace, names: Iterable[str], why: str) -> None:
    """Raise StereovoxError for the first of these options that was given although it does not apply."""
    for name in names:
        value = getattr(arguments, name)
        if not (value is None or value is False or value == []):  # a 0 counts as given
            raise StereovoxError(f"--{name.replace('_', '-')}: {why}; leave the option out")


def open_cubes(path: str) -> VoxelMap:
    """Load the map at `path` with cubic cells; raises MapFileError as `open_map`."""
    from stereovox.maps.storage.cubes import in_cubes

    return in_cubes(open_map(path))


def open_map(path: str) -> VoxelMap:
    """Load the map at `path`; raises MapFileError, one line that suggests the map or recording likely meant."""
    from stereovox.maps import load_map

    check_there(path)
    return load_map(path)


def check_there(path: str) -> None:
    """Raise MapFileError if `path` is no map: one line that suggests the map or recording likely meant."""
    from stereovox.maps.files.store import is_map

    if not is_map(path):
        raise MapFileError(f"{path}: {_what_is_there(Path(path))}")


def _what_is_there(path: Path) -> str:
    from stereovox.maps.files.store import is_map
    from stereovox.opening import is_recording

    if not os.path.exists(path):
        return "no stereovox map here, nor anything else; check the name"
    if dimensions(str(path)) == 2:
        return "is the map of a floor; eval, info, picture and grid take it, but this command needs a 3-D map"
    entries = sorted(path.iterdir()) if path.is_dir() else []
    candidate = next((folder for folder in entries if is_map(folder)), None)
    if candidate:
        return f"no stereovox map here (did you mean {candidate}?)"
    if is_recording(path):
        make = command_line("map", path, "--out", f"{path.resolve().stem}.svox")
        return f"no stereovox map here, but a recording; make a map of it with: {make}"
    return "no stereovox map here (a map is a folder with a manifest.json); make one with: stereovox map"
