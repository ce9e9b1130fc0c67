# SPDX-License-Identifier: Apache-2.0
"""Small rectified stereo pairs of a furnished corner with a pattern on all surfaces, taken from exact poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.cameras.wide import Lens
from stereovox.frame import StereoFrame
from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.d435 import photograph
from stereovox.simulate.scene import Point, Scene, box

BASELINE = 0.12
LENS = Lens.from_field_of_view("pinhole", 256, 144, 80.0)
CAMERA = PinholeCamera(LENS.width, LENS.height, LENS.fx, LENS.fy, LENS.cx, LENS.cy, baseline=BASELINE)
PAIR = StereoPair(CAMERA)
STEP_NS = 100_000_000
NOISE = 1.5


def corner(x: float = 0.0) -> Scene:
    """Return two boxes in the corner of a room; elsewhere (x) it is of the same shape, but has another pattern."""

    def at(name: str, low: Point, high: Point):
        return box(name, name, (low[0] + x, *low[1:]), (high[0] + x, *high[1:]))

    return Scene(
        [
            at("wall", (3, -6, -1), (3.2, 6, 4)),
            at("floor", (-2, -6, -1.2), (3, 6, -1)),
            at("box", (1.6, -0.8, -1), (2.2, 0, 0.4)),
            at("post", (2.2, 0.6, -1), (3, 1.2, 1.4)),
            at("left", (-2, 3, -1), (3, 3.2, 4)),
            at("right", (-2, -3.2, -1), (3, -3, 4)),
        ]
    )


def way(steps: int, x: float = 0.0) -> list[Transform]:
    """Return poses of a camera that moves evenly: 6 cm and nearly a degree from one to the next."""
    places = [np.array([0.03 * k + x - 0.5, 0.05 * k - 0.8, 0.01 * k]) for k in range(steps)]
    return [look_at(p, np.add(p, (np.cos(0.015 * k), np.sin(0.015 * k), -0.1))) for k, p in enumerate(places)]


def photographs(scene: Scene, poses: Sequence[Transform], pair: StereoPair = PAIR, seed: int = 0) -> list[StereoFrame]:
    """Return what a pair sees from poses of its left eye."""
    frames = []
    for i, T in enumerate(poses):
        right = T.copy()
        right[:3, 3] += BASELINE * T[:3, 0]
        images = (photograph(scene, LENS, eye, NOISE, [seed, i, n]) for n, eye in enumerate((T, right)))
        frames.append(StereoFrame(*images, pair, T, i * STEP_NS, name=f"pair {i}"))
    return frames


def with_sticker(frame: StereoFrame, rows: int, disparity: int) -> StereoFrame:
    """Return a frame whose lowest rows show something with much pattern that moves with the camera."""
    pattern = np.random.default_rng(5).integers(0, 255, (rows // 4 + 1, LENS.width // 4 + 40)).astype(np.uint8)
    pattern = pattern.repeat(4, axis=0).repeat(4, axis=1)[:rows]
    left, right = frame.left.copy(), frame.right.copy()
    left[-rows:] = pattern[:, : LENS.width]
    right[-rows:] = pattern[:, disparity : disparity + LENS.width]
    return StereoFrame(left, right, frame.pair, frame.T_world_sensor, frame.stamp_ns, frame.name)
