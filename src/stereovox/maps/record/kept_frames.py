# SPDX-License-Identifier: Apache-2.0
"""The depth images and clouds of a map, compressed without loss, so that their poses can be corrected later."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.errors import MapFileError
from stereovox.files.safe_io import read_part, zstd_size
from stereovox.frame import Cloud, Frame
from stereovox.geometry.se3 import Transform, apart
from stereovox.maps.cells import _packing
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.record.camera_path import StampedPose

LEVEL = 1
"""Level of zstd: higher ones take twice as long and save less than a twentieth of the bytes."""
SPACING_M = 0.05
"""Least metres between two kept frames once not all can be kept; a turn by twice as many radians counts too."""
SPARSEST_M = 1e6
"""If frames this far apart exceed the budget, it holds less than one frame."""
DTYPES = {"uint16": np.uint16, "float32": np.uint32, "float64": np.uint32}
"""Types of depth images, and the integers as which they are packed."""
NOWHERE = np.zeros((2, 3), np.int32)


class Bytes(Protocol):
    """Packed bytes of a frame, wherever they are."""

    @property
    def size(self) -> int:
        """Number of bytes."""
        ...

    def read(self) -> bytes:
        """Return the bytes. Raises MapFileError if they are gone or damaged."""
        ...


class InMemory(NamedTuple):
    """Bytes in memory."""

    content: bytes

    @property
    def size(self) -> int:
        """Number of bytes."""
        return len(self.content)

    def read(self) -> bytes:
        """Return the bytes."""
        return self.content


@dataclass(eq=False)
class InFile:
    """Bytes in a file of a saved map.

    Attributes:
        place: The file and the byte at which they begin; it changes when the map is saved again in its folder.
        size: Number of bytes.
        digest: Their `digest_of`.
    """

    place: tuple[Path, int]
    size: int
    digest: str

    def read(self) -> bytes:
        """Return the bytes. Raises MapFileError if they are gone or damaged."""
        file, start = place = self.place
        try:
            content = read_part(file, start, self.size)
        except OSError as error:
            if self.place != place:  # another thread has saved the map meanwhile
                return self.read()
            raise MapFileError(
                f"{file}: kept frames cannot be read ({error.strerror}); was the map saved again? reload it, "
                f"or {_give_up(file.parent)}"
            ) from None
        if digest_of(content) != self.digest:
            raise MapFileError(f"{file}: kept frames are damaged; map again, or {_give_up(file.parent)}")
        return content


class Packed(NamedTuple):
    """A depth image, packed without loss.

    dtype: of the depth. depth_bytes: how many of the bytes are depth; the rest, if any, are the reasons.
    """

    dtype: str
    depth_bytes: int
    content: Bytes
    digest: str

    @classmethod
    def of(cls, frame: Frame) -> Packed:
        """Pack depth and reasons of a valid frame."""
        depth = np.ascontiguousarray(frame.depth)
        parts = [_packed(depth)] + ([] if frame.reason is None else [_packed_reasons(frame.reason)])
        content = b"".join(parts)
        return cls(depth.dtype.name, len(parts[0]), InMemory(content), digest_of(content))

    def unpacked(self, camera: VirtualCamera) -> tuple[NDArray[np.generic], NDArray[np.uint8] | None]:
        """Return depth and reasons (height, width) as they were. Raises MapFileError if they cannot be read."""
        content, shape = self.content.read(), (camera.height, camera.width)
        try:
            depth = _unpacked(content[: self.depth_bytes], shape, np.dtype(self.dtype))
            if self.depth_bytes == len(content):
                return depth, None
            return depth, np.frombuffer(_decoded(content[self.depth_bytes :], shape[0] * shape[1]), np.uint8).reshape(
                shape
            )
        except (ValueError, RuntimeError) as error:
            raise MapFileError(f"a kept frame is damaged ({error}); map again") from None


class PackedCloud(NamedTuple):
    """A cloud, packed without loss.

    dtype: of its points. counts: number of points, rays without a point, and origins; -1 if the cloud lacks the array.
    sizes: number of bytes of each.
    """

    dtype: str
    counts: tuple[int, int, int]
    sizes: tuple[int, int, int]
    content: Bytes
    digest: str

    @classmethod
    def of(cls, cloud: Cloud) -> PackedCloud:
        """Pack a valid cloud."""
        given = cloud.points, cloud.clear, cloud.origins
        dtype = np.result_type(np.float32, *(part.dtype for part in given if part is not None))
        parts = [b"" if part is None else _packed(np.ascontiguousarray(part, dtype)) for part in given]
        content, (points, clear, origins) = b"".join(parts), (-1 if part is None else len(part) for part in given)
        sizes = len(parts[0]), len(parts[1]), len(parts[2])
        return cls(dtype.name, (points, clear, origins), sizes, InMemory(content), digest_of(content))

    def unpacked(self) -> list[NDArray[Any] | None]:
        """Return points, clear and origins as they were. Raises MapFileError if they cannot be read."""
        content, starts = self.content.read(), np.cumsum([0, *self.sizes])
        try:
            return [
                None if count < 0 else _unpacked(content[start : start + size], (count, 3), np.dtype(self.dtype))
                for count, size, start in zip(self.counts, self.sizes, starts.tolist(), strict=False)
            ]
        except (ValueError, RuntimeError) as error:
            raise MapFileError(f"a kept cloud is damaged ({error}); map again") from None


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """A frame of a map: all that is needed to map it again, from any pose.

    Attributes:
        number: How many frames the map held before it.
        sensor: Name of the sensor that took it.
        name: As in `Frame`.
        stamp_ns: As in `Frame`.
        T_world_sensor: (4, 4) float64, as given with the frame, or as corrected.
        camera: As in `Frame`; the lidar of a cloud.
        quality: The quality level that it was mapped at.
        pose_sigma: As in `Frame`.
        depth_scale: As in `Frame`.
        farthest: As in `Frame`.
        packed: Its depth image, or the cloud.
        seen: Time and exactly rigid pose of the image that was mapped.
        blocks: (2, 3) int32, lowest block with evidence and the first beyond the highest.
    """

    number: int
    sensor: str
    name: str
    stamp_ns: int
    T_world_sensor: Transform
    camera: VirtualCamera | Lidar
    quality: str
    pose_sigma: tuple[float, float]
    depth_scale: float
    farthest: float
    packed: Packed | PackedCloud
    seen: StampedPose
    blocks: NDArray[np.int32]

    def frame(self) -> Frame | Cloud:
        """Return the frame without its photo, at its present pose. Raises MapFileError if it cannot be read."""
        if isinstance(self.camera, Lidar):
            return self._cloud(self.camera)
        assert isinstance(self.packed, Packed)
        depth, reason = self.packed.unpacked(self.camera)
        return Frame(
            depth, self.camera, self.T_world_sensor, self.stamp_ns, self.depth_scale, reason, self.name,
            sensor=self.sensor, farthest=self.farthest, pose_sigma=self.pose_sigma,
        )  # fmt: skip

    def _cloud(self, lidar: Lidar) -> Cloud:
        assert isinstance(self.packed, PackedCloud)
        points, clear, origins = self.packed.unpacked()
        assert points is not None
        return Cloud(
            points, self.T_world_sensor, self.stamp_ns, lidar, origins, clear, self.name, sensor=self.sensor,
            pose_sigma=self.pose_sigma,
        )  # fmt: skip


class KeptFrames:
    """The frames of a map in the order in which they entered it.

    All are kept until they need more bytes than `budget` (None: no limit). From then on a frame is kept if its sensor
    has moved or turned by `spacing` since the last kept one; the spacing doubles whenever the budget is exceeded.

    Attributes:
        spacing: Least metres between two kept frames of a sensor; 0 while all are kept.
    """

    def __init__(self, budget: int | None = None, frames: Iterable[KeptFrame] = (), spacing: float = 0.0):
        self.budget, self.spacing = budget, spacing
        self._frames: list[KeptFrame] = []
        self._bytes, self._last = 0, {}
        self._put(list(frames))

    def __len__(self) -> int:
        return len(self._frames)

    def __deepcopy__(self, memo: object) -> KeptFrames:
        """Return an independent copy; the frames themselves never change."""
        return KeptFrames(self.budget, self._frames, self.spacing)

    @property
    def frames(self) -> Sequence[KeptFrame]:
        """The kept frames; a copy of the list."""
        return tuple(self._frames)

    @property
    def bytes(self) -> int:
        """Bytes of all kept images."""
        return self._bytes

    def are_all(self, frames: int) -> bool:
        """Return whether all of this number of frames are kept."""
        return len(self._frames) == frames

    def wants(self, sensor: str, seen: StampedPose) -> bool:
        """Return whether to keep a frame of this sensor from this pose."""
        before = self._last.get(sensor)
        return before is None or self._is_far(before, seen)

    def keep(self, frame: KeptFrame) -> None:
        """Add a frame; if that exceeds the budget, frames with similar views are dropped."""
        self._frames.append(frame)
        self._last[frame.sensor] = frame.seen
        self._bytes += frame.packed.content.size
        while self.budget is not None and self._bytes > self.budget and self.spacing < SPARSEST_M:
            self.spacing = max(2 * self.spacing, SPACING_M)
            self._put(self._thinned())

    def replace(self, frames: Sequence[KeptFrame]) -> None:
        """Replace the first frames by as many corrected ones."""
        self._put([*frames, *self._frames[len(frames) :]])

    def clear(self) -> None:
        """Drop all frames."""
        self._put([])

    def _put(self, frames: list[KeptFrame]) -> None:
        self._frames, self._bytes = frames, sum(frame.packed.content.size for frame in frames)
        self._last = {frame.sensor: frame.seen for frame in frames}

    def _is_far(self, before: StampedPose, now: StampedPose) -> bool:
        metres, angle = apart(before.pose, now.pose)
        return metres >= self.spacing or angle >= 2 * self.spacing

    def _thinned(self) -> list[KeptFrame]:
        last: dict[str, StampedPose] = {}
        kept: list[KeptFrame] = []
        for frame in self._frames:
            if frame.sensor not in last or self._is_far(last[frame.sensor], frame.seen):
                kept.append(frame)
                last[frame.sensor] = frame.seen
        return kept


def packed_of(frame: Frame | Cloud) -> Packed | PackedCloud:
    """Pack a valid frame."""
    return PackedCloud.of(frame) if isinstance(frame, Cloud) else Packed.of(frame)


def kept_frame(
    frame: Frame | Cloud,
    packed: Packed | PackedCloud,
    number: int,
    sensor: str,
    seen: StampedPose,
    quality: str,
    evidence: Evidence,
) -> KeptFrame:
    """Return a frame to be kept; arguments: as in `KeptFrame`."""
    T_world_sensor = np.array(frame.T_world_sensor, float)
    turn, shift = map(float, frame.pose_sigma)
    scale, farthest = (1.0, inf) if isinstance(frame, Cloud) else (float(frame.depth_scale), float(frame.farthest))
    return KeptFrame(
        number, sensor, frame.name, int(frame.stamp_ns), T_world_sensor, frame.camera, quality, (turn, shift), scale,
        farthest, packed, seen, blocks_seen(evidence),
    )  # fmt: skip


def blocks_seen(evidence: Evidence) -> NDArray[np.int32]:
    """Return the lowest block with evidence and the first beyond the highest (2, 3), zeros without evidence."""
    parts = [coords for coords in (evidence.coords, evidence.uniform) if len(coords)]
    if not parts:
        return NOWHERE
    low = np.min([coords.min(axis=0) for coords in parts], axis=0)
    return np.stack([low, np.max([coords.max(axis=0) for coords in parts], axis=0) + 1]).astype(np.int32)


def digest_of(content: bytes) -> str:
    """Return 24 hexadecimal digits that change if the bytes do."""
    return hashlib.blake2b(content, digest_size=12).hexdigest()


def _give_up(folder: Path) -> str:
    """Return the command by which a map with intact cells can be used without its frames."""
    words = "stereovox", "map", "RECORDING", "--out", str(folder), "--resume", "--set", "map.keep_frames=false"
    return f"drop the frames to continue or to merge: {shlex.join(words)}"


def _packed(image: NDArray[Any]) -> bytes:
    bits = _bits_of(image)
    planes = np.empty((bits.itemsize, *bits.shape), np.uint8)
    _packing.split(bits, planes)
    return _encoded(planes)


def _packed_reasons(reason: NDArray[np.uint8]) -> bytes:
    return _encoded(np.ascontiguousarray(reason))


def _unpacked(content: bytes, shape: tuple[int, int], dtype: np.dtype) -> NDArray[np.generic]:
    image = np.empty(shape, dtype)
    bits = _bits_of(image)
    planes = np.frombuffer(_decoded(content, image.nbytes), np.uint8).reshape(bits.itemsize, *bits.shape)
    _packing.join(planes, bits)
    return image


def _bits_of(image: NDArray[np.generic]) -> NDArray[np.unsignedinteger]:
    """Return a contiguous image as unsigned numbers of 16 or 32 bits, in the same memory."""
    return image.view(DTYPES[image.dtype.name])


def _encoded(array: NDArray[np.uint8]) -> bytes:
    from numcodecs.zstd import Zstd

    return bytes(Zstd(level=LEVEL).encode(array))


def _decoded(content: bytes, size: int) -> bytes:
    """Return bytes decompressed by zstd. Raises ValueError unless they are `size` bytes, and RuntimeError."""
    from numcodecs.zstd import Zstd

    if zstd_size(content[:18]) != size:
        raise ValueError(f"an image does not unpack to {size} bytes")
    return bytes(Zstd().decode(content))
