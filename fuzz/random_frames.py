# SPDX-License-Identifier: Apache-2.0
"""Random frames, scans and stereo pairs of a few pixels: sound ones, odd ones, and ones that are nonsense."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.cameras import DepthCorrection
from stereovox.frame import AnyFrame, Scan, StereoFrame
from stereovox.geometry import from_quaternion
from stereovox.lenses import Lens
from stereovox.rigs import Eyes, StereoPair
from stereovox.wide import CylindricalCamera, SphericalCamera

STRANGE = (0.0, -0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e30, 1e-45, 3e38, 65535.0, 65536.0, 0.05, 2.0)
"""Numbers that are not what a sensor says, or just are."""
PLACES = (0, 0, 0, 1, 1, 20, 1e4, 4e5, 1e7)
"""Metres that a camera is away from the origin."""
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 0, -1, 1e-12, 1e12, 1e308, 10**30, -(10**400), 2**62, "1", None, 1j, [1], True)
ODD_THINGS = (
    None, "x", b"\x00", 7, 2.5, [], [[1, 2], [3]], {}, object(), np.zeros(0), np.zeros((0, 4)), np.zeros((2, 2, 2, 2)),
    np.float32(1), np.array(None), np.array(["a", "b"]), np.ma.masked_array(np.ones((4, 4)), np.eye(4)), 1e400,
    np.zeros(3, [("x", float)]), np.datetime64("2020-01-01"), float, "a\nb\r\x00\udc80" * 9,
)  # fmt: skip
ODD_DTYPES = (
    ">f4", ">u2", "<f8", ">f8", "f2", "i1", "u1", "i2", "i4", "i8", "u8", "?", "c8", "c16", "O", "S3", "g", "M8[s]",
)  # fmt: skip
CAMERAS = 40
NAMES = ("", "a.png", "two\nlines", "\udc80", "x" * 300)
STAMP_STEPS = (33_000_000, 33_000_000, 0, -33_000_000, -(10**10), 10**18, 2**63, 0.5)
"""Nanoseconds from one frame to the next."""


class Maker:
    """Makes one thing after another; the same ones for the same seed."""

    def __init__(self, seed: int):
        self._rng = np.random.default_rng(seed)
        self._stamp: Any = 0
        self._cameras = [self._any_camera() for _ in range(CAMERAS)]
        self._pairs = [self._pair(eyes) for eyes in (False, False, True)]

    def frame(self) -> AnyFrame:
        """Return a depth image or a stereo pair."""
        made = self._stereo() if self._rng.random() < 0.15 else self._depth()
        return self._spoilt(made) if self._rng.random() < 0.35 else made

    def scan(self) -> Scan:
        """Return a turn of a lidar."""
        made = self._scan()
        return self._spoilt(made) if self._rng.random() < 0.35 else made

    def nonsense(self) -> Any:
        """Return what is no frame at all."""
        return self._one_of(ODD_THINGS)

    def _one_of(self, choices: Any) -> Any:
        return choices[self._rng.integers(len(choices))]

    def _rarely(self, share: float = 0.05) -> bool:
        return self._rng.random() < share

    def _depth(self) -> sv.Frame:
        rng, camera = self._rng, self._camera()
        depth = rng.uniform(0.05, 6) + rng.normal(size=(camera.height, camera.width)) * self._one_of((0.0, 0.02, 1.0))
        strange = rng.random(depth.shape) < self._one_of((0.0, 0.0, 0.1, 0.5, 1.0))
        depth[strange] = rng.choice(STRANGE, strange.sum())
        dtype = np.dtype(self._one_of(("f4", "f4", "f8", "u2")))
        scale = 0.001 if dtype.kind == "u" else 1.0
        with np.errstate(all="ignore"):
            depth = (depth / scale).astype(dtype)
        reason = rng.integers(0, 6, depth.shape, np.uint8) if self._rarely(0.2) else None
        return sv.Frame(depth, camera, self._pose(), depth_scale=scale, reason=reason, **self._shared())

    def _stereo(self) -> StereoFrame:
        pair = self._one_of(self._pairs)
        sizes = [
            (lens.height, lens.width)
            for lens in ((pair.eyes.left, pair.eyes.right) if pair.eyes else (pair.camera,) * 2)
        ]
        colour = (3,) * int(self._rng.integers(2))
        left, right = (self._rng.integers(0, 256, size + colour, np.uint8) for size in sizes)
        if self._rarely(0.5) and left.shape == right.shape:
            right = np.roll(left, -int(self._rng.integers(1, 9)), axis=1)
        return StereoFrame(left, right, pair, self._pose(), **self._shared())

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
            if self._rarely(0.3)
        }
        first = self._one_of((-2.0, -2.0, 1e9, np.nan, -1e300))
        pose, mount = (self._pose(level=True) for _ in range(2))
        with np.errstate(all="ignore"):
            ranges = ranges.astype(np.float32)
        return Scan(ranges, first, step, *limits, pose, mount, **given, **self._shared())

    def _shared(self) -> dict[str, Any]:
        step = STAMP_STEPS[0] if not self._rarely(0.1) else self._one_of(STAMP_STEPS)
        stamp = self._stamp + step
        self._stamp = stamp if isinstance(stamp, int) and 0 <= stamp < 2**62 else 0
        fault = self._one_of(("no_pose", "unreadable", "a new one\n")) if self._rarely(0.03) else None
        off = self._one_of((0, 0, 0, 10**7, 10**12, -1))
        return {"stamp_ns": stamp, "name": self._one_of(NAMES), "fault": fault, "pose_off_ns": off}

    def _pose(self, level: bool = False) -> Any:
        rng = self._rng
        turn = rng.normal(size=4) * ([0, 0, 1, 1] if level else [1, 1, 1, 1])
        T = from_quaternion(rng.normal(size=3) * self._one_of(PLACES), turn)
        if self._rarely():
            T[tuple(rng.integers(0, 4, 2))] = self._one_of(STRANGE)
        if self._rarely():
            with np.errstate(all="ignore"):
                T[:3, :3] *= self._one_of((1 + 1e-4, 0.99, 2.0, 0.0, -1.0, 1e200))
        return T

    def _camera(self) -> Any:
        """Return one of a few dozen cameras, for a robot has few; now and then one of them is replaced."""
        number = int(self._rng.integers(CAMERAS))
        if self._rarely():
            self._cameras[number] = self._any_camera()
        return self._cameras[number]

    def _any_camera(self) -> Any:
        rng = self._rng
        width, height = int(rng.integers(1, 25)), int(rng.integers(1, 19))
        baseline = self._one_of((None, 0.05, 1e-6, 50.0))
        if self._rarely(0.15):
            kind = self._one_of((SphericalCamera, CylindricalCamera))
            return kind.from_field_of_view(width, height, rng.uniform(5, 170), rng.uniform(5, 359), baseline)
        focal = self._one_of((20.0, 20.0, 60.0, 600.0, 1e5))
        u, v = self._one_of((0.5, 0.5, 0.0, -3.0)) * width, self._one_of((0.5, 0.5, 0.0, 9.0)) * height
        correction = None
        if self._rarely(0.1):
            correction = DepthCorrection(
                "scale+disparity", tuple(rng.normal(size=12) * self._one_of((1e-3, 1.0, 1e30)))
            )
        return sv.PinholeCamera(width, height, focal, focal, u, v, baseline, correction=correction)

    def _pair(self, eyes: bool) -> StereoPair:
        rng = self._rng
        width, height = int(rng.integers(20, 70)), int(rng.integers(8, 40))
        if not eyes:
            return StereoPair(sv.PinholeCamera(width, height, 40.0, 40.0, width / 2, height / 2, 0.1))
        lens = Lens.from_field_of_view("fisheye", width, height, 160.0)
        T_left_right = np.eye(4)
        T_left_right[0, 3] = 0.1
        return StereoPair.from_eyes(Eyes(lens, lens, T_left_right), "spherical", size=(40, 30))

    def _spoilt(self, made: Any) -> Any:
        """Return the frame with one field replaced by what does not belong there."""
        name = self._one_of([field.name for field in fields(made)])
        old = getattr(made, name)
        new = self._one_of(ODD_THINGS)
        if isinstance(old, np.ndarray) and not self._rarely(0.3):
            new = self._odd_array(old)
        elif isinstance(old, int | float) and not self._rarely(0.3):
            new = self._one_of(ODD_NUMBERS)
        return replace(made, **{name: new})

    def _odd_array(self, array: np.ndarray) -> Any:
        """Return an array of another kind, shape or layout; some of them mean the same."""
        ways = (
            lambda: self._of_dtype(array), lambda: self._of_dtype(array), lambda: array[:-1], lambda: array[..., None],
            lambda: array[..., ::-1], lambda: np.asfortranarray(array), lambda: array.tolist(), lambda: array.T,
            lambda: np.repeat(array, 2, axis=-1)[..., ::2], lambda: np.ma.masked_invalid(array.astype(float)),
            lambda: np.broadcast_to(np.float32(2), array.shape), lambda: array.ravel(), lambda: array[:0],
            lambda: np.zeros((1, *array.shape), array.dtype), lambda: self._read_only(array), lambda: array[:3],
        )  # fmt: skip
        return self._one_of(ways)()

    def _of_dtype(self, array: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.nan_to_num(array, posinf=9, neginf=-9).clip(-9, 9).astype(self._one_of(ODD_DTYPES))

    def _read_only(self, array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flags.writeable = False
        return array
