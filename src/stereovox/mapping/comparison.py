# SPDX-License-Identifier: Apache-2.0
"""Compare the evidence of a frame with the map before integration, and inspect contradictions closely."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import AnyFrame, AnyImage, CheckedCloud, DepthImage
from stereovox.geometry.se3 import Transform, apart, rotation_matrix
from stereovox.integrate.views import PerCamera, sensor_table
from stereovox.mapping.disagreement import EXPLAINED, FEW, MOSTLY_KNOWN, Sight
from stereovox.mapping.gate import BLUR, FARTHEST, Gate, GateResult
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.query.queries import RayHits
from stereovox.maps.record.glance import Glance, Votes
from stereovox.maps.record.history import DisagreementSpell, History
from stereovox.maps.voxel_map import leaning
from stereovox.sensors import make_sensor
from stereovox.sensors.noise import RangeNoise
from stereovox.sensors.protocol import InverseSensorModel

FIRM = 0.4
"""Share of the largest hit evidence that makes a hit firm: far hits say less, for their noise is wider than a cell."""
GLANCED, POINTS, TRIED = 2000, 500, 100
"""Most points of a frame in doubt that a glance keeps, that are looked up in the map, and that faults are tried on."""
CONFIRMED, CONTRADICTED = 0.85, 0.7
"""The first frames count once another agrees with the map in this share of its points on known cells; below the second
they are taken out, and between both if most is known: from elsewhere, good frames agree less."""
OVERLAP, MOST = 0.25, 0.5
"""Share of a frame's points that must be known for a judgement, and to count as most."""
SPREAD, BLURRED, ENOUGH = 3, 2, 10
"""How many sigma two measurements of a surface may differ, noise in cells beyond which they prove little, and how many
frames that do not contradict each other count although none confirms another."""
GAIN = 0.1
"""Least share of its points by which a frame must agree better under a fault, however little there is to explain."""
DEEP_CELLS = 4
"""A surface is seen through by points more than this many cells behind it; a floor at a flat angle is thick."""
REACH = 60.0
"""Metres along a ray within which the map's first surface is sought."""

MIRRORED = {
    "mirrored": (-1, 1, 1),
    "upside down": (1, -1, 1),
    "turned by half": (-1, -1, 1),
    "back to front": (1, 1, -1),
}
TURNS_DEG = (-32, -24, -16, -8, 8, 16, 24, 32)
STRETCHES = (0.67, 0.77, 0.87, 1.15, 1.3, 1.5)

ALIGNED, BESIDE = 300, 3
"""Most pixels that are registered to the map, and the distance in pixels of the neighbours for their normals."""
AROUND, FLAT = 16, 0.1
"""Points of a cloud that give one its normal, and how flat they must be: largest ratio of spread across to along."""
DENSE = 4000
"""Most points of a cloud in which these neighbours are searched."""
STEPS, EVERY = 20, 3
"""Iterations of the registration; of the frames in doubt, one in EVERY is registered."""
REACH_M, REACH_CELLS = 0.6, 2.0
"""Search radius of a point for its surface in the first iteration (metres) and in the last (cells)."""
MIN_POINTS = 30
"""Least number of points that must find a surface."""
MAX_SHIFT_M, MAX_TURN = 0.5, np.radians(15)
"""How far a knocked camera may be from its pose."""
DAMPING = 1e-3
"""Damping of the least squares, for motions that no surface constrains."""


def _faults() -> dict[str, NDArray[np.float64]]:
    """Return by name of each fault the matrix (3, 3) that undoes it, for points in the sensor's frame."""
    turns = [(f"turned by {deg} deg", np.radians(deg) * axis) for axis in np.eye(3) for deg in TURNS_DEG]
    return {
        **{name: np.diag(signs).astype(float) for name, signs in MIRRORED.items()},
        **{f"{name} about {'xyz'[n // len(TURNS_DEG)]}": rotation_matrix(by) for n, (name, by) in enumerate(turns)},
        **{f"seen with a focal length x {1 / k:.2g}": np.diag([k, k, 1.0]) for k in STRETCHES},
        **{f"stretched along z by {1 / k:.2g}": np.diag([1.0, 1.0, k]) for k in STRETCHES},
    }


FAULTS = _faults()


class Comparison:
    """Compares the evidence of each frame with the map, and lets the gate decide whether to accept the frame."""

    def __init__(self, config: Config, gate: Gate):
        self._gate, self._compares = gate, config.trust.max_disagreement < 1
        self._firm = PerCamera(partial(_firm, make_sensor(config.sensor), config))
        self._noise = PerCamera(partial(RangeNoise.of, config.noise))
        self._prepared = False

    def check(
        self, frame: AnyFrame, image: AnyImage, evidence: Evidence, passed: GateResult, voxel_map: VoxelMap
    ) -> GateResult:
        """Return what the gate needs to accept the frame; a cone is not compared, for it yields to the map.

        evidence: the evidence of `image`. passed: what `Gate.check` returned. Raises FrameRefused as
        `Gate.check_agreement`; a provisional map may begin anew instead, for either may be wrong.
        """
        if not self._compares or isinstance(image.camera, RangeSensor):
            return passed
        self._prepare(voxel_map, image)
        if voxel_map.history.is_provisional:
            passed = self._confirmed(image, passed, voxel_map)
            if passed.takes_out:
                return passed
        against = voxel_map.storage.agreement(evidence, self._firm[image.camera]).against
        with voxel_map.lock:
            doubted = self._gate.in_doubt(passed, against)
            sight = self._sight(image, self._gate.doubt(passed), voxel_map) if doubted else None
            return self._gate.check_agreement(frame, passed, against, sight)

    def _confirmed(self, image: AnyImage, passed: GateResult, voxel_map: VoxelMap) -> GateResult:
        """Return the result for a frame whose map is of frames that none has confirmed.

        Its points are looked up in any cell, since no cell is certain yet. Blurred ones, whose noise is wider than
        two cells, contradict nothing: neither of two such measurements of a surface need be where the other is.
        """
        points, history = _sampled(image, GLANCED, FARTHEST * voxel_map.config.max_range), voxel_map.history
        sigma = self._noise[image.camera].sigma(np.linalg.norm(points, axis=1))
        sharp = sigma <= BLURRED * voxel_map.voxel_size
        is_sharp = bool(np.count_nonzero(sharp) >= FEW)
        points, sigma = (thinned(values[sharp] if is_sharp else values, POINTS) for values in (points, sigma))
        tolerance, tries = np.maximum(voxel_map.voxel_size, (SPREAD if is_sharp else 1) * sigma), 1 + 2 * SPREAD
        with voxel_map.lock:
            placed = _placed(voxel_map, image.T_world_sensor, points, tolerance, tries)
            agree, known = int(placed.agrees.sum()), int((placed.agrees | placed.against).sum())
            return judged(passed, history, agree, known, len(points), is_sharp)

    def _prepare(self, voxel_map: VoxelMap, image: AnyImage) -> None:
        """Inspect the first image, so that kernels compile now and not when a frame is in doubt."""
        if not self._prepared:
            self._prepared = True
            self._sight(image, None, voxel_map)
            pose_on_surfaces(voxel_map, image)

    def _sight(self, image: AnyImage, doubt: DisagreementSpell | None, voxel_map: VoxelMap) -> Sight:
        """Return how a frame in doubt fits the map; the work does not depend on the size of the image."""
        seen, sigma = _sampled(image, GLANCED, FARTHEST * voxel_map.config.max_range), self._noise[image.camera].sigma
        return sight(voxel_map, image.T_world_sensor, seen, sigma, doubt, partial(_fault, voxel_map, image))


def judged(
    passed: GateResult, history: History, agree: int, known: int, seen: int, contradicts: bool = True
) -> GateResult:
    """Return the result for a frame whose map is of frames that none has confirmed; the map's lock must be held.

    agree: how many of the `known` points, or beams, agree with the map. seen: all of the frame. contradicts: whether
    the others contradict it.
    """
    enough = history.frames - history.cones.total() >= ENOUGH
    if known < max(FEW, OVERLAP * seen):
        return passed._replace(confirms=enough)
    if contradicts and agree < (CONFIRMED if known >= MOST * seen else CONTRADICTED) * known:
        return passed._replace(takes_out=history.frames, glances=())
    return passed._replace(confirms=enough or agree >= CONFIRMED * known)


class Surfaces(Protocol):
    """A map to look points up in, such as a `VoxelMap`; whatever is no surface is FREE or UNKNOWN."""

    @property
    def voxel_size(self) -> float:
        """Side of a cell in metres."""
        ...

    def state(self, points: ArrayLike) -> NDArray[np.uint8]:
        """Return the state at points (N, 3)."""
        ...

    def cast_rays(self, origins: ArrayLike, directions: ArrayLike, max_distance: float) -> RayHits:
        """Return the first hit of each ray (N, 3)."""
        ...


def sight(
    surfaces: Surfaces,
    T: Transform,
    seen: NDArray[np.float64],
    sigma: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    doubt: DisagreementSpell | None,
    fault: Callable[[NDArray[np.float64], NDArray[np.float64], Placed, bool], str],
) -> Sight:
    """Return how a frame in doubt fits a map.

    seen: (N, 3) points in the sensor's frame, at pose T. sigma: their noise by their distance, in metres. fault:
    returns the name of the fault from some of the points, their tolerances, their places in the map, and whether to
    search for another pose.
    """
    points = thinned(seen, POINTS)
    tolerance = np.maximum(surfaces.voxel_size, sigma(np.linalg.norm(points, axis=1)))
    placed = _placed(surfaces, T, points, tolerance)
    against = placed.against
    known = int((placed.agrees | against).sum())
    anchored = float(placed.agrees.sum()) / known if known >= max(FEW, MOSTLY_KNOWN * len(points)) else None
    votes, frames = Votes(), 0
    if doubt is not None and doubt.glance is not None:
        votes, frames = doubt.glance.votes(points[against], T, BLUR * tolerance[against]), doubt.frames
    wrong = fault(points, tolerance, placed, frames % EVERY == 0)
    return Sight(anchored, wrong, int(against.sum()), int(placed.behind.sum()), votes, Glance.at(seen, T))


class Placed(NamedTuple):
    """Where points (N,) are in the map.

    agrees: on a surface. against: in known free space, or behind an occupied cell and on no surface. behind: on a
    surface, but seen through an occupied cell. lengths: distance to the map's first surface along the ray, as a
    multiple of the distance to the point; inf if there is no surface.
    """

    agrees: NDArray[np.bool_]
    against: NDArray[np.bool_]
    behind: NDArray[np.bool_]
    lengths: NDArray[np.float64]


def _placed(
    voxel_map: Surfaces, T: Transform, points: NDArray[np.float64], tolerance: NDArray[np.float64], tries: int = 3
) -> Placed:
    """Return where points (N, 3) in the sensor's frame are in the map; tries: as for `_on_surface`."""
    if not len(points):
        empty = np.zeros(0, bool)
        return Placed(empty, empty, empty, np.zeros(0))
    rays = points @ T[:3, :3].T
    away = np.linalg.norm(points, axis=1)
    agrees = _on_surface(voxel_map, T, points, tolerance, tries)
    first = voxel_map.cast_rays(np.broadcast_to(T[:3, 3], rays.shape), rays, REACH).distance.astype(float)
    gap = away - np.where(np.isfinite(first), first, np.inf)
    through = gap > tolerance + DEEP_CELLS * voxel_map.voxel_size
    midway = np.where(through, (1 - 0.5 * gap / away), 1.0)
    between = _states(voxel_map, T[:3, 3] + rays * midway[:, None]) == State.FREE
    free = _states(voxel_map, T[:3, 3] + rays) == State.FREE
    return Placed(agrees, ~agrees & (through | free), agrees & through & between, first / away)


def _on_surface(
    voxel_map: Surfaces, T: Transform, points: NDArray[np.float64], tolerance: NDArray[np.float64], tries: int = 3
) -> NDArray[np.bool_]:
    """Return which points (..., 3) in the sensor's frame are on a surface, give or take (...) metres along the ray.

    tries: at how many places along it.
    """
    step = (tolerance / np.maximum(np.linalg.norm(points, axis=-1), 1e-9))[..., None]
    tried = np.stack([points * (1 + k * step) for k in np.linspace(-1, 1, tries)])
    placed = tried.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    return np.any(_states(voxel_map, placed).reshape(tried.shape[:-1]) >= State.TENTATIVE, axis=0)


def _states(surfaces: Surfaces, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the states (N,) of points (N, 3), free also where evidence leans to that without deciding."""
    return leaning(surfaces, points, State.FREE) if isinstance(surfaces, VoxelMap) else surfaces.state(points)


def _fault(
    voxel_map: VoxelMap,
    image: AnyImage,
    points: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    placed: Placed,
    align: bool,
) -> str:
    """Return as `explained`; searches for another pose only if `align`, for that takes longest."""
    pose = partial(pose_on_surfaces, voxel_map, image) if align else None
    return explained(voxel_map, image.T_world_sensor, points, tolerance, placed.lengths, FAULTS, pose)


def explained(
    surfaces: Surfaces,
    T: Transform,
    points: NDArray[np.float64],
    tolerance: NDArray[np.float64],
    lengths: NDArray[np.float64],
    faults: Mapping[str, NDArray[np.float64]],
    pose: Callable[[], Transform | None] | None,
) -> str:
    """Return the fault under which points (N, 3) of a sensor at T would be on the map's surfaces, "" if none fits.

    It tries `faults`, depths too large or too small by a factor or by some metres (lengths: as in `Placed`), and
    another pose of the sensor, `pose`.
    """
    points, tolerance, lengths = (thinned(values, TRIED) for values in (points, tolerance, lengths))
    found = np.isfinite(lengths) & (lengths > 0)
    if not found.any():
        return ""
    times = float(np.median(lengths[found]))
    away = np.linalg.norm(points, axis=1)
    metres = float(np.median((lengths - 1)[found] * away[found]))
    tried = [
        *(points @ matrix.T for matrix in faults.values()),
        times * points,
        points * (1 + metres / away)[:, None],
    ]
    names = [*faults, f"seen with depths x {1 / times:.2g}", f"seen with depths {-metres:+.2g} m"]
    shares = _on_surface(surfaces, T, np.stack(tried), np.broadcast_to(tolerance, (len(tried), len(points)))).mean(1)
    as_it_is = float(_on_surface(surfaces, T, points, tolerance).mean())
    enough = as_it_is + max(EXPLAINED * (1 - as_it_is), GAIN)
    best = int(shares.argmax())
    if shares[best] >= enough:
        return "moved" if " about " in names[best] else names[best]
    elsewhere = pose() if pose is not None else None
    if elsewhere is not None and _on_surface(surfaces, elsewhere, points, tolerance).mean() >= enough:
        return "moved"
    return ""


def pose_on_surfaces(voxel_map: VoxelMap, image: AnyImage) -> Transform | None:
    """Return a T_world_sensor (4, 4) near the image's own that brings its points onto the map's surfaces.

    None if there is no such pose, or if the image is already there to within a cell.

    Iterative closest points, from points with normals to the centres of cells (Chen and Medioni 1992); the search
    radius shrinks with each iteration.
    """
    points, normals = _surfaces(image, FARTHEST * voxel_map.config.max_range)
    T, last = image.T_world_sensor, min(REACH_M, REACH_CELLS * voxel_map.voxel_size)
    for reach in np.geomspace(REACH_M, last, STEPS):
        there, planes = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
        found = voxel_map.nearest_obstacle(there, float(reach)) if len(there) else None
        near = np.isfinite(found.distance) if found else np.zeros(0, bool)
        if found is None or near.sum() < MIN_POINTS:
            return None
        T = _motion(there[near], planes[near], voxel_map.centers(found.cell[near])) @ T
    shift_m, turn = apart(tuple(image.T_world_sensor[:3].ravel().tolist()), tuple(T[:3].ravel().tolist()))
    moved_m = np.linalg.norm(points @ (T - image.T_world_sensor)[:3, :3].T + (T - image.T_world_sensor)[:3, 3], axis=1)
    elsewhere = moved_m.mean() > voxel_map.voxel_size and shift_m <= MAX_SHIFT_M and turn <= MAX_TURN
    return T if elsewhere else None


def _sampled(image: AnyImage, most: int, reach: float) -> NDArray[np.float64]:
    """Return about `most` of the image's points (N, 3) up to `reach` metres from the sensor, in its frame."""
    if isinstance(image, CheckedCloud):
        points = image.ends[image.hits]
        return thinned(points[_near(points, reach)], most)
    step = max(1, round((image.depth_m.size / most) ** 0.5))
    rows, columns = (np.arange(step // 2, size, step) for size in image.depth_m.shape)
    points = _points(image, *np.meshgrid(rows, columns, indexing="ij")).reshape(-1, 3)
    return points[_near(points, reach)]


def _near(points: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """Return which points (..., 3) are finite, within `reach` metres of the sensor, and not at its origin."""
    with np.errstate(over="ignore"):
        away = np.linalg.norm(points, axis=-1)
    return (away > 0) & (away <= reach)


def thinned(values: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """Return every n-th of the values (N, ...), at most `most` in all."""
    return values[:: max(1, -(-len(values) // most))]


def _surfaces(image: AnyImage, reach: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return some points (N, 3) within `reach` metres of the sensor, and their normals (N, 3), in its frame."""
    if isinstance(image, CheckedCloud):
        points = image.ends[image.hits]
        return _surfaces_of_cloud(points[_near(points, reach)])
    height, width = image.depth_m.shape
    step = max(1, round((image.depth_m.size / ALIGNED) ** 0.5))
    rows, columns = (np.arange(BESIDE, size - BESIDE, step) for size in (height, width))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    here = _points(image, v, u)
    across = _points(image, v, u + BESIDE) - _points(image, v, u - BESIDE)
    down = _points(image, v + BESIDE, u) - _points(image, v - BESIDE, u)
    normals = np.cross(across, down)
    length = np.linalg.norm(normals, axis=-1)
    seen = _near(here, reach) & np.isfinite(length) & (length > 0)
    return here[seen], normals[seen] / length[seen][:, None]


def _surfaces_of_cloud(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return some of these points and their normals, from planes fitted to the points around each."""
    from scipy.spatial import KDTree

    if len(points) < AROUND:
        return np.empty((0, 3)), np.empty((0, 3))
    points = thinned(points, DENSE)
    some = thinned(points, ALIGNED)
    _, near = KDTree(points).query(some, AROUND)
    arms = points[near] - points[near].mean(axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms))
    flat = spread[:, 0] < FLAT * spread[:, 1]  # a single ring of a lidar is a line, and has no normal
    return some[flat], axes[flat, :, 0]


def _points(image: DepthImage, v: NDArray[np.integer], u: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the points (..., 3) of pixels, NaN for those without depth."""
    columns, rows = (rays.astype(float) for rays in image.camera.rays())
    depth = np.where(np.isfinite(image.depth_m[v, u]), image.depth_m[v, u], np.nan)
    return np.stack([columns[u], rows[v, 0], rows[v, 1]], axis=-1) * depth[..., None]


def _motion(points: NDArray[np.float64], normals: NDArray[np.float64], onto: NDArray[np.float64]) -> Transform:
    """Return the small rigid motion (4, 4) that minimises the distances of points (N, 3) to others along normals."""
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


def _firm(sensor: InverseSensorModel, config: Config, camera: VirtualCamera | Lidar) -> int:
    """Return the evidence in thousandths above which a hit is firm."""
    return round(FIRM * int(sensor_table(sensor, config, camera).hit.max()))
