# SPDX-License-Identifier: Apache-2.0
"""Options of the node, in addition to the settings of the map: topics, frames, times.

ROS parameters are settings of the map by their own names, and options of the node with the prefix `ros.`. They are read
once, at the start; only `ros.out` may change later.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from stereovox.cameras.lidar import USUAL_SIGMA_M
from stereovox.errors import StereovoxError, did_you_mean
from stereovox.files.safe_io import FLOOR_READABLE
from stereovox.localize.robot_track import parse_start
from stereovox.runs.pose_choice import GIVEN, TRACK
from stereovox.sources.clouds.options import LidarOptions

PREFIX = "ros."
"""Prefix of the parameters that are options of the node."""
LISTS = ("depth", "cloud", "scan", "range", "odometry", "pose", "fixed", "exclude")
SLAM = "slam"
POSES = (GIVEN, TRACK, SLAM)
OUT = f"{PREFIX}out"
"""The parameter that may change while the node runs."""
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters of rclpy itself, by name or prefix."""


@dataclass(frozen=True)
class Options:
    """Options of the command, and parameters of the node with the prefix `ros.`.

    depth: topics of depth images; `TOPIC=INFO` if the camera_info is not next to it. cloud, scan, range: topics;
    silence_clears: whether the cone of a range in which nothing was heard is free. range_sigma: standard deviation of
    ranges in metres (0: the message's, else 0.03).
    odometry: topics of nav_msgs/Odometry; pose: `TOPIC=FRAME`, a topic of PoseStamped and the frame whose pose it is.
    fixed: `PARENT CHILD x y z yaw pitch roll`, fixed pose of a frame in another, metres and radians.
    poses: `given`, from tf and the topics above; `track`, from the first depth camera by visual odometry; `slam`, by
    SLAM with the scans of `lidar`; or the `.yaml` of a map in which these scans localise the robot.
    lidar: topic of those scans; "": the first of `scan`. start: `X,Y,DEG`, first pose of the robot in the map, metres
    and degrees; "": anywhere. publish_tf: publish tracked poses, or the odometry's frame in the map, on /tf;
    tf_tolerance_s: seconds by which the latter is dated ahead.
    reference: `.yaml` of a map to compare the 2-D map with; "": the map in which the robot is localised.
    exclude: regions of it that do not count, `X0,Y0,X1,Y1` in metres. slam_out: file for SLAM's map; "": none.
    world_frame: the frame of the map; "": `map` or `odom`, whichever is connected to the sensors first.
    base_frame: frame of the robot, on the floor, for floor maps; "": `base_footprint`, else `base_link`.
    wait_s: seconds that a frame waits for its pose. extrapolate_s: seconds by which a pose may then be extrapolated.
    apart_s: seconds by which frames and poses of the same time may arrive apart at the start; more: clocks differ.
    late_s: a frame that has waited this long for a busy map yields to newer ones. queue: waiting frames per topic.
    map_rate, cloud_rate, obstacle_rate: largest rate in messages per second: of the 2-D map, of the cloud and the
    OctoMap, and of obstacles and free rays. obstacle_range: radius of those around the robot in metres; blind_m: metres
    up to which unknown cells do not end a free ray.
    low, high: metres above the floor that the robot occupies, for the 2-D map; NaN: as in the settings.
    full_octomap: publish log-odds, not only occupied and free.
    lidar_sigma: standard deviation of the ranges of clouds and scans in metres. lidar_min, lidar_max: metres below
    which their points are dropped, and beyond which they are no surfaces (0: no limit).
    corrected_path: topic of nav_msgs/Path by which the map is corrected. path_frame: frame whose poses it holds; "":
    that of the first topic. correct_jumps: spread jumps of `odom_frame` in the map over the path since the last one.
    odom_frame: frame of the odometry. reliable: request reliable delivery of images. out: file for the map; "": none.
    """

    depth: tuple[str, ...] = ()
    cloud: tuple[str, ...] = ()
    scan: tuple[str, ...] = ()
    range: tuple[str, ...] = ()
    silence_clears: bool = False
    range_sigma: float = 0.0
    odometry: tuple[str, ...] = ()
    pose: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    poses: str = GIVEN
    lidar: str = ""
    start: str = ""
    reference: str = ""
    exclude: tuple[str, ...] = ()
    slam_out: str = ""
    publish_tf: bool = True
    tf_tolerance_s: float = 0.5
    world_frame: str = ""
    base_frame: str = ""
    wait_s: float = 0.5
    extrapolate_s: float = 0.1
    apart_s: float = 0.3
    late_s: float = 0.1
    queue: int = 10
    map_rate: float = 30.0
    cloud_rate: float = 1.0
    obstacle_rate: float = 10.0
    obstacle_range: float = 5.0
    blind_m: float = 1.0
    low: float = math.nan
    high: float = math.nan
    full_octomap: bool = False
    lidar_sigma: float = USUAL_SIGMA_M
    lidar_min: float = 0.5
    lidar_max: float = 0.0
    corrected_path: str = ""
    path_frame: str = ""
    correct_jumps: bool = False
    odom_frame: str = "odom"
    reliable: bool = False
    out: str = ""

    def __post_init__(self) -> None:
        if self.poses not in POSES and not self.floor:
            known = f"give given, track, slam or the .yaml of a map{did_you_mean(self.poses, POSES)}"
            raise StereovoxError(f"{PREFIX}poses '{self.poses}': {known}")
        parse_start(self.start, f"{PREFIX}start")
        for text in self.exclude:
            region_of(text)
        for name in ("wait_s", "extrapolate_s", "apart_s", "late_s", "tf_tolerance_s"):
            if not 0 <= getattr(self, name) <= 60:
                raise StereovoxError(f"{PREFIX}{name} {getattr(self, name):g}: give seconds, 0 to 60")
        for name in ("map_rate", "cloud_rate", "obstacle_rate"):
            if not 0 < getattr(self, name) <= 1000:
                raise StereovoxError(f"{PREFIX}{name} {getattr(self, name):g}: give messages per second, above 0")
        if not 0.1 <= self.obstacle_range <= 100:
            raise StereovoxError(f"{PREFIX}obstacle_range {self.obstacle_range:g}: give metres, 0.1 to 100")
        if not 0 <= self.blind_m <= self.obstacle_range:
            raise StereovoxError(f"{PREFIX}blind_m {self.blind_m:g}: give metres, 0 to ros.obstacle_range")
        if not 1 <= self.queue <= 1000:
            raise StereovoxError(f"{PREFIX}queue {self.queue}: give 1 to 1000 frames")
        self.ranges.lidar  # noqa: B018 - its numbers are checked
        if not 0 <= self.range_sigma < math.inf:
            raise StereovoxError(f"{PREFIX}range_sigma {self.range_sigma:g}: give metres, or 0 for the message's own")
        if lacking := [text for text in self.pose if not all(split_pair(text))]:
            raise StereovoxError(f"{PREFIX}pose '{lacking[0]}': write TOPIC=FRAME, the frame whose pose it is")
        if math.isnan(self.low) != math.isnan(self.high) or self.low >= self.high:
            raise StereovoxError(f"{PREFIX}low {self.low:g}, {PREFIX}high {self.high:g}: give both, the second higher")

    @property
    def heights(self) -> tuple[float, float] | None:
        """Metres above the floor that the robot occupies, for the 2-D map; None: as in the settings."""
        return None if math.isnan(self.low) else (self.low, self.high)

    @property
    def ranges(self) -> LidarOptions:
        """The reliability of the ranges of clouds and scans."""
        return LidarOptions(self.lidar_sigma, self.lidar_min, self.lidar_max)

    @property
    def floor(self) -> str:
        """File of the map in which the robot is localised; "" for none."""
        return self.poses if Path(self.poses).suffix.lower() in FLOOR_READABLE else ""

    @property
    def localised(self) -> bool:
        """Whether the robot is localised by its lidar."""
        return self.poses == SLAM or bool(self.floor)

    def check_sources(self) -> Options:
        """Return these options; raises StereovoxError without an input topic, or if options exclude each other."""
        if not (self.depth or self.cloud or self.scan or self.range or (self.localised and self.lidar)):
            raise StereovoxError(
                "no topic to map; give --depth /camera/depth/image_rect_raw, --cloud, --scan or --range"
            )
        if self.poses == TRACK and not self.depth:
            raise StereovoxError("--poses track: it needs a depth camera; give --depth, or poses by --poses given")
        if self.poses == TRACK and (self.odometry or self.pose):
            given = "--odometry" if self.odometry else "--pose"
            topic = (self.odometry or self.pose)[0]
            raise StereovoxError(f"{given} {topic}: is not used with --poses track; leave one of them out")
        self._check_localisation()
        return self

    def _check_localisation(self) -> None:
        if self.localised and not (self.lidar or self.scan):
            raise StereovoxError(f"--poses {self.poses}: it localises the robot by scans; give --lidar /scan")
        if self.lidar and not self.localised:
            raise StereovoxError(f"--lidar {self.lidar}: is for --poses slam or MAP.yaml; to map scans, give --scan")
        if self.start and not self.floor:
            raise StereovoxError(f"--start {self.start}: is a pose in a map; give the map: --poses MAP.yaml")
        if self.slam_out and self.poses != SLAM:
            raise StereovoxError(f"--slam-out {self.slam_out}: is for SLAM's map; add --poses slam")
        if self.exclude and not (self.reference or self.floor):
            raise StereovoxError(f"--exclude {self.exclude[0]}: is for comparisons; give --reference MAP.yaml")


def region_of(text: str) -> tuple[float, float, float, float]:
    """Parse `X0,Y0,X1,Y1`, two opposite corners in metres; raises StereovoxError."""
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        x0 = y0 = x1 = y1 = math.nan
    if not all(map(math.isfinite, (x0, y0, x1, y1))):
        raise StereovoxError(f"{PREFIX}exclude '{text}': give X0,Y0,X1,Y1 in metres, two opposite corners")
    return x0, y0, x1, y1


def with_parameters(options: Options, given: Mapping[str, Any]) -> Options:
    """Return options overridden by parameters of the node, by their names without `ros.`.

    Raises StereovoxError, one line, for an unknown name or a value of the wrong type.
    """
    kinds = {field.name: field for field in fields(Options)}
    changed = {}
    for name, value in given.items():
        if name not in kinds:
            raise StereovoxError(f"unknown parameter '{PREFIX}{name}'{did_you_mean(name, kinds, PREFIX)}")
        changed[name] = _as_kind(name, value, kinds[name].default)
    return replace(options, **changed)


def _as_kind(name: str, value: Any, default: Any) -> Any:
    if name in LISTS:
        return tuple(map(str, [value] if isinstance(value, str) or not isinstance(value, Iterable) else value))
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        raise StereovoxError(f"{PREFIX}{name} {value!r}: give a {type(default).__name__}")
    return value


def split_pair(text: str) -> tuple[str, str]:
    """Split `TOPIC=OTHER` into both sides; a missing second one is ""."""
    first, _, second = text.partition("=")
    return first.strip(), second.strip()


class Given(NamedTuple):
    """Parameters by their owner. settings: of the map, by dotted names. options: of the node, without `ros.`."""

    settings: dict[str, Any]
    options: dict[str, Any]


def given_parameters(node: Any) -> Given:
    """Return the parameters with which a node was started."""
    found = Given({}, {})
    for name, parameter in node.get_parameters_by_prefix("").items():
        value = list(parameter.value) if isinstance(parameter.value, array) else parameter.value
        if name.startswith(PREFIX):
            found.options[name.removeprefix(PREFIX)] = value
        elif not name.startswith(ROS_PARAMETERS):
            found.settings[name] = value
    return found


def freeze(node: Any, out: str) -> Callable[[], None]:
    """Declare `ros.out` and refuse changes of all other parameters, until the returned function is called."""
    from rcl_interfaces.msg import SetParametersResult

    if not node.has_parameter(OUT):
        node.declare_parameter(OUT, out)

    def check(parameters: list[Any]) -> Any:
        fixed = [one.name for one in parameters if one.name != OUT and not one.name.startswith(ROS_PARAMETERS)]
        reason = f"{', '.join(fixed)}: read only at the start; restart the node" if fixed else ""
        return SetParametersResult(successful=not fixed, reason=reason)

    node.add_on_set_parameters_callback(check)
    return lambda: node.remove_on_set_parameters_callback(check)
