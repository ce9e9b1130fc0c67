# SPDX-License-Identifier: Apache-2.0
"""Pictures in a recording taken with its depth images, by the same camera or one mounted next to it."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Photo
from stereovox.geometry.se3 import Transform
from stereovox.sources.bags.depth_topic import (
    CAMERA_INFO,
    COMPRESSED,
    IMAGE,
    RECTIFIED,
    DepthTopic,
    camera_of,
    first_picture,
    holds_depth,
    read_picture,
    sibling,
)
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.messages import Picture, read_camera_info
from stereovox.sources.bags.tf import Tf
from stereovox.sources.photos import decode_photo
from stereovox.sources.rgbd.depth_files import Undistortion

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "8UC3": 3, "mono8": 1, "8UC1": 1}
"""Encodings of pictures, and their channels; the order of colours does not matter for grey corners."""
INFRARED = re.compile(r"infra|(?<![a-z])ir(?![a-z])")
"""Topics of infrared images, which show the projected pattern: it moves with the camera."""
WITHIN_NS, RECORDED_NS = 20_000_000, 200_000_000
"""Largest distance between a picture and its depth image by their own times, and by recording times."""


class PhotoTopic:
    """Pictures of one topic.

    Attributes:
        camera: Their camera after undistortion.
        T_depth_photo: (4, 4), maps its optical frame into the depth camera's.
    """

    def __init__(self, file: BagFile, topic: str, T_depth_photo: Transform):
        info = read_camera_info(file.read(sibling(topic.removesuffix("/compressed"), "camera_info"), 0))
        rectified = RECTIFIED.search(topic) is not None
        self.camera, self.T_depth_photo = camera_of(info, rectified), T_depth_photo
        self._undistort = Undistortion(self.camera, () if rectified else info.D)
        self._file, self._topic, self._stamps = file, topic, file.stamps(topic)

    def near(self, recorded_ns: int, stamp_ns: int) -> Photo | None:
        """Return the picture recorded nearest to a depth image, None if none is near.

        Its `pixels` raise FrameRefused if its own time is not near `stamp_ns`, the depth image's.
        """
        after = int(np.searchsorted(self._stamps, recorded_ns))
        around = [k for k in (after - 1, after) if 0 <= k < len(self._stamps)]
        away = [abs(int(self._stamps[k]) - recorded_ns) for k in around]
        if not away or min(away) > RECORDED_NS:
            return None
        return Photo(partial(self._pixels, around, stamp_ns), self.camera, self.T_depth_photo)

    def _pixels(self, around: list[int], stamp_ns: int) -> NDArray[np.uint8]:
        pictures = [read_picture(self._file, self._topic, k, f"{self._topic} {k}") for k in around]
        picture = min(pictures, key=lambda one: abs(one.stamp_ns - stamp_ns))
        if abs(picture.stamp_ns - stamp_ns) > WITHIN_NS:
            raise FrameRefused("no_photo", f"{self._topic}: no picture within 20 ms of the depth image at {stamp_ns}")
        grey = pixels_of(picture, (self.camera.width, self.camera.height), self._topic)
        return self._undistort(grey)


def find_photos(file: BagFile, depth: DepthTopic, transforms: Callable[[], Tf | None]) -> PhotoTopic | None:
    """Return the pictures that depth images are registered to, else those of a camera mounted next to theirs.

    None if there are no pictures with a known camera and mount. Infrared images are left out.

    transforms: reads the transforms of the recording; called only if needed.
    """
    if not depth.frame_id:
        return None
    found = [topic for topic in sorted(file.types) if _is_photo(file, topic) and topic != depth.topic]
    frames = {topic: picture.frame_id for topic in found if (picture := first_picture(file, topic))}
    same = [topic for topic, frame in frames.items() if frame == depth.frame_id]
    try:
        if same:
            return PhotoTopic(file, same[0], np.eye(4))
        tf = transforms() if frames else None
        for topic, frame in frames.items():
            if tf is not None and tf.connected(depth.frame_id, frame) and not tf.moving(depth.frame_id, frame):
                return PhotoTopic(file, topic, tf.lookup(depth.frame_id, frame, depth.stamp_ns(0)))
    except (StereovoxError, ValueError):
        return None
    return None


def pixels_of(picture: Picture, size: tuple[int, int], name: str) -> NDArray[np.uint8]:
    """Return a picture of (width, height) = `size` as (height, width) uint8 grey or (height, width, 3) in any order.

    Raises FrameRefused: `unreadable`, `bad_shape`.
    """
    if picture.encoding not in CHANNELS:
        return decode_photo(bytes(picture.data), size, name)
    channels = CHANNELS[picture.encoding]
    rows, row = picture.height, picture.width * channels
    if (picture.width, rows) != size:
        raise FrameRefused("bad_shape", f"{name}: {picture.width}x{rows} pixels, its camera has {size[0]}x{size[1]}")
    if picture.step < row or len(picture.data) < (rows - 1) * picture.step + row:
        raise FrameRefused("unreadable", f"{name}: fewer bytes than pixels; the message is damaged")
    strides = (picture.step, channels, 1)
    image = np.ndarray((rows, picture.width, channels), np.uint8, picture.data, strides=strides)
    return np.ascontiguousarray(image[..., 0] if channels == 1 else image[..., :3])


def _is_photo(file: BagFile, topic: str) -> bool:
    """Return whether a topic holds pictures with a CameraInfo next to them."""
    info = sibling(topic.removesuffix("/compressed"), "camera_info")
    if file.types[topic] not in (IMAGE, COMPRESSED) or INFRARED.search(topic) or file.types.get(info) != CAMERA_INFO:
        return False
    picture = first_picture(file, topic)
    if picture is None:
        return False
    packed = file.types[topic] == COMPRESSED and not holds_depth(picture, topic)
    return picture.encoding in CHANNELS or packed
