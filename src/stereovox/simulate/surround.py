# SPDX-License-Identifier: Apache-2.0
"""`sim:surround`: a drone with four stereo cameras in the furnished room, with rendered photographs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.cameras.wide import Lens, SphericalCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame, Reason, StereoFrame
from stereovox.geometry.se3 import Transform, look_at, rotation_matrix
from stereovox.simulate.d435 import photograph
from stereovox.simulate.scene import Scene
from stereovox.simulate.scenes import room
from stereovox.simulate.stage import Stage, one_of, within
from stereovox.sources import parameters
from stereovox.sources.base import Source

BASELINE = 0.15
TOE_IN_DEG, ROLL_DEG = 0.4, -0.3
"""Rotation of the right eye of each pair relative to the left: real mounts are never perfectly aligned."""
FISHEYE_DEG = (150.0, 140.0)
"""Width and height of the fisheyes' virtual images, limited by the steep rows in their corners; beyond 75 degrees aside
a pair sees along its own baseline, and its ranges are four times as noisy as in the middle (Valenti 2018, Eq 4.7)."""
BACKWARD_DEG = 20.0
"""Backward rotation of the side cameras, so that their views overlap behind the vehicle."""
_FISHEYE = ("fisheye", 175.0, 640, 360, (-0.01, 0.002, 0.0, 0.0))
HZ = 10.0
ALL = "all"


class Surround(Source):
    """Stereo frames of a simulated drone: front, left, right, down at the same moment, then the next moment.

    location: `sim:surround` or with parameters `sim:surround?pair=front&scale=0.5`, see `Options`. The images are
    raw, with the lenses' distortion. World: z up, metres; the drone's body is level, x forward, y left, z up. Frames
    can be read in any order and are always the same for the same `seed`. Raises SourceError for an unknown parameter
    and for values out of range.
    """

    layout = "four stereo cameras round a drone (sim:surround)"

    def __init__(self, location: str | Path = "sim:surround"):
        self.name = str(location)
        try:
            _, written = parameters.split(self.name)
            self.options = Options(**parameters.typed(written, parameters.defaults(Options)))
        except SourceError as error:
            raise SourceError(f"{location}: {error}") from None
        names = tuple(MOUNTS) if self.options.pair == ALL else (self.options.pair,)
        self.pairs: tuple[StereoPair, ...] = tuple(surround_pair(name, self.options.scale) for name in names)
        self.camera = self.pairs[0].camera.middle

    @classmethod
    def recognises(cls, location: str | Path) -> bool:
        """Return whether `location` names this simulation."""
        return str(location).partition("?")[0] == "sim:surround"

    @cached_property
    def scene(self) -> Scene:
        """The drone's surroundings, in the frame of the world."""
        return self._stage.scene

    def __len__(self) -> int:
        return self.options.moments * len(self.pairs)

    def frame(self, i: int) -> StereoFrame:
        """Return stereo frame `i` (negative: from the end); raises IndexError for a frame that does not exist."""
        pair, T_world_left, stamp_ns, name = self._at(i)
        assert pair.eyes is not None
        seed = [self.options.seed, range(len(self))[i]]
        left = photograph(self.scene, pair.eyes.left, T_world_left, self.options.noise, [*seed, 0])
        T_world_right = T_world_left @ pair.eyes.T_left_right
        right = photograph(self.scene, pair.eyes.right, T_world_right, self.options.noise, [*seed, 1])
        return StereoFrame(left, right, pair, T_world_left, stamp_ns, name, sensor=pair.name)

    def exact(self, i: int) -> Frame:
        """Return the true depth of frame `i` in its pair's rectified left eye.

        Pixels outside the view of either lens are MASKED. Empty pixels are TOO_FAR.
        """
        pair, T_world_left, stamp_ns, name = self._at(i)
        depth = self._cast(pair, T_world_left)
        reason = np.where(np.isfinite(depth), Reason.VALID, Reason.TOO_FAR).astype(np.uint8)
        reason[~visible_to_both(pair)] = Reason.MASKED
        depth = np.where(reason == Reason.VALID, depth, np.float32(0))
        return Frame(depth, pair.camera, T_world_left, stamp_ns, reason=reason, name=name, sensor=pair.name)

    def body_pose(self, i: int) -> Transform:
        """Return T_world_body (4, 4) of frame `i`: level, x forward, y left, z up."""
        moment = range(len(self))[i] // len(self.pairs)
        T_world_camera = self._stage.path(moment / max(self.options.moments - 1, 1))
        forward = T_world_camera[:3, 2] * (1, 1, 0)
        forward /= np.linalg.norm(forward)
        T_world_body = np.eye(4)
        T_world_body[:3, :3] = np.column_stack([forward, np.cross([0, 0, 1], forward), [0, 0, 1]])
        T_world_body[:3, 3] = T_world_camera[:3, 3]
        return T_world_body

    @cached_property
    def _stage(self) -> Stage:
        return room.stage()

    def _at(self, i: int) -> tuple[StereoPair, Transform, int, str]:
        i = range(len(self))[i]
        pair, moment = self.pairs[i % len(self.pairs)], i // len(self.pairs)
        name = f"{self.name} moment {moment} {pair.name}"
        return pair, self.body_pose(i) @ pair.T_body_camera, round(moment * 1e9 / HZ), name

    def _cast(self, pair: StereoPair, T_world_left: Transform) -> NDArray[np.float32]:
        directions = _rays(pair) @ T_world_left[:3, :3].T.astype(np.float32)
        return self.scene.cast(T_world_left[:3, 3], directions).reshape(pair.camera.height, pair.camera.width)


@dataclass(frozen=True)
class Options:
    """Parameters of `sim:surround`.

    pair: `all`, or one of `front`, `left`, `right`, `down`. moments: number of images of each pair on the path
    through room and corridor, ten times a second. scale: size of the images, 1: half of Valenti 2018, Table 3.1; 2: as
    there. noise: of the images, grey levels. seed: of the noise.
    """

    pair: str = ALL
    moments: int = 80
    scale: float = 1.0
    noise: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        one_of("pair", self.pair, (ALL, *MOUNTS))
        within("moments", self.moments, 1, 1_000_000)
        within("scale", self.scale, 0.05, 2)
        within("noise", self.noise, 0, 100)
        within("seed", self.seed, 0, 2**63)


@dataclass(frozen=True)
class Mount:
    """A camera of Table 3.1, at half its resolution.

    hfov_deg, width, height: of the image. distortion: of both lenses. forward, down: unit vectors in the body's frame
    (x forward, y left, z up): optical axis, and the image's down direction. centre: between both eyes, metres.
    """

    model: str
    hfov_deg: float
    width: int
    height: int
    distortion: tuple[float, ...]
    forward: tuple[float, float, float]
    down: tuple[float, float, float]
    centre: tuple[float, float, float]


def _aside(sign: float) -> tuple[float, float, float]:
    azimuth = sign * math.radians(90 + BACKWARD_DEG)
    return math.cos(azimuth), math.sin(azimuth), 0.0


MOUNTS = {
    "front": Mount("pinhole", 91.0, 960, 540, (-0.03, 0.006), (1, 0, 0), (0, 0, -1), (0.12, 0, 0)),
    "left": Mount(*_FISHEYE, _aside(1), (0, 0, -1), (0, 0.12, 0)),
    "right": Mount(*_FISHEYE, _aside(-1), (0, 0, -1), (0, -0.12, 0)),
    "down": Mount("pinhole", 105.0, 640, 360, (-0.03, 0.006), (0, 0, -1), (-1, 0, 0), (0, 0, -0.08)),
}
"""The four pairs by name, in order of delivery."""


def surround_pair(name: str, scale: float = 1.0) -> StereoPair:
    """Return the stereo pair of this name; its images are `scale` times half the width in Table 3.1."""
    mount = MOUNTS[name]
    width, height = max(16, round(mount.width * scale)), max(9, round(mount.height * scale))
    lens = Lens.from_field_of_view(mount.model, width, height, mount.hfov_deg)
    bent = Lens(lens.model, width, height, lens.fx, lens.fy, lens.cx, lens.cy, mount.distortion)
    eyes = Eyes(bent, bent, _right_eye())
    return StereoPair(_virtual(mount, width, height), eyes, _mounted(mount), name=name)


@lru_cache(maxsize=8)
def visible_to_both(pair: StereoPair) -> NDArray[np.bool_]:
    """Return the pixels (height, width) of the rectified left image that both lenses see, for distant objects."""
    assert pair.eyes is not None
    R_left, R_right = pair.eyes.rectifying_rotations()
    rays = _rays(pair).astype(float)
    seen = np.ones(len(rays), bool)
    for lens, R in ((pair.eyes.left, R_left), (pair.eyes.right, R_right)):
        u, v = lens.project(rays @ R.T).T
        seen &= (u >= 0) & (u <= lens.width - 1) & (v >= 0) & (v <= lens.height - 1)
    return seen.reshape(pair.camera.height, pair.camera.width)


def _virtual(mount: Mount, width: int, height: int) -> PinholeCamera | SphericalCamera:
    if mount.model == "pinhole":
        return PinholeCamera.from_field_of_view(width, height, mount.hfov_deg, BASELINE)
    columns, rows = (round(width * angle / mount.hfov_deg) for angle in FISHEYE_DEG)
    return SphericalCamera.from_field_of_view(columns, rows, *FISHEYE_DEG, BASELINE)


def _right_eye() -> Transform:
    """Return T_left_right. Toe-in and roll leave the rectified left frame equal to the left eye's."""
    T_left_right = np.eye(4)
    turn, roll = rotation_matrix([0, math.radians(TOE_IN_DEG), 0]), rotation_matrix([0, 0, math.radians(ROLL_DEG)])
    T_left_right[:3, :3], T_left_right[0, 3] = turn @ roll, BASELINE
    return T_left_right


def _mounted(mount: Mount) -> Transform:
    """Return T_body_camera of the rectified left eye."""
    T_body_camera: NDArray[np.float64] = look_at(np.zeros(3), mount.forward, -np.array(mount.down))
    T_body_camera[:3, 3] = np.array(mount.centre) - BASELINE / 2 * T_body_camera[:3, 0]
    return T_body_camera


def _rays(pair: StereoPair) -> NDArray[np.float32]:
    """Return the rays (height * width, 3) of the rectified camera, of depth 1."""
    columns, rows = pair.camera.rays()
    grid = np.stack(np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:]), axis=-1)
    return np.ascontiguousarray(grid.reshape(-1, 3))
