# SPDX-License-Identifier: Apache-2.0
"""Depth images packed into one file: ScanNet's `.sens` and SLAMBench's `.raw`; read frame by frame."""

from __future__ import annotations

import os
import struct
import zlib
from abc import abstractmethod
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from stereovox.cameras.pinhole import MAX_PIXELS
from stereovox.errors import FrameRefused, NoPoses, SourceError
from stereovox.geometry.se3 import Transform
from stereovox.sources.calibration.camera_file import FoundCamera, find_camera, pinhole
from stereovox.sources.calibration.intrinsics import Intrinsics, metres_per_unit
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.depth_files import Depth
from stereovox.sources.rgbd.folder import SECOND, DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.layouts.icl_nuim import INTRINSICS
from stereovox.sources.rgbd.layouts.icl_nuim import POSES as ICL_POSES
from stereovox.sources.rgbd.pose_files import ImagePoses, read_poses

VERSION, MAX_NAME = 4, 1 << 12
RAW, ZLIB = 0, 1
DEPTH_CODES = {RAW: "raw", ZLIB: "zlib", 2: "occi"}
FRAME = struct.Struct("<16f4Q")
"""camera to world, times of colour and depth, bytes of colour and depth."""
MAX_FRAMES = 1_000_000


class Piece(NamedTuple):
    """A frame in a file: offset and length of its depth, and its pose (4, 4), or None if the file has none."""

    offset: int
    length: int
    T_world_camera: Transform | None


class SensHeader(NamedTuple):
    """Header of a `.sens` file.

    intrinsics: the depth camera's. size: (width, height) of depth. code: see `DEPTH_CODES`. scale: metres per unit.
    frames: their number. start: offset of the first.
    """

    intrinsics: Intrinsics
    size: tuple[int, int]
    code: int
    scale: float
    frames: int
    start: int


class PackedDepth(DepthFolder):
    """Depth images in one file; times are number / 30 Hz.

    Raises SourceError for any other file. A truncated file gives its whole frames, with a note.
    """

    _size: tuple[int, int]
    _pieces: list[Piece]

    def list_images(self) -> list[ImageFile]:
        """Return the file once for each image in it."""
        self.file = self.find_file(self.folder)
        self._pieces = self.index()
        return [ImageFile(self.file, int(i * SECOND / self.fps)) for i in range(len(self._pieces))]

    @classmethod
    def find_file(cls, path: Path) -> Path:
        """Return the packed file."""
        return path

    @abstractmethod
    def index(self) -> list[Piece]:
        """Return the positions of the frames, and set `_size`; raises SourceError."""

    def numbers(self) -> list[int]:
        """Return the numbers of the images in the file."""
        return list(range(len(self)))

    def size(self) -> tuple[int, int]:
        """Return (width, height) of the images."""
        return self._size

    def pose_in_file(self, i: int) -> Transform:
        """Return the pose as in the file; raises FrameRefused `no_pose`."""
        T = self._pieces[i].T_world_camera
        if self._poses is not None:
            return super().pose_in_file(i)
        if T is None or not np.isfinite(T).all():
            raise FrameRefused("no_pose", f"{self.file}: tracking was lost in frame {i}; leave it out")
        return T

    def read(self, i: int) -> Depth:
        """Return the depth image (height, width) uint16 of frame `i`; raises FrameRefused `unreadable`."""
        piece = self._pieces[i]
        try:
            with self.file.open("rb") as file:
                file.seek(piece.offset)
                data = self.unpacked(file.read(piece.length))
        except (OSError, zlib.error) as error:
            raise FrameRefused("unreadable", f"{self.file}: frame {i}: {error}; copy it again") from None
        width, height = self._size
        if len(data) != 2 * width * height:
            raise FrameRefused("unreadable", f"{self.file}: frame {i} has {len(data)} bytes of depth; copy it again")
        return np.frombuffer(data, "<u2").reshape(height, width).astype(np.uint16)

    def unpacked(self, data: bytes) -> bytes:
        """Return the bytes of a depth image; raises zlib.error."""
        return data

    def poses_beside(self, missing: str) -> Poses | ImagePoses:
        """Return the poses of the `.freiburg` of the same name next to the file, or of the only one there.

        Raises NoPoses with the text `missing` if there is none.
        """
        beside = sorted(self.file.parent.glob(ICL_POSES))
        same = [path for path in beside if path.name.startswith(self.file.stem)] or beside
        if len(same) != 1:
            raise NoPoses(f"{self.file}: {missing}")
        return self.fitted(read_poses(same[0]))


class SensFile(PackedDepth):
    """A ScanNet `.sens` file, or a folder with one: depth raw or zlib, camera to world for each frame.

    Camera and unit are its header's (its extrinsics are not used, as in ScanNet's own reader). World:
    the poses', z up only after ScanNet's alignment. Frames in which tracking was lost (-inf): `no_pose`.
    Raises SourceError if depth is packed as occi, which only ScanNet's program reads.
    """

    layout = "a ScanNet .sens file"
    certain = True

    @classmethod
    def find_file(cls, path: Path) -> Path:
        """Return the file, or the first `.sens` in the folder."""
        return path if path.is_file() else sorted(path.glob("*.sens"))[0]

    def index(self) -> list[Piece]:
        """Return the positions of the frames; raises SourceError."""
        try:
            with self.file.open("rb") as file:
                self._header = read_header(self.file, file)
                self._size = self._header.size
                pieces = _pieces(file, self._header, os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise SourceError(f"{self.file}: {error.strerror}; make it readable") from None
        if len(pieces) < self._header.frames:
            self.notes += (f"{self.file}: ends after {len(pieces)} of {self._header.frames} frames; copy it again",)
        return pieces

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the header."""
        return FoundCamera(pinhole(size, self._header.intrinsics, None), depth_scale=self._header.scale)

    def unpacked(self, data: bytes) -> bytes:
        """Return the bytes of a depth image; raises zlib.error."""
        if self._header.code == RAW:
            return data
        width, height = self._size
        return zlib.decompressobj().decompress(data, 2 * width * height + 1)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is named like such a file, or is a folder with one."""
        path = Path(folder_part(where))
        try:
            return path.is_file() if path.suffix.lower() == ".sens" else any(path.glob("*.sens"))
        except (OSError, ValueError):
            return False


class SlambenchRaw(PackedDepth):
    """A SLAMBench `.raw` file: for each frame width, height, uint16 mm, and again width, height, 8-bit RGB.

    Poses: `?poses=FILE`, or a `.freiburg` next to it. The scenes are ICL-NUIM's, whose poses are left-handed
    (see `icl_nuim`), and whose camera is the default for 640x480.
    """

    layout = "a SLAMBench .raw file"

    def index(self) -> list[Piece]:
        """Return the positions of the frames; raises SourceError."""
        self._size, frames, whole = _raw_layout(self.file)
        width, height = self._size
        step = 16 + 5 * width * height
        if not whole:
            self.notes += (f"{self.file}: ends within a frame, which is left out; copy it again",)
        return [Piece(i * step + 8, 2 * width * height, None) for i in range(frames)]

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses next to the file."""
        return self.poses_beside("has no poses, and there is no .freiburg next to it; add ?poses=FILE")

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of a file next to it, else ICL-NUIM's."""
        found = find_camera([self.file.parent], size, None, INTRINSICS)
        left_handed = self._poses is not None and self._poses.where.endswith(".freiburg")
        return found._replace(mirrored=left_handed or found.mirrored)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a file `.raw` whose size fits the frames declared in its first bytes."""
        path = Path(folder_part(where))
        try:
            return path.suffix.lower() == ".raw" and path.is_file() and _raw_layout(path)[1] > 0
        except (OSError, ValueError):
            return False


def read_header(path: Path, file: BinaryIO) -> SensHeader:
    """Read the header of a `.sens` file; raises SourceError with the problem."""
    try:
        version, length = struct.unpack("<IQ", file.read(12))
        if version != VERSION or length > MAX_NAME:
            raise SourceError(
                f"{path}: not a .sens file of version {VERSION}; export its images with ScanNet's SensReader"
            )
        file.seek(length, os.SEEK_CUR)
        matrices = np.array(struct.unpack("<64f", file.read(256)), float).reshape(4, 4, 4)
        _, code, _, _, width, height = struct.unpack("<2i4I", file.read(24))
        shift, frames = struct.unpack("<fQ", file.read(12))
    except struct.error:
        raise SourceError(f"{path}: ends within its header; copy it again") from None
    if code not in (RAW, ZLIB):
        packed = DEPTH_CODES.get(code, f"code {code}")
        raise SourceError(f"{path}: depth is packed as {packed}; export its images with ScanNet's SensReader")
    if not 0 < width * height <= MAX_PIXELS or frames > MAX_FRAMES or not 0 < shift < 1e6:
        raise SourceError(f"{path}: declares {frames} frames of {width}x{height}, 1/{shift:g} m; copy it again")
    depth = matrices[2]
    if not np.isfinite(depth[:2, :3]).all():
        raise SourceError(f"{path}: its camera is NaN or infinite; add ?camera=FILE")
    numbers = float(depth[0, 0]), float(depth[1, 1]), float(depth[0, 2]), float(depth[1, 2])
    return SensHeader(numbers, (width, height), code, metres_per_unit(shift), frames, file.tell())


def _pieces(file: BinaryIO, header: SensHeader, end: int) -> list[Piece]:
    found, at = [], header.start
    for _ in range(header.frames):
        file.seek(at)
        data = file.read(FRAME.size)
        if len(data) < FRAME.size:
            break
        *numbers, _, _, colour, depth = FRAME.unpack(data)
        start = at + FRAME.size + colour
        at = start + depth
        if at > end:
            break
        found.append(Piece(start, depth, np.array(numbers, float).reshape(4, 4)))
    return found


def _raw_layout(path: Path) -> tuple[tuple[int, int], int, bool]:
    """Return (width, height), the number of frames, and whether the last is whole; raises SourceError if invalid."""
    try:
        with path.open("rb") as file:
            width, height = struct.unpack("<2I", file.read(8))
            step = 16 + 5 * width * height
            end = os.fstat(file.fileno()).st_size
            file.seek(8 + 2 * width * height)
            second = file.read(8)
    except (OSError, struct.error, OverflowError, ValueError):
        raise SourceError(f"{path}: not a SLAMBench .raw file; give one written by scene2raw") from None
    if not 0 < width * height <= MAX_PIXELS or second != struct.pack("<2I", width, height):
        raise SourceError(f"{path}: not a SLAMBench .raw file; give one written by scene2raw")
    return (width, height), end // step, end % step == 0
