# SPDX-License-Identifier: Apache-2.0
"""Build ROS 1 or ROS 2 messages of rosbags' types from scans, images, poses and maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Frame, Scan
from stereovox.geometry.se2 import lifted
from stereovox.geometry.se3 import Transform, rotation_vector
from stereovox.maps.occupancy import OccupancyGrid

PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Rows and columns of x, y and yaw in a covariance of x, y, z, roll, pitch, yaw."""

ENCODINGS = {"u2": "16UC1", "f4": "32FC1", "u1": "mono8"}
"""Encodings of `sensor_msgs/Image` (REP 118) by array type."""
FLOAT32 = 7
"""Type of float32 in `sensor_msgs/PointField`."""


class Messages:
    """Makes messages of one ROS: `store` has rosbags' types, `ros` is 1 or 2."""

    def __init__(self, store: Any, ros: int):
        self._types, self._ros = store.types, ros

    def scan(self, scan: Scan, frame_id: str) -> Any:
        """Return a `sensor_msgs/LaserScan` with unchanged ranges (REP 117)."""
        step = scan.angle_step
        return self._make(
            "sensor_msgs/msg/LaserScan",
            header=self._header(scan.stamp_ns, frame_id),
            angle_min=scan.angle_min,
            angle_max=scan.angle_min + step * (len(scan.ranges) - 1),
            angle_increment=step,
            time_increment=0.0,
            scan_time=0.0,
            range_min=scan.range_min,
            range_max=scan.range_max,
            ranges=np.ascontiguousarray(scan.ranges, np.float32),
            intensities=np.empty(0, np.float32),
        )

    def image(self, pixels: NDArray[np.generic], stamp_ns: int, frame_id: str) -> Any:
        """Return a `sensor_msgs/Image` of (height, width) uint16 millimetres, float32 metres or uint8 grey.

        Also of (height, width, 3) uint8 RGB.
        """
        height, width = pixels.shape[:2]
        little = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
        kind = "rgb8" if pixels.ndim == 3 else ENCODINGS[pixels.dtype.str[1:]]
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(stamp_ns, frame_id),
            height=height,
            width=width,
            encoding=kind,
            is_bigendian=0,
            step=little.strides[0],
            data=little.view(np.uint8).ravel(),
        )

    def compressed(self, data: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Any:
        """Return a `sensor_msgs/CompressedImage` of compressed_depth_image_transport; data: (N,) uint8."""
        header = self._header(stamp_ns, frame_id)
        form = "16UC1; compressedDepth png"
        return self._make("sensor_msgs/msg/CompressedImage", header=header, format=form, data=data)

    def camera_info(self, camera: PinholeCamera, stamp_ns: int, frame_id: str) -> Any:
        """Return a `sensor_msgs/CameraInfo` of images without distortion."""
        K = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], float)
        matrices = {"D": np.zeros(5), "K": K, "R": np.eye(3).ravel(), "P": np.insert(K, (3, 6, 9), 0.0)}
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(stamp_ns, frame_id),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=self._make("sensor_msgs/msg/RegionOfInterest", **roi),
            **{key if self._ros == 1 else key.lower(): numbers for key, numbers in matrices.items()},
        )

    def odometry(self, pose: NDArray[np.float64], stamp_ns: int, parent: str, child: str) -> Any:
        """Return a `nav_msgs/Odometry` of a (3,) pose x, y, yaw; speeds and covariances are zero: unknown."""
        vector = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._make("geometry_msgs/msg/Twist", linear=vector, angular=vector)
        return self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            pose=self._covered(pose, None),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )

    def imu(self, rate: ArrayLike | None, force: ArrayLike | None, stamp_ns: int, frame_id: str) -> Any:
        """Return a `sensor_msgs/Imu` of (3,) rad/s and (3,) m/s^2; the first covariance of a missing measurement is
        -1.
        """
        return self._make(
            "sensor_msgs/msg/Imu",
            header=self._header(stamp_ns, frame_id),
            orientation=self._rotation(np.eye(4)),
            orientation_covariance=_not_measured(None),
            angular_velocity=self._vector(rate),
            angular_velocity_covariance=_not_measured(rate),
            linear_acceleration=self._vector(force),
            linear_acceleration_covariance=_not_measured(force),
        )

    def pose(self, pose: NDArray[np.float64], covariance: ArrayLike | None, stamp_ns: int, frame_id: str) -> Any:
        """Return a `geometry_msgs/PoseWithCovarianceStamped`; covariance: (3, 3) of x, y, yaw, (6, 6) or None."""
        header = self._header(stamp_ns, frame_id)
        return self._make(
            "geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=self._covered(pose, covariance)
        )

    def transforms(self, stamp_ns: int, edges: Sequence[tuple[str, str, Transform]]) -> Any:
        """Return a `tf2_msgs/TFMessage` of edges: the names of parent and child, and T_parent_child (4, 4)."""
        stamped = [
            self._make(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(stamp_ns, parent),
                child_frame_id=child,
                transform=self._make(
                    "geometry_msgs/msg/Transform",
                    translation=self._xyz("Vector3", T),
                    rotation=self._rotation(T),
                ),
            )
            for parent, child, T in edges
        ]
        return self._make("tf2_msgs/msg/TFMessage", transforms=stamped)

    def occupancy(self, grid: OccupancyGrid, stamp_ns: int, frame_id: str) -> Any:
        """Return a `nav_msgs/OccupancyGrid`."""
        rows, columns = grid.cells.shape
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(stamp_ns),
            resolution=grid.resolution,
            width=columns,
            height=rows,
            origin=self._pose(lifted(grid.origin)),
        )
        data = np.ascontiguousarray(grid.message_cells).ravel()
        return self._make("nav_msgs/msg/OccupancyGrid", header=self._header(stamp_ns, frame_id), info=info, data=data)

    def octomap(self, data: bytes, binary: bool, resolution: float, stamp_ns: int, frame_id: str) -> Any:
        """Return an `octomap_msgs/Octomap` of a tree of type OcTree with cells of `resolution` metres."""
        return self._make(
            "octomap_msgs/msg/Octomap",
            header=self._header(stamp_ns, frame_id),
            binary=binary,
            id="OcTree",
            resolution=resolution,
            data=np.frombuffer(data, np.int8),
        )

    def cloud(self, points: NDArray[np.floating], stamp_ns: int, frame_id: str) -> Any:
        """Return a `sensor_msgs/PointCloud2` of (N, 3) metres, as float32."""
        little = np.ascontiguousarray(points, "<f4")
        fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * k, datatype=FLOAT32, count=1)
            for k, name in enumerate("xyz")
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(stamp_ns, frame_id),
            height=1,
            width=len(little),
            fields=fields,
            is_bigendian=False,
            point_step=12,
            row_step=little.nbytes,
            data=little.view(np.uint8).ravel(),
            is_dense=True,
        )

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _time(self, stamp_ns: int) -> Any:
        seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        sequence = {"seq": 0} if self._ros == 1 else {}
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp_ns), frame_id=frame_id, **sequence)

    def _xyz(self, kind: str, T: Transform) -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", T[:3, 3].tolist(), strict=True)))

    def _vector(self, numbers: ArrayLike | None) -> Any:
        x, y, z = (0.0, 0.0, 0.0) if numbers is None else np.asarray(numbers, float).tolist()
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _rotation(self, T: Transform) -> Any:
        vector = rotation_vector(T[:3, :3])
        angle = float(np.linalg.norm(vector))
        x, y, z = (vector * (0.5 * np.sinc(angle / (2 * np.pi)))).tolist()  # sinc(t) = sin(pi t) / (pi t)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=float(np.cos(angle / 2)))

    def _pose(self, T: Transform) -> Any:
        return self._make("geometry_msgs/msg/Pose", position=self._xyz("Point", T), orientation=self._rotation(T))

    def _covered(self, pose: NDArray[np.float64], covariance: ArrayLike | None) -> Any:
        given, full = np.asarray(0.0 if covariance is None else covariance, float), np.zeros((6, 6))
        full[PLANAR if given.shape == (3, 3) else ...] = given
        covered = "geometry_msgs/msg/PoseWithCovariance"
        return self._make(covered, pose=self._pose(lifted(pose)), covariance=full.ravel())


def _not_measured(numbers: ArrayLike | None) -> NDArray[np.float64]:
    """Return a covariance (9,): unknown, or marked as not measured (`sensor_msgs/Imu`)."""
    covariance = np.zeros(9)
    covariance[0] = -1.0 if numbers is None else 0.0
    return covariance


def millimetres(frame: Frame) -> NDArray[np.uint16]:
    """Return a depth image in whole millimetres, (height, width) uint16; 0 for no value and beyond 65.534 m."""
    depth, missing = frame.depth, None
    if depth.dtype == np.uint16:
        if frame.depth_scale == 0.001:
            return depth.astype(np.uint16, copy=False)
        missing = depth == np.iinfo(np.uint16).max
    with np.errstate(invalid="ignore"):
        scaled = np.rint(depth.astype(np.float64) * (frame.depth_scale * 1000))
        usable = (scaled > 0) & (scaled < np.iinfo(np.uint16).max)
    if missing is not None:
        usable &= ~missing
    return np.where(usable, scaled, 0).astype(np.uint16)


def metres(frame: Frame) -> NDArray[np.float32]:
    """Return a depth image in metres, (height, width) float32; invalid pixels stay NaN or zero."""
    return (np.asarray(frame.depth, float) * frame.depth_scale).astype(np.float32)


def packed_png(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return the format of compressed_depth_image_transport for (height, width) uint16: 12 bytes, then a PNG."""
    import cv2

    whole, png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not whole:
        raise ValueError("the image cannot be packed as PNG")
    return np.concatenate([np.zeros(12, np.uint8), png.ravel()])  # zeros: parameters for packed floats, unused here
