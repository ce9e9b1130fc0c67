# SPDX-License-Identifier: Apache-2.0
"""Bounded decompression of recordings, by chunk or by message."""

from __future__ import annotations

import sys
from typing import Any

from stereovox.errors import MissingExtra

STEP = 4 * 1024 * 1024
MAX_RATIO = 1000
"""Largest ratio of decompressed to compressed bytes: recordings of real scenes never reach it."""
ALWAYS_ALLOWED = 32 * 1024 * 1024
"""Decompressed bytes that are always accepted: an empty image compresses to almost nothing."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""Magic of a zstd frame; no serialised ROS message starts with it."""


def max_unpacked(packed: int) -> int:
    """Return the largest decompressed size accepted for this many compressed bytes; more counts as an attack."""
    return max(ALWAYS_ALLOWED, MAX_RATIO * packed)


def decompress(data: bytes | memoryview, compression: str, limit: int) -> bytes:
    """Return decompressed bytes; compression: `bz2`, `lz4`, `zstd`, or "" and `none` for none.

    Raises ValueError for data that is damaged, truncated, in another format, or exceeds `limit` or `max_unpacked`,
    and MissingExtra if its library is not installed.
    """
    if compression in ("", "none"):
        return bytes(data)
    limit = min(limit, max_unpacked(len(data)))
    if compression == "zstd" and _declared_size(data) > limit:
        raise ValueError("declares an absurd size")
    parts, size, rest = [], 0, bytes(data)
    while rest and size <= limit:  # there may be several packed pieces
        unpacking = _decompressor(compression)
        while not unpacking.eof and size <= limit:  # in steps: lz4 allocates all of `max_length` at once
            parts.append(_step(unpacking, rest))
            rest = b""
            size += len(parts[-1])
            if unpacking.needs_input and not unpacking.eof:
                raise ValueError("a packed part is cut off")
        rest = unpacking.unused_data if unpacking.eof else b""
    if size > limit:
        raise ValueError("a chunk unpacks to an absurd size")
    return b"".join(parts)


def decompress_message(data: bytes, limit: int) -> bytes:
    """Return a message, decompressed if it was compressed by itself: rosbag2's mode `message`, and librealsense 2.57.

    Raises as `decompress`.
    """
    return decompress(data, "zstd", limit) if data[:4] == ZSTD else data


def _declared_size(data: bytes | memoryview) -> int:
    zstd = _zstd()
    try:
        return zstd.get_frame_info(bytes(data[:32])).decompressed_size or 0  # it may be missing
    except zstd.ZstdError as error:
        raise ValueError(f"cannot be unpacked: {error}") from None


def _step(unpacking: Any, data: bytes) -> bytes:
    try:
        return unpacking.decompress(data, max_length=STEP)
    except Exception as error:  # bz2, lz4 and zstd each have their own
        raise ValueError(f"cannot be unpacked: {error}") from None


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        import bz2

        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return _lz4().LZ4FrameDecompressor()
    if compression == "zstd":
        return _zstd().ZstdDecompressor()
    raise ValueError(f"packed with '{compression[:20]}', which is unknown")


def _lz4() -> Any:
    try:
        import lz4.frame
    except ImportError:
        raise MissingExtra("lz4", "bags") from None
    return lz4.frame


def _zstd() -> Any:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd  # comes with rosbags
    except ImportError:
        raise MissingExtra("zstd", "bags") from None
    return zstd
