# SPDX-License-Identifier: Apache-2.0
"""Small recordings with exact poses, and what a tracker makes of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.frame import AnyFrame, Frame, Photo
from stereovox.geometry.se3 import Transform, inverse, look_at, rotation_vector
from stereovox.simulate.d435 import D435, depth_camera, photograph
from stereovox.simulate.scene import Point, Scene, box
from stereovox.simulate.simulation import Simulation
from stereovox.track.tracker import Tracked, Tracker

WIDTH = 160
SUBPIXEL = 0.08 * WIDTH / 848
"""Of a small picture of the full camera, which errs by as many radians."""
CAMERA = replace(depth_camera(WIDTH), baseline=0.05)
STEP_NS = 33_000_000
LENS = Lens.from_field_of_view("pinhole", 320, 200, 80.0)
PHOTO_CAMERA = PinholeCamera(LENS.width, LENS.height, LENS.fx, LENS.fy, LENS.cx, LENS.cy)
"""Of grey images that are taken along, finer than the depth images."""
T_DEPTH_PHOTO = np.array([[1, 0, 0, 0.025], [0, 1, 0, 0.002], [0, 0, 1, -0.003], [0, 0, 0, 1.0]])


def tracker(start: Transform | None = None) -> Tracker:
    """Return a tracker that is told how the small camera errs."""
    return Tracker(start=start, **{"noise.subpixel": SUBPIXEL})


def simulated(scene: str, seed: int = 0) -> Simulation:
    """Return a simulation with small images."""
    mark = "&" if "?" in scene else "?"
    return Simulation(f"sim:{scene}{mark}image_width={WIDTH}&subpixel={SUBPIXEL}&seed={seed}")


def seen(scene: Scene, poses: Sequence[Transform], seed: int = 0, moving: Callable[[int], Scene | None] | None = None):
    """Return frames of a depth camera in a scene; `moving`: what else stands there in frame i."""
    frames = []
    for i, T in enumerate(poses):
        depth = _cast(scene, T)
        other = moving(i) if moving else None
        if other is not None:
            depth = np.minimum(depth, _cast(other, T))
        millimetres, reason = D435(CAMERA, SUBPIXEL).measure(depth, [seed, i])
        frames.append(Frame(millimetres, CAMERA, T, i * STEP_NS, 0.001, reason, f"frame {i}"))
    return frames


def _cast(scene: Scene, T: Transform):
    x, y = CAMERA.ray_slopes()
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
    return scene.cast(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32)).reshape(CAMERA.height, CAMERA.width)


def pictured(frames: Sequence[Frame], scene: Scene, seed: int = 0, contrast: float = 0.5, moving=None) -> list[Frame]:
    """Return frames with a grey image each, of a camera next to the depth camera; `moving` as that of `seen`."""
    out = []
    for i, frame in enumerate(frames):
        other = moving(i) if moving else None
        there = scene if other is None else Scene([*scene.solids, *other.solids])
        T = frame.T_world_sensor @ T_DEPTH_PHOTO
        pixels = photograph(there, LENS, T, 1.5, [seed, i], contrast)
        out.append(replace(frame, photo=Photo(pixels, PHOTO_CAMERA, T_DEPTH_PHOTO)))
    return out


def covered(frame: Frame) -> Frame:
    """Return what the camera delivers behind a finger."""
    return replace(frame, depth=np.zeros_like(frame.depth), reason=None)


def aside(steps: int, step: Point = (0, 0.05, 0), eye: Point = (0, 0, 1.2), to: Point = (2, 0, -0.3)):
    """Return poses of a camera that moves evenly and looks into one direction."""
    places = [np.add(eye, np.multiply(k, step)) for k in range(steps)]
    return [look_at(place, place + to) for place in places]


def bay(y: float, name: str, deep: float = 0.0):
    """Return a shelf, a box and a pillar before the wall x = 2.5, from y on over 3 m."""
    return [
        box("shelf", f"{name}: shelf", (2.1, y + 0.3, 0.9), (2.5, y + 1.2, 1.3)),
        box("box", f"{name}: box", (1.7 - deep, y + 1.6, 0), (2.2, y + 2.2, 0.8)),
        box("pillar", f"{name}: pillar", (2.2, y + 2.4 - deep, 0), (2.5, y + 2.6, 3)),
    ]


def hall(bays: Iterable[tuple[float, float]]) -> Scene:
    """Return a wall and a floor with bays at given y and of given depth."""
    return Scene(
        [
            box("wall", "wall", (2.5, -40, 0), (2.7, 40, 3)),
            box("floor", "floor", (-1, -40, -0.2), (2.7, 40, 0)),
            *(solid for n, (y, deep) in enumerate(bays) for solid in bay(y, f"bay {n}", deep)),
        ]
    )


@dataclass(frozen=True)
class Track:
    """What a tracker made of frames whose poses are known."""

    found: list[Tracked]
    truth: list[Transform]

    @property
    def lost(self) -> list[int]:
        """Which frames are lost."""
        return [i for i, one in enumerate(self.found) if one.lost]

    @property
    def tracked(self) -> list[int]:
        """Which frames have a pose."""
        return [i for i, one in enumerate(self.found) if not one.lost]

    def errors(self) -> np.ndarray:
        """Return (N, 2) how far off the poses are from the image with which the map begins, in metres and degrees."""
        begun = [i for i in self.lost if self.found[i].begins][-1]
        T = self.found[begun].T_world_sensor @ inverse(self.truth[begun])
        return np.array([_size(inverse(T @ self.truth[i]) @ self.found[i].T_world_sensor) for i in self.tracked])

    def nees(self) -> np.ndarray:
        """Return squared errors of motions between successive poses by their covariance, over the 6 degrees of freedom.

        The covariance of a motion is taken for the sum of both poses'.
        """
        out = []
        for i in self.tracked:
            if i - 1 in self.tracked:
                one, two = self.found[i - 1], self.found[i]
                true = inverse(self.truth[i - 1]) @ self.truth[i]
                off = inverse(true) @ inverse(one.T_world_sensor) @ two.T_world_sensor
                R = two.T_world_sensor[:3, :3]
                error = np.append(R @ rotation_vector(off[:3, :3]), R @ off[:3, 3])
                out.append(error @ np.linalg.solve(one.covariance + two.covariance, error) / 6)
        return np.array(out)


def _size(T: Transform) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(np.linalg.norm(rotation_vector(T[:3, :3]))))


def track(frames: Sequence[AnyFrame], by: Tracker | None = None) -> Track:
    """Return what a tracker makes of frames; it starts at the pose of the first."""
    by = by or tracker(frames[0].T_world_sensor)
    return Track([by.add(frame) for frame in frames], [frame.T_world_sensor for frame in frames])
