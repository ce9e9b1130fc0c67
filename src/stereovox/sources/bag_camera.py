# SPDX-License-Identifier: Apache-2.0
"""The camera of a recorded depth topic."""

from __future__ import annotations

import re

from stereovox.cameras import MAX_PIXELS, PinholeCamera
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.sources.bag_files import BagFile
from stereovox.sources.bag_messages import CameraInfo, read_camera_info, read_pairs
from stereovox.sources.bag_metadata import option, sibling

CAMERA_INFO = "sensor_msgs/CameraInfo"
RECTIFIED = re.compile(r"(?<![a-z])rect")
"""In the names of topics: `image_rect`, `rectified`, but not `direct`."""


def find_camera(
    file: BagFile, topic: str, info: str, stream: str | None, sensor: str
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of depth `topic`, and notes. `info`: topic that tells it, "" to look for one.

    stream, sensor: prefixes of a RealSense stream (`/device_0/sensor_0/Depth_0`) and sensor, None and "" for others.
    Intrinsics: K, or P where the topic's name says that images are rectified. Baseline: the sensor's, else None.
    Raises SourceError where there is no camera, or no possible one.
    """
    where = [info] if info else _places(topic, stream)
    found = next((place for place in where if place in file.types), None)
    if found is None:
        known = sorted(name for name, kind in file.types.items() if kind == CAMERA_INFO)
        say = f"give one with ?info=/topic{f' (there are: {_few(known)})' if known else ', for example of another bag'}"
        raise SourceError(f"{file.path}: no {where[0]} that tells the camera of {topic}; {say}")
    rectified = RECTIFIED.search(topic) is not None
    try:
        told = _read(file, found)
        millimetres = option(file, sensor, "Stereo Baseline") if sensor else None
        camera = camera_of(told, rectified, millimetres and millimetres / 1000)
    except (FrameRefused, StereovoxError, ValueError) as error:
        raise SourceError(f"{file.path}: {found}: {error}") from None
    if any(told.D) and not rectified:
        return camera, (f"{file.path}: {found} tells of lens distortion, which is not corrected in {topic}",)
    return camera, ()


def _places(topic: str, stream: str | None) -> list[str]:
    if stream:
        return [f"{stream}/info/camera_info", f"{stream}/camera_info", f"{stream}/image/camera_info"]
    return [sibling(topic.removesuffix("/compressedDepth"), "camera_info")]


def _read(file: BagFile, topic: str) -> CameraInfo:
    if file.types[topic] == CAMERA_INFO:
        return read_camera_info(file.read(topic, 0))
    pairs = read_pairs(file.read(topic, 0), file.types[topic])
    try:
        width, height = int(pairs["width"]), int(pairs["height"])
        fx, fy, cx, cy = (float(pairs[key]) for key in ("fx", "fy", "ppx", "ppy"))
    except KeyError as error:
        raise ValueError(f"{error} is missing; name a topic of {CAMERA_INFO} with ?info=/topic") from None
    D = tuple(float(word) for word in pairs.get("coeffs", "").split(",") if word)
    return CameraInfo(width, height, (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0), D)


def camera_of(told: CameraInfo, rectified: bool, baseline: float | None = None) -> PinholeCamera:
    """Return the camera that a message tells; rectified: its images are, so that P counts and not K.

    Raises StereovoxError for one that cannot be.
    """
    fx, _, cx, _, fy, cy = told.K[:6]
    if rectified and told.P[0] > 0:
        fx, cx, fy, cy = told.P[0], told.P[2], told.P[5], told.P[6]
    if told.width * told.height > MAX_PIXELS:
        raise SourceError(f"tells of {told.width}x{told.height} pixels; correct it or name another with ?info=/topic")
    return PinholeCamera(told.width, told.height, fx, fy, cx, cy, baseline)


def _few(names: list[str]) -> str:
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
