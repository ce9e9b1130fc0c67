# SPDX-License-Identifier: Apache-2.0
"""Recordings, bags and logs of robots, as `describe` reports them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.descriptions.files import Description, command_line, many, map_name, metres, picture_name, thousands
from stereovox.errors import NoPoses, StereovoxError, without_name
from stereovox.opening import is_recording, is_robot, open_images, open_robot, open_source
from stereovox.runs.survey import LEVEL_ENOUGH, TILTED, Survey, UpEstimate, survey
from stereovox.sources.bags import open_bag, suffix_of
from stereovox.sources.bags.depth_topic import depth_topics
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.recording import file_part
from stereovox.sources.bags.robot_messages import CLOUDS, POINT_CLOUD, RANGE
from stereovox.sources.bags.scans import frame_id_of
from stereovox.sources.rgbd.layouts.rtabmap_db import RtabmapDatabase
from stereovox.sources.robots.robot import Robot
from stereovox.track.tracker import POSE_FAULTS

MAX_TOPICS = 40
"""Topics of a bag that are printed."""
IN_WORDS = {"depth": "depth image", "stereo": "stereo pair", "cloud": "cloud", "range": "range"}
"""Kinds of frames in words."""
WITHOUT_IMAGES = {"cloud": "points", "range": "ranges"}
"""Kinds of frames that are no images, and what they consist of."""
MAX_RATE_HZ = 2000.0
"""Frames a second beyond which the stamps of a recording are wrong."""
MAPS_IN_BAGS = ("octomap_msgs/Octomap", "nav_msgs/OccupancyGrid", POINT_CLOUD)


def describe_recording(path: str) -> Description | None:
    """Describe a recording, a bag or a robot's log; None for anything else.

    Raises SourceError if it is damaged or lacks a part.
    """
    if suffix_of(file_part(path)) and not RtabmapDatabase.recognises(path):
        return _bag(path)
    if is_robot(path):
        with suppress(StereovoxError):  # a .log may hold anything else
            return _robot(path, open_robot(path))
    return _recording(path) if is_recording(path) else _images(path)


def _recording(path: str) -> Description:
    found = survey(open_source(path))
    return Description("recording", _survey_lines(found), survey_facts(found), survey_commands(path, found))


def _images(path: str) -> Description | None:
    """Describe depth images without poses, or None."""
    try:
        found = survey(open_images(path))  # pyrefly: ignore[bad-argument-type] - it can be read in any order
    except StereovoxError:
        return None
    missing, why, commands = _missing(path)
    facts = survey_facts(found) | {"missing": missing}
    return Description("recording", [*_survey_lines(found), *why], facts, commands)


def _missing(path: str) -> tuple[str, list[str], list[str]]:
    """Return what a folder of depth images lacks, a line about it, and commands that work without it."""
    try:
        open_source(path)
    except NoPoses as error:
        add, name = "&" if "?" in path else "?", map_name(path)
        commands = [command_line("map", path, "--out", name)]
        if "?poses=" in str(error):
            commands.append(command_line("map", f"{path}{add}poses=FILE", "--out", name))
        return str(error), [], commands
    except StereovoxError as error:
        return str(error), [f"cannot be mapped yet: {without_name(error, path)}"], []
    return "", [], []


def survey_commands(path: str, found: Survey) -> list[str]:
    """Return command lines that use a recording."""
    name = map_name(path)
    return [command_line("map", path, "--out", name), command_line("picture", name, picture_name(name))]


def survey_facts(found: Survey) -> dict[str, Any]:
    """Return the results of a survey as numbers and strings for JSON."""
    camera, up = found.camera, found.up
    return {
        "kind": "recording",
        "name": found.name,
        "frames_are": found.kind,
        "frames": found.frames,
        "seconds": found.seconds,
        "rate_hz": found.rate_hz,
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "baseline": camera.baseline,
        "looked_at": found.read,
        "faults": dict(found.faults),
        "posed": found.posed,
        "extent_m": None if found.extent_m is None else found.extent_m.round(4).tolist(),
        "depth_m": None if found.depth_m is None else found.depth_m.round(4).tolist(),
        "without_value": found.without_value,
        "unit": found.unit,
        "unit_m": found.unit_m,
        "unit_sure": found.unit_sure,
        "unit_why": found.unit_why,
        "up": None if up is None else up.axis,
        "up_direction": None if up is None else up.direction.round(4).tolist(),
        "up_sure": None if up is None else up.sure,
        "up_why": None if up is None else up.why,
        "suggested": {"max_range": found.max_range.value, "voxel_size": found.voxel_size.value},
        "notes": list(found.notes),
    }  # fmt: skip


def _survey_lines(found: Survey) -> list[str]:
    camera, frames = found.camera, many(found.frames, IN_WORDS[found.kind])
    when = "" if found.rate_hz is None else f", {found.seconds:.1f} s{_rate(found.rate_hz)}"
    if found.rate_hz is not None and found.rate_hz > MAX_RATE_HZ:
        when = f", whose stamps span {found.seconds:.3f} s, which cannot be right"
    baseline = "unknown" if camera.baseline is None else f"{camera.baseline:.4g} m"
    about = (
        f"camera: fx {camera.fx:.5g}, fy {camera.fy:.5g}, cx {camera.cx:.5g}, cy {camera.cy:.5g}, baseline {baseline}"
    )
    if found.kind in WITHOUT_IMAGES:
        lines = [f"{found.name}: {frames}{when}"]
    else:
        lines = [f"{found.name}: {frames} of {camera.width}x{camera.height}{when}", about]
    if found.unit is not None:
        noted = any(found.unit_why in note for note in found.notes)
        why = "" if noted else f" ({found.unit_why})"
        lines.append(f"depth in {found.unit}{'' if found.unit_sure else ', which is not certain'}{why}")
    if found.depth_m is not None and found.without_value is not None:
        near, middle, far = found.depth_m
        lines.append(
            f"90 % of the depths lie from {near:.2f} to {far:.2f} m, half of them below {middle:.2f} m; "
            f"{100 * found.without_value:.0f} % of the {WITHOUT_IMAGES.get(found.kind, 'pixels')} have none"
        )
    lines += _pose_lines(found)
    for reason, count in found.faults.most_common():
        if reason in POSE_FAULTS and not found.posed:  # reported above
            continue
        lines.append(f"{count} of {found.read} sampled frames cannot be used: {reason}")
    if found.posed:
        lines.append(
            f"mapped by default with depth up to {found.max_range.value:g} m ({found.max_range.why}) and cells of "
            f"{found.voxel_size.value:g} m; else give --max-range, --voxel-size"
        )
    return [*lines, *(f"note: {note}" for note in found.notes)]


def _pose_lines(found: Survey) -> list[str]:
    if found.kind in WITHOUT_IMAGES and not found.posed:
        return [f"no sampled frame has a pose, and {found.kind}s cannot be tracked"]
    if not found.posed or found.extent_m is None:
        return ["no sampled frame has a pose: map tracks the camera by visual odometry, as track does"]
    share = "all" if found.posed == found.read else f"{found.posed} of {found.read}"
    return [
        f"{share} sampled frames have poses; the sensor moves within {metres(found.extent_m)}",
        *([] if found.up is None else [_up_line(found.up)]),
    ]


def _up_line(up: UpEstimate) -> str:
    if not up.sure:
        return f"the up direction is not certain, perhaps {up.axis} ({up.why})"
    tilted = f"; {TILTED}" if up.off > LEVEL_ENOUGH else ""
    return f"{up.words} ({up.why}){tilted}"


def _rate(rate_hz: float | None) -> str:
    """Return the rate in words if the stamps can be right."""
    return "" if rate_hz is None or rate_hz > MAX_RATE_HZ else f", {rate_hz:.3g} a second"


def _robot(path: str, robot: Robot) -> Description:
    lines, facts = robot_lines(robot)
    out = map_name(path, ".yaml")
    commands = [command_line("slam", path, "--out", out)] if len(robot.scans) else []
    if len(robot.frames) or "extent_m" in facts:  # its poses are known
        commands.append(command_line("grid", path, "--out", out))
    commands = [*commands, command_line("picture", out, picture_name(out))]
    return Description("robot", lines, {"kind": "robot", **facts}, commands)


def robot_lines(robot: Robot) -> tuple[list[str], dict[str, Any]]:
    """Return lines and facts about a robot's recording."""
    lines, facts = [], {"name": robot.name, "scans": len(robot.scans), "depth_images": len(robot.frames)}
    if len(robot.scans):
        first, last = robot.scans[0], robot.scans[len(robot.scans) - 1]
        seconds, wide = (
            (last.stamp_ns - first.stamp_ns) / 1e9,
            np.degrees(abs(np.ptp(first.angles))) if len(first.ranges) else 0,
        )
        facts |= {"seconds": seconds, "beams": len(first.ranges), "range_max": float(first.range_max)}
        rate = _rate((len(robot.scans) - 1) / seconds if seconds > 0 else None)
        lines.append(f"{robot.name}: {many(len(robot.scans), 'scan')} in {seconds:.1f} s{rate}")
        lines.append(f"scans of {len(first.ranges)} beams over {wide:.0f} degrees, up to {first.range_max:g} m")
        positions = [scan.pose_world_base[:2] for scan in robot.scans[:: max(1, len(robot.scans) // 200)]]
        moved = np.array([place for place in positions if np.isfinite(place).all()])
        if len(moved) and np.ptp(moved, axis=0).any():
            facts["extent_m"] = np.ptp(moved, axis=0).round(4).tolist()
            lines.append(f"by its odometry the robot moves within {metres(np.ptp(moved, axis=0))}")
        else:
            lines.append("there is no odometry, so only stereovox slam makes a map of it")
    if len(robot.frames):
        lines.append(many(len(robot.frames), "depth image"))
    return [*lines, *(f"note: {note}" for note in robot.notes)], facts


def _bag(path: str) -> Description:
    file = open_bag(Path(file_part(path)))
    topics = _topics(file)
    spans = [topic["seconds"] for topic in topics]
    count = sum(topic["messages"] for topic in topics)
    lines = [f"a bag with {many(count, 'message')} on {many(len(topics), 'topic')}, {max(spans, default=0.0):.1f} s"]
    width = max((len(topic["topic"]) for topic in topics[:MAX_TOPICS]), default=0)
    for topic in topics[:MAX_TOPICS]:
        rate = _rate(topic["rate_hz"])
        lines.append(f"  {topic['topic']:<{width}}  {topic['type']}, {thousands(topic['messages'])}{rate}")
    if len(topics) > MAX_TOPICS:
        lines.append(f"  and {len(topics) - MAX_TOPICS} more (all with --json)")
    facts: dict[str, Any] = {"kind": "bag", "topics": topics}
    commands: list[str] = []
    for part in (_bag_depth, _bag_robot, _bag_clouds, _bag_maps):
        part(path, file, lines, facts, commands)
    if not commands:
        lines.append("no topic here makes a map: it takes depth images with poses, scans, clouds, or a map")
    return Description("bag", lines, facts, commands)


def _topics(file: BagFile) -> list[dict[str, Any]]:
    found = []
    for topic, kind in sorted(file.types.items()):
        stamps = file.stamps(topic)
        seconds = float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0
        rate = (len(stamps) - 1) / seconds if seconds > 0 else None
        found.append({"topic": topic, "type": kind, "messages": len(stamps), "seconds": seconds, "rate_hz": rate})
    return found


def _bag_depth(path: str, file: BagFile, lines: list[str], facts: dict[str, Any], commands: list[str]) -> None:
    """Add the depth images with poses, or why there is nothing to map."""
    if not any(kind in ("sensor_msgs/Image", "sensor_msgs/CompressedImage") for kind in file.types.values()):
        return
    try:
        found = survey(open_source(path))
    except StereovoxError as error:
        lines.append(f"no depth to map: {without_name(error, path)}")
        return
    facts["depth"] = survey_facts(found)
    lines += _survey_lines(found)
    commands += survey_commands(path, found)
    if not found.posed:
        lines.append("name a topic of poses with ?poses=/topic, or pair the images with a tracker's poses (pair.toml)")


def _bag_robot(path: str, file: BagFile, lines: list[str], facts: dict[str, Any], commands: list[str]) -> None:
    """Add the scans."""
    if not any(kind in ("sensor_msgs/LaserScan", "sensor_msgs/MultiEchoLaserScan") for kind in file.types.values()):
        return
    try:
        found = _robot(path, open_robot(path))
    except StereovoxError as error:
        lines.append(f"no scans to map: {without_name(error, path)}")
        return
    facts["robot"] = found.facts
    lines += found.lines
    commands += found.commands


def _bag_clouds(path: str, file: BagFile, lines: list[str], facts: dict[str, Any], commands: list[str]) -> None:
    """Add the clouds and ranges that have poses, or why they have none; not clouds made of the depth images."""
    images = {frame_id_of(file, topic) for topic in depth_topics(file)} - {""}
    kinds = {"cloud": CLOUDS, "range": (RANGE,)}
    found = {
        option: [topic for topic, kind in sorted(file.types.items()) if kind in known and len(file.stamps(topic)) > 1]
        for option, known in kinds.items()
    }  # a single cloud is a map
    wanted = [("cloud", topic) for topic in found["cloud"] if frame_id_of(file, topic) not in images]
    wanted += [("range", ",".join(found["range"]))] if found["range"] else []
    for option, topics in wanted:
        where = f"{file_part(path)}?{option}={topics}"
        try:
            surveyed = survey(open_source(where))
        except StereovoxError as error:
            lines.append(f"{topics} cannot be mapped: {without_name(error, where)}")
            continue
        facts.setdefault("clouds", {})[topics] = survey_facts(surveyed)
        lines += _survey_lines(surveyed)
        if surveyed.posed:
            name = Path(map_name(path)).stem + topics.replace("/", "_").replace(",", "") + ".svox"
            commands += [command_line("map", where, "--out", name), command_line("picture", name, picture_name(name))]
        else:
            lines.append(f"give poses: {command_line('map', f'{where}&poses=FILE', '--out', map_name(path))}")


def _bag_maps(path: str, file: BagFile, lines: list[str], facts: dict[str, Any], commands: list[str]) -> None:
    """Add the maps and clouds that can be imported."""
    for topic, kind in sorted(file.types.items()):
        is_mapped = facts.get("clouds", {}).get(topic, {}).get("posed")
        if kind in MAPS_IN_BAGS and not is_mapped:
            out = map_name(path, ".yaml" if kind == "nav_msgs/OccupancyGrid" else ".svox")
            commands.append(command_line("import", file_part(path), out, "--topic", topic))
