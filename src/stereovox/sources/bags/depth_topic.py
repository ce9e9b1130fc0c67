# SPDX-License-Identifier: Apache-2.0
"""The depth topic of a recording: images as arrays, their camera, and metadata recorded with them.

Depth in `sensor_msgs/CompressedImage`: by compressed_depth_image_transport, or 16-bit PNG by any other node.
"""

from __future__ import annotations

import math
import re
import struct
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import MAX_PIXELS, PinholeCamera
from stereovox.errors import FrameRefused, SourceError, StereovoxError, did_you_mean
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.messages import (
    CameraInfo,
    Picture,
    ns_from_ms,
    read_camera_info,
    read_compressed,
    read_image,
    read_pairs,
    read_value,
)
from stereovox.sources.bags.robot_messages import CLOUDS, frame_name
from stereovox.sources.calibration.intrinsics import scaled
from stereovox.sources.photos import DEPTH_KINDS, HEADER_BYTES, decode_depth_png, decode_rvl, header_size

PACKED = "compressedDepth"
SUFFIXES = ("/compressedDepth", "/compressed")
"""Names that image_transport appends to the topic of the plain images, the better one for depth first."""
WHOLE, FLOATS = ("16UC1", "mono16"), "32FC1"
"""Encodings of whole numbers and of metres."""
HEAD = struct.Struct("<iff")
"""What precedes the image of compressed_depth_image_transport: its format, and a, b of packed metres a / (n - b)."""


def plain_topic(topic: str) -> str:
    """Return the topic of the plain images that a topic's compressed images belong to."""
    return topic.removesuffix(SUFFIXES[0]).removesuffix(SUFFIXES[1])


def holds_depth(picture: Picture, topic: str) -> bool:
    """Return whether a compressed image is depth: it says so, or is a 16-bit PNG of a topic named after depth."""
    if PACKED in picture.encoding:
        return True
    try:
        header_size(topic, bytes(picture.data[:HEADER_BYTES]), DEPTH_KINDS)
    except FrameRefused:
        return False
    encoding = _encoding(picture)
    return encoding == WHOLE[0] or (not encoding and "depth" in topic.lower())


def decompressed(picture: Picture, size: tuple[int, int], name: str) -> tuple[NDArray[np.generic], str]:
    """Return depth (height, width) uint16 or float32 metres, NaN: no value; and its encoding.

    size: width and height of its camera. name: used in messages. Raises FrameRefused `unreadable`, `bad_dtype` or
    `bad_shape`. Formats: codec.cpp and rvl_codec.cpp of compressed_depth_image_transport.
    """
    encoding, form = _encoding(picture), picture.encoding
    if PACKED not in form and not encoding and "png" in form:
        encoding = WHOLE[0]
    if encoding not in (*WHOLE, FLOATS) or not (PACKED in form or ("png" in form and encoding != FLOATS)):
        what = f"{name}: '{picture.encoding}' is not supported"
        raise FrameRefused("bad_dtype", f"{what}; record depth as compressedDepth, 16-bit PNG or plain images")
    if PACKED not in form:
        return decode_depth_png(name, bytes(picture.data), size), encoding
    if len(picture.data) < HEAD.size:
        raise FrameRefused("unreadable", f"{name}: only {len(picture.data)} bytes; leave the frame out")
    _, a, b = HEAD.unpack_from(picture.data)
    content = bytes(picture.data[HEAD.size :])
    whole = decode_rvl(name, content, size) if "rvl" in form else decode_depth_png(name, content, size)
    if encoding != FLOATS:
        return whole, encoding
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = np.float32(a) / (whole.astype(np.float32) - np.float32(b))
    return np.where(whole > 0, metres, np.float32(np.nan)).astype(np.float32), encoding


def _encoding(picture: Picture) -> str:
    """Return the encoding of the plain image, "" if unknown."""
    encoding, _, rest = picture.encoding.partition(";")
    return encoding.strip() if rest or encoding.strip() in (*WHOLE, FLOATS) else ""


PAIRS = ("diagnostic_msgs/KeyValue", "std_msgs/String")
VALUES = ("std_msgs/Float32", "std_msgs/String")
CAMERA_INFO = "sensor_msgs/CameraInfo"
RECTIFIED = re.compile(r"(?<![a-z])rect")
"""Matches topic names such as `image_rect` and `rectified`, but not `direct`."""
REALSENSE = re.compile(r"((/device_\d+/sensor_\d+)/Depth_\d+)/image/data(/compressedDepth)?")
IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
UNITS = {"16UC1": 0.001, "mono16": 0.001, "32FC1": 1.0}
"""Encodings and their usual metres per unit (REP 118); librealsense calls its own images mono16."""
DTYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
DEPTH = ("16UC1", "32FC1")
"""Encodings of depth; mono16 counts only in RealSense files, or if the user selects its topic."""


class DepthTopic:
    """Depth images of one topic, from one camera; see `Bag`.

    frame_id: frame of the first image, "" if unknown.
    """

    def __init__(self, file: BagFile, topic: str, info: str = ""):
        self._file, self.topic = file, topic
        match = REALSENSE.fullmatch(topic)
        stream, sensor = (match[1], match[2]) if match else (None, "")
        self.camera, self.notes = find_camera(file, topic, info, stream, sensor)
        self._stamps = file.stamps(topic)
        metadata = f"{stream}/image/metadata"
        self._metadata = Metadata(file, metadata) if file.types.get(metadata) == "std_msgs/String" else None
        self._unit = option(file, sensor, "Depth Units") if sensor else None
        first = first_picture(file, topic)
        self.frame_id = first.frame_id if first and not stream else ""

    def __len__(self) -> int:
        return len(self._stamps)

    def stamp_ns(self, i: int) -> int:
        """Return the time at which image `i` was recorded."""
        return int(self._stamps[i])

    def taken_ns(self) -> list[int]:
        """Return the times of all readable images, ascending; their pixels are not decoded."""
        found = set[int]()
        for i in range(len(self)):
            with suppress(FrameRefused):
                found.add(self.time_ns(i))
        return sorted(found)

    def time_ns(self, i: int) -> int:
        """Return the time of image `i` without its pixels; raises FrameRefused if it is unreadable."""
        return self._time(i, read_picture(self._file, self.topic, i, self.topic))[0]

    def _time(self, i: int, picture: Picture) -> tuple[int, dict[str, str]]:
        """Return an image's time in nanoseconds, and its metadata."""
        info = self._metadata.at(self.stamp_ns(i)) if self._metadata else {}
        if "timestamp" in info:  # only in .db3, where the header counts from the start of the recording
            return ns_from_ms(info["timestamp"]) or picture.stamp_ns, info
        return picture.stamp_ns, info

    def image(self, i: int, name: str) -> tuple[NDArray[np.generic], int, float]:
        """Return depth (height, width) uint16 or float32, its time in nanoseconds, and metres per unit.

        Raises FrameRefused `unreadable`, `bad_dtype` or `bad_shape`, and `no_camera` for an image of another one, with
        `name` in the message.
        """
        picture = read_picture(self._file, self.topic, i, name)
        check_frame(picture.frame_id, self.frame_id, name)
        packed = self._file.types[self.topic] == COMPRESSED
        depth, encoding = decoded(picture, packed, (self.camera.width, self.camera.height), name)
        stamp_ns, info = self._time(i, picture)
        unit = picture.depth_units or _positive(info.get("depth_units", "")) or self._unit
        return depth, stamp_ns, unit or UNITS[encoding]


def check_frame(frame_id: str, expected: str, name: str) -> None:
    """Raise FrameRefused `no_camera` for an image in another frame than its topic's first one ("": unknown)."""
    if expected and frame_name(frame_id) != frame_name(expected):
        said = f"it is in frame '{frame_name(frame_id)}', the camera of its topic in '{frame_name(expected)}'"
        raise FrameRefused("no_camera", f"{name}: {said}; give each camera a topic of its own")


def find_depth(file: BagFile, topic: str = "", info: str = "") -> DepthTopic:
    """Return the depth images of `topic`, or of the only topic that has any.

    Raises SourceError if there is no such topic, none at all, or several.
    """
    for named in filter(None, (topic, info)):
        if named not in file.types:
            raise SourceError(f"{file.path}: no topic {named} with messages{did_you_mean(named, file.types)}")
    if topic and file.types[topic] not in (IMAGE, COMPRESSED):
        raise SourceError(f"{file.path}: {topic} holds {file.types[topic]}, not images; leave ?depth= out")
    found = [topic] if topic else depth_topics(file)
    if len(found) > 1:
        raise SourceError(f"{file.path}: several topics with depth, choose one: ?depth={' or ?depth='.join(found)}")
    if not found:
        seen = ", ".join(f"{name} ({kind})" for name, kind in sorted(file.types.items())[:5]) or "nothing at all"
        clouds = [f"?cloud={name}" for name, kind in sorted(file.types.items()) if kind in CLOUDS]
        grey = [
            f"?depth={name}" for name, kind in sorted(file.types.items()) if kind == IMAGE and _is_grey16(file, name)
        ]
        cure = f"; if mono16 is depth here: {' or '.join(grey)}" if grey else ""
        cure += f"; for its clouds add {' or '.join(clouds)}" if clouds else ""
        raise SourceError(f"{file.path}: no depth images ({', '.join(DEPTH)} or {PACKED}) in it; it holds {seen}{cure}")
    return DepthTopic(file, found[0], info)


def _is_grey16(file: BagFile, topic: str) -> bool:
    with suppress(FrameRefused, ValueError):
        return read_image(file.read(topic, 0)).encoding == "mono16"
    return False


def depth_topics(file: BagFile) -> list[str]:
    """Return the topics with depth images: RealSense's own if present, else by the encoding of the images."""
    realsense = sorted(filter(REALSENSE.fullmatch, file.types))
    found = realsense or sorted(topic for topic in file.types if _is_depth(file, topic))
    of_one = {plain_topic(topic): [f"{plain_topic(topic)}{suffix}" for suffix in ("", *SUFFIXES)] for topic in found}
    return [next(filter(set(found).__contains__, names)) for names in of_one.values()]


def first_picture(file: BagFile, topic: str, attempts: int = 3) -> Picture | None:
    """Return the first readable image of a topic, None if none of the first few is."""
    for i in range(min(attempts, len(file.stamps(topic)))):
        try:
            return read_picture(file, topic, i, topic)
        except FrameRefused:
            continue  # reported when it is read
    return None


def read_picture(file: BagFile, topic: str, i: int, name: str) -> Picture:
    """Return image `i` of a topic; raises FrameRefused `unreadable`."""
    wire = file.read(topic, i)
    try:
        return read_image(wire) if file.types[topic] == IMAGE else read_compressed(wire)
    except ValueError as error:
        raise FrameRefused("unreadable", f"{name}: {error}; the message is damaged, leave the frame out") from None


def decoded(picture: Picture, packed: bool, size: tuple[int, int], name: str) -> tuple[NDArray[np.generic], str]:
    """Return depth (height, width) uint16 or float32, and its encoding, one of `UNITS`.

    packed: the picture is a `CompressedImage`. size: width and height of its camera. name: used in messages. Raises
    FrameRefused `unreadable`, `bad_dtype` or `bad_shape`.
    """
    if packed:
        return decompressed(picture, size, name)
    if picture.encoding not in DTYPES:
        raise FrameRefused("bad_dtype", f"{name}: '{picture.encoding}' is not depth; it must be 16UC1 or 32FC1")
    if (picture.width, picture.height) != size:
        found, wanted = f"{picture.width}x{picture.height}", f"{size[0]}x{size[1]}"
        raise FrameRefused("bad_shape", f"{name}: {found} pixels, its camera has {wanted}; give ?info=/topic")
    return _pixels(picture, name), picture.encoding


def find_camera(
    file: BagFile, topic: str, info: str, stream: str | None, sensor: str
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of depth `topic`, and notes. `info`: its CameraInfo topic, "" to search for one.

    stream, sensor: prefixes of a RealSense stream (`/device_0/sensor_0/Depth_0`) and sensor, None and "" for others.
    Intrinsics: K, or P if the topic's name marks its images as rectified. Baseline: the sensor's, else None. Raises
    SourceError if there is no camera, or no valid one.
    """
    where = [info] if info else _places(topic, stream)
    found = next((place for place in where if place in file.types), None)
    if found is None:
        known = sorted(name for name, kind in file.types.items() if kind == CAMERA_INFO)
        say = f"give one with ?info=/topic{f' (there are: {_few(known)})' if known else ', for example of another bag'}"
        raise SourceError(f"{file.path}: no {where[0]} with the camera of {topic}; {say}")
    rectified = RECTIFIED.search(topic) is not None
    try:
        message = _read(file, found)
        millimetres = option(file, sensor, "Stereo Baseline") if sensor else None
        camera = camera_of(message, rectified, millimetres and millimetres / 1000)
    except (FrameRefused, StereovoxError, ValueError) as error:
        raise SourceError(f"{file.path}: {found}: {error}") from None
    if any(message.D) and not rectified:
        return camera, (f"{file.path}: {found} has lens distortion, which is not corrected in {topic}",)
    return camera, ()


def camera_of(info: CameraInfo, rectified: bool, baseline: float | None = None) -> PinholeCamera:
    """Return the camera of a CameraInfo message; rectified: the images are, so P counts instead of K.

    Raises StereovoxError for an invalid camera.
    """
    fx, _, cx, _, fy, cy = info.K[:6]
    if rectified and info.P[0] > 0:
        fx, cx, fy, cy = info.P[0], info.P[2], info.P[5], info.P[6]
    if not (fx > 0 and fy > 0):
        raise SourceError(
            "has no focal length (K is zero: the camera was not calibrated); name another with ?info=/topic"
        )
    left, top, height, width = info.roi
    if not (width and height):
        left, top, height, width = 0, 0, info.height, info.width
    across, down = info.binning
    if across > 1 or down > 1 or left or top:
        fx, fy, cx, cy = scaled((fx, fy, cx - left, cy - top), 1 / across, 1 / down)
    info = replace(info, width=width // across, height=height // down)
    if info.width * info.height > MAX_PIXELS:
        raise SourceError(f"has {info.width}x{info.height} pixels; correct it or name another with ?info=/topic")
    return PinholeCamera(info.width, info.height, fx, fy, cx, cy, baseline)


class Metadata:
    """Keys and values recorded at exactly the time of another topic's message; {} if there are none."""

    def __init__(self, file: BagFile, topic: str):
        self._file, self._topic = file, topic
        self._kind = file.types.get(topic, "")
        self._stamps = file.stamps(topic) if self._kind in PAIRS else np.empty(0, np.int64)

    def at(self, recorded_ns: int) -> dict[str, str]:
        """Return the pairs recorded at that time, without unreadable ones."""
        found: dict[str, str] = {}
        first, last = (int(np.searchsorted(self._stamps, recorded_ns, side)) for side in ("left", "right"))
        for i in range(first, last):
            try:
                found.update(read_pairs(self._file.read(self._topic, i), self._kind))
            except (FrameRefused, ValueError):
                continue
        return found


def option(file: BagFile, sensor: str, name: str) -> float | None:
    """Return a setting of a RealSense sensor (`/device_0/sensor_0`), for example "Depth Units"; None if not recorded.

    Spaces in the name became underscores in librealsense 2.57.
    """
    for written in (name, name.replace(" ", "_")):
        topic = f"{sensor}/option/{written}/value"
        kind = file.types.get(topic, "")
        if kind in VALUES:
            try:
                value = read_value(file.read(topic, 0), kind)
            except (FrameRefused, ValueError):
                continue
            if math.isfinite(value) and value > 0:
                return value
    return None


def sibling(topic: str, name: str) -> str:
    """Return the name of the topic `name` next to `topic`."""
    return f"{topic.rpartition('/')[0]}/{name}"


def _places(topic: str, stream: str | None) -> list[str]:
    if stream:
        return [f"{stream}/info/camera_info", f"{stream}/camera_info", f"{stream}/image/camera_info"]
    return [sibling(plain_topic(topic), "camera_info")]


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


def _few(names: list[str]) -> str:
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")


def _is_depth(file: BagFile, topic: str) -> bool:
    if file.types[topic] not in (IMAGE, COMPRESSED):
        return False
    picture = first_picture(file, topic)
    if picture is None:
        return False
    return picture.encoding in DEPTH if file.types[topic] == IMAGE else holds_depth(picture, topic)


def _pixels(picture: Picture, name: str) -> NDArray[np.generic]:
    dtype = np.dtype(DTYPES[picture.encoding]).newbyteorder(">" if picture.big_endian else "<")
    shape = picture.height, picture.width
    try:
        if picture.step < picture.width * dtype.itemsize:
            raise ValueError(f"a row of {picture.width} pixels does not fit into {picture.step} bytes")
        needed = (picture.height - 1) * picture.step + picture.width * dtype.itemsize
        if needed > len(picture.data):  # NumPy would read beyond an empty buffer
            raise ValueError(f"an image of {needed} bytes has {len(picture.data)}")
        strided = np.ndarray(shape, dtype, picture.data, strides=(picture.step, dtype.itemsize))
    except (TypeError, ValueError) as error:
        raise FrameRefused("unreadable", f"{name}: {error}; the message is damaged, leave the frame out") from None
    return strided.astype(dtype.newbyteorder("="))


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0 < value < np.inf else None
