# SPDX-License-Identifier: Apache-2.0
"""Views of a map by name."""

from __future__ import annotations

from typing import Any

from stereovox.errors import StereovoxError, did_you_mean
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.drawn import checked_up
from stereovox.view.layer import draw_axis, draw_layer
from stereovox.view.picture import draw
from stereovox.view.space import draw_space

VIEWS = ("overview", "layer", "axis", "space")


def draw_view(
    voxel_map: VoxelMap,
    view: str,
    heading: str,
    up: str,
    at_m: float | None = None,
    viewpoint: Viewpoint | None = None,
    counted: VoxelMap | None = None,
) -> Any:
    """Return the matplotlib figure of one view of a map.

    overview: from above, from three sides, and a slice. layer: one layer across `up`, at height `at_m` along it or at
    the camera's. axis: log-odds along the optical axis. space: cells and field of view in space. viewpoint: by default
    the map's last. counted: the original map for the heading's numbers, if `voxel_map` was turned for the picture.
    Raises StereovoxError for an unknown view, or if the view needs an unknown camera.
    """
    counted = counted or voxel_map  # before it is coarsened
    up, voxel_map = checked_up(up), voxel_map.overview()
    if view == "overview":
        return draw(voxel_map, heading=heading, up=up, counted=counted)
    if view == "layer":
        return draw_layer(voxel_map, heading, up, at_m, viewpoint, counted)
    if view == "axis":
        return draw_axis(voxel_map, heading, None, viewpoint, counted)
    if view == "space":
        return draw_space(voxel_map, heading, up, viewpoint, counted)
    raise StereovoxError(f"unknown view '{view}'{did_you_mean(view, VIEWS)}")
