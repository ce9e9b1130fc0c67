# SPDX-License-Identifier: Apache-2.0
"""What all cameras of a vehicle see together: the last grid of each, moved to where the vehicle is now."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from stereovox.config import Config
from stereovox.depth import prepare
from stereovox.depth.sphere import T_BODY_OPTICAL, SphereGrid, SphereLayout, accumulate, empty, moved, stitch
from stereovox.depth.stereo import StereoDepth
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, StereoFrame
from stereovox.geometry import Transform, inverse, orthonormalise


def look_round(frames: Iterable[Frame | StereoFrame], config: Config) -> tuple[SphereGrid, int, dict[str, int]]:
    """Return the grid of all pairs' last frames, the time of the newest in ns, and how many were refused and why.

    A pair is known by its name. A depth camera has none and counts as one that stands at the body's origin and looks
    ahead. Raises StereovoxError where no frame at all could be used.
    """
    depth_of = StereoDepth(config.stereo)
    last: dict[str, tuple[SphereGrid, Transform]] = {}
    refused: dict[str, int] = {}
    why = "the source is empty"
    for frame in frames:
        name = frame.pair.name if isinstance(frame, StereoFrame) else ""
        try:
            last[name] = _grid_of(frame, depth_of, config)
        except FrameRefused as error:
            refused[error.reason] = refused.get(error.reason, 0) + 1
            why = str(error)
    if not last:
        raise StereovoxError(f"not one frame could be used ({why})")
    grid, now_ns = _together(last)
    return grid, now_ns, refused


def _grid_of(frame: Frame | StereoFrame, depth_of: StereoDepth, config: Config) -> tuple[SphereGrid, Transform]:
    """Return the grid of one frame in the body's frame, and T_world_body."""
    mounted = frame.pair.T_body_camera if isinstance(frame, StereoFrame) else T_BODY_OPTICAL
    image = prepare(depth_of(frame) if isinstance(frame, StereoFrame) else frame, config)
    T_world_body = orthonormalise(np.asarray(frame.T_world_sensor, float)) @ inverse(mounted)
    T_body_eye = inverse(T_world_body) @ image.T_world_sensor  # the right eye's, where that is the one with depth
    return accumulate(image, T_body_eye, config, SphereLayout.configured(config.sphere)), T_world_body


def _together(last: dict[str, tuple[SphereGrid, Transform]]) -> tuple[SphereGrid, int]:
    newest, T_world_now = max(last.values(), key=lambda item: _stamp(item[0]))
    grids = [_carried(grid, inverse(T_world_now) @ T_world_then) for grid, T_world_then in last.values()]
    return stitch(grids or [empty(newest.layout)]), _stamp(newest)


def _carried(grid: SphereGrid, T_now_then: Transform) -> SphereGrid:
    return grid if np.allclose(T_now_then, np.eye(4), atol=1e-6) else moved(grid, T_now_then)


def _stamp(grid: SphereGrid) -> int:
    return int(grid.stamp_ns.max())
