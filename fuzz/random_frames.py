# SPDX-License-Identifier: Apache-2.0
"""Random images, pairs, clouds and scans of a few pixels or points: valid ones, odd ones, and nonsense."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

import stereovox as sv
from random_cameras import RandomCameras
from stereovox.cameras.rigs import VirtualCamera
from stereovox.frame import AnyFrame, Scan, StereoFrame
from stereovox.geometry.se3 import from_quaternion, inverse

STRANGE = (0.0, -0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e30, 1e-45, 3e38, 65535.0, 65536.0, 0.05, 2.0)
"""Numbers at or beyond the limits of a sensor."""
PLACES = (0, 0, 0, 1, 1, 20, 1e4, 4e5, 1e7)
"""Distances of a camera from the origin in metres."""
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 0, -1, 1e-12, 1e12, 1e308, 10**30, -(10**400), 2**62, "1", None, 1j, [1], True)
ODD_THINGS = (
    None, "x", b"\x00", 7, 2.5, [], [[1, 2], [3]], {}, object(), np.zeros(0), np.zeros((0, 4)), np.zeros((2, 2, 2, 2)),
    np.float32(1), np.array(None), np.array(["a", "b"]), np.ma.masked_array(np.ones((4, 4)), np.eye(4)), 1e400,
    np.zeros(3, [("x", float)]), np.datetime64("2020-01-01"), float, "a\nb\r\x00\udc80" * 9,
)  # fmt: skip
ODD_DTYPES = (
    ">f4", ">u2", "<f8", ">f8", "f2", "i1", "u1", "i2", "i4", "i8", "u8", "?", "c8", "c16", "O", "S3", "g", "M8[s]",
)  # fmt: skip
DTYPES, NO_DTYPES = ("f4", "f4", "f8", "u2", "u2"), ("f2", ">f4", ">u2", "i4", "u1")
"""Valid and invalid dtypes of depth; integers are millimetres."""
CLOUD_DTYPES = ("f4", "f4", "f8", "f2", "i4", ">f4")
LIDARS = (sv.Lidar(), sv.Lidar(), sv.Lidar(0.02, 0.0, 3.0), sv.Lidar(1e-9, 0.1), sv.Lidar(5.0, 0.0, 1e12))
ROOM_M = np.array([4.0, 3.0, 2.5])
"""Half size of the room shown in plausible images."""
CAMERAS = 6
"""Cameras in use. A mapper makes tables for each new camera, which takes longest; it keeps those of 16."""
LARGE = 0.003
"""Share of depth images of realistic size."""
SENSORS = ("", "", "", "left", "right", "lidar 1")
NAMES = ("", "a.png", "two\nlines", "\udc80", "x" * 300)
STAMP_STEPS = (33_000_000, 33_000_000, 0, -33_000_000, -(10**10), 10**18, 2**63, 0.5)
"""Nanoseconds from one frame to the next."""


class Maker:
    """Makes things in sequence; the same for the same seed. odd_cameras: see `RandomCameras`."""

    def __init__(self, seed: Any, odd_cameras: bool = True):
        self._rng = np.random.default_rng(seed)
        self._stamp: Any = 0
        self._shapes = RandomCameras(self._rng, odd_cameras)
        self._cameras = [self._shapes.camera() for _ in range(CAMERAS)]
        self._pairs = [self._shapes.pair(model) for model in (None, None, "spherical", "cylindrical")]

    def frame(self) -> AnyFrame:
        """Return a depth image, a stereo pair or a cloud."""
        chance = self._rng.random()
        made = self._stereo() if chance < 0.1 else self._cloud() if chance < 0.3 else self._depth()
        return self._spoilt(made) if self._chance(0.25) else self._same(made)

    def scan(self) -> Scan:
        """Return a turn of a lidar."""
        made = self._scan()
        return self._spoilt(made) if self._chance(0.25) else self._same(made)

    def nonsense(self) -> Any:
        """Return a non-frame."""
        return self._one_of(ODD_THINGS)

    def _one_of(self, choices: Any) -> Any:
        return choices[self._rng.integers(len(choices))]

    def _chance(self, share: float = 0.05) -> bool:
        return self._rng.random() < share

    def _depth(self) -> sv.Frame:
        rng, camera = self._rng, self._camera()
        plausible = self._chance(0.6)
        T = from_quaternion(rng.uniform(-1, 1, 3), rng.normal(size=4)) if plausible else self._pose()
        depth = room_depth(camera, T) if plausible else rng.uniform(0.05, 6)
        shape = int(camera.height), int(camera.width)
        depth = depth + rng.normal(size=shape) * self._one_of((0.0, 0.02, 0.02 if plausible else 1.0))
        strange = rng.random(depth.shape) < self._one_of((0.0, 0.0, 0.0, 0.1, 0.1 if plausible else 1.0))
        depth[strange] = rng.choice(STRANGE, strange.sum())
        dtype = np.dtype(self._one_of(NO_DTYPES if self._chance(0.02) else DTYPES))
        scale = 0.001 if dtype.kind in "iu" else 1.0
        with np.errstate(all="ignore"):
            depth = (depth / scale).astype(dtype)
        reason = rng.integers(0, 6, depth.shape, np.uint8) if self._chance(0.2) else None
        farthest = self._one_of((3.0, 0.0, 1e-3, 4, np.float32(2))) if self._chance() else np.inf
        scale = self._one_of((1, scale, np.float32(scale), np.float16(scale))) if self._chance() else scale
        return sv.Frame(depth, camera, T, depth_scale=scale, reason=reason, farthest=farthest, **self._shared())

    def _stereo(self) -> StereoFrame:
        pair = self._one_of(self._pairs)
        sizes = [
            (lens.height, lens.width)
            for lens in ((pair.eyes.left, pair.eyes.right) if pair.eyes else (pair.camera,) * 2)
        ]
        colour = (3,) * int(self._rng.integers(2))
        left, right = (self._rng.integers(0, 256, size + colour, np.uint8) for size in sizes)
        if self._chance(0.5) and left.shape == right.shape:
            right = np.roll(left, -int(self._rng.integers(1, 9)), axis=1)
        return StereoFrame(left, right, pair, self._pose(), **self._shared())

    def _cloud(self) -> sv.Cloud:
        """Return a cloud of the room, of random points, or of strange points only."""
        rng, count = self._rng, int(self._one_of((0, 1, 7, 40, 250, 1500)))
        T = from_quaternion(rng.uniform(-1, 1, 3), rng.normal(size=4)) if self._chance(0.6) else self._pose()
        points = rng.normal(size=(count, 3)) * self._one_of((1.0, 1.0, 1000.0, 1e-4))
        if self._chance(0.6):
            points = room_points(T, points) + rng.normal(size=(count, 3)) * self._one_of((0.0, 0.02, 0.3))
        strange = rng.random(count) < self._one_of((0.0, 0.0, 0.1, 0.997, 1.0))
        points[strange] = rng.choice(STRANGE, (int(strange.sum()), 3))
        with np.errstate(all="ignore"):
            points = points.astype(self._one_of(CLOUD_DTYPES))
        lidar = self._one_of(LIDARS)
        more = {}
        if self._chance(0.2):
            more["origins"] = rng.normal(size=(count, 3)) * self._one_of((0.1, 0.1, 1e4, np.nan))
        if self._chance(0.2):
            more["clear"] = rng.normal(size=(int(self._one_of((0, 5, 300))), 3)) * self._one_of((3, 3, 5000, np.inf))
        return sv.Cloud(points, T, lidar=lidar, **more, **self._shared())

    def _scan(self) -> Scan:
        rng = self._rng
        beams = int(self._one_of((0, 1, 7, 40, 360)))
        ranges = rng.uniform(0, 8, beams)
        strange = rng.random(beams) < self._one_of((0.0, 0.3, 1.0))
        ranges[strange] = rng.choice(STRANGE, strange.sum())
        limits = self._one_of(
            ((0.1, 5.6), (0.1, 5.6), (0.0, np.inf), (0.0, 1e-9), (3.0, 3.0), (np.nan, 5.0), (5, 1e30))
        )
        step = self._one_of((0.1, 0.1, -0.1, 1e-12, 1e6, 0.0, np.inf, 1e300))
        given = {
            name: rng.choice([*STRANGE, 2.0], beams).astype(np.float32)
            for name in ("clear", "clear_from")
            if self._chance(0.3)
        }
        first = self._one_of((-2.0, -2.0, 1e9, np.nan, -1e300))
        pose, mount = (self._pose(level=True) for _ in range(2))
        with np.errstate(all="ignore"):
            ranges = ranges.astype(np.float32)
        return Scan(ranges, first, step, *limits, pose, mount, **given, **self._shared())

    def _shared(self) -> dict[str, Any]:
        step = STAMP_STEPS[0] if not self._chance() else self._one_of(STAMP_STEPS)
        stamp = self._stamp + step
        self._stamp = stamp if isinstance(stamp, int) and 0 <= stamp < 2**62 else 0
        fault = self._one_of(("no_pose", "unreadable", "a new one\n")) if self._chance(0.02) else None
        off = self._one_of((10**7, 10**12, -1)) if self._chance() else 0
        if self._chance() and stamp < 2**63:
            stamp = np.int64(stamp)
        return {
            "stamp_ns": stamp,
            "name": self._one_of(NAMES),
            "fault": fault,
            "pose_off_ns": off,
            "sensor": self._one_of(SENSORS),
        }

    def _pose(self, level: bool = False) -> Any:
        rng = self._rng
        turn = rng.normal(size=4) * ([0, 0, 1, 1] if level else [1, 1, 1, 1])
        T = from_quaternion(rng.normal(size=3) * self._one_of(PLACES), turn)
        if self._chance():
            T[tuple(rng.integers(0, 4, 2))] = self._one_of(STRANGE)
        if self._chance():
            with np.errstate(all="ignore"):
                T[:3, :3] *= self._one_of((1 + 1e-4, 0.99, 2.0, 0.0, -1.0, 1e200))
        return T

    def _camera(self) -> VirtualCamera:
        """Return one of a few cameras, as a robot has; occasionally one is replaced."""
        if self._chance(LARGE):
            return self._shapes.large()
        number = int(self._rng.integers(CAMERAS))
        if self._chance():
            self._cameras[number] = self._shapes.camera()
        return self._cameras[number]

    def _same(self, made: Any) -> Any:
        """Return the frame, occasionally with equal arrays in another memory layout."""
        if not self._chance(0.2):
            return made
        arrays = [field.name for field in fields(made) if isinstance(getattr(made, field.name), np.ndarray)]
        name = self._one_of(arrays)
        return replace(made, **{name: self._laid_out(getattr(made, name))})

    def _laid_out(self, array: np.ndarray) -> np.ndarray:
        ways = (
            lambda: np.asfortranarray(array), lambda: np.repeat(array, 2, axis=-1)[..., ::2],
            lambda: self._read_only(array), lambda: array[..., ::-1].copy()[..., ::-1],
            lambda: np.asmatrix(array) if array.ndim == 2 else array, lambda: array.view(np.recarray),
        )  # fmt: skip
        return self._one_of(ways)()

    def _spoilt(self, made: Any) -> Any:
        """Return the frame with one field replaced by an invalid value."""
        name = self._one_of([field.name for field in fields(made)])
        old = getattr(made, name)
        new = self._one_of(ODD_THINGS)
        if isinstance(old, np.ndarray) and not self._chance(0.3):
            new = self._odd_array(old)
        elif isinstance(old, int | float) and not self._chance(0.3):
            new = self._one_of(ODD_NUMBERS)
        return replace(made, **{name: new})

    def _odd_array(self, array: np.ndarray) -> Any:
        """Return an array of another dtype, shape or layout; some are equivalent."""
        ways = (
            lambda: self._of_dtype(array), lambda: self._of_dtype(array), lambda: array[:-1], lambda: array[..., None],
            lambda: array[..., ::-1], lambda: self._laid_out(array), lambda: array.tolist(), lambda: array.T,
            lambda: np.ma.masked_invalid(array.astype(float)), lambda: np.broadcast_to(np.float32(2), array.shape),
            lambda: array.ravel(), lambda: array[:0], lambda: np.zeros((1, *array.shape), array.dtype),
            lambda: array[:3],
        )  # fmt: skip
        return self._one_of(ways)()

    def _of_dtype(self, array: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.nan_to_num(array, posinf=9, neginf=-9).clip(-9, 9).astype(self._one_of(ODD_DTYPES))

    def _read_only(self, array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flags.writeable = False
        return array


def room_points(T_world_sensor: Any, rays: np.ndarray) -> np.ndarray:
    """Return the hits of rays (N, 3) of a sensor on the walls of the room around the origin, in the sensor's frame."""
    with np.errstate(all="ignore"):
        directions = rays @ np.asarray(T_world_sensor)[:3, :3].T
        walls = (np.sign(directions) * ROOM_M - np.asarray(T_world_sensor)[:3, 3]) / directions
        return rays * np.min(np.where(directions == 0, np.inf, walls), axis=1)[:, None]


def room_depth(camera: VirtualCamera, T_world_camera: np.ndarray) -> np.ndarray:
    """Return the depth (height, width) in metres of the walls of a room around the origin, seen by a camera in it."""
    columns, rows = camera.rays()
    shape = len(rows), len(columns)
    across, down, ahead = np.broadcast_to(columns, shape), *(np.broadcast_to(row[:, None], shape) for row in rows.T)
    directions = np.stack([across, down, ahead], axis=-1) @ inverse(T_world_camera)[:3, :3]
    with np.errstate(all="ignore"):
        walls = (np.sign(directions) * ROOM_M - T_world_camera[:3, 3]) / directions
    return np.nanmin(np.where(directions == 0, np.inf, walls), axis=-1)
