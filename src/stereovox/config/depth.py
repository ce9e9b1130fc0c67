# SPDX-License-Identifier: Apache-2.0
"""Settings of depth images: their noise, stereo matching, the spherical grid."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from stereovox.config.base import Section


class NoiseConfig(Section):
    """Range noise sigma(z) = s0 + s1 z + s2 z^2 in metres.

    s0, s1: constant and linear part.
    s2: quadratic part. Not set: from the camera, `subpixel / (focal_px * baseline)` (Chien 2020, Eq 3.5 with the square
        that is missing in print).
    subpixel: standard deviation of the disparity in pixels. Not set: the camera's own (`stereo.subpixel` for images
        that are matched here), else 0.08.
    correlation_px: errors of neighbouring pixels are correlated as if smoothed by a Gaussian of this standard deviation
        in pixels, so they average out more slowly than independent ones; `calibrate noise` measures it. 0: independent.
    default_baseline: metres between the two eyes, for cameras whose file does not give it.
    pose_m, pose_deg: standard deviation of the tracker's poses along and about each axis; sensor models that know the
        noise then give hits and misses less weight.
    """

    s0: float = Field(0.0, ge=0)
    s1: float = Field(0.0, ge=0)
    s2: float | None = Field(None, ge=0)
    subpixel: float | None = Field(None, gt=0)
    correlation_px: float = Field(0.0, ge=0, le=16)
    default_baseline: float = Field(0.05, gt=0)
    pose_m: float = Field(0.0, ge=0, le=10)
    pose_deg: float = Field(0.0, ge=0, le=90)


class DepthConfig(Section):
    """Preparation of a depth image before it becomes evidence.

    denoise: average depths that differ by no more than the camera's noise, if that is large compared with the cells.
    keep_lines: a line of measured pixels in front of both its sides, such as a rod before a wall, keeps its own mean.
        Fewer thin objects are lost, but what has moved away clears later (docs/thin.md).
    downsample: merge n by n pixels into one with the smallest valid depth of the block (Chien 2020, 3.2); 1: off.
    far: which pixels count as too far, and so clear cells up to the maximum range. `measured`: only depths measured
        beyond it; `reported`: also pixels that the source reports as too far;
        `infinite`: also +inf (REP 117), for cameras that never write it for pixels that are too near or unmatched.
    """

    denoise: bool = True
    keep_lines: bool = False
    downsample: int = Field(1, ge=1, le=64)
    far: Literal["measured", "reported", "infinite"] = "reported"


class StereoConfig(Section):
    """How the disparity of a stereo pair is found (Valenti 2018, 5.1 and 5.2); lengths are pixels of the full image.

    method: `census` (own semi-global matching along three paths), `sgm` (OpenCV's), `sgm8` (with eight paths), `hh4`
        (with four), `block`, `onnx`.
    model: the file of a network for `onnx`: two images in, a disparity out.
    disparities: number of disparities searched, from 0.
    block_size: side of the window that is compared; odd. p1, p2: cost of a step of one disparity and of
        more, per pixel of the window. uniqueness: per cent by which the best match must beat the second best.
    from_below: start the vertical path of `census` and `sgm` at the bottom: better if a road fills the lower half of
        the view.
    unlock: spread fractions of a pixel evenly; semi-global matching pulls them towards whole pixels.
    speckle_size, speckle_range: drop smaller patches; a larger step of disparity ends a patch. 0: keep all.
    left_right: largest difference between the disparities of both images; 0: not checked.
    aligned: the image that the depth belongs to (Valenti 2018: right).
    halve: match at half the resolution: four to five times as fast, and smoother (Valenti 2018, 5.1), with equally good
        maps of streets. The result has full size, and the settings above still count full pixels. Not set: images
        of more than 450,000 pixels are halved.
    rcrop: columns dropped at the border that the other eye cannot see: the right one for the right image (Valenti
        2018, Eq 5.1). Pixels whose match is outside the other image are always dropped.
    min_confidence: pixels with less confidence are invalid (0 to 1, see docs/stereo.md).
    texture: mean grey step over two columns below which pixels are invalid. 1 drops only flat areas, 2 to 3
        also clear skies, but smooth roads too; 0: not checked.
    subpixel: standard deviation of the remaining disparities in pixels, which the map assumes as their noise.
    threads: threads from images to depth; the result does not depend on it.
    """

    method: str = "census"
    model: str | None = None
    disparities: int = Field(128, ge=16, le=1024, multiple_of=16)
    block_size: int = Field(5, ge=1, le=51)
    p1: float = Field(16.0, ge=0, le=100)
    p2: float = Field(64.0, gt=0, le=400)
    uniqueness: int = Field(15, ge=0, le=99)
    from_below: bool = False
    unlock: bool = True
    speckle_size: int = Field(400, ge=0)
    speckle_range: float = Field(2.0, gt=0)
    left_right: float = Field(1.0, ge=0)
    aligned: Literal["left", "right"] = "left"
    halve: bool | None = None
    rcrop: int = Field(0, ge=0)
    min_confidence: float = Field(0.5, ge=0, le=1)
    texture: float = Field(1.0, ge=0)
    subpixel: float = Field(0.4, gt=0)
    threads: int = Field(2, ge=1, le=256)

    @model_validator(mode="after")
    def _fitting(self) -> StereoConfig:
        if self.block_size % 2 == 0:
            raise ValueError(f"block_size {self.block_size} must be odd")
        if self.p1 >= self.p2:
            raise ValueError(f"p1 {self.p1} must be smaller than p2 {self.p2}")
        return self


class SphereConfig(Section):
    """The spherical grid round the vehicle between depth and map (Valenti 2018, 5.3); off without `step_deg`.

    step_deg: width of a cell in both angles; must divide 180 degrees evenly.
    statistic: how a cell summarises its ranges. `robust`: their mean less `spread` standard deviations if
        the standard deviation is below `std_threshold` metres, else the smallest (Eq 5.4); `minimum`: the smallest.
    std_threshold: metres. spread: standard deviations; both for `robust`.
    polar_deg, azimuth_deg: limits; polar from the body's z axis (0: up, 90: level, 180: down), azimuth from its x
        axis to its y axis (0: forward, 90: left, 270 or -90: right). They are widened to whole cells.
    """

    step_deg: float | None = Field(None, ge=0.05, le=30)
    statistic: Literal["robust", "minimum"] = "robust"
    std_threshold: float = Field(0.1, gt=0)
    spread: float = Field(3.0, ge=0, le=10)
    polar_deg: tuple[float, float] = (0.0, 180.0)
    azimuth_deg: tuple[float, float] = (-180.0, 180.0)

    @model_validator(mode="after")
    def _fitting(self) -> SphereConfig:
        if self.step_deg is not None and abs(180 / self.step_deg - round(180 / self.step_deg)) > 1e-6:
            raise ValueError("step_deg must divide 180 evenly, as 0.5, 1, 1.5, 2, 3, 5 do")
        if not 0 <= self.polar_deg[0] < self.polar_deg[1] <= 180:
            raise ValueError("polar_deg must rise, from 0 (up) to 180 (down)")
        if not (-180 <= self.azimuth_deg[0] < self.azimuth_deg[1] <= self.azimuth_deg[0] + 360):
            raise ValueError("azimuth_deg must rise from -180 or more, and span 360 at most")
        return self
