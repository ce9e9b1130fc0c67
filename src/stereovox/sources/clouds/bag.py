# SPDX-License-Identifier: Apache-2.0
"""Clouds, 2-D scans and ranges of bags: `drive.bag?cloud=/points`, `drive.bag?scan=/scan`, `drive.bag?range=/sonar`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from math import inf, nan
from pathlib import Path

import numpy as np

from stereovox.cameras.lidar import RangeSensor
from stereovox.depth.cloud import deskewed
from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Cloud, Range
from stereovox.geometry.se3 import inverse
from stereovox.sensors.protocol import REACH_SIGMA
from stereovox.sources.bags import open_bag, suffix_of
from stereovox.sources.bags.recording import Options as PoseOptions
from stereovox.sources.bags.recording import PosedSensor, TurnedTf, file_part, read_poses
from stereovox.sources.bags.robot_messages import CLOUDS, LASER_SCAN, RANGE, LaserScan, PointCloud, RangeReading
from stereovox.sources.bags.scans import ScanTopics, check_topic
from stereovox.sources.clouds.options import CloudSource, LidarOptions, no_others, options_of
from stereovox.sources.parameters import mounted
from stereovox.sources.rgbd.pose_fit import CloudReading, clouds_misfit

TOPICS = {"cloud": CLOUDS, "scan": (LASER_SCAN,), "range": (RANGE,)}
POSES = ("poses", "world_frame", "invert", "poses_scale", "max_gap")
MOUNT = "mount=x,y,z,yaw,pitch,roll of the lidar on it"


@dataclass(frozen=True)
class Options(LidarOptions):
    """Those of all clouds (`LidarOptions`), and:

    cloud: topic of the clouds (`sensor_msgs/PointCloud2`, `PointCloud`, Livox's `CustomMsg`). scan: topic of scans
    (`sensor_msgs/LaserScan`) to use instead; range: of sonars or radars (`sensor_msgs/Range`). Several topics are
    separated by commas. silence_clears: 1 if a cone in which nothing was heard is free (`RangeSensor`). poses: topic or
    file of the lidar's poses, or of its body's; default: /tf.
    mount: where the lidar is on the posed body, instead of /tf: x,y,z in metres, then yaw, pitch and roll in radians
    (0,0,0: the poses are the lidar's). world_frame, invert, poses_scale, max_gap: as for depth images. deskew: 0 to
    treat the points of a cloud as measured at once although they have times.
    """

    cloud: str = ""
    scan: str = ""
    range: str = ""
    silence_clears: bool = False
    poses: str = ""
    mount: str = ""
    invert: bool = False
    poses_scale: float = 1.0
    max_gap: float = 0.0
    world_frame: str = ""
    deskew: bool = True

    def __post_init__(self) -> None:
        mounted("mount", self.mount)


class BagClouds(CloudSource):
    """Clouds, 2-D scans or ranges of a bag, with poses from /tf or another topic.

    where: the file, with `?cloud=/topic`, `?scan=/topic` or `?range=/topic`; see `Options`.
    Points: fields x, y and z. If they have times (`time`, `t`, `timestamp`, `offset_time`) they are deskewed with
        the poses of the sensor (`deskewed`). Of a scan: each beam's end; beams without an echo (+inf) are free up to
        its `range_max`. A range is a `Range`: the arc of a cone about the frame's x axis.
    Pose: of the frame that the messages name, at their times.
    Faults: `unreadable`, `no_pose`, `bad_pose_file`.
    Raises SourceError for unusable files, topics that do not exist or have another type, and bad options.
    """

    layout = "clouds of a bag (drive.bag?cloud=/topic), its 2-D scans (?scan=/topic) or ranges (?range=/topic)"

    def __init__(self, where: str):
        path = file_part(where)
        self._options, others = options_of(where, len(path), Options)
        no_others(where, others, Options)
        given = {key: topic for key in TOPICS if (topic := getattr(self._options, key))}
        if len(given) != 1:
            raise SourceError(f"{where}: has {' and '.join(given)}; give one of ?cloud=, ?scan= and ?range=")
        ((key, topics),) = given.items()
        self._refuse_unused(where, key)
        self._file = open_bag(Path(path))
        self._scans = self._topics(key, topics)
        self.name, self.lidar = f"{Path(path).name} {topics}", self._options.lidar
        mount = mounted("mount", self._options.mount)
        self._T_body_lidar = np.eye(4) if mount is None else mount
        options = PoseOptions(**{key: getattr(self._options, key) for key in POSES})
        sensor = PosedSensor(self._scans.frame_id, "" if self._options.mount else MOUNT, self._scans.taken_ns)
        self._poses, self._missing, notes = read_poses(self._file, options, sensor)
        self._refuse_world()
        self.posed = self._poses is not None
        self.notes = (*self._file.notes, *notes, *self._scans.notes, *filter(None, [self._misfit(key)]))

    def _misfit(self, key: str) -> str:
        """Return a note if the poses do not fit the clouds."""
        if self._poses is None or key == "range" or len(set(self._scans.frame_ids)) > 1:
            return ""
        tf = isinstance(self._poses, TurnedTf)
        own = self._options
        changed = tf or own.invert or own.poses_scale != 1
        place = "x,y,z,yaw,pitch" if tf else "0,0,0,0,0"
        now = CloudReading(known=("ros",), whole=not changed, place=place)
        if own.mount:
            now = now._replace(mount=tuple(self._T_body_lidar.ravel().tolist()))

        def raw(i: int) -> np.ndarray:
            message = self._scans.read(i)
            T = self._pose_at(message.frame_id, message.stamp_ns)
            return T @ inverse(self._T_body_lidar) if own.mount else T

        def points(i: int) -> np.ndarray:
            message = self._scans.read(i)
            if isinstance(message, RangeReading):
                return np.empty((0, 3))
            return message.points if isinstance(message, PointCloud) else cloud_of_scan(message).points

        return clouds_misfit(points, raw, len(self), now)

    def _refuse_unused(self, where: str, key: str) -> None:
        """Raise SourceError for options that this kind of topic does not use."""
        unused = ("range_min", "range_max", "deskew") if key == "range" else ("silence_clears",)
        for name in unused:
            if getattr(self._options, name) != getattr(Options(), name):
                raise SourceError(f"{where}: {name}= is not for ?{key}=; leave it out")

    def _topics(self, key: str, names: str) -> ScanTopics:
        topics = names.split(",")
        for topic in topics:
            check_topic(self._file, topic, TOPICS[key], key)
        found = ScanTopics(self._file, topics, self._options.range_max)
        if len(topics) > 1 and (len(set(topics)) < len(topics) or self._options.mount or not all(found.frame_ids)):
            said = "several topics must differ, name their frames and have their mounts in /tf"
            raise SourceError(f"{self._file.path}: ?{key}={names}: {said}; give one of them")
        return found

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a bag with an option for clouds, scans or ranges."""
        file = file_part(where)
        asked = [word.partition("=")[0] for word in where[len(file) :].lstrip("?").split("&")]
        return bool(set(asked) & set(TOPICS)) and bool(suffix_of(file))

    def __len__(self) -> int:
        return len(self._scans)

    def stamp_ns(self, i: int) -> int:
        """Return the time at which cloud `i` was recorded."""
        return self._scans.recorded_ns(i)

    def file(self, i: int) -> str:
        """Return its message."""
        return self._scans.name(i)

    def cloud(self, i: int) -> Cloud | Range:
        """Return cloud `i`, deskewed if its points have times; of a topic of ranges, the range."""
        message = self._scans.read(i)
        pose_at = partial(self._pose_at, message.frame_id)
        T = pose_at(message.stamp_ns)
        if isinstance(message, RangeReading):
            found = range_of_reading(message, self._options.sigma, self._options.silence_clears)
        elif isinstance(message, LaserScan):
            found = cloud_of_scan(message, self._options)
        else:
            found = Cloud(message.points, T, lidar=self.lidar)
        found = replace(
            found, T_world_sensor=T, stamp_ns=message.stamp_ns, name=self.file(i), sensor=self._scans.topic_of(i),
            pose_off_ns=self._off_ns(message.frame_id, message.stamp_ns),
        )  # fmt: skip
        if isinstance(found, Range):
            return found
        times = None
        if isinstance(message, PointCloud) and self._options.deskew:
            if message.fault:
                detail = f"{self.file(i)}: {message.fault}; add ?deskew=0 for clouds measured at once"
                raise FrameRefused("no_pose", detail)
            times = message.times_s
        return found if times is None else deskewed(found, times, pose_at)

    def blank(self) -> Cloud | Range:
        """Return a cloud, or of a topic of ranges one of these, without values and pose."""
        return Range(nan, np.full((4, 4), np.nan)) if self._options.range else super().blank()

    def _pose_at(self, frame_id: str, stamp_ns: int) -> np.ndarray:
        """Return the pose of a sensor that publishes on the topic; a topic may carry those of several sensors."""
        found = self._poses
        if found is None:
            raise FrameRefused("no_pose", self._missing)
        if isinstance(found, TurnedTf) and not self._options.mount:
            return replace(found, poses=found.poses.of(frame_id)).at(stamp_ns)
        if frame_id != self._scans.frame_id:
            said = f"this cloud is in frame '{frame_id}', the poses are those of '{self._scans.frame_id}'"
            raise FrameRefused("no_pose", f"{self._scans.topics[0]}: {said}; record /tf_static, or leave it out")
        return found.at(stamp_ns) @ self._T_body_lidar

    def _off_ns(self, frame_id: str, stamp_ns: int) -> int:
        if not isinstance(self._poses, TurnedTf):
            return 0
        return self._poses.poses.of(frame_id).off_ns(stamp_ns)

    def _refuse_world(self) -> None:
        """Raise SourceError for clouds in the world's own frame although robots move in it: nobody knows where their
        rays began.
        """
        if not isinstance(self._poses, TurnedTf):
            return
        tf, world = self._poses.poses.tf, self._poses.poses.world
        moving = next((name for name in tf.frames if tf.connected(world, name) and tf.moving(world, name)), None)
        if self._poses.poses.edge is not None or not moving:
            return
        for topic, body in zip(self._scans.topics, self._scans.frame_ids, strict=True):
            if not tf.moving(world, body):
                said = f"{topic} is in frame '{body}', in which {moving} moves, so its rays have no origin"
                raise SourceError(f"{self._file.path}: {said}; name the lidar's own topic")


def range_of_reading(reading: RangeReading, sigma: float = 0.0, silence_clears: bool = False) -> Range:
    """Return a reading as a range, without a pose.

    Args:
        reading: The reading. Without a field of view it has the usual cone of a `RangeSensor`.
        sigma: Standard deviation in metres; 0: the reading's, else the usual one.
        silence_clears: As in `RangeSensor`.
    """
    usual = RangeSensor()
    least = reading.range_min if reading.range_min < reading.range_max else 0.0  # a sensor of a fixed distance
    beam = RangeSensor(
        sigma or reading.sigma or usual.sigma, least, reading.range_max, reading.beam or usual.beam, silence_clears
    )
    return Range(reading.distance, np.full((4, 4), np.nan), reading.stamp_ns, beam)


def cloud_of_scan(scan: LaserScan, options: LidarOptions | None = None) -> Cloud:
    """Return a 2-D scan as a cloud in its own plane, without a pose.

    Args:
        scan: The scan; +inf is nothing up to `range_max`, less four sigma: nearer surfaces may be measured beyond it.
        options: The noise of its ranges.
    """
    angles = scan.angle_min + scan.angle_step * np.arange(len(scan.ranges))
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    hit, free = np.isfinite(scan.ranges), scan.ranges == inf
    lidar = replace((options or LidarOptions()).lidar, range_min=scan.range_min, range_max=scan.range_max)
    return Cloud(
        directions[hit] * scan.ranges[hit, None].astype(float), np.full((4, 4), np.nan), scan.stamp_ns, lidar,
        clear=directions[free] * max(scan.range_max - REACH_SIGMA * lidar.sigma, 0.0),
    )  # fmt: skip
