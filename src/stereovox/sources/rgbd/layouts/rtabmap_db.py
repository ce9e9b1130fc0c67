# SPDX-License-Identifier: Apache-2.0
"""Databases of RTAB-Map (`rtabmap.db`), version 0.11.2 and later."""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections import Counter
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError, one_line
from stereovox.geometry.se3 import Transform
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import scaled
from stereovox.sources.photos import MAX_BYTES, decode_rvl, size_text
from stereovox.sources.rgbd.depth_files import Depth, decode_depth
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses
from stereovox.sources.sqlite_file import FAULTS, SqliteFile

SQLITE = b"SQLite format 3\0"
TABLES = "Node", "Data", "Admin"
RVL = b"DEPTHRVL"
OLDEST, PACKED = (0, 11, 2), (0, 18, 0)
"""First version that is supported, and first whose calibrations are packed with their sizes."""
LOOPS = (1, 2, 3, 4)
"""Types of links that close loops."""
EXPORT = "export it with: rtabmap-export --images --poses_camera FILE.db"


class Calibration(NamedTuple):
    """Camera of a node: fx, fy, cx, cy in pixels, (width, height) or None, T_base_camera (4, 4) metres."""

    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int] | None
    T_base_camera: Transform


@dataclass(frozen=True)
class _Node:
    """A node's number, its time in nanoseconds, T_world_base (4, 4) or why it is missing, and its cameras."""

    id: int
    stamp_ns: int
    T_world_base: Transform | str
    cameras: list[Calibration]


class RtabmapDatabase(DepthFolder):
    """The depth images of a database, with the poses of its optimised graph, else of odometry.

    World: the graph's, z up. Images of several cameras next to each other become a frame each. Depth: PNG or RVL of
    16-bit millimetres, or floats in metres. Nodes outside the optimised graph have no pose. Without such a
    graph only the longest session is used, as each has its own frame, and a note reports that loops are left open.
    """

    up = "z"
    layout = "an RTAB-Map database (rtabmap.db)"
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the depth images in order of time, named by node and, for several cameras, their number."""
        self.name = self.folder.stem
        try:
            self._sqlite = SqliteFile(self.folder, TABLES, MAX_BYTES)
            self._nodes = self._read_nodes()
        except FAULTS as error:
            if isinstance(error, SourceError):
                raise SourceError(f"{self.folder}: {error}") from None
            raise SourceError(
                f"{self.folder}: {one_line(str(error))[:100]}; not a readable RTAB-Map database: {EXPORT}"
            ) from None
        self._views = [(node, k) for node in self._nodes for k in range(len(node.cameras))]
        if not self._views:
            count = self._sqlite.rows("SELECT count(*) FROM Node")[0][0]
            raise SourceError(
                f"{self.folder}: its {count} nodes hold no depth images; record with a depth camera and keep them "
                "(Mem/BinDataKept true)"
            )
        many = any(len(node.cameras) > 1 for node in self._nodes)
        names = [f"node {node.id}" + (f" camera {k}" if many else "") for node, k in self._views]
        return [
            ImageFile(self.folder / name, node.stamp_ns) for name, (node, _) in zip(names, self._views, strict=True)
        ]

    def read_poses(self) -> ImagePoses:
        """Return T_world_camera of all images."""
        found = [
            node.T_world_base
            if isinstance(node.T_world_base, str)
            else node.T_world_base @ node.cameras[k].T_base_camera
            for node, k in self._views
        ]
        return ImagePoses(found, str(self.folder))

    def numbers(self) -> list[int]:
        """Return the numbers of the nodes."""
        return [node.id for node, _ in self._views]

    def size(self) -> tuple[int, int]:
        """Return (width, height) of the images of one camera; raises SourceError if none is readable."""
        found, fault = Counter[tuple[int, int]](), "there is no image"
        for i in np.unique(np.linspace(0, len(self) - 1, 5).astype(int)).tolist():
            try:
                depth = self._depth(i)
                found[depth.shape[1], depth.shape[0]] += 1
            except FrameRefused as refused:
                fault = str(refused)
        if not found:
            raise SourceError(f"{self.folder}: none of its {len(self)} depth images can be read: {fault}")
        return found.most_common(1)[0][0]

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the first image."""
        self._size = size
        return FoundCamera(self._pinhole(0))

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i`."""
        return self.camera if self.options.camera else self._pinhole(i)

    def read(self, i: int) -> Depth:
        """Return depth image `i`; raises FrameRefused as `read_depth`."""
        depth, size = self._depth(i), (self.camera.width, self.camera.height)
        found = depth.shape[1], depth.shape[0]
        if found != size:
            raise FrameRefused(
                "bad_shape", f"{self.image(i).path}: {size_text(found)} pixels, the recording has {size_text(size)}"
            )
        return depth

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a SQLite file whose name ends in `.db`; options may follow."""
        path = folder_part(where)
        try:
            if not path.lower().endswith(".db") or not os.path.isfile(path):
                return False
            with open(path, "rb") as file:
                return file.read(len(SQLITE)) == SQLITE
        except (OSError, ValueError):
            return False

    def _read_nodes(self) -> list[_Node]:
        version = _version(self._sqlite.rows("SELECT version FROM Admin"))
        if version < OLDEST:
            raise SourceError(
                f"is from RTAB-Map {'.'.join(map(str, version))}; open it once in a newer one, or {EXPORT}"
            )
        rows = self._sqlite.rows(
            "SELECT Node.id, Node.map_id, Node.stamp, Node.pose, Data.calibration FROM Node JOIN Data "
            "ON Data.id = Node.id WHERE length(Data.depth) > 0 AND length(Data.calibration) > 0 "
            "ORDER BY Node.stamp, Node.id"
        )
        known = self._optimised(version)
        if not known:
            known, rows = self._by_odometry(rows)
        missing = f"{self.folder}: is not in the graph; leave it out"
        return [
            _Node(int(id), round(stamp * 1e9), known.get(id, missing), calibrations(blob, version))
            for id, _, stamp, _, blob in rows
        ]

    def _optimised(self, version: tuple[int, ...]) -> dict[int, Transform]:
        """Return the poses of the optimised graph by node; empty if it was not saved."""
        if version < (0, 17, 0):
            return {}
        ids, poses = next(iter(self._sqlite.rows("SELECT opt_ids, opt_poses FROM Admin")), (None, None))
        if not ids or not poses:
            return {}
        numbers, matrices = _unpacked(ids).view("<i4"), _unpacked(poses).view("<f4").reshape(-1, 12)
        return {int(n): transform(row) for n, row in zip(numbers, matrices, strict=True)}

    def _by_odometry(self, rows: list[Any]) -> tuple[dict[int, Transform], list[Any]]:
        """Return the poses of odometry by node, and the rows of the session with the most."""
        sessions = Counter(row[1] for row in rows)
        if not sessions:
            return {}, []
        session, count = sessions.most_common(1)[0]
        if count < len(rows):
            self.notes += (f"{self.folder}: {len(rows) - count} images of {len(sessions) - 1} other sessions left out",)
        loops = self._sqlite.rows(f"SELECT count(*) FROM Link WHERE type IN {LOOPS}")[0][0]
        if loops:
            self.notes += (
                f"{self.folder}: holds no optimised poses, so {loops} loop closures are not used (odometry is); "
                f"close it properly, or {EXPORT}",
            )
        rows = [row for row in rows if row[1] == session]
        return {row[0]: transform(np.frombuffer(row[3], "<f4")) for row in rows if len(row[3] or b"") == 48}, rows

    def _depth(self, i: int) -> Depth:
        """Return the part of a node's depth image that its camera took."""
        node, k = self._views[i]
        path = self.image(i).path
        try:
            content = self._sqlite.rows("SELECT depth FROM Data WHERE id = ?", node.id)[0][0]
        except FAULTS as error:
            raise FrameRefused("unreadable", f"{path}: {one_line(str(error))[:100]}; leave it out") from None
        depth = decode_rvl(path, content[len(RVL) :]) if content.startswith(RVL) else decode_depth(path, content)
        width = depth.shape[1] // len(node.cameras)
        return cast("Depth", np.ascontiguousarray(depth[:, k * width : (k + 1) * width]))

    def _pinhole(self, i: int) -> PinholeCamera:
        node, k = self._views[i]
        numbers, size, _ = node.cameras[k]
        factor = self._size[0] / size[0] if size else 1.0
        try:
            return pinhole(self._size, scaled(numbers, factor), None)
        except SourceError as error:
            raise SourceError(f"{self.folder}: node {node.id}: {error}") from None


def calibrations(blob: bytes, version: tuple[int, ...]) -> list[Calibration]:
    """Return the cameras in `Data.calibration` of a version; raises SourceError for stereo, ValueError for damage."""
    found = _packed(blob) if version >= PACKED else _floats(blob)
    if not found:
        raise ValueError(f"a calibration of {len(blob)} bytes")
    return found


def transform(numbers: NDArray[np.float32]) -> Transform:
    """Return the motion (4, 4) of 12 numbers, a 3x4 matrix row by row."""
    T = np.eye(4)
    T[:3] = numbers.reshape(3, 4)
    return T


def _packed(blob: bytes) -> list[Calibration]:
    """Return cameras packed as: 11 int32 (version, kind, size, lengths of K D R P and of the transform), then these."""
    found, at = [], 0
    while at < len(blob):
        if len(blob) < at + 44:
            raise ValueError("a truncated calibration")
        _, _, _, kind, width, height, *lengths = struct.unpack_from("<11i", blob, at)
        if kind != 0:
            raise SourceError(f"holds stereo pairs, not depth; {EXPORT}, and map these as a stereo rig")
        sound = lengths[0] in (0, 9) and lengths[3] in (0, 12) and lengths[4] in (0, 12)
        if not sound or not any((lengths[0], lengths[3])) or not all(0 <= length <= 14 for length in lengths[1:3]):
            raise ValueError("a damaged calibration")
        at += 44
        K, _, _, P = (
            np.frombuffer(blob, "<f8", length, at + 8 * sum(lengths[:n])) for n, length in enumerate(lengths[:4])
        )
        at += 8 * sum(lengths[:4])
        T = transform(np.frombuffer(blob, "<f4", 12, at)) if lengths[4] == 12 else np.eye(4)
        at += 4 * lengths[4]
        fx, fy, cx, cy = P[[0, 5, 2, 6]] if len(P) and (P[0] > 0 or not len(K)) else K[[0, 4, 2, 5]]
        size = (width, height) if width > 0 and height > 0 else None
        found.append(Calibration((float(fx), float(fy), float(cx), float(cy)), size, T))
    return found


def _floats(blob: bytes) -> list[Calibration]:
    """Return cameras of 18 float32 each: fx fy cx cy width height and the transform."""
    numbers = np.frombuffer(blob, "<f4")
    if len(numbers) == 19:
        raise SourceError(f"holds stereo pairs, not depth; {EXPORT}, and map these as a stereo rig")
    if len(numbers) % 18:
        raise ValueError(f"a calibration of {len(numbers)} numbers")
    rows = numbers.reshape(-1, 18)
    return [
        Calibration(
            (float(row[0]), float(row[1]), float(row[2]), float(row[3])),
            (int(row[4]), int(row[5])) if row[4] > 0 and row[5] > 0 else None,
            transform(row[6:]),
        )
        for row in rows
    ]


def _unpacked(blob: bytes) -> NDArray[np.uint8]:
    """Return the bytes of a matrix packed with zlib, followed by its rows, columns and type."""
    try:
        return np.frombuffer(zlib.decompressobj().decompress(blob, MAX_BYTES), np.uint8)
    except zlib.error as error:
        raise ValueError(str(error)) from None


def _version(rows: list[Any]) -> tuple[int, ...]:
    """Return the newest version in the table of versions."""
    found = [tuple(int(n) for n in re.findall(r"\d+", str(row[0]))[:3]) for row in rows]
    if not found:
        raise ValueError("it has no version")
    return max(found)
