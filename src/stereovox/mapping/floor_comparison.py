# SPDX-License-Identifier: Apache-2.0
"""Compare a scan with the grid before integration, as `comparison` does for frames in space."""

from __future__ import annotations

from functools import partial
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.frame import AnyFrame, Scan
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform, rotation_matrix
from stereovox.mapping.comparison import (
    GAIN,
    TRIED,
    Placed,
    explained,
    judged,
    sight,
    thinned,
)
from stereovox.mapping.disagreement import Sight
from stereovox.mapping.gate import Gate, GateResult
from stereovox.maps.cells.cell_format import State
from stereovox.maps.cells.evidence import GridEvidence
from stereovox.maps.grid_map import GridMap
from stereovox.maps.query.queries import RayHits
from stereovox.maps.record.history import DisagreementSpell

ERROR_M = 0.05
"""How far a hit may be from its surface: noise of lidars and poses, and half the thickness of walls as drawn."""
LEVEL_M = 0.02
"""Difference in height up to which two sensors see the same obstacles."""
MIRRORED = {"mirrored": (1, -1, 1), "back to front": (-1, 1, 1)}
TURNED_DEG, MOUNTED_DEG = range(2, 31, 2), range(32, 181, 2)
"""Turns of a sensor that has moved, and of one whose mount was given wrong."""
SHIFTED_M, SHIFT_TURN_DEG = 0.6, np.arange(-15, 15.1, 1.5)
"""Search range along each axis, and turns, for a sensor that was knocked or whose poses are late."""
FITS = 0.9
"""Share of the points that must then be on surfaces; otherwise other faults are tried first."""
FAR_CELLS = 400
"""Cells from the sensor within which hits count in that search."""


def _faults() -> dict[str, NDArray[np.float64]]:
    """Return by name of each fault the matrix (3, 3) that undoes it, for points in the sensor's frame."""
    turns = {f"turned by {s * deg} deg about z": s * deg for deg in TURNED_DEG for s in (1, -1)}
    turns |= {f"turned by {s * deg} deg": s * deg for deg in MOUNTED_DEG for s in (1, -1)}
    return {
        **{name: np.diag(signs).astype(float) for name, signs in MIRRORED.items()},
        **{name: rotation_matrix([0, 0, np.radians(deg)]) for name, deg in turns.items()},
    }


FAULTS = _faults()


class FloorComparison:
    """Compares each scan with the grid, and lets the gate decide whether to accept it.

    An obstacle for one sensor may be too low for another: nothing is compared once sensors at different heights have
    mapped a grid. Nor are images compared with a grid loaded from a picture (`from_picture`): its sensor is unknown.
    """

    def __init__(self, config: Config, gate: Gate, from_picture: bool):
        self._gate, self._compares, self._from_picture = gate, config.trust.max_disagreement < 1, from_picture
        self._reach, self._prepared = config.max_range, False
        self._around = max(1, ceil(round(ERROR_M / config.voxel_size, 6)))

    def check(
        self, frame: AnyFrame | Scan, scan: Scan, evidence: GridEvidence, passed: GateResult, grid_map: GridMap
    ) -> GateResult:
        """Return what the gate needs to accept `scan`, which was made from `frame`.

        evidence: the evidence of the scan. passed: what `Gate.check` returned. Raises FrameRefused as
        `Gate.check_agreement`.
        """
        if not self._compares or (self._from_picture and not isinstance(frame, Scan)):
            return passed
        if self._gate.others_apart(passed, LEVEL_M):
            return passed
        if not self._prepared:  # once, so that kernels compile now and not when a scan is in doubt
            self._prepared = True
            self._sight(scan, None, grid_map)
        if grid_map.history.is_provisional:
            passed = self._confirmed(evidence, passed, grid_map)
            if passed.takes_out:
                return passed
        with grid_map.lock:
            against = grid_map.storage.agreement(evidence, self._around).against
            doubted = self._gate.in_doubt(passed, against)
            found = self._sight(scan, self._gate.doubt(passed), grid_map) if doubted else None
            return self._gate.check_agreement(frame, passed, against, found)

    def _confirmed(self, evidence: GridEvidence, passed: GateResult, grid_map: GridMap) -> GateResult:
        """Return the result for a scan whose map is of scans that none has confirmed, as `Comparison` does."""
        with grid_map.lock:
            met = grid_map.storage.agreement(evidence, self._around, sure=False)
            known = met.agree + met.into_free + met.through
            return judged(passed, grid_map.history, met.agree, known, met.every)

    def _sight(self, scan: Scan, doubt: DisagreementSpell | None, grid_map: GridMap) -> Sight:
        """Return how a scan in doubt fits the grid."""
        reach = min(self._reach, scan.range_max)
        hit = (scan.ranges >= scan.range_min) & (scan.ranges > 0) & (scan.ranges <= reach)
        angles, ranges = scan.angles[hit], scan.ranges[hit].astype(float)
        seen = np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(angles))])
        plane = Plane(grid_map, self._around)
        return sight(plane, scan.T_world_sensor, seen, _noise, doubt, partial(_fault, plane, scan.T_world_sensor))


def _noise(away: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full(len(away), ERROR_M)


def _fault(
    plane: Plane,
    T: Transform,
    points: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    placed: Placed,
    align: bool,
) -> str:
    """Return as `explained`, but first try a pose from which nearly all would agree: wrong ranges look like one."""
    there = plane.pose_on_surfaces(T, points) if align else None
    if there is not None and plane.share(there, points) >= max(FITS, plane.share(T, points) + GAIN):
        return "moved"
    return explained(plane, T, points, tolerance, placed.lengths, FAULTS, lambda: there)


class Plane:
    """A grid in which points in space are looked up: their heights are ignored, and surfaces widen by `around` cells.

    It implements `comparison.Surfaces`.
    """

    def __init__(self, grid_map: GridMap, around: int):
        self._storage, self._around, self.voxel_size = grid_map.storage, around, grid_map.voxel_size
        self._to_cells = se2.lifted(se2.inverse(grid_map.origin))[:2] / self.voxel_size

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return OCCUPIED for points (N, 3) near a surface, FREE or UNKNOWN for others."""
        return self._storage.seen_at(np.floor(self._cells(np.asarray(points))).astype(np.int64), self._around)

    def cast_rays(self, origins: ArrayLike, directions: ArrayLike, max_distance: float) -> RayHits:
        """Return the distance along rays (N, 3) of any length to the first occupied cell; infinity if there is none."""
        starts, rays = np.asarray(origins, float), np.asarray(directions, float)
        far = max_distance / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
        lines = np.column_stack([self._cells(starts), self._cells(starts + rays * far[:, None])])
        return RayHits.none(len(rays))._replace(distance=(self._storage.cast(lines) * max_distance).astype(np.float32))

    def share(self, T: Transform, points: NDArray[np.float64]) -> float:
        """Return the share of points (N, 3) in the sensor's frame that are near a surface if the sensor is at T."""
        found = self.state(points @ T[:3, :3].T + T[:3, 3])
        return float((found == State.OCCUPIED).mean()) if len(found) else 0.0

    def pose_on_surfaces(self, T: Transform, points: NDArray[np.float64]) -> Transform | None:
        """Return the T_world_sensor near T that puts the most of points (N, 3) on surfaces; None if that is T."""
        if not len(points):
            return None
        points = thinned(points, TRIED)
        arms = np.stack([points @ rotation_matrix([0, 0, np.radians(deg)]).T for deg in SHIFT_TURN_DEG])
        cells = np.floor(self._cells((arms @ T[:3, :3].T + T[:3, 3]).reshape(-1, 3))).astype(int)
        here = np.floor(self._cells(T[None, :3, 3])).astype(int)
        near = np.abs(cells - here).max(axis=1) <= FAR_CELLS
        step = 2 * self._around
        most = ceil(SHIFTED_M / self.voxel_size / step)
        shifts = step * np.arange(-most, most + 1)
        side, rim = FAR_CELLS + step * most, self._around
        low = here[0] - side - rim
        picture = self._storage.surfaces(*low.tolist(), *[2 * (side + rim) + 1] * 2)
        thick = _thickened(picture, rim)
        column, row = np.where(near[:, None], cells - low - rim, side).T.reshape(2, len(arms), -1)
        found = thick[row[..., None, None] + shifts[:, None], column[..., None, None] + shifts]
        shares = (found & near.reshape(len(arms), -1)[..., None, None]).mean(axis=1)
        turn, up, across = np.unravel_index(shares.argmax(), shares.shape)
        there = T.copy()
        there[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0, float(np.radians(SHIFT_TURN_DEG[turn]))])
        there[:2, 3] += np.linalg.solve(self._to_cells[:, :2], [shifts[across], shifts[up]])
        return None if np.array_equal(there, T) else there

    def _cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return columns and rows (N, 2), with fractions, of points (N, 3)."""
        return points @ self._to_cells[:, :3].T + self._to_cells[:, 3]


def _thickened(picture: NDArray[np.bool_], rim: int) -> NDArray[np.bool_]:
    """Return a picture, less `rim` on each side, of all pixels within `rim` rows and columns of a set one."""
    rows = np.logical_or.reduce([picture[k : len(picture) - 2 * rim + k] for k in range(2 * rim + 1)])
    return np.logical_or.reduce([rows[:, k : rows.shape[1] - 2 * rim + k] for k in range(2 * rim + 1)])
