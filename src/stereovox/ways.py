# SPDX-License-Identifier: Apache-2.0
"""Ways from a frame to evidence, from the thorough one to the quick one.

`near` says of what is near what `full` says, and of the rest nothing. `coarse` says it of larger pixels.
"""

from __future__ import annotations

from functools import lru_cache
from math import sqrt
from typing import Protocol

import numpy as np

from stereovox.cameras import PinholeCamera
from stereovox.config import Config
from stereovox.depth import DepthPath
from stereovox.depth.downsample import downsample
from stereovox.depth.shorten import shortened
from stereovox.errors import ConfigError
from stereovox.frame import AnyFrame, DepthImage, Frame
from stereovox.health import FULL
from stereovox.integrate import make_integrator
from stereovox.sensors.model import REACH_SIGMA
from stereovox.sensors.noise import RangeNoise

FACE = sqrt(2)
"""Depth of a wide camera over depth of the pinhole images that it is cut into, at most."""


class ToDepth(Protocol):
    """What makes depth images of frames; see `DepthPath`."""

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame as one with depth, any other as it is."""
        ...

    def image(self, frame: Frame) -> DepthImage:
        """Return the frame's depth image."""
        ...


class Way:
    """One way from a frame to evidence: what makes depth images, and what makes evidence of them."""

    def __init__(self, name: str, depth: ToDepth, config: Config):
        self.name, self.depth = name, depth
        self.integrator = make_integrator(config)


def full(config: Config) -> Way:
    """Return the way that leaves nothing out."""
    return Way(FULL, DepthPath(config), config)


def ladder(config: Config) -> list[Way]:
    """Return `full`, `near` and `coarse`, as `config.pace` says. Raises ConfigError where `near` would see nothing."""
    near = config.pace.near_share * config.max_range
    cleared = near - float(np.linalg.norm(config.cell)) / 2  # a cell may be cleared if all that lies in it can be seen
    if cleared <= config.min_range:
        raise ConfigError(
            f"pace.near_share {config.pace.near_share:g}: leaves nothing between min_range {config.min_range:g} and "
            f"{near:g} m; raise it"
        )
    short = config.model_copy(update={"max_range": cleared, "blind_range": config.blind})
    halved = config.model_copy(update={"stereo": config.stereo.model_copy(update={"halve": True})})
    return [
        full(config),
        Way("near", NearDepth(config, near, 1), short),
        Way("coarse", NearDepth(halved, near, config.pace.stride), short),
    ]


class NearDepth:
    """Depth images up to `near` metres, blocks of `stride` by `stride` pixels in one; a wide camera keeps all pixels.

    A pixel beyond is TOO_FAR only where its noise cannot have put it there; else it says nothing.
    """

    def __init__(self, config: Config, near: float, stride: int):
        self._path, self._near, self._stride = DepthPath(config), near, stride
        self._far_from = lru_cache(lambda camera: _far_from(config, near, camera))

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame as one with depth, any other as it is. Raises FrameRefused as `DepthPath`."""
        return self._path.matched(frame)

    def image(self, frame: Frame) -> DepthImage:
        """Return the near part of the frame's depth image. Raises FrameRefused as `DepthPath`."""
        image = self._path.image(frame)
        if self._stride > 1 and isinstance(image.camera, PinholeCamera):
            image = downsample(image, self._stride)
        return shortened(image, self._near, self._far_from(image.camera))


def _far_from(config: Config, near: float, camera: object) -> float:
    """Return the measured depth in metres from which on all up to `near` is plainly free, whatever the noise."""
    reach = near if isinstance(camera, PinholeCamera) else FACE * near
    return reach + REACH_SIGMA * float(RangeNoise.of(config.noise, camera).sigma(reach))  # pyright: ignore[reportArgumentType]
