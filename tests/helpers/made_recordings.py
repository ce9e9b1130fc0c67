# SPDX-License-Identifier: Apache-2.0
"""Small recordings of both layouts, and damaged images to put into them."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

SIZE = (16, 12)
"""Width, height."""
K = "20 0 7.5\n0 21 5.5\n0 0 1\n"


def depth_image(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A ramp that differs from frame to frame, with both marks of no value."""
    image = (1000 + 10 * number + np.arange(size[0] * size[1])).astype(np.uint16).reshape(size[1], size[0])
    image[0, 0], image[0, 1] = 0, 65535
    return image


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def pose(number: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = 0.1 * number, -0.2, 0.3
    return T


def seven_scenes(folder: Path, count: int = 4, intrinsics: str | None = K, size: tuple[int, int] = SIZE) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for n in range(count):
        write_png(folder / f"frame-{n:06d}.depth.png", depth_image(n, size))
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", pose(n))
    if intrinsics is not None:
        (folder / "camera-intrinsics.txt").write_text(intrinsics)
    return folder


def tum(folder: Path, stamps: list[str], groundtruth: str, listed: bool = True, intrinsics: str | None = K) -> Path:
    for n, stamp in enumerate(stamps):
        write_png(folder / "depth" / f"{stamp}.png", depth_image(n))
    if listed:
        lines = "".join(f"{stamp} depth/{stamp}.png\n" for stamp in stamps)
        (folder / "depth.txt").write_text(f"# depth maps\n# timestamp filename\n{lines}")
    (folder / "groundtruth.txt").write_text(groundtruth)
    if intrinsics is not None:
        (folder / "camera-intrinsics.txt").write_text(intrinsics)
    return folder


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bytes(width: int, height: int, bits: int = 16, colour: int = 0, rows: bytes | None = None) -> bytes:
    """A PNG with right check sums, whatever its header claims."""
    if rows is None:
        rows = (b"\0" + b"\1\2" * width) * height
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body
