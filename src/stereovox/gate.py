# SPDX-License-Identifier: Apache-2.0
"""The last check before a frame may change the map: does it fit to the frames before it?"""

from __future__ import annotations

from collections.abc import Callable

from stereovox.config import Config
from stereovox.frame import AnyFrame, DepthImage


class Gate:
    """Watches stamps and poses of each sensor. clock: nanoseconds now, for the age of what came last."""

    def __init__(self, config: Config, clock: Callable[[], int]):
        self._config, self._clock = config.trust, clock

    def check(self, frame: AnyFrame, image: DepthImage) -> None:
        """Raise FrameRefused where the frame does not fit; remembers nothing of it."""

    def took(self, frame: AnyFrame, image: DepthImage) -> None:
        """Remember a frame that the map took in."""
