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

    @property
    def size(self) -> str:
        """Width and height of the images, `640x480`."""
        camera = self.frames[0].camera
        return f"{camera.width}x{camera.height}"


def read_frames(
    source: Iterable[AnyFrame], config: Config, limit: int | None = None, tell: Progress = silent
) -> Recording:
    """Read the usable frames of `source` (at most `limit`).

    Pixels without a value and beyond `config.max_range` are 0, so that no library clears space through them, and poses
    are exactly rigid. Raises StereovoxError when no frame can be used.
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
            frames.append(_only_valid_pixels(path.matched(frame), config))
        except FrameRefused as refused:
            refusals.append(str(refused))
        tell(done, total, "reading frames")
    if not frames:
        why = next(iter(refusals), "the source is empty")
        raise StereovoxError(f"{name}: not one frame can be used ({why})")
    return Recording(name, frames, refusals)


def points_of(image: DepthImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (N, 3) in the world of all pixels with a value, and the camera's position (3,)."""
    T = image.T_world_sensor
    v, u = np.nonzero(image.reason == Reason.VALID)
    columns, rows = image.camera.rays()
    points = np.column_stack([columns[u], rows[v]]) * image.depth_m[v, u, None].astype(float)
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3]), T[:3, 3].copy()


def _only_valid_pixels(frame: Frame, config: Config) -> Frame:
    """Return the frame in its own units, all that has no value up to the maximum range set to 0."""
    image = prepare(frame, config)
    valid = image.reason == Reason.VALID
    if not valid.any():
        raise FrameRefused("no_valid_depth", f"{frame.name or 'a frame'}: no depth up to {config.max_range:g} m")
    depth = np.where(valid, frame.depth, 0).astype(frame.depth.dtype)
    return replace(frame, depth=depth, reason=None, T_world_sensor=image.T_world_sensor)
