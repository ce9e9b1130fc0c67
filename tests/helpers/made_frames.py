# SPDX-License-Identifier: Apache-2.0
"""A few frames for benchmarks: a wall with a box before it, a hole, and a strip beyond any range."""

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Frame
from stereovox_lab.bench.frames import Recording

CAMERA = PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5, 0.05)


def a_frame(i=0, wall=2.0):
    """The camera looks along world x."""
    depth = np.full((48, 64), 1000 * wall, np.uint16)
    depth[20:40, 20:40] = 1500
    depth[:5, :5] = 0
    depth[:, -4:] = 9000
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = 0.01 * i, 0.02, 1.0
    return Frame(depth, CAMERA, T, stamp_ns=i, depth_scale=0.001, name=f"frame {i}")


def a_recording(frames=3):
    return Recording("wall", [a_frame(i) for i in range(frames)], [])
