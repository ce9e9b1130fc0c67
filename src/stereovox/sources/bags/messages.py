# SPDX-License-Identifier: Apache-2.0
"""The few ROS messages needed for depth images and poses, parsed from their bytes, for both ROS 1 and ROS 2 (CDR).

Written by hand, because librealsense's ROS 1 images are longer than their own definition (a float with the depth unit
follows if the header's frame_id is "1"), which general readers refuse, and because no allocation here trusts a
declared length.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

STAMP_LIMIT = 2**63
MAX_COEFFICIENTS = 64
"""Most coefficients of a lens; the longest model in use has 14."""
STAMPED = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")
WITH_CHILD = ("TransformStamped", "Odometry")
POSE_TYPES = frozenset({"geometry_msgs/Transform", "nav_msgs/Odometry"} | {f"geometry_msgs/{n}" for n in STAMPED[:3]})


class Wire:
    """A serialised message, read from front to back; raises ValueError if it is too short.

    cdr: ROS 2's encoding: four bytes of header, numbers aligned to their own size, text ends in a zero byte.
    """

    def __init__(self, data: bytes | memoryview, cdr: bool):
        self._view, self._cdr, self._at, self._start = memoryview(data), cdr, 0, 0
        self.order: Literal["<", ">"] = "<"
        if cdr:
            self.order = "<" if bytes(self.block(4))[1:2] == b"\1" else ">"
            self._start = 4

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._view) - self._at

    def numbers(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """Return `count` numbers of the struct type `code`."""
        size = struct.calcsize(code)
        if self._cdr:
            self._at += -(self._at - self._start) % size
        return struct.unpack(f"{self.order}{count}{code}", self.block(size * count))

    def number(self, code: str = "I") -> Any:
        """Return one number of the struct type `code`."""
        return self.numbers(code)[0]

    def array(self, code: str, count: int) -> NDArray[np.generic]:
        """Return `count` numbers of the NumPy type `code` (`f4`) as an array (count,) in the machine's byte order."""
        dtype = np.dtype(code)
        if self._cdr and count:  # aligned only if something follows
            self._at += -(self._at - self._start) % dtype.itemsize
        stored = np.frombuffer(self.block(dtype.itemsize * count), dtype.newbyteorder(self.order))
        return stored.astype(dtype)

    def point_size(self, size: int) -> int:
        """Return the distance of records of `size` bytes that begin with a number of four, and go to the first."""
        if self._cdr:
            self._at += -(self._at - self._start) % 4
        return size + (-size % 4 if self._cdr else 0)

    def block(self, size: int) -> memoryview:
        """Return the next `size` bytes without a copy."""
        if size > self.left:
            raise ValueError(f"{size} bytes are announced, but {max(self.left, 0)} are left")
        self._at += size
        return self._view[self._at - size : self._at]

    def data(self) -> memoryview:
        """Return the bytes of a `uint8[]` without a copy."""
        return self.block(self.number())

    def text(self) -> str:
        """Return a `string`."""
        text = bytes(self.data()).decode("utf-8", "replace")
        return text.removesuffix("\0") if self._cdr else text

    def header(self) -> tuple[int, str]:
        """Return time in nanoseconds and frame_id of a `std_msgs/Header`."""
        if not self._cdr:
            self.number()  # sequence number, which ROS 2 dropped
        seconds, nanoseconds = self.number("i" if self._cdr else "I"), self.number()
        return seconds * 1_000_000_000 + nanoseconds, self.text()


@dataclass(frozen=True)
class Picture:
    """A `sensor_msgs/Image`, or a `sensor_msgs/CompressedImage` whose size and step are 0; the data is not copied."""

    stamp_ns: int
    frame_id: str
    encoding: str
    data: memoryview
    height: int = 0
    width: int = 0
    step: int = 0
    big_endian: bool = False
    depth_units: float | None = None


def read_image(wire: Wire) -> Picture:
    """Return a `sensor_msgs/Image`, with librealsense's depth unit in metres if one follows."""
    stamp_ns, frame_id = wire.header()
    height, width = wire.numbers("I", 2)
    encoding, big_endian, step, data = wire.text(), wire.number("B"), wire.number(), wire.data()
    units = wire.number("f") if frame_id == "1" and wire.left == 4 else None
    return Picture(stamp_ns, frame_id, encoding, data, height, width, step, bool(big_endian), units)


def read_compressed(wire: Wire) -> Picture:
    """Return a `sensor_msgs/CompressedImage`; its format is stored in `encoding`."""
    stamp_ns, frame_id = wire.header()
    return Picture(stamp_ns, frame_id, wire.text(), wire.data())


@dataclass(frozen=True)
class CameraInfo:
    """A `sensor_msgs/CameraInfo`: K (3x3) and P (3x4) row by row, and the distortion coefficients D.

    They are of the whole image; images are cut to roi (x_offset, y_offset, height, width; height and width 0: whole),
    and of binning pixels along x and y one is made.
    """

    width: int
    height: int
    K: tuple[float, ...]
    D: tuple[float, ...] = ()
    P: tuple[float, ...] = (0.0,) * 12
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


def read_camera_info(wire: Wire) -> CameraInfo:
    """Return a `sensor_msgs/CameraInfo`."""
    wire.header()
    height, width = wire.numbers("I", 2)
    wire.text()
    count = wire.number()
    if count > MAX_COEFFICIENTS:
        raise ValueError(f"a lens with {count} coefficients")
    D = wire.numbers("d", count) if count else ()  # aligned only if something follows
    K, _, P = wire.numbers("d", 9), wire.numbers("d", 9), wire.numbers("d", 12)
    binning, roi = wire.numbers("I", 2), wire.numbers("I", 4)
    return CameraInfo(
        width, height, K, D, P, (max(binning[0], 1), max(binning[1], 1)), (roi[0], roi[1], roi[2], roi[3])
    )


@dataclass(frozen=True)
class StampedPose:
    """A pose: tx ty tz in metres, quaternion qx qy qz qw; time and frame names if the message has them."""

    numbers: tuple[float, ...]
    stamp_ns: int | None = None
    child: str = ""
    parent: str = ""


def read_pose(wire: Wire, kind: str) -> StampedPose:
    """Return the pose in a message of one of the `POSE_TYPES`, without covariance and speed."""
    name = kind.rpartition("/")[2]
    stamp_ns, parent = wire.header() if name in STAMPED else (None, "")
    child = wire.text() if name in WITH_CHILD else ""
    return StampedPose(wire.numbers("d", 7), stamp_ns, child, parent)


def read_pairs(wire: Wire, kind: str) -> dict[str, str]:
    """Return the keys and values of a `diagnostic_msgs/KeyValue`, or of a `std_msgs/String` "key=value;key=value"."""
    if kind.endswith("/KeyValue"):
        return {wire.text(): wire.text()}
    parts = (part.partition("=") for part in wire.text().split(";"))
    return {key: value for key, _, value in parts if key}


def read_value(wire: Wire, kind: str) -> float:
    """Return the number in a `std_msgs/Float32`, or in the text of a `std_msgs/String`; raises ValueError."""
    return wire.number("f") if kind.endswith("/Float32") else float(wire.text())


def ns_from_ms(text: str) -> int | None:
    """Return the nanoseconds of a decimal number of milliseconds; None if it is invalid or too large for int64."""
    try:
        number = Decimal(text) * 1_000_000
    except ArithmeticError:  # raised by Decimal
        return None
    return round(number) if number.is_finite() and abs(number) < STAMP_LIMIT else None
