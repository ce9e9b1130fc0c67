# SPDX-License-Identifier: Apache-2.0
"""Kept frames on disk: packs of images that never change, and an index with their poses.

Files are named by a digest of their contents. So a checkpoint writes only new packs and the index; all files that the
map's manifest names exist before it does. Images are read when they are needed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.errors import StereovoxError
from stereovox.files.safe_io import count_in, json_value, read_bounded
from stereovox.frame import MAX_POINTS
from stereovox.maps.record.camera_path import FARTHEST, StampedPose
from stereovox.maps.record.health import FULL
from stereovox.maps.record.kept_frames import DTYPES, InFile, KeptFrame, KeptFrames, Packed, PackedCloud, digest_of

FRAME_FILES = r"frames-[0-9a-f]{12}|\.frames\.new"
"""Pattern of the file names; the last is a file being written."""
IN_A_PACK = 64
"""Frames in a file."""
MAX_INDEX = 1 << 29
"""Most bytes of an index; a frame takes less than a kilobyte."""
CAMERAS = {
    "pinhole": PinholeCamera,
    "spherical": SphericalCamera,
    "cylindrical": CylindricalCamera,
    "range_sensor": RangeSensor,
    "lidar": Lidar,
}
QUALITIES = (FULL, "near", "coarse")
MAX_NAME = 4096
"""Most letters of a frame's name."""


def write_frames(folder: Path, kept: KeptFrames) -> dict[str, Any]:
    """Write frames into the folder of a map, and return their entry for its manifest. Raises OSError."""
    frames, packs = kept.frames, _packs(kept)
    for name, pack in packs:
        if not _is_there(folder / name, pack):
            _write(folder, name, (frame.packed.content.read() for frame in pack))
    index = json.dumps(_index(kept.spacing, frames)).encode()
    _write(folder, _name(index), [index])
    return {"index": _name(index), "packs": [name for name, _ in packs], "frames": len(frames), "bytes": kept.bytes}


def move_frames(folder: Path, kept: KeptFrames) -> None:
    """Point frames that were read from this folder to its new files, before the files of an earlier save go."""
    home = folder.resolve()
    for name, pack in _packs(kept):
        start = 0
        for frame in pack:
            content = frame.packed.content
            if isinstance(content, InFile) and content.place[0].parent.resolve() == home:
                content.place = folder / name, start
            start += content.size


def files_of_frames(saved: Any) -> set[str]:
    """Return the names of the frame files in a manifest's entry."""
    return set() if saved is None else {str(saved["index"]), *map(str, saved["packs"])}


def read_frames(folder: Path, saved: Any, budget: int | None) -> KeptFrames | None:
    """Return the frames of a saved map; their images are read when they are needed.

    Raises KeyError, TypeError, ValueError or OSError if `write_frames` cannot have written them.
    """
    if saved is None:
        return None
    names = [_checked(name) for name in (saved["index"], *saved["packs"])]
    content = read_bounded(folder / names[0], MAX_INDEX)
    if _name(content) != names[0]:
        raise ValueError("the index of kept frames does not match its name")
    index = json_value(content)
    spacing = float(index["spacing"])
    if not 0 <= spacing < inf:
        raise ValueError(f"kept frames: invalid spacing {spacing}")
    cameras = [_camera_from(one) for one in index["cameras"]]
    return KeptFrames(budget, _frames_from([folder / name for name in names[1:]], index["frames"], cameras), spacing)


def _packs(kept: KeptFrames) -> list[tuple[str, Sequence[KeptFrame]]]:
    """Return the name of each file and its frames."""
    frames = kept.frames
    packs = [frames[start : start + IN_A_PACK] for start in range(0, len(frames), IN_A_PACK)]
    return [(_name("".join(frame.packed.digest for frame in pack).encode()), pack) for pack in packs]


def _name(content: bytes) -> str:
    return f"frames-{digest_of(content)[:12]}"


def _checked(name: Any) -> str:
    if not isinstance(name, str) or "/" in name or not name.startswith("frames-"):
        raise ValueError(f"kept frames: invalid file name '{name}'")
    return name


def _is_there(file: Path, pack: Sequence[KeptFrame]) -> bool:
    return file.is_file() and file.stat().st_size == sum(frame.packed.content.size for frame in pack)


def _write(folder: Path, name: str, parts: Iterable[bytes]) -> None:
    """Write a file so that it is whole once it has its name."""
    temporary = folder / ".frames.new"
    with temporary.open("wb") as file:
        for part in parts:
            file.write(part)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(folder / name)


def _index(spacing: float, frames: Sequence[KeptFrame]) -> dict[str, Any]:
    cameras = list(dict.fromkeys(frame.camera for frame in frames))
    number = {camera: n for n, camera in enumerate(cameras)}
    return {
        "spacing": spacing,
        "cameras": [_camera_to(camera) for camera in cameras],
        "frames": [_frame_to(frame, number[frame.camera]) for frame in frames],
    }


def _frame_to(frame: KeptFrame, camera: int) -> dict[str, Any]:
    return {
        "number": frame.number,
        "sensor": frame.sensor,
        "name": frame.name[:MAX_NAME],
        "stamp_ns": int(frame.stamp_ns),
        "T_world_sensor": np.asarray(frame.T_world_sensor, float).ravel().tolist(),
        "seen": [frame.seen.stamp_ns, list(frame.seen.pose)],
        "camera": camera,
        "quality": frame.quality,
        "pose_sigma": list(frame.pose_sigma),
        "depth_scale": float(frame.depth_scale),
        "farthest": float(frame.farthest) if isfinite(frame.farthest) else None,
        "blocks": frame.blocks.tolist(),
        "dtype": frame.packed.dtype,
        **_layout(frame.packed),
        "bytes": frame.packed.content.size,
        "digest": frame.packed.digest,
    }


def _layout(packed: Packed | PackedCloud) -> dict[str, Any]:
    """Return the layout of a frame's bytes."""
    if isinstance(packed, Packed):
        return {"depth_bytes": packed.depth_bytes}
    return {"counts": list(packed.counts), "sizes": list(packed.sizes)}


def _packed_from(saved: Any, content: InFile, camera: VirtualCamera | Lidar) -> Packed | PackedCloud:
    dtype = str(saved["dtype"])
    if dtype not in DTYPES:
        raise ValueError("a kept frame has an unknown type")
    if not isinstance(camera, Lidar):
        depth_bytes = count_in(saved, "depth_bytes")
        if not depth_bytes <= content.size:
            raise ValueError("a kept frame is larger than its file")
        return Packed(dtype, depth_bytes, content, content.digest)
    counts, sizes = ([int(number) for number in saved[key]] for key in ("counts", "sizes"))
    if len(counts) != 3 or len(sizes) != 3 or not all(-1 <= count <= MAX_POINTS for count in counts):
        raise ValueError("a kept cloud has an invalid size")
    if counts[0] < 0 or min(sizes) < 0 or sum(sizes) != content.size or dtype == "uint16":
        raise ValueError("a kept cloud does not match its bytes")
    return PackedCloud(
        dtype, (counts[0], counts[1], counts[2]), (sizes[0], sizes[1], sizes[2]), content, content.digest
    )


def _frames_from(packs: Sequence[Path], saved: Any, cameras: Sequence[VirtualCamera | Lidar]) -> Iterator[KeptFrame]:
    if len(saved) > IN_A_PACK * len(packs):
        raise ValueError(f"{len(saved)} kept frames in {len(packs)} packs")
    start, before = 0, -1
    for n, one in enumerate(saved):
        start = 0 if n % IN_A_PACK == 0 else start
        frame = _frame_from(one, cameras, packs[n // IN_A_PACK], start)
        if frame.number <= before:
            raise ValueError("kept frames are out of order")
        start, before = start + frame.packed.content.size, frame.number
        yield frame


def _frame_from(saved: Any, cameras: Sequence[VirtualCamera | Lidar], pack: Path, start: int) -> KeptFrame:
    size = count_in(saved, "bytes")
    stamp_ns, pose = saved["seen"]
    blocks = np.array(saved["blocks"], np.int32)
    if saved["quality"] not in QUALITIES:
        raise ValueError("a kept frame has an unknown quality level")
    if blocks.shape != (2, 3) or len(pose) != 12 or count_in(saved, "camera") >= len(cameras):
        raise ValueError("a kept frame has no valid pose, blocks or camera")
    turn, shift = _numbers(saved["pose_sigma"])
    content, camera = InFile((pack, start), size, str(saved["digest"])), cameras[saved["camera"]]
    return KeptFrame(
        count_in(saved, "number"), str(saved["sensor"]), str(saved["name"]), int(saved["stamp_ns"]),
        np.array(_numbers(saved["T_world_sensor"])).reshape(4, 4), camera,
        saved["quality"], (abs(turn), abs(shift)), float(saved["depth_scale"]),
        inf if saved["farthest"] is None else float(saved["farthest"]),
        _packed_from(saved, content, camera),
        StampedPose(int(stamp_ns), tuple(_numbers(pose))), blocks,
    )  # fmt: skip


def _numbers(saved: Any) -> list[float]:
    numbers = [float(number) for number in saved]
    if not all(abs(number) <= FARTHEST for number in numbers):  # False for NaN
        raise ValueError("kept frames: an invalid pose")
    return numbers


def _camera_to(camera: VirtualCamera | Lidar) -> dict[str, Any]:
    kind = next(kind for kind, one in CAMERAS.items() if isinstance(camera, one))
    numbers = asdict(camera)
    return {"kind": kind, **{key: None if value == inf else value for key, value in numbers.items()}}


def _camera_from(saved: Any) -> VirtualCamera | Lidar:
    numbers = dict(saved)
    if numbers["kind"] == "lidar" and numbers["range_max"] is None:
        numbers["range_max"] = inf
    kind = CAMERAS[numbers.pop("kind")]
    correction = numbers.pop("correction", None)
    if correction:
        numbers["correction"] = DepthCorrection(correction["model"], tuple(correction["coefficients"]))
    try:
        return kind(**numbers)
    except StereovoxError as error:
        raise ValueError(str(error)) from None
