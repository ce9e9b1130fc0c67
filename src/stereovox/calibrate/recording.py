# SPDX-License-Identifier: Apache-2.0
"""A recording of a flat wall by a camera at rest, reduced to a few sums per pixel."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.correlation import LAGS, add_products
from stereovox.calibrate.surface import find_wall
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.prepare import correct
from stereovox.errors import StereovoxError
from stereovox.frame import AnyFrame, Frame, Reason, StereoFrame

GROSS = 0.25
"""Values off by a larger share of the depth are not noise: mismatches, or a person walking through."""
USUAL = 0.5
"""A pixel counts if it has a value in this share of the frames; rarer ones scatter in one direction."""


@dataclass(eq=False)
class WallRecording:
    """Sums over the frames of one recording for each pixel, without gross errors.

    camera: its correction, if any, is already applied. distance: where the optical axis meets the wall, as
    measured by hand, in metres, or None.
    sums (4, height, width) float64: number of values, then the sums of 1/z, z and z^2 (z in metres).
    gross: number of values left out as gross errors; skipped: frames without usable depth, first_fault: why the first
    of them was. Poses are ignored.
    products: of the errors of 1/z of neighbouring pixels, see `add_products`, against the surface in the first frame.
    greys: mean grey level of the pixels with a value, of each frame whose image is known.
    condition: light, emitter power or texture, in words.
    """

    name: str
    camera: PinholeCamera
    distance: float | None = None
    frames: int = 0
    skipped: int = 0
    first_fault: str = ""
    gross: int = 0
    sums: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 0, 0)))
    products: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, LAGS + 1, 2)))
    greys: list[float] = field(default_factory=list)
    condition: str = ""

    @property
    def count(self) -> NDArray[np.float64]:
        """Number of values of each pixel, (height, width)."""
        return self.sums[0]

    @property
    def inverse(self) -> NDArray[np.float64]:
        """Mean of 1/z in 1/m, (height, width), NaN if fewer than half the frames have a value.

        Not of z: a stereo camera's noise is uniform in disparity, which is proportional to 1/z; far away the mean of z
        is biased upwards.
        """
        enough = self.count >= max(1.0, USUAL * self.frames)
        return np.where(enough, self.sums[1] / np.maximum(self.count, 1), np.nan)

    @property
    def valid_share(self) -> float:
        """Share of all pixels of all frames that have a value, gross errors left out."""
        return float(self.count.sum() / max(1, self.frames * self.count.size))


def itself(frame: AnyFrame) -> Frame:
    """Return the frame, which must have depth."""
    assert isinstance(frame, Frame)
    return frame


def read_wall(
    frames: Iterable[AnyFrame],
    name: str,
    camera: PinholeCamera,
    distance: float | None = None,
    matched: Callable[[AnyFrame], Frame] = itself,
    condition: str = "",
) -> WallRecording:
    """Return the sums over `frames`, which may lack poses; depths are corrected if `camera` has a correction.

    matched: turns stereo frames into depth frames. condition: see `WallRecording`.

    The first frame gives the wall, and so defines gross errors.
    Raises StereovoxError if no frame has usable depth, and as `find_wall` if the first shows no wall.
    """
    wall = WallRecording(name, camera, distance, sums=np.zeros((4, camera.height, camera.width)), condition=condition)
    expected, gross = None, GROSS
    for seen in frames:
        frame = matched(seen)
        depth_m = metres(frame)
        if depth_m.shape != wall.count.shape or not np.isfinite(depth_m).any():
            wall.skipped += 1
            wall.first_fault = wall.first_fault or frame.fault_detail or f"{frame.name}: no valid depth"
            continue
        correct(depth_m, camera)
        if expected is None:
            found = find_wall(1 / depth_m.astype(float), camera, name)
            expected, gross = found.inverse(camera), max(GROSS, 6 * found.noise)
        _add(wall, depth_m, expected, gross)
        if isinstance(seen, StereoFrame) and seen.left.shape[:2] == depth_m.shape:
            wall.greys.append(float(seen.left[np.isfinite(depth_m)].mean()))
    if not wall.frames:
        raise StereovoxError(f"{name}: no valid depth in any frame ({wall.first_fault or 'it has none'})")
    return wall


def metres(frame: Frame) -> NDArray[np.float32]:
    """Return the depth as measured in metres, float32, NaN if missing; poses and corrections are ignored."""
    raw = np.asarray(frame.depth)
    depth_m = raw.astype(np.float32) * np.float32(frame.depth_scale)
    usable = np.isfinite(depth_m) & (depth_m > 0)
    if raw.dtype == np.uint16:
        usable &= raw != np.iinfo(np.uint16).max
    if frame.reason is not None and frame.reason.shape == raw.shape:
        usable &= frame.reason == Reason.VALID
    return np.where(usable, depth_m, np.float32(np.nan))


def _add(wall: WallRecording, depth_m: NDArray[np.float32], expected: NDArray[np.float64], gross: float) -> None:
    z = depth_m.astype(float)
    known = np.isfinite(z)
    with np.errstate(invalid="ignore"):
        usable = known & (np.abs(z * expected - 1) <= gross)
    wall.gross += int(known.sum() - usable.sum())
    z[~usable] = 0
    inverse = np.divide(1, z, out=np.zeros_like(z), where=usable)
    wall.sums += [usable, inverse, z, z * z]
    add_products(wall.products, np.where(usable, inverse - expected, np.nan))
    wall.frames += 1
