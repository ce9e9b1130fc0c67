# SPDX-License-Identifier: Apache-2.0
"""Open the map that a command was given, or say what the folder holds instead."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from stereovox.cli.terminal import command_line
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files import FLOOR_READABLE

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap


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
    from stereovox.sources import is_recording

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
