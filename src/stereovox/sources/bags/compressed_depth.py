# SPDX-License-Identifier: Apache-2.0
"""Depth in `sensor_msgs/CompressedImage`: by compressed_depth_image_transport, or 16-bit PNG by any other node."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.sources._rvl import unpack
from stereovox.sources.bags.messages import Picture
from stereovox.sources.images import START, decode_depth_png

PACKED = "compressedDepth"
SUFFIXES = ("/compressedDepth", "/compressed")
"""Names that image_transport appends to the topic of the plain images, the better one for depth first."""
WHOLE, FLOATS = ("16UC1", "mono16"), "32FC1"
"""Encodings of whole numbers and of metres."""
HEAD = struct.Struct("<iff")
"""What precedes the image of compressed_depth_image_transport: its format, and a, b of packed metres a / (n - b)."""
SIZE = struct.Struct("<II")
"""What precedes RVL: columns and rows."""
GREY_16 = b"\x10\0"
"""Bit depth and colour type in the header of a PNG, after its width and height."""


def plain_topic(topic: str) -> str:
    """Return the topic of the plain images that a topic's compressed images belong to."""
    return topic.removesuffix(SUFFIXES[0]).removesuffix(SUFFIXES[1])


def holds_depth(picture: Picture, topic: str) -> bool:
    """Return whether a compressed image is depth: it says so, or is a 16-bit PNG of a topic named after depth."""
    encoding, form = _format(picture)
    png = bytes(picture.data[: len(START) + 10])
    is_png = png[: len(START)] == START and png[-2:] == GREY_16
    return PACKED in form or (is_png and (encoding == WHOLE[0] or (not encoding and "depth" in topic.lower())))


def decompressed(picture: Picture, size: tuple[int, int], name: str) -> tuple[NDArray[np.generic], str]:
    """Return depth (height, width) uint16 or float32 metres, NaN: no value; and its encoding.

    size: width and height of its camera. name: used in messages. Raises FrameRefused `unreadable`, `bad_dtype` or
    `bad_shape`. Formats: codec.cpp and rvl_codec.cpp of compressed_depth_image_transport.
    """
    encoding, form = _format(picture)
    if PACKED not in form and not encoding and "png" in form:
        encoding = WHOLE[0]
    if encoding not in (*WHOLE, FLOATS) or not (PACKED in form or ("png" in form and encoding != FLOATS)):
        what = f"{name}: '{picture.encoding}' is not supported"
        raise FrameRefused("bad_dtype", f"{what}; record depth as compressedDepth, 16-bit PNG or plain images")
    if PACKED not in form:
        return decode_depth_png(name, bytes(picture.data), size), encoding
    if len(picture.data) < HEAD.size + SIZE.size:
        raise FrameRefused("unreadable", f"{name}: only {len(picture.data)} bytes; leave the frame out")
    _, a, b = HEAD.unpack_from(picture.data)
    content = bytes(picture.data[HEAD.size :])
    whole = _rvl(content, size, name) if "rvl" in form else decode_depth_png(name, content, size)
    if encoding != FLOATS:
        return whole, encoding
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        metres = np.float32(a) / (whole.astype(np.float32) - np.float32(b))
    return np.where(whole > 0, metres, np.float32(np.nan)).astype(np.float32), encoding


def _format(picture: Picture) -> tuple[str, str]:
    """Return the encoding of the plain image, "" if unknown, and the whole format."""
    encoding, _, rest = picture.encoding.partition(";")
    return (encoding.strip() if rest or encoding.strip() in (*WHOLE, FLOATS) else ""), picture.encoding


def _rvl(content: bytes, size: tuple[int, int], name: str) -> NDArray[np.uint16]:
    found = SIZE.unpack_from(content)
    if found != size:
        wanted = f"{size[0]}x{size[1]}"
        raise FrameRefused("bad_shape", f"{name}: {found[0]}x{found[1]} pixels, its camera has {wanted}")
    words = np.frombuffer(content, "<u4", (len(content) - SIZE.size) // 4, SIZE.size).astype(np.int64)
    pixels = np.zeros(size[0] * size[1], np.uint16)
    if not unpack(words, pixels):
        raise FrameRefused("unreadable", f"{name}: its RVL image is damaged; leave the frame out")
    return pixels.reshape(size[1], size[0])
