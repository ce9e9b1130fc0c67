# SPDX-License-Identifier: Apache-2.0
"""The spherical grid round the vehicle: gather, stitch and query it, and pass it to the mapper."""

from stereovox.depth.sphere.grid import NEVER, SphereGrid, SphereLayout, accumulate, empty, gather, moved, stitch
from stereovox.depth.sphere.image import T_BODY_GRID, T_BODY_OPTICAL, frame_of, through_sphere
from stereovox.depth.sphere.sight import MAIN_DIRECTIONS, Sight, range_in, sight_of, surroundings

__all__ = [
    "MAIN_DIRECTIONS", "NEVER", "T_BODY_GRID", "T_BODY_OPTICAL", "Sight", "SphereGrid", "SphereLayout", "accumulate",
    "empty", "frame_of", "gather", "moved", "range_in", "sight_of", "stitch", "surroundings", "through_sphere",
]  # fmt: skip
