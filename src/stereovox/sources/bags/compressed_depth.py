# SPDX-License-Identifier: Apache-2.0
"""Depth in `sensor_msgs/CompressedImage`: by compressed_depth_image_transport, or 16-bit PNG by any other node."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.sources.bags.messages import Picture
from stereovox.sources.images import DEPTH_KINDS, HEADER_BYTES, decode_depth_png, decode_rvl, header_size

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
