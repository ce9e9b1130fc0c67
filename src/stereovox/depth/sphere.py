# SPDX-License-Identifier: Apache-2.0
"""The spherical grid round the vehicle, in one place: gathered, stitched, asked, and handed on to the mapper."""

from stereovox.depth.sphere_grid import NEVER, SphereGrid, accumulate, empty, gather
from stereovox.depth.sphere_image import T_BODY_GRID, T_BODY_OPTICAL, frame_of, through_sphere
from stereovox.depth.sphere_layout import SphereLayout
from stereovox.depth.sphere_sight import MAIN_DIRECTIONS, Sight, range_in, sight_of, surroundings
from stereovox.depth.sphere_stitch import moved, stitch

__all__ = [
    "MAIN_DIRECTIONS", "NEVER", "T_BODY_GRID", "T_BODY_OPTICAL", "Sight", "SphereGrid", "SphereLayout", "accumulate",
    "empty", "frame_of", "gather", "moved", "range_in", "sight_of", "stitch", "surroundings", "through_sphere",
]  # fmt: skip
