# SPDX-License-Identifier: Apache-2.0
"""Occupancy maps: sparse voxel blocks in memory, Zarr on disk."""

from __future__ import annotations

from pathlib import Path

from stereovox.config import Config
from stereovox.errors import ConfigError
from stereovox.maps.boxed_map import save_boxed
from stereovox.maps.files.loading import load_map
from stereovox.maps.record.kept_frames import KeptFrames
from stereovox.maps.storage.storage import Storage
from stereovox.maps.voxel_map import State, VoxelMap, unbounded

__all__ = ["State", "VoxelMap", "load_map", "make_map", "save_boxed", "unbounded"]


def make_map(config: Config, resume: VoxelMap | None = None, tiles: Path | None = None) -> VoxelMap:
    """Return the map for `config`: unbounded, or in a window that moves with the camera, or within `max_memory`, or on
    a graphics card.

    resume: a map to continue. tiles: folder for the cells that leave a window, a temporary one by default; it is not
    there if this raises. Raises ConfigError if the settings would change the meaning of `resume`'s cells, or if
    something does not fit into `max_memory`.
    """
    if config.dimensions == 2:
        raise ConfigError(
            f"profile {config.profile}: dimensions 2 is a floor's grid; use GridMapper, map_floor or `stereovox grid`"
        )
    kept = _kept_frames(config, resume)
    if resume is not None:
        resume.storage.check_can_grow()
        resume.storage.check_cells(config)  # before anything is written to disk
    try:
        made = _made(config, resume, tiles)
        made.storage.kept = kept
        return made
    except MemoryError:
        raise ConfigError("this machine has no room for the map; set a smaller max_memory or window.size") from None


def _kept_frames(config: Config, resume: VoxelMap | None) -> KeptFrames | None:
    """Return the store of kept frames, including those of `resume`. Raises ConfigError if `resume` kept none."""
    if not config.map.keep_frames:
        return None
    if resume is None:
        return KeptFrames(config.map.frames_budget)
    if (kept := resume.storage.kept) is not None:
        return KeptFrames(config.map.frames_budget, kept.frames, kept.spacing)
    raise ConfigError("cannot continue: the map did not keep its frames; set map.keep_frames=false, or begin a new map")


def _made(config: Config, resume: VoxelMap | None, tiles: Path | None) -> VoxelMap:
    if config.window.size is None and (config.max_memory is None or config.when_full == "refuse"):
        return _without_window(config, resume)
    from stereovox.maps.storage.rolling import RollingMap

    rolling = RollingMap(config, tiles)
    if resume is not None:
        try:
            rolling.storage.go_on_with(resume.storage)
        except BaseException:
            rolling.close()
            raise
    return rolling


def _without_window(config: Config, resume: VoxelMap | None) -> VoxelMap:
    if config.device == "cuda":
        from stereovox.maps.storage.gpu import gpu_map

        return gpu_map(config, resume)
    if config.max_memory is None:
        return VoxelMap(config) if resume is None else _continued(resume, config)
    from stereovox.maps.cells.capped import CappedMap

    capped = CappedMap(config)
    if resume is not None:
        capped.storage.go_on_with(resume.storage)
    return capped


def _continued(resume: VoxelMap, config: Config) -> VoxelMap:
    """Return the map itself with the new run's settings; a copy if it is bounded or not in memory."""
    if type(resume.storage) is not Storage:
        return unbounded(resume, config)
    resume.storage.continue_with(config)
    return resume
