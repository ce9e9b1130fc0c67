# SPDX-License-Identifier: Apache-2.0
"""Compare the evidence of a frame with the map before the map takes it in, also from nearby poses."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import AnyFrame, AnyImage, CheckedCloud, DepthImage
from stereovox.integrate import Integration
from stereovox.integrate.views import PerCamera, sensor_table
from stereovox.maps import State, VoxelMap
from stereovox.maps.evidence import Evidence
from stereovox.se3 import Transform, apart, rotation_matrix
from stereovox.sensors import make_sensor
from stereovox.sensors.model import InverseSensorModel
from stereovox.trust.gate import Gate, Passed

SURFACES = (State.OCCUPIED, State.TENTATIVE)
POINTS, BESIDE = 600, 3
"""Most pixels that are registered with the map, and the distance in pixels of the neighbours for their normals."""
AROUND, FLAT = 16, 0.1
"""Points of a cloud that give one its normal, and how flat they must lie: their spreads across and along."""
STEPS = 30
"""Iterations of the registration."""
REACH_M, REACH_CELLS = 0.6, 2.0
"""Search radius of a point for its surface in the first iteration (metres) and in the last (cells)."""
MIN_POINTS = 30
"""Points that must find a surface."""
MAX_SHIFT_M, MAX_TURN = 0.5, np.radians(15)
"""How far a knocked camera may stand from its pose."""
DAMPING = 1e-3
"""Damping of the least squares, for motions that no surface constrains."""
SUBCELL = (0.5, 0.25)
"""Steps, in cells, of the search for the pose that agrees best."""
FIRM = 0.4
"""Share of the largest hit evidence that makes a hit firm: far hits say less, their noise is wider than a cell."""


class Comparison:
    """Compares the evidence of each frame with the map, and lets the gate decide whether to accept the frame."""

    def __init__(self, config: Config, gate: Gate):
        self._gate, self._compares = gate, config.trust.max_disagreement < 1
        self._firm = PerCamera(partial(_firm, make_sensor(config.sensor), config))
        self._prepared = False

    def check(
        self,
        frame: AnyFrame,
        image: AnyImage,
        evidence: Evidence,
        passed: Passed,
        integrator: Integration,
        voxel_map: VoxelMap,
    ) -> tuple[Evidence, Passed]:
        """Return the evidence to add, and what the gate needs to accept the frame.

        evidence: what `integrator` made of `image`. passed: what `Gate.check` returned. Raises FrameRefused as
        `Gate.check_agreement`.
        """
        if not self._compares:
            return evidence, passed
        self._prepare(voxel_map, image)
        firm, fits = self._firm[image.camera], False
        against = voxel_map.storage.agreement(evidence, firm).against
        limit = self._gate.limit_elsewhere(passed, against)
        if limit is not None:
            fits = _fits_elsewhere(image, integrator, voxel_map, firm, limit)
            evidence = integrator.evidence(image)  # again: each call reuses the memory of the one before
        with voxel_map.lock:
            passed = self._gate.check_agreement(frame, passed, against, fits)
        return evidence, passed

    def _prepare(self, voxel_map: VoxelMap, image: AnyImage) -> None:
        """Register the first image, so that kernels compile then and not when a frame is in doubt."""
        if not self._prepared:
            self._prepared = True
            pose_on_surfaces(voxel_map, image)


def pose_on_surfaces(voxel_map: VoxelMap, image: AnyImage) -> Transform | None:
    """Return a T_world_sensor (4, 4) near the image's own that brings its points onto the map's surfaces.

    None where there is no such pose, or the image already lies there within a cell.

    Iterative closest points, from points and their planes to the centres of cells (Chen and Medioni 1992); the search
    radius shrinks from iteration to iteration.
    """
    points, normals = _surfaces(image)
    T, last = image.T_world_sensor, min(REACH_M, REACH_CELLS * voxel_map.voxel_size)
    for reach in np.geomspace(REACH_M, last, STEPS):
        there, planes = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
        found = voxel_map.nearest_obstacle(there, float(reach), SURFACES) if len(there) else None
        near = np.isfinite(found.distance) if found else np.zeros(0, bool)
        if found is None or near.sum() < MIN_POINTS:
            return None
        T = _motion(there[near], planes[near], voxel_map.centers(found.cell[near])) @ T
    shift_m, turn = apart(tuple(image.T_world_sensor[:3].ravel().tolist()), tuple(T[:3].ravel().tolist()))
    moved_m = np.linalg.norm(points @ (T - image.T_world_sensor)[:3, :3].T + (T - image.T_world_sensor)[:3, 3], axis=1)
    elsewhere = moved_m.mean() > voxel_map.voxel_size and shift_m <= MAX_SHIFT_M and turn <= MAX_TURN
    return T if elsewhere else None


def _surfaces(image: AnyImage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return some of the image's points (N, 3) and the normals of their surfaces (N, 3), in the sensor's frame."""
    if isinstance(image, CheckedCloud):
        return _surfaces_of_cloud(image.ends[image.hits])
    height, width = image.depth_m.shape
    step = max(1, round((image.depth_m.size / POINTS) ** 0.5))
    rows, columns = (np.arange(BESIDE, size - BESIDE, step) for size in (height, width))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    here = _points(image, v, u)
    across = _points(image, v, u + BESIDE) - _points(image, v, u - BESIDE)
    down = _points(image, v + BESIDE, u) - _points(image, v - BESIDE, u)
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=-1)
    seen = np.isfinite(here).all(axis=-1) & np.isfinite(length) & (length > 0)
    return here[seen], normals[seen] / length[seen][:, None]


def _surfaces_of_cloud(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return some of these points and their normals, by the plane through the points around each."""
    from scipy.spatial import KDTree

    if len(points) < AROUND:
        return np.empty((0, 3)), np.empty((0, 3))
    some = points[:: max(1, len(points) // POINTS)]
    _, near = KDTree(points).query(some, AROUND)
    arms = points[near] - points[near].mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms))
    flat = spread[:, 0] < FLAT * spread[:, 1]  # a single ring of a lidar is a line, and has no normal
    return some[flat], axes[flat, :, 0]


def _points(image: DepthImage, v: NDArray[np.integer], u: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the points (..., 3) of pixels, NaN where they have no depth."""
    columns, rows = (rays.astype(float) for rays in image.camera.rays())
    depth = np.where(np.isfinite(image.depth_m[v, u]), image.depth_m[v, u], np.nan)
    return np.stack([columns[u], rows[v, 0], rows[v, 1]], axis=-1) * depth[..., None]


def _motion(points: NDArray[np.float64], normals: NDArray[np.float64], onto: NDArray[np.float64]) -> Transform:
    """Return the small rigid motion (4, 4) that brings points (N, 3), along their normals, nearest to others."""
    middle = points.mean(axis=0)
    arms = points - middle
    jacobian = np.hstack([np.cross(arms, normals), normals])
    gap = ((onto - points) * normals).sum(axis=1)
    square = jacobian.T @ jacobian + DAMPING * len(points) * np.eye(6)
    turn, shift = np.split(np.linalg.solve(square, jacobian.T @ gap), 2)
    T = np.eye(4)
    T[:3, :3] = rotation_matrix(turn)
    T[:3, 3] = middle + shift - T[:3, :3] @ middle
    return T


def _fits_elsewhere(image: AnyImage, integrator: Integration, voxel_map: VoxelMap, firm: int, limit: float) -> bool:
    """Return whether an image disagrees with the map by at most `limit` from where its surfaces lie on the map's.

    Registered with the centres of cells it may be half a cell off; from there the pose of least disagreement is sought
    along the world's axes.
    """
    pose = pose_on_surfaces(voxel_map, image)
    if pose is None:
        return False

    def against_from(T: Transform) -> float:
        against = voxel_map.storage.agreement(integrator.evidence(replace(image, T_world_sensor=T)), firm).against
        return 1.0 if against is None else against

    least = against_from(pose)
    for step in SUBCELL if least > limit else ():
        for shift in step * voxel_map.voxel_size * np.vstack([np.eye(3), -np.eye(3)]):
            moved = pose.copy()
            moved[:3, 3] += shift
            if (against := against_from(moved)) < least:
                least, pose = against, moved
    return least <= limit


def _firm(sensor: InverseSensorModel, config: Config, camera: VirtualCamera | Lidar) -> int:
    """Return the evidence in thousandths above which a hit is firm."""
    return round(FIRM * int(sensor_table(sensor, config, camera).hit.max()))
