# SPDX-License-Identifier: Apache-2.0
"""The frames' own poses, corrected by tracking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereovox.config import Config
from stereovox.frame import AnyFrame
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error
from stereovox.track.fit import RIGID
from stereovox.track.tracker import Tracked, Tracker

NO_START = "no frame so far has a pose of its own, at which the map could begin"


class GuidedTracker:
    """A tracker that predicts motion from the frames' own poses and corrects it by registration to known surfaces.

    Its world starts as the world of the frames' own poses and departs from it as they drift. A frame without a pose
    is tracked by its image alone.

    Args:
        config: Settings by which depth is prepared, as for the map.

    Attributes:
        prior_only_frames: Frames placed by their own motion alone, because nothing known was in view.
    """

    def __init__(self, config: Config):
        self.prior_only_frames = 0
        self._config, self._tracker = config, Tracker(config)
        self._T_world_tracker: Transform | None = None
        self._own: Transform | None = None  # own pose of the last frame the tracker used
        self._at = np.full((4, 4), np.nan)

    def add(self, frame: AnyFrame) -> Tracked:
        """Return the pose of a frame, as `Tracker.add`.

        Args:
            frame: Depth image or stereo pair, with its own pose; a pose that is not rigid counts as missing.
        """
        own = _own_pose(frame)
        if own is None and self._T_world_tracker is None:
            return Tracked(self._at, np.full((6, 6), np.inf), NO_START)
        known = None if own is None or self._own is None else inverse(self._own) @ own
        tracked = self._tracker.add(frame, known)
        if not np.array_equal(tracked.T_world_sensor, self._at):  # else its image was unusable
            self._at, self._own = tracked.T_world_sensor, own
            if own is None and self._T_world_tracker is not None and not tracked.lost:
                self._own = self._T_world_tracker @ tracked.T_world_sensor
        self.prior_only_frames += tracked.believed
        if tracked.begins:
            self._begin(own)
        if self._T_world_tracker is None:
            return replace(tracked, lost=NO_START)
        return tracked.moved(self._T_world_tracker)

    def expect(self, frame: AnyFrame) -> None:
        """Start to prepare the next frame, as `Tracker.expect`."""
        self._tracker.expect(frame)

    def picture_use(self) -> str:
        """Return how the color images were used so far, in words; "" if there are none."""
        return self._tracker.picture_use()

    def _begin(self, own: Transform | None) -> None:
        """Place the tracker's world by the own pose of the image that its map began with."""
        self._own = own
        self._T_world_tracker = None if own is None else own @ inverse(self._at)
        if own is None:
            self._tracker, self._at = Tracker(self._config), np.full((4, 4), np.nan)


def _own_pose(frame: AnyFrame) -> Transform | None:
    T = frame.T_world_sensor
    return orthonormalise(np.asarray(T, float)) if T is not None and rigidity_error(T) < RIGID else None
