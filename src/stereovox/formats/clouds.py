# SPDX-License-Identifier: Apache-2.0
"""Point clouds and meshes of other programs as maps: their unit, their origin and the size of the cells.

`read_cloud` reads the file as it is, `map_of_cloud` decides what the file leaves open, and the map records both.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.safe_io import read_bounded
from stereovox.formats.cell_size import SuggestedCell, extents, suggested_cell, suggested_for_mesh
from stereovox.formats.las import read_las
from stereovox.formats.points import cells_of_points
from stereovox.formats.text_points import read_text_points
from stereovox.maps import VoxelMap
from stereovox.maps.record.history import Imported
from stereovox.sources.lidar import find_layout, read_velodyne
from stereovox.sources.point_files import MAX_BYTES, read_points

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": 1200 / 3937}
"""Metres of each unit that `--unit` accepts."""
FAR, ROUND = 10_000.0, 100.0
"""Metres from 0 beyond which coordinates get a new origin, and the multiple it is rounded to."""
EARTH = 2e7
"""Metres; no map has larger coordinates: half of the Earth's circumference."""
SPARSE, TINY = 0.5, 0.02
"""Spacing of points, or length of a cloud, in metres, beyond which metres may be the wrong unit."""
SAMPLES_OF_ANY, SAMPLES_A_TRIANGLE, MAX_SAMPLES = 4_000_000, 1000, 16_000_000
"""Samples allowed for any mesh, more for each of its triangles, and the upper limit."""
PER_CELL = 2
"""Samples of a mesh along the side of a cell."""
MAX_LIDAR_M = 1000.0
"""Largest distance in metres of points in a KITTI scan."""
MESHES = (".stl", ".obj", ".off")
TEXTS = (".xyz", ".csv", ".txt", ".asc", ".pts", ".ptx")
LAS = (".las", ".laz")


class PointFile(NamedTuple):
    """Points as stored in a file.

    xyz: (N, 3) float64, in the file's unit and frame; not finite if invalid. holds: a short description of the
    file. voxel_size: metres, if the file declares that its points are centres of cells. faces: (M, 3) integers,
    the points at the corners of each triangle; None for bare points. metres: metres per unit along each axis, and its
    source in the file; None if unknown. notes: what the user should know.
    """

    xyz: NDArray[np.float64]
    holds: str
    voxel_size: float | None = None
    faces: NDArray[np.integer] | None = None
    metres: tuple[tuple[float, float, float], str] | None = None
    notes: tuple[str, ...] = ()


def read_cloud_map(
    path: str | Path,
    voxel_size: float | None = None,
    unit: str | None = None,
    origin: Sequence[float] | None = None,
) -> VoxelMap:
    """Return a map in which each cell that holds a point, or a piece of a mesh, is occupied, all others unknown.

    voxel_size: metres; None: the file's own, else a suggested one. unit: of `UNITS`; None: the file's own, else metres.
    origin: (3,) point in metres, in the file's frame, that becomes the map's origin; None: that of the file, unless it
    is far away. Raises MapFileError: one line with the file and the problem.
    """
    try:
        return map_of_cloud(read_cloud(path), Path(path).name, voxel_size, unit, origin)
    except MapFileError:
        raise
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None


def read_cloud(path: str | Path) -> PointFile:
    """Return the points of a file with one of the endings `formats.CLOUDS`.

    Raises MapFileError, MissingExtra if the library for `.las` is not installed.
    """
    ending = Path(path).suffix.lower()
    if ending in LAS:
        return PointFile(**read_las(path)._asdict())
    if ending in TEXTS:
        xyz, named, scans = read_text_points(path)
        metres = ((UNITS[named], UNITS[named], UNITS[named]), named) if named else None
        return PointFile(xyz, f"{f'PTX, {scans} scans' if scans else 'text'}, {_count(xyz)}", metres=metres)
    if ending == ".bin":
        return _lidar_scan(path)
    if ending in MESHES:
        return _mesh(path, ending[1:])
    points = read_points(path)
    if points.faces:
        return _mesh(path, "ply")
    kind = "PLY" if points.ply else "PCD"
    rows = f"{points.width} x {points.height}, " if points.height > 1 else ""
    notes = ("its VIEWPOINT is not applied: points are used as stored",) if points.turned else ()
    if points.haze is not None:
        kind, number = "Gaussian splats", len(points.xyz) + points.haze
        notes = (f"{points.haze:,} of {number:,} splats are left out: their opacity is below 0.5",)
    return PointFile(points.xyz, f"{kind}, {rows}{_count(points.xyz)}", points.voxel_size, notes=notes)


def map_of_cloud(
    cloud: PointFile,
    name: str,
    voxel_size: float | None = None,
    unit: str | None = None,
    origin: Sequence[float] | None = None,
) -> VoxelMap:
    """Return the map of a cloud; name: of its file, for the map's history; the rest as in `read_cloud_map`.

    Raises StereovoxError.
    """
    if cloud.voxel_size is not None and unit is None and origin is None:  # our own file: nothing is left open
        made = cells_of_points(cloud.xyz, cloud.voxel_size if voxel_size is None else voxel_size)
        made.history.imported = Imported(name, cloud.holds)
        return made
    if not np.isfinite(cloud.xyz).all(axis=1).any():
        raise StereovoxError("holds no point; name a file with points")
    xyz, unit_notes = _in_metres(cloud, unit)
    xyz, origin_notes = _near_origin(xyz, origin)
    size, size_notes = _sized(xyz, cloud, name, voxel_size, unit)
    points = xyz if cloud.faces is None else _on_surface(xyz, cloud.faces, size)
    made = cells_of_points(points, size)
    made.history.imported = Imported(name, cloud.holds, (*size_notes, *unit_notes, *origin_notes, *cloud.notes))
    return made


def _count(xyz: NDArray[np.float64]) -> str:
    return f"{int(np.isfinite(xyz).all(axis=1).sum()):,} points"


def _in_metres(cloud: PointFile, unit: str | None) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the points in metres, and a note if the file defines the unit; raises StereovoxError for a bad unit."""
    if unit is not None:
        if unit not in UNITS:
            raise StereovoxError(f"--unit {unit}: unknown unit; give one of {', '.join(UNITS)}")
        return cloud.xyz * UNITS[unit], (f"taken as {unit}",) if unit != "m" else ()
    if cloud.metres is None or cloud.metres[0] == (1.0, 1.0, 1.0):
        return cloud.xyz, ()
    return cloud.xyz * cloud.metres[0], (f"unit: {cloud.metres[1]}, as the file says (--unit overrides)",)


def _near_origin(
    xyz: NDArray[np.float64], origin: Sequence[float] | None
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the points relative to the map's origin, and a note if that is not the file's."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    if np.abs(finite).max() > EARTH:
        raise StereovoxError(
            f"a coordinate of {np.abs(finite).max():.3g} m is beyond the Earth; give --unit, or name columns x,y,z"
        )
    if origin is not None:
        given = np.asarray(origin, np.float64)
        return xyz - given, (f"its origin is ({_point(given)}) m of the file",) if given.any() else ()
    middle = np.median(finite, axis=0)
    if (np.abs(middle) <= FAR).all():
        return xyz, ()
    moved = np.where(np.abs(middle) > FAR, np.floor(middle / ROUND) * ROUND, 0.0)
    return xyz - moved, (f"its origin is ({_point(moved)}) m of the file, far from 0 (--origin 0,0,0 keeps its own)",)


def _point(point: NDArray[np.float64]) -> str:
    return ", ".join(f"{number:.12g}" for number in point)


def _sized(
    xyz: NDArray[np.float64], cloud: PointFile, name: str, voxel_size: float | None, unit: str | None
) -> tuple[float, tuple[str, ...]]:
    """Return the side of a cell, and notes: why it was chosen, and whether the unit is doubtful."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    if cloud.voxel_size is not None:
        return cloud.voxel_size if voxel_size is None else voxel_size, ()
    suggested = suggested_cell(finite) if cloud.faces is None else suggested_for_mesh(finite)
    if voxel_size is not None:
        return voxel_size, _unit_notes(finite, cloud, unit, suggested)
    if suggested is None:
        raise StereovoxError(
            f"{len(finite)} points do not determine a cell size; type: stereovox import {name} MAP --voxel-size 0.05"
        )
    notes = (f"cells of {suggested.voxel_size:g} m, {suggested.why} (--voxel-size overrides)",)
    return suggested.voxel_size, notes + _unit_notes(finite, cloud, unit, suggested)


def _unit_notes(
    xyz: NDArray[np.float64], cloud: PointFile, unit: str | None, suggested: SuggestedCell | None
) -> tuple[str, ...]:
    """Return a note if the unit of points (N, 3) is unspecified and metres may be wrong."""
    length = float(extents(xyz).max())
    sparse = suggested is not None and suggested.spacing is not None and suggested.spacing > SPARSE
    if unit is not None or cloud.metres is not None or not (sparse or length < TINY or cloud.faces is not None):
        return ()
    long = f"{length:.3g}" if length < 1000 else f"{length:.0f}"
    return (f"unit unsure: {long} long, taken as metres (else --unit mm, cm or ft)",)


def _on_surface(xyz: NDArray[np.float64], faces: NDArray[np.integer], voxel_size: float) -> NDArray[np.float64]:
    """Return points (M, 3) on all triangles, in rows along their longest sides; rows and points are at most half a cell
    apart.

    Raises StereovoxError for too many points.
    """
    corners = xyz[faces]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    turn = (np.argmax(sides, axis=1)[:, None] + [0, 1, 2]) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[:, :, None], axis=1), 1, 0)
    length, step = sides.max(axis=1, initial=0.0), voxel_size / PER_CELL
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.where(length > 0, length, 1.0)
    most = min(MAX_SAMPLES, SAMPLES_OF_ANY + SAMPLES_A_TRIANGLE * len(corners))
    rows, along = np.ceil(height / step), np.ceil(length / step)
    if not float(((rows + 4) * (along + 2)).sum()) <= most:
        raise StereovoxError(
            f"its surface takes too many cells of {voxel_size:g} m; give a larger --voxel-size, or its unit: --unit mm"
        )
    of_row, t = _shares(rows.astype(np.int64))
    of_point, s = _shares(np.ceil(along[of_row] * (1 - t)).astype(np.int64))
    of_face, t = of_row[of_point], t[of_point]
    edges = np.concatenate([np.stack([a, c], axis=1), np.stack([b, c], axis=1)])  # rows alone may leave gaps in these
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    of_edge, share = _shares(np.ceil(lengths / step).astype(np.int64))
    on_edges = edges[of_edge, 0] + share[:, None] * (edges[of_edge, 1] - edges[of_edge, 0])
    a, b, c, s, t = a[of_face], b[of_face], c[of_face], s[:, None], t[:, None]
    return np.concatenate([a + t * (c - a) + s * (1 - t) * (b - a), on_edges])


def _shares(steps: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return for each of `steps` (N,) the shares 0, 1/steps, ..., 1 (M,), and the index of its step (M,)."""
    owner = np.repeat(np.arange(len(steps)), steps + 1)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(steps + 1) - steps - 1, steps + 1)
    return owner, number / np.maximum(steps, 1)[owner]


def _lidar_scan(path: str | Path) -> PointFile:
    """Return the points of a KITTI velodyne scan, in the frame of the lidar."""
    try:
        xyz = read_velodyne(Path(path), find_layout(Path(path))).astype(np.float64)
    except StereovoxError as error:
        raise MapFileError(str(error)) from None
    if not len(xyz) or np.abs(xyz).max() > MAX_LIDAR_M:
        raise MapFileError(f"{path}: not a KITTI velodyne scan (float32 x, y, z, reflectance); save it as .ply or .pcd")
    return PointFile(xyz, f"KITTI velodyne scan, {_count(xyz)}", metres=((1.0, 1.0, 1.0), "metres"))


def _mesh(path: str | Path, kind: str) -> PointFile:
    """Return the corners and triangles of a mesh, with larger faces split; without faces, its points."""
    import trimesh

    content = _bytes(path)
    load: Callable[..., Any] = trimesh.load
    try:
        loaded: Any = load(io.BytesIO(content), file_type=kind, process=False, skip_materials=True)
        parts: list[Any] = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
        sizes = np.cumsum([0, *(len(part.vertices) for part in parts)])
        xyz = np.concatenate([np.empty((0, 3)), *(np.asarray(part.vertices, np.float64) for part in parts)])
        faces = [np.asarray(getattr(part, "faces", np.empty((0, 3))), np.int64) for part in parts]
        faces = np.concatenate([np.empty((0, 3), np.int64), *(f + n for f, n in zip(faces, sizes, strict=False))])
        if prod(faces.shape) and not (faces.min() >= 0 and faces.max() < len(xyz)):
            raise ValueError("a triangle has missing corners")
    except Exception as error:  # trimesh can raise anything on a damaged file
        why = (" ".join(str(error).split()) or type(error).__name__)[:100]
        raise MapFileError(f"{path}: not a readable mesh ({why}); export it again") from None
    if not len(faces):
        return PointFile(xyz, f"{kind.upper()}, {_count(xyz)}")
    return PointFile(xyz, f"{kind.upper()} mesh, surface of {len(faces):,} triangles", faces=faces)


def _bytes(path: str | Path) -> bytes:
    try:
        return read_bounded(Path(path), MAX_BYTES)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of points") from None
