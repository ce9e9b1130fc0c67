# SPDX-License-Identifier: Apache-2.0
"""Depth images in a recording: `.db3` and `.bag` of a RealSense camera, and ordinary bags of ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources import parameters
from stereovox.sources.bags import open_bag, suffix_of
from stereovox.sources.bags.depth_topic import DepthTopic, find_depth
from stereovox.sources.bags.imu import read_readings, up_by_gravity
from stereovox.sources.bags.photo_topic import PhotoTopic, find_photos
from stereovox.sources.bags.poses import find_poses
from stereovox.sources.bags.tf import Tf, TfPoses, read_tf
from stereovox.sources.base import DepthSource
from stereovox.sources.imu import ImuReadings
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.tracker import AXES, WORLDS, turned
from stereovox.sources.rgbd.depth_files import Depth
from stereovox.sources.rgbd.pose_fit import Images, Reading, misfit
from stereovox.sources.rigs.rig_options import poses_of_images

STANDING = ("", "fixed")
OptionsT = TypeVar("OptionsT")


@dataclass(frozen=True)
class Options:
    """Options after the file's name, as in `walk.bag?depth=/camera/depth/image_rect&poses=/vicon`.

    depth, info, poses: topics of the depth images, of their `sensor_msgs/CameraInfo`, and of the camera's poses, if
        they are not found or the wrong ones are; `poses` may also be a file of poses, of any form.
    axes: axes of the posed body, `optical`, `ros` (x forward, z up) or `opengl` (T265); world: axes of the map, `file`,
        `up` or `optical`. Defaults: `opengl` and `up` for T265 poses, else `optical` and `file`.
    world_frame: the frame of /tf that is the world; default: `map`, else `odom`, else the root of the tree.
    pose: `fixed` for a static camera: every pose is the identity, and poses in the file are ignored.
    imu: topic of the IMU (`sensor_msgs/Imu`), if there are several; `off` for none.
    scale: metres per unit (0: the file's, else millimetres); baseline: metres (0: the file's).
    max_gap: longest gap in seconds between poses that is bridged (0: 0.5 in /tf, else as smooth motion allows).
    invert, poses_scale: for poses that map the world into the camera, and metres per unit; not for /tf.
    """

    depth: str = ""
    info: str = ""
    poses: str = ""
    axes: str = ""
    world: str = ""
    world_frame: str = ""
    pose: str = ""
    imu: str = ""
    scale: float = 0.0
    baseline: float = 0.0
    max_gap: float = 0.0
    invert: bool = False
    poses_scale: float = 1.0

    def __post_init__(self) -> None:
        for key, known in {"axes": tuple(AXES), "world": WORLDS, "pose": STANDING}.items():
            word = getattr(self, key)
            if word and word not in known:
                raise SourceError(f"{key}={word} must be {' or '.join(filter(None, known))}")
        for one, others in {"pose": ("poses", "axes", "world", "world_frame"), "poses": ("world_frame",)}.items():
            for key in filter(lambda key, one=one: getattr(self, one) and getattr(self, key), others):
                told = f"{one}={getattr(self, one)} and {key}={getattr(self, key)}"
                raise SourceError(f"{told} contradict each other; give one")
        for key in ("scale", "baseline", "max_gap"):
            if getattr(self, key) < 0:
                raise SourceError(f"{key}={getattr(self, key):g} must be a positive number")
        if not self.poses_scale > 0:
            raise SourceError(f"poses_scale={self.poses_scale:g} must be above 0: metres per unit of the poses")


class Bag(DepthSource):
    """Depth images of one topic of a recorded file, with poses from /tf or another topic.

    Realsense-viewer writes `.db3` since librealsense 2.57 and `.bag` before; both are recognised by their topics and
    contain camera, unit and baseline. In ordinary bags the depth topic has 16UC1 (millimetres), 32FC1 (metres) or
    compressedDepth images, 16-bit PNG, and `camera_info` next to it. If there are several, `?depth=/topic` selects one.

    The files are read message by message, not played back by pyrealsense2, which plays at its own pace, cannot go to
    frame number i, and may crash the program on a damaged file. Checked: `.db3` against files that
    pyrealsense2 2.59 recorded and against its own playback; RealSense `.bag` only against files made for the tests as
    librealsense's `ros_writer.cpp` describes, which librealsense's own reader accepts; no bag of a real camera was
    available.

    Invalid pixels: 0 in 16UC1, which is UNKNOWN and clears nothing; 32FC1 follows REP 117: -inf is TOO_NEAR, NaN
    UNKNOWN, +inf as set by `depth.far`.
    Pictures of a camera that has the depth images' frame, or is fixed to it by /tf, help tracking.
    Time: the image's own; in RealSense files the frame's own clock domain. Pose: interpolated at that
    time; /tf for the images' frame takes precedence, and holds for up to 0.1 s at its ends (`pose_off_ns`). It is the
    pose of the depth camera's optical frame unless `axes` differs; for poses of another camera,
    or in another file, use a camera pair (`pair.toml`).
    Faults: `unreadable`, `bad_dtype`, `bad_shape`, `no_camera`; `no_pose` and `bad_pose_file`, which keep the
        depth image.
    Raises SourceError for files that are empty, damaged or without usable depth, and for bad options.
    """

    layout = "a RealSense .db3 or .bag, or a .bag, .db3, .mcap or rosbag2 folder with depth images"

    def __init__(self, where: str | Path, *, posed: bool = True):
        path, options = parse(str(where))
        self.name = path.name or path.resolve().name
        self._file = open_bag(path)
        self._depth: DepthTopic = find_depth(self._file, options.depth, options.info)
        self.camera = self._depth.camera
        if options.baseline:
            self.camera = replace(self.camera, baseline=options.baseline)
        self._scale, self._imu = options.scale, options.imu
        self._standing, self.posed = options.pose == "fixed" or not posed, posed
        self._poses, self._missing, notes = None, "", ()
        if not self._standing:
            self._poses, self._missing, notes = read_poses(
                self._file, options, PosedSensor(self._depth.frame_id, stamps_ns=self._depth.taken_ns)
            )
        self.notes = (*self._file.notes, *self._depth.notes, *notes, *self._misfit(options))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is, or by its name should be, such a file or folder; options may follow."""
        return bool(suffix_of(file_part(where)))

    def _misfit(self, options: Options) -> tuple[str, ...]:
        """Return a note if the poses do not fit the images."""
        if self._poses is None or options.invert or options.poses_scale != 1:
            return ()
        poses, name = self._poses, str(self._file.path)

        @lru_cache(12)
        def read(i: int) -> Depth:
            image, _, _ = self._depth.image(i, name)
            return image  # pyrefly: ignore[bad-return] - uint16 or float32

        try:
            unit = self._scale or self._depth.image(0, name)[2]
            images = Images(len(self), lambda i: poses.at(self._depth.time_ns(i)), read, self.camera)
            found = misfit(images, unit, unit, Reading())
        except FrameRefused:  # reported when it is read
            return ()
        given = options.axes or (isinstance(poses, TurnedTf) and ("invert=" in found or "poses_scale=" in found))
        cure = "; check that poses, camera and depth unit belong to these images"
        return (found.partition("; try")[0] + cure if given and "; try" in found else found,) if found else ()

    @classmethod
    def depth_only(cls, where: str) -> Bag:
        """Return the depth images without searching for poses: every pose is the identity."""
        return cls(where, posed=False)

    def __len__(self) -> int:
        return len(self._depth)

    @cached_property
    def _photos(self) -> PhotoTopic | None:
        """Pictures taken with the depth images."""
        return find_photos(self._file, self._depth, lambda: self._tf)

    @cached_property
    def _tf(self) -> Tf | None:
        """The transforms in the recording, None if missing."""
        return self._poses.poses.tf if isinstance(self._poses, TurnedTf) else read_tf(self._file)

    def gravity(self) -> NDArray[np.float64] | None:
        """Return the unit vector (3,) that points up in the world of the poses by an IMU; None if unknown."""
        found = self._poses
        if not isinstance(found, TurnedTf) or found.world != "file":
            return None
        return up_by_gravity(self._file, found.poses)

    def imu(self) -> ImuReadings | None:
        """Return the readings of the IMU in the recording; see `read_readings`."""
        if self._imu == "off":
            return None
        return read_readings(self._file, self._tf, self._depth.frame_id, self._imu)

    def frame(self, i: int) -> Frame:
        """Return frame `i`; depth is (0, 0) if the image has a `fault`, the pose NaN if it is missing."""
        i = range(len(self))[i]
        frame = depth_frame(self._depth, i, f"{self._file.path} frame {i}", self._pose, self.camera, self._scale)
        if self._photos is not None and frame.depth.size:
            frame = replace(frame, photo=self._photos.near(self._depth.stamp_ns(i), frame.stamp_ns))
        if frame.fault or not isinstance(self._poses, TurnedTf):
            return frame
        return replace(frame, pose_off_ns=self._poses.poses.off_ns(frame.stamp_ns))

    def _pose(self, stamp_ns: int) -> Transform:
        if self._standing:
            return np.eye(4)
        if self._poses is None:
            raise FrameRefused("no_pose", self._missing)
        return self._poses.at(stamp_ns)


def depth_frame(
    images: DepthTopic,
    i: int,
    name: str,
    pose: Callable[[int], Transform],
    camera: PinholeCamera,
    scale: float = 0.0,
) -> Frame:
    """Return image `i` of a topic as a frame with the pose at its time, T_world_sensor; see `Bag.frame`.

    name: for messages. scale: metres per unit, 0 for the recording's own. pose: may raise FrameRefused.
    """
    blank = Frame(np.empty((0, 0), np.uint16), camera, np.full((4, 4), np.nan), images.stamp_ns(i), name=name)
    try:
        depth, stamp_ns, told = images.image(i, name)
    except FrameRefused as refused:
        return replace(blank, fault=refused.reason, fault_detail=str(refused))
    frame = replace(blank, depth=depth, stamp_ns=stamp_ns, depth_scale=scale or told)
    try:
        return replace(frame, T_world_sensor=pose(stamp_ns))
    except FrameRefused as refused:
        return replace(frame, fault=refused.reason, fault_detail=str(refused))


def file_part(where: str) -> str:
    """Return `where` without options; an existing path with a `?` in its name takes precedence. Never raises."""
    try:
        whole = Path(where).exists()
    except (OSError, ValueError):
        whole = False
    return where if whole else where.partition("?")[0]


def parse(where: str) -> tuple[Path, Options]:
    """Return file and options; raises SourceError for bad options."""
    return parse_as(where, Options)


def parse_as(where: str, kind: type[OptionsT]) -> tuple[Path, OptionsT]:
    """Return file and options of a given class; raises SourceError for bad options."""
    file = file_part(where)
    try:
        _, texts = parameters.split(where[len(file) :])
        return Path(file), kind(**parameters.typed(texts, parameters.defaults(kind)))
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None


@dataclass(frozen=True)
class TurnedTf:
    """Poses from /tf of a body in optical axes; see `tracker.turned`."""

    poses: TfPoses
    axes: str
    world: str

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_body at a time; raises FrameRefused `no_pose`."""
        return turned(self.poses.at(stamp_ns), self.axes, self.world)


class PosedSensor(NamedTuple):
    """What needs poses: the frame of a sensor ("" if unknown), the option that says how its body's poses are to be
    read ("" if given), and its messages' times, ascending."""

    frame_id: str = ""
    option: str = "axes=ros if both have one origin"
    stamps_ns: Callable[[], Sequence[int]] = list


def read_poses(
    file: Any, options: Options, sensor: PosedSensor
) -> tuple[Poses | TurnedTf | None, str, tuple[str, ...]]:
    """Return the poses in a bag or in a file next to it, if any, the reason if there are none, and notes about
    assumptions."""
    if options.poses not in file.types and (path := _file_of(options.poses, file.path)):
        poses, axes = poses_of_images(path, sensor.stamps_ns()), options.axes or "optical"
        found = poses.of(turned(_read_as(poses.T_world_body, options), axes, options.world or "file"))
        return _limited(found, options), "", ((poses.note,) if poses.note else ())
    chained = bool(sensor.option) and not options.axes
    found = find_poses(file, options.poses, sensor.frame_id, options.world_frame, chained)
    if found.unmounted:
        return None, f"{found.unmounted}; record /tf_static, or add ?{sensor.option}", ()
    if found.poses is None:
        return None, found.missing, ()
    axes = options.axes or ("opengl" if found.tracker else "optical")
    world = options.world or ("up" if found.tracker else "file")
    poses = found.poses
    notes = () if found.of_camera or options.axes else (found.assumed,)
    if isinstance(poses, TfPoses):
        if options.invert or options.poses_scale != 1:
            raise SourceError(f"{file.path}: invert= and poses_scale= are not for /tf; leave them out, or name ?poses=")
        if options.max_gap:
            poses.tf.limits = replace(poses.tf.limits, max_gap_s=options.max_gap)
        return TurnedTf(poses, axes, world), "", (*notes, *poses.tf.notes)
    found = poses.of(turned(_read_as(poses.T_world_body, options), axes, world))
    return _limited(found, options), "", notes


def _read_as(T: NDArray[np.float64], options: Options) -> NDArray[np.float64]:
    """Return poses (N, 4, 4) in metres, of the body in the world."""
    T = np.array([inverse(one) for one in T]) if options.invert else T.copy()
    T[:, :3, 3] *= options.poses_scale
    return T


def _limited(poses: Poses, options: Options) -> Poses:
    poses.max_gap_ns = round(options.max_gap * 1e9)
    return poses


def _file_of(text: str, bag: Path) -> Path | None:
    """Return the file of poses that an option names, None if there is no such file."""
    try:
        return parameters.file_of(text, bag if bag.is_dir() else bag.parent) if text else None
    except (SourceError, OSError, ValueError):
        return None


def tracker_poses(where: str | Path, axes: str = "", world: str = "") -> Poses:
    """Return the poses in a `.bag` or `.db3`, for a camera pair; `where` may name the topic: `t265.bag?poses=/topic`.

    `axes` and `world` as in `read_tracker`; T_world_body of a T265 has its confidence.
    Raises SourceError if it has no poses.
    """
    path, options = parse(str(where))
    options = replace(options, pose="", world_frame="", axes=axes or options.axes, world=world or options.world)
    poses, missing, _ = read_poses(open_bag(path), options, PosedSensor())
    if not isinstance(poses, Poses):
        raise SourceError(missing)
    return poses
