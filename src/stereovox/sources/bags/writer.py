# SPDX-License-Identifier: Apache-2.0
"""Write bags that other ROS tools play back: scans, depth images, IMUs, odometry, transforms and maps."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import MissingExtra, SourceError
from stereovox.files.safe_io import check_local, short_name, sync_file, sync_folder, sync_tree
from stereovox.frame import Frame, Scan
from stereovox.geometry.se2 import lifted
from stereovox.geometry.se3 import Transform, rigidity_error
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.sources.bags.depth_topic import sibling
from stereovox.sources.bags.files import UNFINISHED, one_line
from stereovox.sources.bags.writer_messages import Messages, metres, millimetres, packed_png

SECONDS = {1: 2**32, 2: 2**31}
"""Largest seconds in a time of ROS 1 (uint32) and of ROS 2 (int32)."""
TF_MESSAGE, OCTOMAP = "tf2_msgs/msg/TFMessage", "octomap_msgs/msg/Octomap"
NOT_IN_ROSBAGS = {
    TF_MESSAGE: "geometry_msgs/TransformStamped[] transforms\n",
    OCTOMAP: "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n",
}
"""Definitions of messages that rosbags' types may lack."""
VERSION = 8
"""Version of rosbag2's metadata: the newest that every distribution since Humble reads."""
IMAGE, PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
RIGID = 1e-6


class BagWriter:
    """Writes a recording, all or nothing: it is at `path` when the `with` block ends without error, else nothing is.

    path: ends in `.bag` for ROS 1, in `.db3` or `.mcap` for one file of ROS 2; any other name is a rosbag2 folder,
        with an `.mcap` in it. An older file is replaced, and stays intact if writing fails; a folder must be new or
        empty.
    packed: chunks of a `.bag` are packed with lz4, chunks of an `.mcap` with zstd; `.db3` is never packed.

    Times are int64 nanoseconds since the clock's own epoch, not negative; each message is recorded at its own
    time. Messages may be in any order, but readers are fastest if they are in order of time.
    Raises MissingExtra without rosbags; SourceError if the recording cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], *, packed: bool = True):
        self.path = Path(path)
        self._file = BagFileWriter(self.path, packed)
        self._messages = Messages(self._file.store, self._file.ros)
        self._fixed: dict[str, tuple[str, str, Transform]] = {}
        self._last_ns = 0
        self._due = False

    def __enter__(self) -> Self:
        self._file.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._file.abort()
            return
        try:
            self.complete()
        except BaseException:
            self._file.abort()
            raise

    def complete(self) -> None:
        """Complete the recording and move it to `path`; if that fails, `leave` reports what is left."""
        self._flush_fixed()
        self._file.finish()

    def sync(self) -> None:
        """Flush written messages to the disk, all but the last megabyte, so that a loss of power does not destroy
        them."""
        self._file.sync()

    def leave(self) -> str:
        """End a recording that cannot be completed; return the file with the messages so far, "" if missing."""
        return self._file.leave()

    def scan(self, scan: Scan, topic: str = "/scan", frame_id: str = "laser") -> None:
        """Write a `sensor_msgs/LaserScan`; write its mount and the robot's poses with `fixed` and `odometry`."""
        if scan.fault:
            raise SourceError(f"{self.path}: {scan.name or topic} has a fault ({scan.fault}); leave it out")
        self._write(topic, "sensor_msgs/msg/LaserScan", scan.stamp_ns, self._messages.scan(scan, frame_id))

    def depth(
        self,
        frame: Frame,
        topic: str = "/camera/depth/image_raw",
        frame_id: str = "camera_depth_optical_frame",
        *,
        compressed: bool = False,
    ) -> None:
        """Write a depth image and, on `camera_info` next to it, its camera; the pose is not written.

        uint16 depth becomes 16UC1 millimetres, float depth 32FC1 metres (REP 118). compressed: whole millimetres as PNG
        on `<topic>/compressedDepth`. Fields that `sensor_msgs/CameraInfo` lacks are lost: the baseline, a correction,
        and the reasons of invalid pixels.
        """
        camera = frame.camera
        if not isinstance(camera, PinholeCamera) or frame.depth.shape != (camera.height, camera.width):
            what = frame.fault or f"{frame.depth.shape} pixels of a {type(camera).__name__}"
            raise SourceError(f"{self.path}: {frame.name or topic}: {what}; only whole images of a pinhole are written")
        stamp_ns, messages = frame.stamp_ns, self._messages
        if compressed:
            picture = messages.compressed(packed_png(millimetres(frame)), stamp_ns, frame_id)
            self._write(f"{topic}/compressedDepth", PACKED, stamp_ns, picture)
        else:
            depth = millimetres(frame) if frame.depth.dtype.kind == "u" else metres(frame)
            self._write(topic, IMAGE, stamp_ns, messages.image(depth, stamp_ns, frame_id))
        info = messages.camera_info(camera, stamp_ns, frame_id)
        self._write(sibling(topic, "camera_info"), "sensor_msgs/msg/CameraInfo", stamp_ns, info)

    def photo(
        self,
        frame: Frame,
        topic: str = "/camera/color/image_raw",
        frame_id: str = "camera_color_optical_frame",
    ) -> None:
        """Write the picture taken with a depth image, and its camera on `camera_info` next to it.

        Write its mount on the depth camera with `fixed`. The same `frame_id` means that depth is registered to it.
        """
        if frame.photo is None:
            raise SourceError(f"{self.path}: {frame.name or topic} has no picture; leave it out")
        pixels = frame.photo.pixels() if callable(frame.photo.pixels) else frame.photo.pixels
        stamp_ns, messages = frame.stamp_ns, self._messages
        self._write(topic, IMAGE, stamp_ns, messages.image(pixels, stamp_ns, frame_id))
        info = messages.camera_info(frame.photo.camera, stamp_ns, frame_id)
        self._write(sibling(topic, "camera_info"), "sensor_msgs/msg/CameraInfo", stamp_ns, info)

    def imu(
        self,
        stamp_ns: int,
        angular_rate: ArrayLike | None,
        specific_force: ArrayLike | None,
        topic: str = "/imu",
        frame_id: str = "imu_link",
    ) -> None:
        """Write a `sensor_msgs/Imu`: (3,) rad/s and (3,) m/s^2 along the axes of `frame_id`; None: not measured."""
        for numbers in (angular_rate, specific_force):
            if numbers is not None and not (np.shape(numbers) == (3,) and np.isfinite(numbers).all()):
                raise SourceError(f"{self.path}: {numbers} on {topic}; give 3 finite numbers, or None")
        message = self._messages.imu(angular_rate, specific_force, stamp_ns, frame_id)
        self._write(topic, "sensor_msgs/msg/Imu", stamp_ns, message)

    def odometry(
        self,
        stamp_ns: int,
        pose_odom_base: ArrayLike,
        topic: str = "/odom",
        odom_frame: str = "odom",
        base_frame: str = "base_link",
    ) -> None:
        """Write a `nav_msgs/Odometry`, and the same as transform odom -> base_link on `/tf`; pose: (3,) x, y, yaw."""
        pose = self._planar(pose_odom_base)
        message = self._messages.odometry(pose, stamp_ns, odom_frame, base_frame)
        self._write(topic, "nav_msgs/msg/Odometry", stamp_ns, message)
        self.transform(stamp_ns, odom_frame, base_frame, lifted(pose))

    def transform(self, stamp_ns: int, parent: str, child: str, T_parent_child: Transform) -> None:
        """Write the pose of a frame in its parent at one moment, (4, 4), on `/tf`."""
        edge = parent, child, self._rigid(T_parent_child, parent, child)
        self._write("/tf", TF_MESSAGE, stamp_ns, self._messages.transforms(stamp_ns, [edge]))

    def fixed(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """Write the constant pose of a frame in its parent, (4, 4), on `/tf_static`.

        All poses given so far go into one message before the next message of another kind, since only the last message
        of this topic is kept for late subscribers.
        """
        self._fixed[child] = parent, child, self._rigid(T_parent_child, parent, child)
        self._due = True

    def pose(
        self,
        stamp_ns: int,
        pose_map_base: ArrayLike,
        covariance: ArrayLike | None = None,
        topic: str = "/amcl_pose",
        frame_id: str = "map",
    ) -> None:
        """Write a `geometry_msgs/PoseWithCovarianceStamped` of a (3,) pose x, y, yaw.

        covariance: (3, 3) of x, y, yaw in m^2, m rad and rad^2, (6, 6) in ROS's order, or None for zeros.
        """
        if covariance is not None and np.shape(covariance) not in ((3, 3), (6, 6)):
            raise SourceError(f"{self.path}: a covariance of {np.shape(covariance)} on {topic}; give (3, 3) or (6, 6)")
        message = self._messages.pose(self._planar(pose_map_base), covariance, stamp_ns, frame_id)
        self._write(topic, "geometry_msgs/msg/PoseWithCovarianceStamped", stamp_ns, message)

    def occupancy(self, stamp_ns: int, grid: OccupancyGrid, topic: str = "/map_mapping", frame_id: str = "map") -> None:
        """Write a `nav_msgs/OccupancyGrid`, latched: kept for late subscribers."""
        message = self._messages.occupancy(grid, stamp_ns, frame_id)
        self._write(topic, "nav_msgs/msg/OccupancyGrid", stamp_ns, message, latched=True)

    def octomap(
        self,
        stamp_ns: int,
        tree: bytes,
        resolution: float,
        topic: str = "/octomap_full",
        frame_id: str = "map",
        *,
        binary: bool = False,
    ) -> None:
        """Write an `octomap_msgs/Octomap`, latched: the nodes of an OcTree as in an `.ot` file, binary: in a `.bt`.

        resolution: side of a cell in metres.
        """
        message = self._messages.octomap(tree, binary, resolution, stamp_ns, frame_id)
        self._write(topic, OCTOMAP, stamp_ns, message, latched=True)

    def cloud(self, stamp_ns: int, points: ArrayLike, topic: str = "/occupied_cells", frame_id: str = "map") -> None:
        """Write a `sensor_msgs/PointCloud2` of (N, 3) metres, latched."""
        message = self._messages.cloud(np.asarray(points, np.float32).reshape(-1, 3), stamp_ns, frame_id)
        self._write(topic, "sensor_msgs/msg/PointCloud2", stamp_ns, message, latched=True)

    def _write(self, topic: str, kind: str, stamp_ns: int, message: Any, latched: bool = False) -> None:
        self._last_ns = stamp_ns
        self._flush_fixed()
        self._file.write(topic, kind, stamp_ns, message, latched)

    def _flush_fixed(self) -> None:
        if self._due:
            self._due = False
            message = self._messages.transforms(self._last_ns, list(self._fixed.values()))
            self._file.write("/tf_static", TF_MESSAGE, self._last_ns, message, latched=True)

    def _planar(self, pose: ArrayLike) -> NDArray[np.float64]:
        numbers = np.asarray(pose, float)
        if numbers.shape != (3,) or not np.isfinite(numbers).all():
            raise SourceError(f"{self.path}: {pose} is not a pose; give x, y and yaw, all finite")
        return numbers

    def _rigid(self, T: Transform, parent: str, child: str) -> Transform:
        if rigidity_error(T) > RIGID:
            raise SourceError(
                f"{self.path}: {parent} -> {child} is not a rigid motion; give a (4, 4) rotation and translation"
            )
        return np.asarray(T, float)


class BagFileWriter:
    """Serialises messages and writes them next to `path`; `finish` moves the whole recording there.

    ros: 1 for a path that ends in `.bag`, else 2. store: rosbags' types of that ROS. packed: chunks of a `.bag` are
    packed with lz4, chunks of an `.mcap` and of a folder with zstd; `.db3` cannot be packed.
    Raises MissingExtra without rosbags, SourceError if the recording cannot be written.
    """

    def __init__(self, path: Path, packed: bool = True):
        check_local(path, SourceError)
        self.path = path
        self._packed = packed
        self._ending = path.suffix.lower()
        self.ros = 1 if self._ending == ".bag" else 2
        self.store = typestore(self.ros)
        self._connections: dict[str, Any] = {}
        self._writer: Any = None
        self._target = Path(os.path.realpath(path))  # write through a link
        self._folder = self._target.with_name(f"{short_name(self._target)}.{uuid.uuid4().hex[:6]}{UNFINISHED}")
        self._check()

    def open(self) -> None:
        """Begin; nothing is at `path` yet."""
        try:
            with self._one_line_errors():
                self._folder.mkdir()
                self._writer = self._ros1() if self.ros == 1 else self._ros2()
                self._writer.open()
        except SourceError:
            self.abort()
            raise

    def write(self, topic: str, kind: str, stamp_ns: int, message: Any, latched: bool = False) -> None:
        """Write one message of the store's type `kind` (`nav_msgs/msg/Odometry`), recorded at `stamp_ns`.

        latched: the topic's last message is kept for late subscribers.
        """
        if self._writer is None:
            raise SourceError(f"{self.path}: not open; write 'with BagWriter(path) as bag:'")
        self.check_stamp(stamp_ns)
        with self._one_line_errors():
            if topic not in self._connections:
                self._connections[topic] = self._connect(topic, kind, latched)
            if (held := self._connections[topic].msgtype) != kind:
                raise SourceError(f"{self.path}: {topic} holds {held}, not {kind}; give each its own topic")
            pack = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
            self._writer.write(self._connections[topic], int(stamp_ns), pack(message, kind))

    def check_stamp(self, stamp_ns: int) -> None:
        """Raise SourceError for a time that ROS cannot represent."""
        if not 0 <= stamp_ns < SECONDS[self.ros] * 1_000_000_000:
            limit = f"0 and {SECONDS[self.ros]} seconds"
            raise SourceError(f"{self.path}: the time {stamp_ns} ns must be between {limit}; shift the clock")

    def finish(self) -> None:
        """Complete the recording and move it into place; an older file of that name is replaced.

        If that fails, the written data stays next to `path` until `abort`.
        """
        with self._one_line_errors():
            self._writer.close()
            self._move()
        self.abort()

    def sync(self) -> None:
        """Flush written data to the disk."""
        for file in self._folder.rglob("*.*"):
            with suppress(OSError):  # SQLite's journal may be gone by now; a broken disk fails at the next message
                sync_file(file)

    def leave(self) -> str:
        """End the recording in place, and return the readable file; without one, as `abort`."""
        grown = self._folder / self._target.stem / self._target.name
        if self._ending != ".mcap" or not grown.is_file():
            self.abort()
            return ""
        with suppress(Exception):
            self._writer.abort()
        self._writer = None
        return str(self.path.parent / grown.relative_to(self._target.parent))

    def abort(self) -> None:
        """Discard the recording; an older file stays intact."""
        if self._writer is not None:
            with suppress(Exception):
                self._writer.abort()
            self._writer = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _check(self) -> None:
        """Refuse a path that cannot hold the recording, before anything is written."""
        file = self._ending in (".bag", ".db3", ".mcap")
        if file and self._target.is_dir():
            raise SourceError(f"{self.path}: is a folder; name a file")
        if not file and self._target.exists() and (not self._target.is_dir() or any(self._target.iterdir())):
            raise SourceError(
                f"{self.path}: exists and is not empty; give a new folder, or a name ending in .bag or .mcap"
            )
        if self._ending == ".db3" and set(str(self._target)) & set("?#%"):
            raise SourceError(f"{self.path}: SQLite's library misreads ?, # and % in a name; choose another name")

    def _ros1(self) -> Any:
        from rosbags.rosbag1 import Writer

        writer = Writer(self._folder / self._target.name)
        if self._packed:
            writer.set_compression(Writer.CompressionFormat.LZ4)
        return writer

    def _ros2(self) -> Any:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        sqlite = self._ending == ".db3"
        # rosbags gives the file inside the name of its folder, and records it in the metadata
        name = self._target.stem if self._ending in (".db3", ".mcap") else self._target.name
        plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
        writer = Writer(self._folder / name, version=VERSION, storage_plugin=plugin)
        if self._packed and not sqlite:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        return writer

    def _connect(self, topic: str, kind: str, latched: bool) -> Any:
        if self.ros == 1:
            more: dict[str, Any] = {"callerid": "/stereovox", "latching": int(latched)}
        else:
            more = {"offered_qos_profiles": [_transient_local()] if latched else []}
        return self._writer.add_connection(topic, kind, typestore=self.store, **more)

    def _move(self) -> None:
        made: Path = self._writer.path
        if self._ending in (".db3", ".mcap"):
            made = made / f"{made.name}{self._ending}"
        if made.is_dir():
            sync_tree(made)
        else:
            sync_file(made)
        made.replace(self._target)
        sync_folder(self._target.parent)

    @contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        """Convert errors of writing into one-line SourceErrors."""
        try:
            yield
        except OSError as error:
            reason = one_line(error.strerror or error)
            cure = "choose an existing folder with free space and write permission"
            raise SourceError(f"{self.path}: cannot be written ({reason}); {cure}") from None
        except SourceError:
            raise
        except Exception as error:  # rosbags, SQLite and struct each have their own
            raise SourceError(f"{self.path}: cannot be written ({one_line(error)})") from None


def typestore(ros: int) -> Any:
    """Return rosbags' message types of ROS 1 or 2; raises MissingExtra without rosbags."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtra("rosbags", "bags") from None
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind, definition in NOT_IN_ROSBAGS.items():
        if kind not in store.types:
            store.register(get_types_from_msg(definition, kind))
    return store


def _transient_local() -> Any:
    """Return ROS 2's QoS for latched topics: reliable, the last message kept for late subscribers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(0, 0)
    kept = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*kept, never, never, QosLiveliness.SYSTEM_DEFAULT, never, False)
