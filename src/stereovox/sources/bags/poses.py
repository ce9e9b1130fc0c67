# SPDX-License-Identifier: Apache-2.0
"""Find the poses in a recording: a T265's own topic, /tf, or a topic of ordinary ROS messages."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.sources.bags.depth_topic import Metadata
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.messages import POSE_TYPES, StampedPose, ns_from_ms, read_pose
from stereovox.sources.bags.robot_messages import frame_name, is_motion
from stereovox.sources.bags.tf import Edge, TfPoses, read_tf, tf_poses
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import transforms

T265 = re.compile(r"(/device_\d+/sensor_\d+/Pose_\d+/pose)/transform/data")
"""A geometry_msgs/Transform without a time, which is in the metadata, with the confidence."""
CURE = "put poses next to it in a camera pair (pair.toml), or add ?pose=fixed for a camera that stood still"


@dataclass(frozen=True)
class FoundPoses:
    """Poses as in the file, in its axes; None, and the reason in one line, if there are none.

    tracker: they are a T265's, in OpenGL axes; of_camera: the messages identify them as the depth camera's;
    assumed: else, what is assumed about them. unmounted: they are another body's, on which nothing
    mounts the sensor.
    """

    poses: Poses | TfPoses | None
    missing: str = ""
    tracker: bool = False
    of_camera: bool = False
    assumed: str = ""
    unmounted: str = ""


def find_poses(
    file: BagFile, topic: str = "", frame_id: str = "", world_frame: str = "", chained: bool = True
) -> FoundPoses:
    """Return the poses of `topic`, else the sensor's according to /tf, else those of the only topic that has any.

    frame_id: frame of the sensor, "" to skip /tf. world_frame: see `tf.tf_poses`. chained: whether poses of another
    body (`child_frame_id`) lead to the sensor's through /tf. Raises SourceError if the named topic does not exist or
    has no poses, and if `world_frame` is not in /tf.
    """
    if topic:
        return topic_poses(file, topic, frame_id, chained)
    found, by_tf, why = pose_topics(file), None, ""
    if frame_id or world_frame:
        by_tf, why = _from_tf(file, frame_id, world_frame)
    if by_tf:
        others = f"; ?poses={' or ?poses='.join(found)} for others" if found else ""
        return FoundPoses(by_tf, assumed=f"{by_tf.where}: these poses are used{others}")
    if len(found) > 1:
        say = f"several topics with poses, choose one: ?poses={' or ?poses='.join(found)}"
        return FoundPoses(None, f"{file.path}: {say}")
    if not found:
        return FoundPoses(None, f"{why or f'{file.path}: holds no poses'}; {CURE}")
    return _read(file, found[0], frame_id, chained)


def topic_poses(file: BagFile, topic: str, frame_id: str = "", chained: bool = True) -> FoundPoses:
    """Return the poses of `topic`; raises SourceError if there is no such topic or it has no poses."""
    if topic not in file.types:
        raise SourceError(f"{file.path}: no topic {topic} with messages{did_you_mean(topic, file.types)}")
    if file.types[topic] not in POSE_TYPES:
        raise SourceError(
            f"{file.path}: {topic} holds {file.types[topic]}, not poses; name one of {_supported_types()}"
        )
    return _read(file, topic, frame_id, chained)


def _from_tf(file: BagFile, frame_id: str, world_frame: str) -> tuple[TfPoses | None, str]:
    """Return the camera's poses according to /tf, or the reason why there are none."""
    tf = read_tf(file)
    if tf is None or not frame_id:
        if world_frame:
            lacks = "no /tf" if tf is None else "no frame_id with its depth images"
            raise SourceError(f"{file.path}: has {lacks}; leave ?world_frame={world_frame} out")
        return None, ""
    found = tf_poses(tf, frame_id, world_frame)
    return (None, found) if isinstance(found, str) else (found, "")


def pose_topics(file: BagFile) -> list[str]:
    """Return the topics with poses, without mounts of a RealSense's own sensors."""
    loose = "geometry_msgs/Transform"
    return sorted(t for t, kind in file.types.items() if kind in POSE_TYPES and (kind != loose or T265.fullmatch(t)))


def _read(file: BagFile, topic: str, frame_id: str, chained: bool) -> FoundPoses:
    kind, recorded, match = file.types[topic], file.stamps(topic), T265.fullmatch(topic)
    metadata = Metadata(file, f"{match[1]}/metadata") if match else None
    stamps, numbers, confidence, parent, child = [], [], [], "", ""
    for i in range(len(recorded)):
        try:
            pose = read_pose(file.read(topic, i), kind)
        except (FrameRefused, ValueError):
            continue  # images near it will have no pose
        values = metadata.at(int(recorded[i])) if metadata else {}
        stamps.append(_stamp(pose, values, int(recorded[i])))
        numbers.append(pose.numbers)
        confidence.append(_confidence(values.get("Tracker Confidence", "")))
        parent, child = parent or pose.parent, child or pose.child
    where = f"{file.path} {topic}"
    if not stamps:
        return FoundPoses(None, f"{where}: no pose can be read; {CURE}")
    rows = np.array(numbers)
    parent, child = frame_name(parent), frame_name(child)
    if chained and child and frame_id and child != frame_name(frame_id):
        edge = Edge(parent or topic, child, topic)
        for stamp_ns, row in zip(stamps, rows, strict=True):
            if is_motion(row.tolist()):
                edge.add(stamp_ns, row)
        return _of_another_body(file, edge, frame_name(frame_id))
    faults = _mark_unusable(rows, stamps, where)
    trusted = np.array(confidence) if np.isfinite(confidence).any() else None
    with np.errstate(invalid="ignore"):
        poses = Poses(stamps, transforms(rows), trusted, where=where, faults=faults)
    what = "T265 body, as if it were the depth camera" if match else "depth camera's optical frame"
    assumed = (
        f"{where}: assumed to be poses of the {what}; set ?axes=, or make a camera pair (pair.toml), if they are not"
    )
    return FoundPoses(poses, "", bool(match), bool(child) and child == frame_name(frame_id), assumed)


def _of_another_body(file: BagFile, edge: Edge, sensor: str) -> FoundPoses:
    """Return the sensor's poses from those of a body that /tf connects with it (the robot's base)."""
    tf, where = read_tf(file), f"{file.path} {edge}"
    if tf is not None and edge.count and tf.connected(edge.child, sensor):
        said = f"{where}: these poses of {edge.child} are used, with the mount of {sensor} on it from /tf"
        return FoundPoses(TfPoses(tf, edge.parent, sensor, edge), assumed=said)
    if sensor == edge.parent:
        return FoundPoses(None, f"{where}: '{sensor}' is the world of its poses, so rays have no origin; {CURE}")
    said = f"has the poses of '{edge.child}', and nothing in /tf connects it with the sensor's frame '{sensor}'"
    return FoundPoses(None, unmounted=f"{where}: {said}")


def _stamp(pose: StampedPose, metadata: dict[str, str], recorded_ns: int) -> int:
    if pose.stamp_ns is not None:
        return pose.stamp_ns
    stamp_ns = ns_from_ms(metadata.get("frame_timestamp", ""))
    return recorded_ns if stamp_ns is None else stamp_ns


def _confidence(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _mark_unusable(rows: np.ndarray, stamps: list[int], where: str) -> dict[int, str]:
    """Replace invalid poses by NaN, and return the reasons by stamp."""
    bad = ~np.isfinite(rows).all(axis=1) | (np.linalg.norm(rows[:, 3:], axis=1) < 1e-6)
    rows[bad] = np.nan
    return {stamps[k]: f"{where}: message {k} holds no pose; leave the images near it out" for k in np.flatnonzero(bad)}


def _supported_types() -> str:
    return ", ".join(sorted(POSE_TYPES))
