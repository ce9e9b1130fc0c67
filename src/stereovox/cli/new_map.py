# SPDX-License-Identifier: Apache-2.0
"""Write a map that a command made of others, and tell what is in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.terminal import cells_line, command_line, say
from stereovox.errors import StereovoxError
from stereovox.files import check_in_space

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap


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
