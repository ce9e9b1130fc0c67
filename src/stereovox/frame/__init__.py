# SPDX-License-Identifier: Apache-2.0
"""The data that flows through the pipeline: frames and scans from a source, depth images for integrators, reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from math import inf, isnan, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair, VirtualCamera
from stereovox.geometry.se2 import flattened
from stereovox.geometry.se3 import Transform, inverse

NOT_GIVEN: float = nan
"""Depth scale of a frame that was made without one."""
Progress = Callable[[int, int, str], object]
"""Called while something takes its time: with steps done, steps in all, and the current one in words."""


def no_progress(done: int, total: int, text: str) -> None:
    """Ignore progress."""


class _Assumed(float):
    """The scale 1 of float images whose scale was not given. It is no scale of whole numbers that replace them."""


@dataclass(frozen=True)
class UpdateReport:
    """What one frame did to the map.

    Attributes:
        depth_ms: Milliseconds to prepare the depth image or scan.
        integrate_ms: Milliseconds to turn it into evidence and put that into the map.
        cells: Number of cells whose value changed.
        refused: Reason the frame was refused; None if it was taken.
        detail: The refusal in one line, or a note that frames of this sensor are accepted again.
        match_ms: Milliseconds to rectify and match a stereo pair; 0 for other frames.
        quality: Quality level of the frame: `full`, or `near` or `coarse` where `deadline_ms` left less time.
        taken_out: Number of earlier frames taken out of the map again, because the frame contradicts them and no other
            had confirmed them.
    """

    depth_ms: float = 0.0
    integrate_ms: float = 0.0
    cells: int = 0
    refused: str | None = None
    detail: str = ""
    match_ms: float = 0.0
    quality: str = "full"
    taken_out: int = 0


class Reason(IntEnum):
    """Why a depth pixel has no value. Only TOO_FAR may clear cells, and only up to the maximum range.

    Attributes:
        VALID: The pixel has a depth.
        UNMATCHED: Stereo matching found nothing reliable.
        TOO_NEAR: Nearer than the minimum range.
        TOO_FAR: Farther than the maximum range.
        MASKED: The pixel is not used.
        UNKNOWN: The source does not say why, like cameras that write 0 for everything.
    """

    VALID = 0
    UNMATCHED = 1
    TOO_NEAR = 2
    TOO_FAR = 3
    MASKED = 4
    UNKNOWN = 5


class Viewpoint(NamedTuple):
    """Camera pose at a time: T_world_camera (4, 4) maps the optical frame into the world; stamp_ns in nanoseconds."""

    camera: PinholeCamera
    T_world_camera: Transform
    stamp_ns: int = 0


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Two images taken at the same time by a stereo pair, as a source delivers them.

    Attributes:
        left: (height, width) uint8 grey or (height, width, 3) uint8 RGB: raw where `pair` has `eyes`, otherwise
            rectified and of the size of the pair's camera.
        right: The same for the right eye.
        pair: The stereo pair that took them.
        T_world_sensor: (4, 4) float64, maps the rectified left optical frame into the world.
        stamp_ns: As in `Frame`.
        name: As in `Frame`.
        fault: As in `Frame`.
        fault_detail: As in `Frame`.
        sensor: As in `Frame`.
        pose_off_ns: As in `Frame`.
        pose_sigma: As in `Frame`.
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
    pose_sigma: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Photo:
    """An image that was taken along with a depth image; its corners tell how a camera moved where depth does not.

    Attributes:
        pixels: (height, width) uint8 grey or (height, width, 3) uint8 RGB; or a function that reads them once they are
            needed, and raises FrameRefused if it cannot.
        camera: The camera that took it, without distortion; its size must be the image's.
        T_sensor_camera: (4, 4) float64, maps its optical frame into that of the depth camera; the same where depth is
            registered to the image.
    """

    pixels: NDArray[np.uint8] | Callable[[], NDArray[np.uint8]]
    camera: PinholeCamera
    T_sensor_camera: Transform = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image with its camera and pose, as a source delivers it.

    Attributes:
        depth: (height, width) uint16, float32 or float64; times `depth_scale` it is the depth in metres, for a pinhole
            along the optical axis. No value: 0, negative, NaN, +inf, and 65535 in uint16 (UNKNOWN); -inf (TOO_NEAR;
            REP 117).
        camera: The camera that took it; its size must be the image's.
        T_world_sensor: (4, 4) float64, maps the optical frame (x right, y down, z forward) into the world (z up).
        stamp_ns: Time of the image in int64 nanoseconds.
        depth_scale: Metres per unit of `depth` (0.001 for millimetres). Not given (NaN): 1 for floats; integer images
            without it are refused, since their unit is unknown.
        reason: (height, width) uint8 of `Reason`, where the source knows why a pixel has no value; else None. VALID:
            as the depth says.
        name: Where the frame came from, for messages.
        fault: Why the source could not deliver this frame (`unreadable`, `no_pose`); it is refused and counted.
        fault_detail: The same in one line that names file, value and cure.
        sensor: Which of several sensors took it (a topic, a name in a rig); each sensor's stamps are checked by
            themselves.
        pose_off_ns: How far the pose was extrapolated from the nearest measured one; 0: measured or interpolated.
        pose_sigma: Standard deviations of the pose on what the frames before it saw, along the direction that is known
            least: radians and metres; 0 where nobody says. Drift since the start is not in it. Loop closure uses it.
        farthest: Metres that are free at least where `reason` is TOO_FAR; a positive depth there says so for that
            pixel. Where this is less than the maximum range, the pixel counts as UNKNOWN.
        photo: An image that was taken at the same time, by which poses are tracked; maps do not need it.
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
    photo: Photo | None = None
    pose_sigma: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        given = self.depth_scale
        if isinstance(given, _Assumed) or (isinstance(given, float | np.floating) and isnan(given)):
            kind = getattr(getattr(self.depth, "dtype", None), "kind", "")
            object.__setattr__(self, "depth_scale", _Assumed(1) if kind == "f" else NOT_GIVEN)


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep of a 2-D lidar, or a depth image reduced to one.

    Attributes:
        ranges: (N,) float32 metres from the sensor. No value (REP 117): NaN no reading, -inf too near, +inf nothing up
            to `range_max`.
        angle_min: Direction of beam 0 in radians, from the sensor's x axis (forward) towards its y axis (left).
        angle_step: Radians from one beam to the next.
        range_min: Shortest range in metres that the sensor measures.
        range_max: Longest range in metres that it measures.
        T_world_sensor: (4, 4) float64, maps the sensor's frame (x forward, y left, z up) into the world (z up). In
            scans from a source, the world is that of the odometry.
        T_base_sensor: (4, 4) float64, maps the sensor's frame into the robot's, which stands on the floor.
        clear: (N,) float32 metres up to which each beam is known to be free, 0 for not at all; never more than the
            beam's hit. None: derived from `ranges`: a hit clears up to itself, +inf up to `range_max`, NaN and -inf
            nothing. Scans made from depth images have it: a camera that looks down sees the floor of a beam at 2 m
            and nothing beyond, so that beam is free up to 2 m (its range: NaN).
        clear_from: (N,) float32 metres from which a beam is known to be free up to `clear`; None: from the sensor. A
            camera does not see what stands on the floor right in front of it.
        stamp_ns: As in `Frame`.
        name: As in `Frame`.
        fault: As in `Frame`.
        fault_detail: As in `Frame`.
        sensor: As in `Frame`.
        pose_off_ns: As in `Frame`.
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
        """Pose of the robot on the floor, (3,) x, y in metres and yaw in radians."""
        return flattened(self.T_world_sensor @ inverse(self.T_base_sensor))


MAX_POINTS = 1 << 23
"""Points of one cloud that are taken."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points that a lidar measured in one turn, or any other points that were seen along straight rays.

    Attributes:
        points: (N, 3) float32 or float64 metres in the sensor's frame (x forward, y left, z up). No value: not finite,
            or all three 0; such a point clears nothing.
        T_world_sensor: (4, 4) float64, maps the sensor's frame at `stamp_ns` into the world (z up).
        stamp_ns: As in `Frame`.
        lidar: What its ranges can be trusted for.
        origins: (N, 3) metres in the same frame: where the sensor was when it measured each point, if it moved
            meanwhile (`deskewed` makes them); None: at 0.
        clear: (M, 3) metres in the same frame: ends of rays that met nothing, free all the way. None: nothing is known
            of rays without a point.
        name: As in `Frame`.
        fault: As in `Frame`.
        fault_detail: As in `Frame`.
        sensor: As in `Frame`.
        pose_off_ns: As in `Frame`.
        pose_sigma: As in `Frame`.
    """

    points: NDArray[np.floating]
    T_world_sensor: Transform
    stamp_ns: int = 0
    lidar: Lidar = field(default_factory=Lidar)
    origins: NDArray[np.floating] | None = None
    clear: NDArray[np.floating] | None = None
    name: str = ""
    fault: str | None = None
    fault_detail: str = ""
    sensor: str = ""
    pose_off_ns: int = 0
    pose_sigma: tuple[float, float] = (0.0, 0.0)

    @property
    def camera(self) -> Lidar:
        """Return the lidar, under the name that all frames have."""
        return self.lidar


@dataclass(frozen=True, eq=False)
class Range:
    """One distance, to the nearest thing in the cone of a sonar, a radar, or another `RangeSensor`.

    A mapper turns it into a `Cloud` of rays that fill the cone, half a cell apart at its end.

    Attributes:
        distance: Metres. +inf: nothing was heard; -inf: something is nearer than `range_min`; NaN: no reading (REP
            117).
        T_world_sensor: (4, 4) float64, maps the sensor's frame (x along the cone, y left, z up) into the world (z up).
        stamp_ns: As in `Frame`.
        beam: The sensor: its cone, limits and noise.
        name: As in `Frame`.
        fault: As in `Frame`.
        fault_detail: As in `Frame`.
        sensor: As in `Frame`.
        pose_off_ns: As in `Frame`.
        pose_sigma: As in `Frame`.
    """

    distance: float
    T_world_sensor: Transform
    stamp_ns: int = 0
    beam: RangeSensor = field(default_factory=RangeSensor)
    name: str = ""
    fault: str | None = None
    fault_detail: str = ""
    sensor: str = ""
    pose_off_ns: int = 0
    pose_sigma: tuple[float, float] = (0.0, 0.0)


Rays = Cloud | Range
"""Frames of sensors that measure along rays, with their x axis forward and z up."""
AnyFrame = Frame | StereoFrame | Rays
"""What a source delivers and a mapper takes."""


CALLED = {Scan: "scan", Cloud: "cloud", Range: "range"}


def name_of(seen: AnyFrame | Scan) -> str:
    """Return the name of a frame or scan for messages."""
    kind = next((word for one, word in CALLED.items() if isinstance(seen, one)), "frame")
    return seen.name or f"{kind} at {seen.stamp_ns} ns"


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A checked depth image in metres, with the reason for every pixel that has no value.

    Attributes:
        depth_m: (height, width) float32, for a pinhole along the optical axis (see `PinholeCamera`). No value (REP
            117): NaN unmatched, masked or unknown; -inf too near; +inf too far (nothing up to the maximum range).
        reason: (height, width) uint8 of `Reason`.
        camera: The camera that took it; its size is the image's.
        T_world_sensor: (4, 4) float64, exactly rigid, maps the optical frame into the world.
        stamp_ns: Time of the image in int64 nanoseconds.
    """

    depth_m: NDArray[np.float32]
    reason: NDArray[np.uint8]
    camera: VirtualCamera
    T_world_sensor: Transform
    stamp_ns: int = 0

    @property
    def viewpoint(self) -> Viewpoint:
        """Pose of the camera, and a pinhole for what it saw (of a wide camera, its middle)."""
        return viewpoint_of(self.camera, self.T_world_sensor, self.stamp_ns)


@dataclass(frozen=True, eq=False)
class CheckedCloud:
    """A checked cloud: rays that end at a surface, and rays that are only known to be free.

    Attributes:
        ends: (N, 3) float64 metres in the sensor's frame, all finite.
        origins: (N, 3) where each ray begins; None: at 0.
        hits: (N,) bool, whether there is a surface at the ray's end.
        lidar: As in `Cloud`.
        T_world_sensor: (4, 4) float64, exactly rigid.
        stamp_ns: As in `Cloud`.
    """

    ends: NDArray[np.float64]
    origins: NDArray[np.float64] | None
    hits: NDArray[np.bool_]
    lidar: Lidar
    T_world_sensor: Transform
    stamp_ns: int = 0

    @property
    def camera(self) -> Lidar:
        """Return the lidar, under the name that all images have."""
        return self.lidar

    @property
    def viewpoint(self) -> Viewpoint:
        """Pose of the sensor, as a camera that looks along its x axis."""
        return viewpoint_of(self.lidar, self.T_world_sensor, self.stamp_ns)


AnyImage = DepthImage | CheckedCloud
"""What integrators turn into evidence."""
FORWARD = PinholeCamera.from_field_of_view(640, 480, 90)


def viewpoint_of(camera: VirtualCamera | Lidar, T_world_sensor: Transform, stamp_ns: int) -> Viewpoint:
    """Return where a sensor was: a camera's middle one; a lidar as a camera that looks along its x axis."""
    if not isinstance(camera, Lidar):
        return Viewpoint(camera.middle, T_world_sensor, stamp_ns)
    T = T_world_sensor.copy()
    T[:3, :3] = T[:3, :3] @ R_SENSOR_OPTICAL
    return Viewpoint(FORWARD, T, stamp_ns)


"""A camera that stands for a lidar where pictures are drawn from its place."""
R_SENSOR_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Turns optical axes (x right, y down, z forward) into those of a sensor (x forward, y left, z up)."""
