# SPDX-License-Identifier: Apache-2.0
"""Deadline scheduler: choose the quality level of each frame so that frames take no longer than `deadline_ms`.

There are three levels, from thorough to quick: `full`; `near`, the same evidence, but only near the sensor; `coarse`,
like `near` but from larger pixels.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache, partial
from math import sqrt
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth import DepthPipeline
from stereovox.depth.cloud import checked_cloud, cloud_of
from stereovox.depth.prepare import downsample, shortened
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import AnyFrame, AnyImage, Cloud, DepthImage, Frame, Rays
from stereovox.integrate import Integration
from stereovox.integrate.views import MAX_CAMERAS
from stereovox.kernels.threads import Ahead
from stereovox.maps.record.health import FULL
from stereovox.sensors.noise import RangeNoise
from stereovox.sensors.protocol import REACH_SIGMA

PATIENCE, MAX_PATIENCE = 8, 128
"""Frames in time before the next better level is tried: at first, and at most; one frame in 128 is less than 1 %."""
FACE = sqrt(2)
"""Largest ratio of a wide camera's depth to the depth of the pinhole images it is cut into."""


class Deadline:
    """Chooses the quality level of each frame from the time that the frames before took.

    Without `deadline_ms` every frame is `full`. Raises ConfigError if the `pace` settings leave nothing to see.
    """

    def __init__(self, config: Config):
        self._levels = [full_quality(config)] if config.deadline_ms is None else quality_levels(config)
        self._scheduler = Scheduler(len(self._levels), config.deadline_ms) if config.deadline_ms else None
        self._warm: set[VirtualCamera | Lidar] = set()

    def quality(self) -> Quality:
        """Return the quality level of the next frame. Raises FrameRefused `no_time` if it must be skipped."""
        if self._scheduler is None:
            return self._levels[0]
        if self._scheduler.skips():
            raise FrameRefused("no_time", "skipped: frames take longer than deadline_ms even at the quickest level")
        return self._levels[self._scheduler.level]

    def expect(self, frame: AnyFrame) -> None:
        """Begin to prepare the next frame if its level is already known."""
        if self._scheduler is None:
            self._levels[0].prepare.begin(frame)

    def record(self, milliseconds: float) -> None:
        """Record the time that a frame took at the level that `quality` returned."""
        if self._scheduler is not None:
            self._scheduler.record(milliseconds)

    def warm_up(self, frame: AnyFrame, camera: VirtualCamera | Lidar) -> None:
        """Run each camera's first frame through all other levels, so that no kernel compiles when time is short."""
        if self._scheduler is None or camera in self._warm or len(self._warm) >= MAX_CAMERAS:
            return  # a source with a new camera in each frame would warm up for ever
        self._warm.add(camera)
        for level in self._levels[1:]:
            with suppress(FrameRefused):
                level.integrator.evidence(level.prepare(frame).image)


class DepthStage(Protocol):
    """Turns frames into depth images; see `DepthPipeline`."""

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame with its depth, any other frame unchanged."""
        ...

    def image(self, frame: Frame) -> DepthImage:
        """Return the frame's depth image."""
        ...


class Prepared(NamedTuple):
    """A frame ready for the integrator, and the milliseconds spent on it."""

    frame: Frame | Cloud  # with the matched depth, for stereo frames
    image: AnyImage
    match_ms: float
    depth_ms: float


class Quality:
    """A quality level: the depth stage and the integrator that take a frame to evidence.

    Attributes:
        name: Its name.
        depth: The depth stage.
        integrator: The integrator.
        prepare: Turns a frame into a depth image; may begin before the frame is added. Raises FrameRefused as `depth`.
    """

    def __init__(self, name: str, depth: DepthStage, config: Config):
        self.name, self.depth = name, depth
        self.integrator = Integration(config)
        self.prepare = Ahead(partial(prepared, depth, config))  # without `self`, which would keep itself alive


def prepared(depth: DepthStage, config: Config, frame: AnyFrame) -> Prepared:
    """Return the depth image of a frame, or the checked cloud. Raises FrameRefused as `depth` or `checked_cloud`."""
    started = perf_counter()
    if isinstance(frame, Rays):  # whole at every level: the level's integrator cuts its rays
        frame = cloud_of(frame, config)
        return Prepared(frame, checked_cloud(frame, config), 0.0, 1e3 * (perf_counter() - started))
    depth_frame = depth.matched(frame)
    matched = started if depth_frame is frame else perf_counter()
    image = depth.image(depth_frame)
    return Prepared(depth_frame, image, 1e3 * (matched - started), 1e3 * (perf_counter() - matched))


def full_quality(config: Config) -> Quality:
    """Return the level that omits nothing."""
    return Quality(FULL, DepthPipeline(config), config)


def quality_levels(config: Config) -> list[Quality]:
    """Return the levels `full`, `near` and `coarse`. Raises ConfigError if `near` would see nothing."""
    near = config.pace.near_share * config.max_range
    cleared = near - float(np.linalg.norm(config.cell)) / 2  # a cell may be cleared only if all of it can be seen
    if cleared <= config.min_range:
        raise ConfigError(
            f"pace.near_share {config.pace.near_share:g}: leaves nothing between min_range {config.min_range:g} and "
            f"{near:g} m; raise it"
        )
    short = config.model_copy(update={"max_range": cleared, "blind_range": config.blind})
    halved = config.model_copy(update={"stereo": config.stereo.model_copy(update={"halve": True})})
    return [
        full_quality(config),
        Quality("near", NearDepth(config, near, 1), short),
        Quality("coarse", NearDepth(halved, near, config.pace.stride), short),
    ]


class Levels:
    """All quality levels by name, built on first use; for frames that were mapped before."""

    def __init__(self, config: Config):
        self._config = config
        self._made: dict[str, Quality] = {}

    def __call__(self, name: str) -> Quality:
        """Return the level of this name. Raises ConfigError if its settings leave nothing to see."""
        if name not in self._made:
            levels = [full_quality(self._config)] if name == FULL else quality_levels(self._config)
            self._made = {level.name: level for level in levels} | self._made
        return self._made[name]


class NearDepth:
    """Depth images up to `near` metres, with `stride` by `stride` pixels merged into one; wide cameras keep all pixels.

    A pixel beyond `near` is TOO_FAR only if noise alone cannot have put it there; otherwise it has no value.
    """

    def __init__(self, config: Config, near: float, stride: int):
        self._pipeline, self._near, self._stride = DepthPipeline(config), near, stride
        self._far_from = lru_cache(lambda camera: _far_from(config, near, camera))

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame with its depth, any other unchanged. Raises FrameRefused as `DepthPipeline`."""
        return self._pipeline.matched(frame)

    def image(self, frame: Frame) -> DepthImage:
        """Return the near part of the frame's depth image. Raises FrameRefused as `DepthPipeline`."""
        image = self._pipeline.image(frame)
        if self._stride > 1 and isinstance(image.camera, PinholeCamera):
            image = downsample(image, self._stride)
        return shortened(image, self._near, self._far_from(image.camera))


def _far_from(config: Config, near: float, camera: VirtualCamera) -> float:
    """Return the measured depth beyond which everything up to `near` is certainly free, whatever the noise."""
    reach = near if isinstance(camera, PinholeCamera) else FACE * near
    return reach + REACH_SIGMA * float(RangeNoise.of(config.noise, camera).sigma(reach))


class Scheduler:
    """Chooses a level, 0 the most thorough, from the milliseconds that frames took.

    - A frame over the deadline moves it one level down, at once.
    - Enough frames in time, in a row, move it one level up; each level's patience says how many. If the better level is
      too slow within as many frames, it was tried too early: it moves down again, and the patience with that level
      doubles, up to `MAX_PATIENCE`. If the better level lasts, its patience is reset to `PATIENCE`.
    - On the last level, time over the deadline is a debt; a frame is skipped when the debt reaches one deadline, but
      never two in a row, and the debt is at most two deadlines.

    So it keeps a level that is in time, tries one that is too slow in one of 128 frames, and once the load is gone
    returns to the first level after at most 128 frames for each step.
    The first frame on each level does not count: it may compile kernels and allocate memory.
    """

    def __init__(self, levels: int, deadline_ms: float):
        self.level = 0
        self._last, self._deadline = levels - 1, deadline_ms
        self._patience = [PATIENCE] * levels
        self._in_time, self._trying = 0, False
        self._known: set[int] = set()
        self._debt, self._skipped = 0.0, False

    def skips(self) -> bool:
        """Return whether the next frame is to be skipped; ask once for each frame."""
        self._skipped = not self._skipped and self._debt >= self._deadline
        if self._skipped:
            self._debt -= self._deadline
        return self._skipped

    def record(self, milliseconds: float) -> None:
        """Record the time of a frame at the present level."""
        if self.level not in self._known:
            self._known.add(self.level)
            return
        if self.level == self._last:
            self._debt = min(max(self._debt + milliseconds - self._deadline, 0.0), 2 * self._deadline)
        if milliseconds > self._deadline:
            self._too_slow()
        else:
            self._was_in_time()

    def _too_slow(self) -> None:
        if self._trying:
            self._patience[self.level] = min(2 * self._patience[self.level], MAX_PATIENCE)
        self._change(min(self.level + 1, self._last), trying=False)

    def _was_in_time(self) -> None:
        self._in_time += 1
        if self._trying and self._in_time >= self._patience[self.level]:
            self._patience[self.level], self._trying = PATIENCE, False
        if self.level > 0 and self._in_time >= self._patience[self.level - 1]:
            self._change(self.level - 1, trying=True)

    def _change(self, level: int, trying: bool) -> None:
        if level != self.level:
            self._debt = 0.0
        self.level, self._trying, self._in_time = level, trying, 0
