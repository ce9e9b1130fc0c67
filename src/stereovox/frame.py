# SPDX-License-Identifier: Apache-2.0
"""What flows through the house: a `Frame` as a source delivers it, a `DepthImage` as an integrator needs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair, VirtualCamera
from stereovox.se2 import flattened
from stereovox.se3 import Transform, inverse


@dataclass(frozen=True)
class UpdateReport:
    """What one frame did: milliseconds spent, cells whose value changed, and why it was refused, if it was.

    detail: why in a line, or that frames of its sensor are believed again.
    match_ms: rectify and match a stereo pair; depth_ms: prepare the depth image; integrate_ms: put it into the map.
    way: how thoroughly the frame was looked at: `full`, or what `pace` left of it.
    """

    depth_ms: float = 0.0
    integrate_ms: float = 0.0
    cells: int = 0
    refused: str | None = None
    detail: str = ""
    match_ms: float = 0.0
    way: str = "full"


NOT_GIVEN: float = nan
"""Depth scale of a frame whose maker did not name one."""


class Reason(IntEnum):
    """Why a depth pixel has no value. Only TOO_FAR may clear cells, and only up to the maximum range.

    UNMATCHED: matching found nothing it could rely on. TOO_NEAR, TOO_FAR: out of range. MASKED: the pixel is not used.
    UNKNOWN: the source does not say why, as cameras that write 0 for everything.
    """

    VALID = 0
    UNMATCHED = 1
    TOO_NEAR = 2
    TOO_FAR = 3
    MASKED = 4
    UNKNOWN = 5


class Viewpoint(NamedTuple):
    """Where a camera stood: T_world_camera (4, 4) maps its optical frame into the world; time in nanoseconds."""

    camera: PinholeCamera
    T_world_camera: Transform
    stamp_ns: int = 0


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Two images taken at one moment by a stereo pair, as a source delivers them.

    left, right: (height, width) uint8 grey or (height, width, 3) uint8 RGB; as the lenses made them where `pair` has
        `eyes`, else rectified, of the size of its camera.
    T_world_sensor: (4, 4) float64, maps the rectified left optical frame into the world.
    stamp_ns, name, fault, fault_detail, sensor, pose_off_ns: as in `Frame`.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    pair: StereoPair
    T_world_sensor: Transform
    stamp_ns: int = 0
    name: str = ""
    fault: str | None = None
    fault_detail: str = ""
    sensor: str = ""
    pose_off_ns: int = 0


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image with its camera and pose, as a source delivers it.

    depth: (height, width) uint16 or float32/float64; times `depth_scale` it is the depth in metres, for a pinhole along
        the optical axis. No value: 0, negative, NaN, +inf, and 65535 in uint16 (UNKNOWN), -inf (TOO_NEAR; REP 117).
    camera: the camera that took it; its size must be the image's.
    T_world_sensor: (4, 4) float64, maps the optical frame (x right, y down, z forward) into the world (z up).
    stamp_ns: time of the image in int64 nanoseconds.
    depth_scale: metres per unit of `depth` (0.001 for millimetres). Not given: 1 for floats; an image of whole numbers
        without it is refused, for nobody can say what it means.
    reason: (height, width) uint8 of `Reason`, where the source knows why a pixel has no value; else None. VALID: as
        the depth says.
    name: where the frame came from, for messages.
    fault: why the source could not deliver this frame (`unreadable`, `no_pose`); such a frame is refused and counted.
    fault_detail: the same in one line that names file, value and cure.
    sensor: which of several sensors took it (a topic, a name in a rig); their times are watched one by one.
    pose_off_ns: how far from the nearest measured pose this one was extrapolated; 0: measured, or between two.
    farthest: metres that are free at least where `reason` is TOO_FAR; a positive depth beside it says so for a pixel.
        Where that is less than the maximum range the pixel counts as UNKNOWN.
    """

    depth: NDArray[np.generic]
    camera: VirtualCamera
    T_world_sensor: Transform
    stamp_ns: int = 0
    depth_scale: float = NOT_GIVEN
    reason: NDArray[np.uint8] | None = None
    name: str = ""
    fault: str | None = None
    fault_detail: str = ""
    sensor: str = ""
    pose_off_ns: int = 0
    farthest: float = inf

    def __post_init__(self) -> None:
        if self.depth_scale is NOT_GIVEN and getattr(getattr(self.depth, "dtype", None), "kind", "") == "f":
            object.__setattr__(self, "depth_scale", 1.0)


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a 2-D lidar, or what a depth image would look like to one.

    ranges: (N,) float32 metres from the sensor. No value (REP 117): NaN no reading, -inf too near, +inf nothing up to
        `range_max`.
    angle_min, angle_step: radians; beam i points `angle_min + i * angle_step` from the sensor's x axis (forward)
        towards its y axis (left).
    range_min, range_max: metres between which the sensor measures.
    T_world_sensor: (4, 4) float64, maps the sensor's frame (x forward, y left, z up) into the world (z up). As a source
        delivers it the world is that of the odometry.
    T_base_sensor: (4, 4) float64, where the sensor sits on the robot, whose frame stands on the floor.
    clear: (N,) float32 metres up to which each beam is known to be free, 0 for not at all; never more than the beam's
        hit. None: as `ranges` alone tell it: a hit clears up to itself, +inf up to `range_max`, NaN and -inf nothing.
        Scans out of depth images have it: a camera that looks down sees a beam's floor at 2 m and nothing beyond, so
        that beam is free up to 2 m (its range: NaN).
    clear_from: (N,) float32 metres from which on a beam is known to be free up to `clear`; None: from the sensor on. A
        camera does not see what stands on the floor right before it.
    stamp_ns, name, fault, fault_detail, sensor, pose_off_ns: as in `Frame`.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_step: float
    range_min: float
    range_max: float
    T_world_sensor: Transform
    T_base_sensor: Transform = field(default_factory=lambda: np.eye(4))
    clear: NDArray[np.float32] | None = None
    clear_from: NDArray[np.float32] | None = None
    stamp_ns: int = 0
    name: str = ""
    fault: str | None = None
    fault_detail: str = ""
    sensor: str = ""
    pose_off_ns: int = 0

    @property
    def angles(self) -> NDArray[np.float64]:
        """Direction of each beam in the sensor's frame, (N,) radians."""
        return self.angle_min + self.angle_step * np.arange(len(self.ranges), dtype=np.float64)

    @property
    def pose_world_base(self) -> NDArray[np.float64]:
        """Where the robot stood, seen from above: (3,) x, y, yaw."""
        return flattened(self.T_world_sensor @ inverse(self.T_base_sensor))


AnyFrame = Frame | StereoFrame
"""What a source delivers and a mapper takes."""


def name_of(seen: AnyFrame | Scan) -> str:
    """Return what to call a frame or scan in a message."""
    return seen.name or f"{'scan' if isinstance(seen, Scan) else 'frame'} at {seen.stamp_ns} ns"


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image that can be trusted, in metres, with the reason of every pixel that has no value.

    depth_m: (height, width) float32, for a pinhole along the optical axis (see `PinholeCamera`). Without value (REP
        117): NaN unmatched, masked or unknown, -inf too near, +inf too far (nothing up to the maximum range).
    reason: (height, width) uint8 of `Reason`.
    T_world_sensor: (4, 4) float64, exactly rigid.
    """

    depth_m: NDArray[np.float32]
    reason: NDArray[np.uint8]
    camera: VirtualCamera
    T_world_sensor: Transform
    stamp_ns: int = 0

    @property
    def viewpoint(self) -> Viewpoint:
        """Where the camera stood, and what it saw at least (a wide camera: its middle)."""
        return Viewpoint(self.camera.middle, self.T_world_sensor, self.stamp_ns)
