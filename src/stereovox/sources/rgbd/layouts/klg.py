# SPDX-License-Identifier: Apache-2.0
"""Logs of Logger2, ElasticFusion and Kintinuous (`.klg`)."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

from stereovox.errors import SourceError
from stereovox.sources.calibration.camera_file import FoundCamera, find_camera
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.folder import ImageFile, folder_part
from stereovox.sources.rgbd.packed import MAX_FRAMES, PackedDepth, Piece
from stereovox.sources.rgbd.pose_files import ImagePoses

HEAD = struct.Struct("<qii")
"""Time in microseconds, bytes of depth and of the picture."""
SIZES = ((640, 480), (320, 240), (512, 424), (848, 480), (1280, 720))
"""Usual (width, height); a file does not contain its own."""
INTRINSICS = 528.0, 528.0, 320.0, 240.0
MOST_BYTES = 2 * max(width * height for width, height in SIZES)


class KlgLog(PackedDepth):
    """A number of frames, then for each its time, depth (uint16 mm, zlib or plain) and picture (not read).

    The size of the images follows from the bytes of the first. Poses: `?poses=FILE`, or the one `.freiburg` next to it,
    as written by ElasticFusion; world: the first camera's. Camera: a file next to it, else for 640x480 ElasticFusion's
    528 528 320 240, with a note.
    """

    layout = "a .klg log of ElasticFusion"

    def list_images(self) -> list[ImageFile]:
        """Return the file once for each image in it, with its time."""
        images = super().list_images()
        return [image._replace(stamp_ns=stamp) for image, stamp in zip(images, self._stamps, strict=True)]

    def index(self) -> list[Piece]:
        """Return the positions of the frames; raises SourceError."""
        pieces, self._stamps, end = [], [], self.file.stat().st_size
        try:
            with self.file.open("rb") as file:
                (frames,) = struct.unpack("<i", file.read(4))
                at = 4
                for _ in range(min(max(frames, 0), MAX_FRAMES)):
                    file.seek(at)
                    head = file.read(HEAD.size)
                    if len(head) < HEAD.size:
                        break
                    micros, depth, picture = HEAD.unpack(head)
                    at += HEAD.size + depth + picture
                    if depth < 0 or picture < 0 or at > end or not 0 <= micros < 2**62 // 1000:
                        break
                    self._stamps.append(micros * 1000)
                    pieces.append(Piece(at - depth - picture, depth, None))
        except (OSError, struct.error) as error:
            raise SourceError(f"{self.file}: {error}; not a .klg log, or copy it again") from None
        if not pieces:
            raise SourceError(f"{self.file}: holds no whole frame; not a .klg log, or copy it again")
        if len(pieces) < frames:
            self.notes += (f"{self.file}: ends after {len(pieces)} of {frames} frames; copy it again",)
        self._size = self._size_of(pieces[0])
        return pieces

    def unpacked(self, data: bytes) -> bytes:
        """Return the bytes of an image."""
        width, height = self._size
        return data if len(data) == 2 * width * height else zlib.decompressobj().decompress(data, MOST_BYTES)

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses next to the file."""
        return self.poses_beside(
            "a .klg log holds depth but no poses, and there is no .freiburg next to it; add ?poses=FILE (ElasticFusion "
            "writes one at its end)"
        )

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of a file next to it, else ElasticFusion's."""
        return find_camera([self.file.parent], size, None, INTRINSICS)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a file that ends in `.klg`; options may follow."""
        path = folder_part(where)
        try:
            return path.lower().endswith(".klg") and os.path.isfile(path)
        except ValueError:
            return False

    def _size_of(self, piece: Piece) -> tuple[int, int]:
        with Path(self.file).open("rb") as file:
            file.seek(piece.offset)
            data = file.read(piece.length)
        plain = {2 * width * height: (width, height) for width, height in SIZES}
        try:
            count = len(data) if len(data) in plain else len(zlib.decompressobj().decompress(data, MOST_BYTES + 1))
        except zlib.error as error:
            raise SourceError(f"{self.file}: the first depth image: {error}; copy it again") from None
        if count not in plain:
            raise SourceError(f"{self.file}: images of {count // 2} pixels; export them as 16-bit PNGs (klg2png)")
        return plain[count]
