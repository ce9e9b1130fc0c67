# SPDX-License-Identifier: Apache-2.0
"""The deadline of a frame: which quality level fits into the time that there is.

Ways from a frame to evidence, from the thorough one to the quick one.
`near` says of what is near what `full` says, and of the rest nothing. `coarse` says it of larger pixels.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from math import sqrt
from typing import Protocol

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth import DepthPath
from stereovox.depth.prepare import downsample, shortened
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import AnyFrame, DepthImage, Frame
from stereovox.integrate import make_integrator
from stereovox.integrate.views import MAX_CAMERAS
from stereovox.sensors.model import REACH_SIGMA
from stereovox.sensors.noise import RangeNoise
from stereovox.trust.health import FULL

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


PATIENCE, LONGEST = 8, 128
"""Frames in time before the next more thorough way is tried, at first and at most; a frame in 128 is less than 1 %."""


class Ladder:
    """Chooses one of some ways, 0 the most thorough, by the milliseconds that frames took on them.

    - A frame that takes longer than the deadline: one step down, at once.
    - So many frames in time, one after the other, as the patience with the next more thorough way: one step up. If that
      way is too slow before as many frames have passed on it, it was tried too early: down again, and the patience with
      it doubles, up to `LONGEST`. If it lasts, the patience with it is `PATIENCE` again.
    - On the last way, time beyond the deadline is owed, and a frame is left out when that of a whole frame is; never
      two in a row, and no more is owed than two frames.

    So a way that is in time is kept; one that is too slow is tried in one of 128 frames; and when the load is gone the
    first way is reached again, after 128 frames for each step at the latest.
    The first frame on each way does not count: it may compile kernels, and takes memory.
    """

    def __init__(self, ways: int, deadline_ms: float):
        self.step = 0
        self._last, self._deadline = ways - 1, deadline_ms
        self._patience = [PATIENCE] * ways
        self._in_time, self._trying = 0, False
        self._known: set[int] = set()
        self._owed, self._left_out = 0.0, False

    def leaves_out(self) -> bool:
        """Tell whether the next frame is to be left out; asked once for each frame."""
        self._left_out = not self._left_out and self._owed >= self._deadline
        if self._left_out:
            self._owed -= self._deadline
        return self._left_out

    def took(self, milliseconds: float) -> None:
        """Learn from a frame that was taken on the present way."""
        if self.step not in self._known:
            self._known.add(self.step)
            return
        if self.step == self._last:
            self._owed = min(max(self._owed + milliseconds - self._deadline, 0.0), 2 * self._deadline)
        if milliseconds > self._deadline:
            self._too_slow()
        else:
            self._was_in_time()

    def _too_slow(self) -> None:
        if self._trying:
            self._patience[self.step] = min(2 * self._patience[self.step], LONGEST)
        self._to(min(self.step + 1, self._last), trying=False)

    def _was_in_time(self) -> None:
        self._in_time += 1
        if self._trying and self._in_time >= self._patience[self.step]:
            self._patience[self.step], self._trying = PATIENCE, False
        if self.step > 0 and self._in_time >= self._patience[self.step - 1]:
            self._to(self.step - 1, trying=True)

    def _to(self, step: int, trying: bool) -> None:
        if step != self.step:
            self._owed = 0.0
        self.step, self._trying, self._in_time = step, trying, 0


class Pace:
    """Chooses the way of each frame so that frames take no longer than `deadline_ms`; without one it is always `full`.

    Raises ConfigError where `pace` leaves nothing to be seen.
    """

    def __init__(self, config: Config):
        self._ways = [full(config)] if config.deadline_ms is None else ladder(config)
        self._ladder = Ladder(len(self._ways), config.deadline_ms) if config.deadline_ms else None
        self._rehearsed: set[VirtualCamera] = set()

    def way(self) -> Way:
        """Return the way of the next frame. Raises FrameRefused `no_time` where it is to be left out."""
        if self._ladder is None:
            return self._ways[0]
        if self._ladder.leaves_out():
            raise FrameRefused("no_time", "left out: frames take longer than deadline_ms even on the quickest way")
        return self._ways[self._ladder.step]

    def rehearse(self, frame: AnyFrame, camera: VirtualCamera) -> None:
        """Let all other ways see the first frame of a camera: kernels are compiled then, and not when time is short."""
        if self._ladder is None or camera in self._rehearsed or len(self._rehearsed) >= MAX_CAMERAS:
            return  # whose camera is another one in each frame would rehearse for ever
        self._rehearsed.add(camera)
        for way in self._ways[1:]:
            with suppress(FrameRefused):
                way.integrator.evidence(way.depth.image(way.depth.matched(frame)))

    def took(self, milliseconds: float) -> None:
        """Learn from the time that a frame took on the way that `way` returned."""
        if self._ladder is not None:
            self._ladder.took(milliseconds)
