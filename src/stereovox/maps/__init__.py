# SPDX-License-Identifier: Apache-2.0
"""Occupancy maps: sparse voxel blocks in memory, Zarr on disk."""

from stereovox.maps.store import load_map
from stereovox.maps.voxel_map import State, VoxelMap

__all__ = ["State", "VoxelMap", "load_map"]
