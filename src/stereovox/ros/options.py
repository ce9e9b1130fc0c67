# SPDX-License-Identifier: Apache-2.0
"""Options of the node besides the settings of the map: topics, frames, times.

ROS parameters are settings of the map by their own names, and options of the node with the prefix `ros.`. They are read
once, at the start; only `ros.out` may be set later.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from stereovox.errors import StereovoxError, did_you_mean
from stereovox.pose_choice import GIVEN, TRACK

PREFIX = "ros."
"""Prefix of the parameters that are options of the node."""
LISTS = ("depth", "cloud", "scan", "odometry", "pose", "fixed")
POSES = (GIVEN, TRACK)
OUT = f"{PREFIX}out"
"""The parameter that may change while the node runs."""
ROS_PARAMETERS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters of rclpy itself, by name or prefix."""


@dataclass(frozen=True)
class Options:
    """Options of the command, and parameters of the node with the prefix `ros.`.

    depth: topics of depth images; `TOPIC=INFO` where the camera_info is not beside it. cloud, scan: topics.
    odometry: topics of nav_msgs/Odometry; pose: `TOPIC=FRAME`, a topic of PoseStamped and the frame whose pose it is.
    fixed: `PARENT CHILD x y z yaw pitch roll`, fixed pose of a frame in another, metres and radians.
    poses: `given`, those of tf and the topics above, or `track`, those of the first depth camera, by its own images.
    publish_tf: publish tracked poses on /tf.
    world_frame: the frame of the map; "": `map`, else `odom`, whichever is connected to the sensors first.
    base_frame: frame of the robot, on the floor, for floor maps; "": `base_footprint`, else `base_link`.
    wait_s: seconds that a frame waits for its pose. extrapolate_s: seconds by which a pose may then be extrapolated.
    late_s: a frame that has waited this long for a busy map gives way to newer ones. queue: frames that wait per topic.
    map_rate, cloud_rate: largest rate in messages a second: of the 2-D map, and of the cloud and the OctoMap.
    low, high: heights in metres between which obstacles mark the 2-D map; NaN: those of the settings.
    full_octomap: publish log-odds, not only occupied and free. cloud_step_deg: see `inputs.frame_of_cloud`.
    corrected_path: topic of nav_msgs/Path by which the map is corrected. path_frame: whose poses they are; "":
    that of the first topic. correct_jumps: spread jumps of `odom_frame` in the map over the way since the last one.
    reliable: request reliable delivery of images. out: where the map is saved; "": nowhere.
    """

    depth: tuple[str, ...] = ()
    cloud: tuple[str, ...] = ()
    scan: tuple[str, ...] = ()
    odometry: tuple[str, ...] = ()
    pose: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    poses: str = GIVEN
    publish_tf: bool = True
    world_frame: str = ""
    base_frame: str = ""
    wait_s: float = 0.5
    extrapolate_s: float = 0.1
    late_s: float = 0.1
    queue: int = 10
    map_rate: float = 30.0
    cloud_rate: float = 1.0
    low: float = math.nan
    high: float = math.nan
    full_octomap: bool = False
    cloud_step_deg: float = 1.0
    corrected_path: str = ""
    path_frame: str = ""
    correct_jumps: bool = False
    odom_frame: str = "odom"
    reliable: bool = False
    out: str = ""

    def __post_init__(self) -> None:
        if self.poses not in POSES:
            raise StereovoxError(f"{PREFIX}poses '{self.poses}': give given or track{did_you_mean(self.poses, POSES)}")
        for name in ("wait_s", "extrapolate_s", "late_s"):
            if not 0 <= getattr(self, name) <= 60:
                raise StereovoxError(f"{PREFIX}{name} {getattr(self, name):g}: give seconds, 0 to 60")
        for name in ("map_rate", "cloud_rate"):
            if not 0 < getattr(self, name) <= 1000:
                raise StereovoxError(f"{PREFIX}{name} {getattr(self, name):g}: give messages a second, above 0")
        if not 1 <= self.queue <= 1000:
            raise StereovoxError(f"{PREFIX}queue {self.queue}: give 1 to 1000 frames")
        if not 0.05 <= self.cloud_step_deg <= 10:
            raise StereovoxError(f"{PREFIX}cloud_step_deg {self.cloud_step_deg:g}: give 0.05 to 10 degrees")
        if lacking := [text for text in self.pose if not all(split_pair(text))]:
            raise StereovoxError(f"{PREFIX}pose '{lacking[0]}': write TOPIC=FRAME, the frame whose pose it is")
        if math.isnan(self.low) != math.isnan(self.high) or self.low >= self.high:
            raise StereovoxError(f"{PREFIX}low {self.low:g}, {PREFIX}high {self.high:g}: give both, the second higher")

    @property
    def heights(self) -> tuple[float, float] | None:
        """Heights in metres between which obstacles mark the 2-D map; None: those of the settings."""
        return None if math.isnan(self.low) else (self.low, self.high)

    def check_sources(self, dimensions: int) -> Options:
        """Return these options; raises StereovoxError for no input topic or one that this kind of map cannot use."""
        if not (self.depth or self.cloud or self.scan):
            raise StereovoxError("no topic to map; give --depth /camera/depth/image_rect_raw, --cloud or --scan")
        if self.poses == TRACK and not self.depth:
            raise StereovoxError("--poses track: a depth camera is tracked; give --depth, or the poses: --poses given")
        if self.poses == TRACK and (self.odometry or self.pose):
            given = "--odometry" if self.odometry else "--pose"
            topic = (self.odometry or self.pose)[0]
            raise StereovoxError(f"{given} {topic}: is not used with --poses track; leave one of them out")
        if self.scan and dimensions == 3:
            raise StereovoxError(
                f"--scan {self.scan[0]}: a 2-D lidar maps a floor; add --set dimensions=2 or --profile ist2019"
            )
        return self


def with_parameters(options: Options, given: Mapping[str, Any]) -> Options:
    """Return options overridden by parameters of the node, given by their names without `ros.`.

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
    """Split `TOPIC=OTHER` into both sides; the second is "" where there is none."""
    first, _, second = text.partition("=")
    return first.strip(), second.strip()


class Given(NamedTuple):
    """Parameters by their owner. settings: of the map, by dotted names. options: of the node, without `ros.`."""

    settings: dict[str, Any]
    options: dict[str, Any]


def given_parameters(node: Any) -> Given:
    """Return the parameters a node was started with."""
    found = Given({}, {})
    for name, parameter in node.get_parameters_by_prefix("").items():
        value = list(parameter.value) if isinstance(parameter.value, array) else parameter.value
        if name.startswith(PREFIX):
            found.options[name.removeprefix(PREFIX)] = value
        elif not name.startswith(ROS_PARAMETERS):
            found.settings[name] = value
    return found


def freeze(node: Any, out: str) -> None:
    """Declare `ros.out` and refuse changes of all other parameters from now on."""
    from rcl_interfaces.msg import SetParametersResult

    if not node.has_parameter(OUT):
        node.declare_parameter(OUT, out)

    def check(parameters: list[Any]) -> Any:
        fixed = [one.name for one in parameters if one.name != OUT and not one.name.startswith(ROS_PARAMETERS)]
        reason = f"{', '.join(fixed)}: read at the start only; start the node anew" if fixed else ""
        return SetParametersResult(successful=not fixed, reason=reason)

    node.add_on_set_parameters_callback(check)
