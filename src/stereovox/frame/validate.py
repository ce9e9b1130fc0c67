# SPDX-License-Identifier: Apache-2.0
"""Validate frames and scans: the types, shapes and poses of their fields."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.cameras.rigs import StereoPair, VirtualCamera
from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import Cloud, Frame, Range, Scan, StereoFrame, name_of
from stereovox.geometry import se3

EXACT = 1e-14
"""Rigidity error of a rotation in float64 that cannot be improved."""
MAX_POSITION = 1e6
"""Metres from the world's origin along an axis from which on a position is an error."""
TOO_FAR = f"positions must lie within {MAX_POSITION:g} m: subtract an offset, or is the unit wrong?"
MAX_INT = 2**63
"""Integers from here on do not fit into 64 bits."""


class Field(NamedTuple):
    """The types a field may have, their name in messages, and the reason for refusing others."""

    types: tuple[type, ...]
    wanted: str
    reason: str = "bad_form"


WHOLE = Field((int, np.integer), "a whole number of nanoseconds", "bad_stamp")
NUMBER = Field((int, float, np.integer, np.floating), "a number")
TEXT = Field((str,), "text")
TEXT_OR_NONE = Field((str, type(None)), "text or None")
ARRAY = Field((np.ndarray,), "an array")
ARRAY_OR_NONE = Field((np.ndarray, type(None)), "an array or None")
SHARED = {
    "stamp_ns": WHOLE,
    "pose_off_ns": WHOLE,
    "sensor": TEXT._replace(reason="bad_sensor"),
    "name": TEXT,
    "fault": TEXT_OR_NONE,
    "fault_detail": TEXT,
}
"""Fields that frames and scans have in common."""
FIELDS = {
    Frame: {
        "camera": Field(get_args(VirtualCamera), "a camera"),
        "depth_scale": NUMBER._replace(reason="bad_scale"),
        "farthest": NUMBER._replace(reason="bad_scale"),
        "reason": ARRAY_OR_NONE._replace(reason="bad_reason"),
    },
    StereoFrame: {"left": ARRAY, "right": ARRAY, "pair": Field((StereoPair,), "a StereoPair")},
    Cloud: {
        "points": ARRAY,
        "lidar": Field((Lidar,), "a Lidar"),
        "origins": ARRAY_OR_NONE,
        "clear": ARRAY_OR_NONE,
    },
    Range: {"distance": NUMBER, "beam": Field((RangeSensor,), "a RangeSensor")},
    Scan: dict.fromkeys(("angle_min", "angle_step", "range_min", "range_max"), NUMBER)
    | {"ranges": ARRAY, "clear": ARRAY_OR_NONE, "clear_from": ARRAY_OR_NONE},
}
"""The other fields of each kind; a frame's `depth` is checked by `depth.prepare`, poses by `rigid_pose`."""
MEASURED = {Frame: ("depth",), StereoFrame: ("left", "right"), Cloud: ("points",), Scan: ("ranges",), Range: ()}
"""Fields that must not be masked arrays."""


def validate_fields(seen: Any, *kinds: type) -> None:
    """Raise FrameRefused for an object that is none of `kinds`, or that has a field of the wrong type.

    The reason is `bad_form`, or `bad_stamp` for its times, `bad_sensor`, `bad_scale`, `bad_reason`; or the source's own
    `fault`. kinds: out of Frame, StereoFrame, Cloud, Range and Scan. Array elements are not checked; masked arrays are
    refused, since nothing downstream reads their mask.
    """
    for kind in kinds:
        if isinstance(seen, kind):
            break
    else:
        names = " or a ".join(kind.__name__ for kind in kinds)
        raise FrameRefused("bad_form", f"{type(seen).__name__} is not a {names}")
    _check_fields(seen, SHARED)
    if seen.fault:  # the rest of a frame that the source could not deliver is not checked
        raise FrameRefused(seen.fault, seen.fault_detail or f"{_label(seen)}: {seen.fault}")
    _check_fields(seen, FIELDS[kind])
    if not isinstance(seen, Scan) and not _is_sigma(seen.pose_sigma):
        detail = "pose_sigma is not two numbers of at least 0; give (radians, metres)"
        raise FrameRefused("bad_form", f"{_label(seen)}: {detail}")
    for name in MEASURED[kind]:
        if isinstance(getattr(seen, name), np.ma.MaskedArray):
            raise FrameRefused("bad_form", f"{_label(seen)}: {name} is a masked array; fill it, `{name}.filled(0)`")


def validate_scan(scan: Scan, rigidity: float) -> Scan:
    """Return the scan with exactly rigid pose and mount; `rigidity` is the largest error that is rounded away.

    Raises FrameRefused: `bad_form`, the source's `fault`, `bad_dtype`, `bad_shape`, `bad_scan`, `mount_not_rigid`,
    `mount_too_far`, and as `rigid_pose`.
    """
    validate_fields(scan, Scan)
    name = name_of(scan)
    ranges = np.asarray(scan.ranges)
    if not np.issubdtype(ranges.dtype, np.floating):
        raise FrameRefused("bad_dtype", f"{name}: ranges are {ranges.dtype}; give float32 metres")
    if ranges.ndim != 1 or not ranges.size:
        raise FrameRefused("bad_shape", f"{name}: ranges are {ranges.shape}; give (N,) metres")
    angles = float(scan.angle_min), float(scan.angle_step)
    limits = float(scan.range_min), float(scan.range_max)
    if (
        not np.isfinite([*angles, angles[0] + angles[1] * ranges.size]).all()
        or scan.angle_step == 0
        or not (0 <= limits[0] < limits[1])
    ):
        found = f"angles from {angles[0]} by {angles[1]}, ranges from {limits[0]} to {limits[1]}"
        raise FrameRefused("bad_scan", f"{name}: {found}; steps must not be 0, and ranges must rise")
    T, mount = rigid_pose(scan, rigidity), _rigid_mount(scan, rigidity)
    return replace(scan, T_world_sensor=T, T_base_sensor=mount)


def validate_upright_scan(scan: Scan, config: Config) -> Scan:
    """Return the scan with an exactly rigid pose.

    Raises FrameRefused as `validate_scan`, or `tilted` if the sensor leans by more than `grid.max_tilt_deg`.
    """
    scan = validate_scan(scan, config.pose_rigidity_tolerance)
    upright = abs(scan.T_world_sensor[2, 2])  # a sensor may hang upside down
    tilt_deg = np.degrees(np.arccos(min(upright, 1.0)))
    if tilt_deg > config.grid.max_tilt_deg:
        raise FrameRefused(
            "tilted", f"{name_of(scan)}: leans {tilt_deg:.1f} degrees (grid.max_tilt_deg); its beams meet the floor"
        )
    return scan


def rigid_pose(frame: Frame | Cloud | Scan | Range, tolerance: float) -> se3.Transform:
    """Return the rigid motion nearest to the pose; `tolerance` is the largest error that is rounded away.

    Raises FrameRefused: `no_pose` for None, `pose_not_finite`, `pose_too_far`, `pose_not_rigid`.
    """
    if frame.T_world_sensor is None:
        raise FrameRefused("no_pose", f"{name_of(frame)}: there is no pose; give a (4, 4) matrix, or wait for one")
    T = matrix_of(frame.T_world_sensor)
    if T.shape == (4, 4):
        _check_place(T, name_of(frame))
    error = se3.rigidity_error(T)
    if error > tolerance:
        raise FrameRefused("pose_not_rigid", f"{name_of(frame)}: the pose is not a rigid 4x4 motion ({_off(T, error)})")
    return se3.orthonormalise(T) if error > EXACT else T


def _check_place(T: NDArray[np.float64], name: str) -> None:
    """Raise FrameRefused if a pose (4, 4) holds numbers that are not finite, or stands too far from the origin."""
    if not all(map(isfinite, T.ravel().tolist())):
        raise FrameRefused("pose_not_finite", f"{name}: the pose holds NaN or infinity; leave the frame out")
    farthest = max(map(abs, T[:3, 3].tolist()))
    if farthest >= MAX_POSITION:
        raise FrameRefused("pose_too_far", f"{name}: the pose is {farthest:.7g} m from the world's origin; {TOO_FAR}")


def matrix_of(given: object) -> NDArray[np.float64]:
    """Return a pose as float64, whatever its shape; an empty array (0,) for anything but real numbers."""
    try:
        numbers = np.asarray(given)
        return numbers.astype(float) if numbers.dtype.kind in "fiu" else np.empty(0)
    except ValueError:  # a ragged list
        return np.empty(0)


def for_kernels(given: ArrayLike) -> NDArray:
    """Return an array as kernels take it: read-only, aligned, contiguous; floats as float32.

    Arrays of other kinds would make Numba compile kernels anew in the middle of a run.
    """
    array = np.asarray(given)
    if array.dtype.kind == "f" and array.dtype != np.float32:
        with np.errstate(over="ignore", invalid="ignore"):
            array = array.astype(np.float32)
    plain = (array if array.flags.carray else np.require(array, None, ["C", "A"])).view()
    plain.flags.writeable = False
    return plain


def _check_fields(seen: object, wanted: dict[str, Field]) -> None:
    for name, (types, what, reason) in wanted.items():
        value = getattr(seen, name)
        if not isinstance(value, types):
            raise FrameRefused(reason, f"{_label(seen)}: {name} is {type(value).__name__}; give {what}")
        if types[0] is int and isinstance(value, WHOLE.types) and abs(int(value)) >= MAX_INT:
            raise FrameRefused(reason, f"{_label(seen)}: {name} does not fit into 64 bits; give {what}")


def _is_sigma(given: Any) -> bool:
    """Return whether these are two deviations."""
    if not isinstance(given, tuple) or len(given) != 2:
        return False
    return all(isinstance(one, NUMBER.types) and 0 <= one <= MAX_POSITION for one in given)


def _label(seen: object) -> str:
    name = getattr(seen, "name", "")
    return name if isinstance(name, str) and name else f"a {type(seen).__name__}"


def _rigid_mount(scan: Scan, rigidity: float) -> se3.Transform:
    T, where = matrix_of(scan.T_base_sensor), "T_base_sensor, the lidar's place on the robot,"
    error = se3.rigidity_error(T)
    if error > rigidity:
        raise FrameRefused("mount_not_rigid", f"{name_of(scan)}: {where} is not a rigid 4x4 motion ({_off(T, error)})")
    farthest = np.abs(T[:3, 3]).max()
    if farthest >= MAX_POSITION:
        raise FrameRefused("mount_too_far", f"{name_of(scan)}: {where} is {farthest:.7g} m from the robot; give metres")
    return se3.orthonormalise(T) if error > EXACT else T


def _off(T: NDArray[np.float64], error: float) -> str:
    """Return how far an array is from a rigid motion, as text."""
    return f"off by {error:.2g}" if T.shape == (4, 4) else f"its shape is {T.shape}"
