# SPDX-License-Identifier: Apache-2.0
"""OctoMap's scan graphs (`.graph`), binary or text: scans with the poses of their sensor become cells.

Format: OctoMap 1.10, ScanGraph.cpp and Pointcloud.cpp. The edges of the graph are not needed and not read.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.config import load_config
from stereovox.depth.cloud import checked_cloud
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.safe_io import read_bounded, shown
from stereovox.formats.cell_size import suggested_cell
from stereovox.formats.points import MAX_BLOCKS
from stereovox.frame import Cloud
from stereovox.geometry.se3 import Transform, from_quaternion, transform_points
from stereovox.integrate.points import scan_evidence
from stereovox.maps import VoxelMap
from stereovox.maps.record.history import Imported

MAX_BYTES = 1 << 32
POINT = np.dtype([("size", "<i4"), ("xyz", "<f8", 3)])
POSE = struct.Struct("<i3di4d")
"""Number of the coordinates, x y z, number of the quaternion's, w x y z."""
TITLE = re.compile(rb"^NODE\b", re.MULTILINE)
SKIPPED = re.compile(r"^[# ].*$", re.MULTILINE)
"""Lines that OctoMap skips."""
SENSOR: dict[str, Any] = {"map.prior": 0.5, "map.log_odds_min": -4.0, "map.log_odds_max": 3.5}
HIT, MISS = 1386, -944
"""Log-odds in thousandths, of p = 0.8 and 0.28: one scan is enough to make a cell occupied or free."""
STEPS_OF_ANY, STEPS_A_POINT, MAX_STEPS = 1 << 19, 10_000, 1 << 31
"""Cells along all rays together: allowed for any graph, more for each of its points, and the upper limit."""
BLOCK_BYTES = 1024
MAX_PLACE = 1e9
ANY = Lidar(range_min=0.0)
"""The sensor is unknown."""


class Scan(NamedTuple):
    """T_world_sensor: (4, 4). points: (N, 3) float64 metres, in the sensor's frame; all finite."""

    T_world_sensor: Transform
    points: NDArray[np.float64]


def read_scan_graph(path: str | Path, voxel_size: float | None = None) -> VoxelMap:
    """Return the map of a scan graph: in each scan, cells with points are hit, others along the rays are missed.

    voxel_size: metres; None: a suggested one. A cell that one scan misses is free, one that it hits is occupied; if
    scans contradict each other, their log-odds add up. Raises MapFileError: one line with the file and the problem,
    also for scans that a mapper would refuse as clouds (`checked_cloud`).
    """
    try:
        return _map_of(read_scans(path), Path(path).name, voxel_size)
    except MapFileError:
        raise
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None


def read_scans(path: str | Path) -> list[Scan]:
    """Return the scans of a graph; raises MapFileError: one line with the file and the problem."""
    try:
        content = read_bounded(Path(path), MAX_BYTES)
        text = TITLE.search(content[:4096]) or content.lstrip().startswith((b"#", b"NODE"))
        scans = list(_text_scans(content) if text else _binary_scans(content))
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a scan graph") from None
    except (ValueError, OverflowError, struct.error) as error:
        why = " ".join(str(error).split())[:120]
        raise MapFileError(f"{path}: not an OctoMap scan graph, or damaged ({why}); write it again") from None
    if not sum(len(scan.points) for scan in scans):
        raise MapFileError(f"{path}: its {len(scans)} scans hold no point; write it again with its scans")
    return scans


def _map_of(scans: list[Scan], name: str, voxel_size: float | None) -> VoxelMap:
    world = [transform_points(scan.T_world_sensor, scan.points) for scan in scans]
    holds = f"OctoMap scan graph, {len(scans)} scans, {sum(map(len, world)):,} points"
    size, notes = voxel_size, ()
    if size is None:
        suggested = suggested_cell(np.concatenate(world))
        if suggested is None:
            raise StereovoxError(
                f"too few points to determine a cell size; type: stereovox import {name} MAP --voxel-size 0.05"
            )
        size = suggested.voxel_size
        notes = (f"cells of {size:g} m, {suggested.why} (--voxel-size overrides)",)
    config = load_config(voxel_size=size, **SENSOR)
    made = VoxelMap(config)
    lengths = (np.abs(points - scan.T_world_sensor[:3, 3]).sum() for scan, points in zip(scans, world, strict=True))
    steps = float(sum(lengths))
    if steps / size > min(MAX_STEPS, STEPS_OF_ANY + STEPS_A_POINT * sum(map(len, world))):
        raise StereovoxError(f"its rays cross {steps / size:.2g} cells of {size:g} m; give a larger --voxel-size")
    for number, (scan, points) in enumerate(zip(scans, world, strict=True), 1):
        if len(points):
            checked_cloud(Cloud(scan.points, scan.T_world_sensor, lidar=ANY, name=f"scan {number}"), config)
            made.add(scan_evidence(scan.T_world_sensor[:3, 3], points, size, HIT, MISS))
        if made.memory_bytes > 2 * MAX_BLOCKS * BLOCK_BYTES:
            raise StereovoxError(f"cells of {size:g} m fill more than 1 GB; give a larger --voxel-size")
    made.history.imported = Imported(name, holds, notes)
    return made


def _binary_scans(content: bytes) -> Iterator[Scan]:
    """Yield the scans: their number, then for each the points, the pose and a number."""
    (number,) = struct.unpack_from("<I", content)
    at = 4
    for _ in range(number):
        (count,) = struct.unpack_from("<I", content, at)
        records = np.frombuffer(content, POINT, count, at + 4)  # ValueError if they are missing
        at += 4 + records.nbytes
        three, x, y, z, four, qw, qx, qy, qz = POSE.unpack_from(content, at)
        at += POSE.size + 4
        if (three, four) != (3, 4) or (count and (records["size"] != 3).any()):
            raise ValueError("coordinates are not in threes")
        yield _checked((x, y, z), (qx, qy, qz, qw), records["xyz"])


def _text_scans(content: bytes) -> Iterator[Scan]:
    """Yield the scans: a line `NODE x y z roll pitch yaw`, then its points, one a line."""
    edges = [found.start() for found in TITLE.finditer(content)]
    for start, stop in zip(edges, [*edges[1:], len(content)], strict=True):
        title, _, rows = content[start:stop].decode("utf-8").partition("\n")
        words = title.split()[1:7]
        if len(words) < 6:
            raise ValueError(f"{shown(title.strip())} is not NODE x y z roll pitch yaw")
        *place, roll, pitch, yaw = map(float, words)
        yield _checked(tuple(place), _quaternion(roll, pitch, yaw), _rows(SKIPPED.sub("", rows)))


def _rows(text: str) -> NDArray[np.float64]:
    lines = [line.split()[:3] for line in text.splitlines() if line.strip()]
    if any(len(line) < 3 for line in lines):
        raise ValueError("a point has fewer than three numbers")
    return np.array([[float(word) for word in line] for line in lines], np.float64).reshape(-1, 3)


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, ...]:
    """Return x, y, z, w of the rotation about x, then y, then z, all fixed axes."""
    half = np.array([roll, pitch, yaw]) / 2
    (sr, sp, sy), (cr, cp, cy) = np.sin(half).tolist(), np.cos(half).tolist()
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _checked(place: tuple[float, ...], quaternion_xyzw: tuple[float, ...], points: NDArray[np.float64]) -> Scan:
    """Return a scan; raises ValueError for an invalid pose. Non-finite points are left out."""
    numbers = np.array([*place, *quaternion_xyzw])
    if not (np.isfinite(numbers).all() and np.abs(numbers).max() < MAX_PLACE and np.linalg.norm(numbers[3:]) > 1e-6):
        raise ValueError(f"pose {shown(numbers.tolist())} is invalid")
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) and np.abs(finite).max() > MAX_PLACE:
        raise ValueError(f"a point {np.abs(finite).max():.3g} m from its sensor")
    unit = numbers[3:] / np.linalg.norm(numbers[3:])
    return Scan(from_quaternion(numbers[:3], unit), finite.astype(np.float64))
