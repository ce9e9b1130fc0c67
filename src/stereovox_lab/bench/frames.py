# SPDX-License-Identifier: Apache-2.0
"""Frames of a benchmark: in memory before timing starts, with only the pixels that all libraries use."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.depth import DepthPipeline, prepare
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, DepthImage, Frame, Reason

Progress = Callable[[int, int, str], None]
"""Called with steps done, their total (0: unknown), and the current step in words."""


def silent(done: int, total: int, text: str) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Recording:
    """Usable frames, their source, and why others were refused."""

    name: str
    frames: list[Frame]
    refusals: list[str]
    far_share: float = 0.0
    """Share of the pixels beyond the maximum range, which clear space up to it."""

    def without_far(self, config: Config) -> Recording:
        """Return the same frames without values beyond the maximum range."""
        return Recording(self.name, [_usable_pixels(frame, config, far=False) for frame in self.frames], self.refusals)

    @property
    def size(self) -> str:
        """Width and height of the images, `640x480`."""
        camera = self.frames[0].camera
        return f"{camera.width}x{camera.height}"


def read_frames(
    source: Iterable[AnyFrame], config: Config, limit: int | None = None, tell: Progress = silent, far: bool = False
) -> Recording:
    """Read the usable frames of `source` (at most `limit`).

    Pixels without a value are 0, and so are those beyond `config.max_range`, unless kept (`far`) to clear space
    up to there; poses are exactly rigid. Raises StereovoxError if no frame is usable.
    """
    total = operator.length_hint(source)
    total = total if limit is None else min(total, limit)
    name = getattr(source, "name", "frames")
    frames: list[Frame] = []
    refusals: list[str] = []
    path = DepthPipeline(config)
    tell(0, total, "reading frames: compiling, if need be")
    for done, frame in enumerate(islice(source, limit), start=1):
        try:
            frames.append(_usable_pixels(path.matched(frame), config, far))
        except FrameRefused as refused:
            refusals.append(str(refused))
        tell(done, total, "reading frames")
    if not frames:
        why = next(iter(refusals), "the source is empty")
        raise StereovoxError(f"{name}: not one frame can be used ({why})")
    seen = [np.mean(prepare(frame, config).reason == Reason.TOO_FAR) for frame in frames] if far else [0.0]
    return Recording(name, frames, refusals, float(np.mean(seen)))


def depth_for_peers(image: DepthImage, beyond_m: float) -> NDArray[np.float32]:
    """Return depths (height, width) float32 in metres, 0 without a value, `beyond_m` beyond the maximum range."""
    depth_m = np.where(image.reason == Reason.VALID, image.depth_m, np.float32(0))
    depth_m[image.reason == Reason.TOO_FAR] = beyond_m
    return depth_m


def points_of(image: DepthImage, beyond_m: float = 0.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (N, 3) in the world of all pixels with a value, and the camera's position (3,).

    beyond_m: depth of the points for pixels beyond the maximum range; 0: no points.
    """
    T, depth_m = image.T_world_sensor, depth_for_peers(image, beyond_m)
    v, u = np.nonzero(depth_m)
    columns, rows = image.camera.rays()
    points = np.column_stack([columns[u], rows[v]]) * depth_m[v, u, None].astype(float)
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3]), T[:3, 3].copy()


def _usable_pixels(frame: Frame, config: Config, far: bool) -> Frame:
    """Return the frame in its own units, with missing values (and, unless `far`, those beyond the range) set to 0."""
    image = prepare(frame, config)
    valid, beyond = image.reason == Reason.VALID, image.reason == Reason.TOO_FAR
    if not valid.any():
        raise FrameRefused("no_valid_depth", f"{frame.name or 'a frame'}: no depth up to {config.max_range:g} m")
    kept = valid | beyond if far else valid
    depth = np.where(kept, frame.depth, 0).astype(frame.depth.dtype)
    reason = None
    if far and frame.reason is not None:
        reason = np.select([valid, beyond], [Reason.VALID, Reason.TOO_FAR], Reason.UNKNOWN).astype(np.uint8)
    return replace(frame, depth=depth, reason=reason, T_world_sensor=image.T_world_sensor)
