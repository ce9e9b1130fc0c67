# SPDX-License-Identifier: Apache-2.0
"""The combined view of a vehicle's cameras: the last grid of each, moved to the vehicle's current pose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from stereovox.cameras.rigs import StereoPair
from stereovox.config import Config
from stereovox.depth import DepthPipeline
from stereovox.depth.sphere import T_BODY_OPTICAL, SphereGrid, SphereLayout, accumulate, empty, moved, stitch
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, StereoFrame
from stereovox.geometry.se3 import Transform, inverse, orthonormalise


def vehicle_grid(
    frames: Iterable[AnyFrame], config: Config, tell: Callable[[str], object] = lambda line: None
) -> tuple[SphereGrid, int, dict[str, int]]:
    """Return the grid of all pairs' last frames, the time of the newest in ns, and the number of refused frames by
    reason.

    Pairs are identified by name. The last frame without a `fault` counts, and only that one is matched. `tell` receives
    one line for each pair whose newest frame cannot be used. A depth camera has no name and is assumed to be
    at the body's origin and to point ahead. So is a pair whose T_body_left is the identity: poses are then those of its
    optical frame, and the body has its axes turned to x forward, y left, z up, for all pairs.
    Raises StereovoxError if no frame could be used.
    """
    newest, why, refused = _newest(frames)
    path, T_ahead_body = DepthPipeline(config), _axes(newest.values())
    last: dict[str, tuple[SphereGrid, Transform]] = {}
    for name, frame in newest.items():
        try:
            last[name] = _grid_of(frame, T_ahead_body, path, config)
        except FrameRefused as error:
            refused[error.reason] = refused.get(error.reason, 0) + 1
            why[name] = str(error)
    if not last:
        raise StereovoxError(f"no frame could be used ({next(iter(why.values()), 'the source is empty')})")
    for name, text in why.items():
        tell(f"{name or 'the camera'}: its last frame cannot be used ({text})")
    grid, now_ns = together(last)
    return grid, now_ns, refused


def _newest(
    frames: Iterable[AnyFrame],
) -> tuple[dict[str, AnyFrame], dict[str, str], dict[str, int]]:
    """Return each pair's last frame without a fault, the fault of a later frame if any, and the number of each
    fault."""
    newest: dict[str, AnyFrame] = {}
    why: dict[str, str] = {}
    refused: dict[str, int] = {}
    for frame in frames:
        name = frame.pair.name if isinstance(frame, StereoFrame) else ""
        if frame.fault:
            refused[frame.fault] = refused.get(frame.fault, 0) + 1
            why[name] = frame.fault_detail or f"{frame.name}: {frame.fault}"
        else:
            newest[name] = frame
            why.pop(name, None)
    return newest, why, refused


def _axes(frames: Iterable[AnyFrame]) -> Transform:
    """Return T_ahead_body, which turns the axes of the poses' frame to x forward, y left, z up."""
    optical = any(isinstance(frame, StereoFrame) and _is_body(frame.pair) for frame in frames)
    return T_BODY_OPTICAL if optical else np.eye(4)


def _is_body(pair: StereoPair) -> bool:
    """Return whether the poses are those of the left eye's optical frame: its T_body_left is the identity."""
    T_left_camera = np.eye(4)
    if pair.eyes is not None:
        T_left_camera[:3, :3] = pair.eyes.rectifying_rotations()[0]
    return np.allclose(pair.T_body_camera, T_left_camera, atol=1e-6)


def _grid_of(
    frame: AnyFrame, T_ahead_body: Transform, path: DepthPipeline, config: Config
) -> tuple[SphereGrid, Transform]:
    """Return the grid of one frame in the frame of the forward-facing body, and T_world_ahead."""
    mounted = T_ahead_body @ frame.pair.T_body_camera if isinstance(frame, StereoFrame) else T_BODY_OPTICAL
    image = path.checked(path.matched(frame))
    T_world_body = orthonormalise(np.asarray(frame.T_world_sensor, float)) @ inverse(mounted)
    T_body_eye = inverse(T_world_body) @ image.T_world_sensor  # the right eye's if that one has the depth
    return accumulate(image, T_body_eye, config, SphereLayout.configured(config.sphere)), T_world_body


def together(
    last: Mapping[str, tuple[SphereGrid, Transform]], now: tuple[int, Transform] | None = None
) -> tuple[SphereGrid, int]:
    """Return the last grids of all cameras as one, seen from the body's pose at the newest, and its time in ns.

    last: by camera, at least one: its grid, and T_world_body (4, 4) at its time. now: a later time in ns and
    T_world_body then, to be used instead of the newest.
    """
    newest, T_world_now = max(last.values(), key=lambda item: _stamp(item[0]))
    at_ns = _stamp(newest)
    if now is not None and now[0] > at_ns:
        at_ns, T_world_now = now
    grids = [_carried(grid, inverse(T_world_now) @ T_world_then) for grid, T_world_then in last.values()]
    return stitch(grids or [empty(newest.layout)]), at_ns


def _carried(grid: SphereGrid, T_now_then: Transform) -> SphereGrid:
    return grid if np.allclose(T_now_then, np.eye(4), atol=1e-6) else moved(grid, T_now_then)


def _stamp(grid: SphereGrid) -> int:
    return int(grid.stamp_ns.max())
