# SPDX-License-Identifier: Apache-2.0
"""The node's sources of poses: /tf and odometry, a tracked camera, or localisation by a lidar."""

from __future__ import annotations

from collections.abc import Mapping
from time import monotonic
from typing import Any, Protocol

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.localize.robot_track import doubt_lines, parse_start, refused_line
from stereovox.localize.slam.pipeline import SlamResult
from stereovox.ros.inputs import CloudInput, DepthInput, FloorCloudInput, Input, RangeInput, RaysInput, ScanInput
from stereovox.ros.options import SLAM, Options, split_pair
from stereovox.ros.outputs import MapServer
from stereovox.ros.poses.localization import (
    LocalizedPoses,
    Localizer,
    LocalizingScanInput,
    Located,
    MapLocalization,
    SlamLocalization,
)
from stereovox.ros.poses.location_topics import InitialPose, Late, LocationTopics, MotionPublisher, never_late
from stereovox.ros.poses.poses import PoseBuffer
from stereovox.ros.poses.tracking import TrackedDepthInput, TrackedPoses, Tracking
from stereovox.runs.pose_choice import GIVEN, TRACK

SLAM_MAP_S = 2.0
"""Least seconds between two maps of SLAM."""
BENT = (
    "SLAM has closed a loop: /map is corrected, but earlier data of other topics stay at their old poses; "
    "call ~/reset, or save SLAM's map and localise in it (--poses MAP.yaml)"
)


class PoseSource(Protocol):
    """A source of poses.

    Attributes:
        poses: The buffer in which frames look up their poses.
        continuable: Whether the map's frame is the same in each run, so that a saved map can be continued.
    """

    poses: PoseBuffer
    continuable: bool = True

    def inputs(self, options: Options, dimensions: int) -> list[Input]:
        """Return the topics to listen to."""
        return inputs_of(options, dimensions)

    def counts(self) -> Mapping[str, object]:
        """Return the values for diagnostics."""
        return {}

    def update(self) -> None:
        """Publish what is due."""
        return

    def finish(self) -> dict[str, Any]:
        """Finish, and return figures for the report."""
        return {}


class GivenPoses(PoseSource):
    """Poses of /tf, odometry and pose topics."""

    def __init__(self, options: Options):
        self.poses = PoseBuffer(options.world_frame, options.base_frame, options.extrapolate_s)


class CameraPoses(PoseSource):
    """Poses by visual odometry of the first depth camera."""

    continuable = False

    def __init__(self, node: Any, config: Config, options: Options, late: Late):
        names = options.world_frame, options.base_frame, options.extrapolate_s
        poses = TrackedPoses(*names, base_needed=config.dimensions == 2)
        self.poses = poses
        self._tracking = Tracking(config, poses, MotionPublisher(node, options.publish_tf, late).publish)

    def inputs(self, options: Options, dimensions: int) -> list[Input]:
        """Return the topics to listen to; the first depth camera is tracked."""
        first = TrackedDepthInput(*split_pair(options.depth[0]), self._tracking)
        return [first, *inputs_of(options, dimensions)[1:]]

    def counts(self) -> Mapping[str, object]:
        """Return the values for diagnostics."""
        return self._tracking.counts()


class LidarPoses(PoseSource):
    """Poses by localisation. The map in which the robot is localised is on `/map`."""

    def __init__(self, node: Any, config: Config, options: Options, late: Late):
        self.poses = LocalizedPoses(options.world_frame, options.base_frame, options.extrapolate_s, options.odom_frame)
        self._log, self._server = node.get_logger(), MapServer(node, self.poses.world)
        self._topics = LocationTopics(node, self.poses, options, late)
        self._slam: SlamLocalization | None = None
        localization = self._slamming(config) if options.poses == SLAM else self._localising(node, config, options)
        self._localizer = Localizer(localization, self.poses, self._located, self._log.warning)
        if isinstance(localization, MapLocalization):
            InitialPose(node, self._localizer, localization)
        self.continuable = self._slam is None
        self._new, self._stamp_ns, self._next, self._bent = False, 0, 0.0, 0

    def inputs(self, options: Options, dimensions: int) -> list[Input]:
        """Return the topics to listen to; scans of the lidar come first."""
        lidar = options.lidar or options.scan[0]
        others = [one for one in inputs_of(options, dimensions) if one.topic != lidar]
        return [LocalizingScanInput(lidar, self._localizer, lidar in options.scan), *others]

    def counts(self) -> Mapping[str, object]:
        """Return the values for diagnostics."""
        bent = {"loops_that_moved": self._slam.bent} if self._slam else {}
        return {**self._localizer.counts(), **bent}

    def update(self) -> None:
        """Publish SLAM's map if it has grown."""
        if self._slam is None or not self._new or monotonic() < self._next:
            return
        self._new, self._next = False, monotonic() + SLAM_MAP_S
        try:
            grid = self._slam.grid()
        except StereovoxError as error:
            self._log.error(f"SLAM's map: {error}", throttle_duration_sec=10.0)
            return
        if grid is not None:
            self._server.show(grid, self._stamp_ns)

    def finish(self) -> dict[str, Any]:
        """Polish SLAM's map, and publish it."""
        found = {"localisation": {"scans": self._localizer.used, "refused": dict(self._localizer.refused)}}
        if line := refused_line(self._localizer.refused):
            self._log.info(f"localisation: {line}")
        result = self._slam.finish() if self._slam is not None else None
        if result is None:
            return found
        self._server.show(result.grid, self._stamp_ns)
        for line in doubt_lines(result.doubts):
            self._log.warning(line)
        return {**found, "slam": _figures(result), "slam_map": result.grid}

    def _slamming(self, config: Config) -> SlamLocalization:
        self._slam = SlamLocalization(config)
        return self._slam

    def _localising(self, node: Any, config: Config, options: Options) -> MapLocalization:
        floor = read_map_server(options.poses)
        if floor.note:
            node.get_logger().warning(f"{options.poses}: {floor.note}")
        found = MapLocalization(floor, config, parse_start(options.start, "ros.start"))
        self._server.show(floor, node.get_clock().now().nanoseconds)
        return found

    def _located(self, found: Located) -> None:
        self._topics.publish(found)
        if self._slam is not None and self._slam.bent > self._bent:
            self._bent = self._slam.bent
            self._log.warning(BENT)
        self._new, self._stamp_ns = self._new or found.moved, found.stamp_ns


def pose_source(node: Any, config: Config, options: Options, late: Late = never_late) -> PoseSource:
    """Return the source of poses. late: returns why data with a stamp are too old to publish, "" if they are not.

    Raises StereovoxError, one line, for a bad map or start, MissingExtra for gtsam.
    """
    if options.poses == GIVEN:
        return GivenPoses(options)
    return (CameraPoses if options.poses == TRACK else LidarPoses)(node, config, options, late)


def inputs_of(options: Options, dimensions: int) -> list[Input]:
    """Return the topics to map."""
    depth = [DepthInput(*split_pair(text)) for text in options.depth]
    ranges = [RangeInput(topic, options.range_sigma, options.silence_clears) for topic in options.range]
    if dimensions == 2:
        return [*depth, *ranges, *map(FloorCloudInput, options.cloud), *map(ScanInput, options.scan)]
    clouds = [CloudInput(topic, options.ranges.lidar) for topic in options.cloud]
    return [*depth, *ranges, *clouds, *(RaysInput(topic, options.ranges) for topic in options.scan)]


def _figures(result: SlamResult) -> dict[str, Any]:
    return {"closures": result.closures, "doubts": [doubt.as_dict() for doubt in result.doubts]}
