# SPDX-License-Identifier: Apache-2.0
"""A tiny recording: a camera that goes sideways along a wall."""

import numpy as np

from stereovox import Frame, PinholeCamera
from stereovox.frame import Reason
from stereovox.geometry.se3 import look_at
from stereovox.sources.base import Source

CAMERA = PinholeCamera(32, 24, 24.0, 24.0, 15.5, 11.5, 0.05)
FRAMES = 12


class Along(Source):
    """Frame 5 has no pose; a post moves from frame to frame, and a corner of the image tells each reason."""

    name, camera = "along", CAMERA

    def __len__(self):
        return FRAMES

    def frame(self, i):
        """Return frame `i`."""
        depth = np.full((24, 32), 1.55, np.float32)
        depth[10:, 2 * i : 2 * i + 2] = 1.25
        reason = np.zeros((24, 32), np.uint8)
        for n, why in enumerate((Reason.UNMATCHED, Reason.TOO_NEAR, Reason.TOO_FAR, Reason.MASKED)):
            depth[:4, 4 * n : 4 * n + 4], reason[:4, 4 * n : 4 * n + 4] = np.nan, why
        depth[:4, 8:12] = 5.0
        pose = look_at((0.2 * i, 0, 1), (0.2 * i, 2, 1), (0, 0, 1))
        fault = "no_pose" if i == 5 else None
        return Frame(depth, CAMERA, pose, i * 10**8, reason=reason, name=f"folder/frame {i}", fault=fault)
