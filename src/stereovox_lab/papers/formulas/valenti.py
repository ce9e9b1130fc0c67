# SPDX-License-Identifier: Apache-2.0
"""Valenti 2018: Eq 4.1 to 4.7, 5.1 to 5.4, stitching, Eq 6.2 to 6.11, maps of chapter 7, Eq 8.1 to 8.9, Appendix A."""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from math import acos, asin, atan2, cos, exp, floor, log, pi, radians, sin, sqrt, tan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.cameras.wide import SphericalCamera
from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline, prepare
from stereovox.depth.sphere.grid import SphereGrid, accumulate, stitch
from stereovox.depth.stereo.disparity import point_sigma, reproject
from stereovox.errors import StereovoxError
from stereovox.evaluate import lidar_truth
from stereovox.evaluate.scores import score
from stereovox.frame import Frame, Reason, StereoFrame, Viewpoint
from stereovox.mapper import Mapper
from stereovox.maps import State, VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.sensors.noise import RangeNoise
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.formulas import SHARE, same, same_cells, settings

Floats = NDArray[np.float64]
Cell = tuple[int, ...]
WIDTH, HEIGHT, FIELD_DEG, BASELINE = 640, 120, 91.0, 0.15
"""The front rig of chapter 3, at a third of its size and few rows."""
FOCAL = 0.5 * WIDTH / tan(radians(FIELD_DEG / 2))
RCROP, STEP, LEAST_STD, CELL = 64, radians(2.0), 0.5, 0.5
"""Eq 5.1, Fig 5.10, Eq 5.4 (the threshold is not printed), Fig 7.2."""
K, FREE, UNKNOWN, OFF_PX = 0.75, 0.3, 0.5, 1.0
"""Fig 6.1; the disparity's error is not printed. Both, and the threshold: chosen, and stated in the profile."""
FRAMES, MOST, ROUND = 3, 3.5, 0.1
"""Pairs; the limit of log-odds (7.1: two bytes a cell); how far the table of the sensor model may be off after them."""
BAND, NEAR_PX, FAR_PX = slice(220, 400), 20, 12
"""Columns of the right image that show a near surface, and the disparities of near and far."""
PRINTED: dict[str, Any] = {
    "voxel_size": 0.5, "min_range": 0.5, "max_range": 20.0, "blind_range": 0.0, "integrator": "ray",
    "stereo.method": "sgm8", "stereo.block_size": 5, "stereo.aligned": "right", "stereo.halve": True,
    "stereo.rcrop": 64, "stereo.min_confidence": 0.0, "stereo.subpixel": 1.0, "depth.denoise": False,
    "sphere.step_deg": 2.0, "sphere.statistic": "robust", "sphere.std_threshold": 0.5, "sphere.spread": 3.0,
    "sensor.model": "valenti", "sensor.k": 0.75, "sensor.p_free": 0.3, "sensor.p_unknown": 0.5,
    "map.cell": "int16", "map.prior": 0.5, "map.log_odds_min": -3.5, "map.log_odds_max": 3.5,
    "map.free_below": 0.3, "map.occupied_above": 0.7, "ray.update": "once",
}  # fmt: skip


def pair(seed: int) -> StereoFrame:
    """Return images of dots: a far wall, and before it a near one in some columns of the right image."""
    rng = np.random.default_rng(seed)
    right = rng.integers(20, 235, (HEIGHT // 2, WIDTH // 2)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    left = rng.integers(20, 235, (HEIGHT // 2, WIDTH // 2)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    left[:, FAR_PX:] = right[:, :-FAR_PX]
    left[:, BAND.start + NEAR_PX : BAND.stop + NEAR_PX] = right[:, BAND]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = TURN, (0.21, 0.13, 1.07)
    return StereoFrame(left, right, StereoPair(eyes_camera()), T, stamp_ns=seed * 100_000_000)


TURN = np.array([[sin(0.3), 0, cos(0.3)], [-cos(0.3), 0, sin(0.3)], [0, -1, 0]])
"""Level, 0.3 radians to the left of the world's x axis."""


def eyes_camera() -> PinholeCamera:
    """Return the camera of both eyes."""
    return PinholeCamera.from_field_of_view(WIDTH, HEIGHT, FIELD_DEG, BASELINE)


def matching() -> list[Claim]:
    """Return the claims on 5.1 and 5.2: the right image's pixels, halved images, the crop, and Eq 4.1's depth."""
    one = pair(0)
    found = DepthPipeline(load_config("valenti2018")).matched(one)
    assert found.reason is not None
    valid = found.reason == Reason.VALID
    twin = np.full((HEIGHT, WIDTH), FOCAL * BASELINE / FAR_PX)
    twin[:, BAND] = FOCAL * BASELINE / NEAR_PX
    steady = np.s_[8:-8, 16 : WIDTH - RCROP - 8]
    depth = np.where(valid, found.depth, np.nan)
    eye = one.T_world_sensor[:3, 3] + BASELINE * TURN[:, 0]
    kept = np.arange(WIDTH) < WIDTH - RCROP
    near = np.nansum(depth < (twin.min() + twin.max()) / 2, axis=0) > HEIGHT / 2
    shown = np.zeros(WIDTH, bool)
    shown[BAND] = True
    return [
        same_cells("Eq 5.1: columns with a depth; the right-most rcrop have none", valid.any(axis=0), kept,
                   SHARE),
        same("Eq 4.1, 6.8: depth from disparity, pixels of the right image", (depth / twin)[steady],
             np.ones_like(twin[steady]), 0.02, 0.9),
        same_cells("5.1: a near surface, columns of the right image", near, shown, 0.95),
        same("5.1: the depth's pose is the right eye's", found.T_world_sensor[:3, 3], eye, 1e-9),
    ]  # fmt: skip


def reprojection() -> list[Claim]:
    """Return the claims on Eq 4.1 to 4.7."""
    rng, step = np.random.default_rng(1), 0.02
    d = rng.uniform(2, 30, (9, 16))
    flat, wide = PinholeCamera(16, 9, 40, 40, 7.3, 4.1, 0.2), SphericalCamera(16, 9, step, 1.5 * step, 7.3, 4.1, 0.2)
    points, sigma, wide_d, wide_points, wide_sigma = (np.empty((9, 16, 3)) for _ in range(5))
    for v in range(9):
        for u in range(16):
            px = d[v, u]
            points[v, u] = (u - 7.3) * 0.2 / px, (v - 4.1) * 0.2 / px, 40 * 0.2 / px
            sigma[v, u] = [abs(x) / px * 0.5 for x in points[v, u]]
            a, b, k = (u - 7.3) * step, (v - 4.1) * 1.5 * step, rng.uniform(1, 9)
            x, y, z = k * sin(a), k * cos(a) * sin(b), k * cos(a) * cos(b)
            wide_points[v, u] = x, y, z
            wide_d[v, u] = (asin((x + 0.2) / sqrt((x + 0.2) ** 2 + y**2 + z**2)) - a) / step  # both eyes' angles
            w = 0.2 * step * (1 + 1 / tan(wide_d[v, u, 0] * step) ** 2) * 0.5 * cos(a)
            wide_sigma[v, u] = [abs(w * part) for part in (sin(a), cos(a) * sin(b), cos(a) * cos(b))]
    found, found_wide = reproject(d, flat, "right"), reproject(wide_d[..., 0], wide, "right")
    return [
        same("Eq 4.1: points of a pinhole pair", found, points, 1e-6),
        same("Eq 4.2: their uncertainty", point_sigma(d, flat, 0.5, "right"), sigma, 1e-6),
        same("Eq 4.3 to 4.6: points of a spherical pair", found_wide, wide_points, 1e-5),
        same("Eq 4.7: their uncertainty", point_sigma(wide_d[..., 0], wide, 0.5, "right"), wide_sigma, 1e-5),
    ]


def sphere_cells(points: Floats) -> dict[Cell, list[float]]:
    """Eq 5.2 and 5.3: the ranges (rho) of points (N, 3) by cell of the grid, polar and azimuth."""
    found: dict[Cell, list[float]] = defaultdict(list)
    for x, y, z in points.tolist():
        rho = sqrt(x * x + y * y + z * z)
        found[floor(acos(z / rho) / STEP), floor((atan2(y, x) + pi) / STEP)].append(rho)
    return found


def summary(ranges: list[float]) -> float:
    """Eq 5.4: the most dangerous range of a cell."""
    mean = sum(ranges) / len(ranges)
    std = sqrt(sum((r - mean) ** 2 for r in ranges) / len(ranges))
    return mean - 3 * std if std < LEAST_STD else min(ranges)


def spheres() -> list[Claim]:
    """Return the claims on 5.3 and 5.4: the grids of two cameras, and both stitched."""
    config, camera = load_config("valenti2018"), PinholeCamera.from_field_of_view(160, 60, FIELD_DEG, BASELINE)
    grids, twins = [], []
    for seed, yaw in enumerate((0.2, 0.9)):
        rng = np.random.default_rng(seed)
        v, u = np.mgrid[:60, :160]
        z = 3 + 0.01 * u + rng.normal(0, 0.05, u.shape)
        z[20:40, 40:90], z[:, 120:] = 1.5 + rng.normal(0, 0.05, (20, 50)), 2 + 6 * rng.random((60, 40))
        T = np.eye(4)
        T[:3, :3] = np.array([[sin(yaw), 0, cos(yaw)], [-cos(yaw), 0, sin(yaw)], [0, -1, 0]])
        T[:3, 3] = 0.1, -0.05, 0.07
        z = z.astype(np.float32)
        image = prepare(Frame(z, camera, np.eye(4), depth_scale=1.0), config)
        grids.append(accumulate(image, T, config))
        seen = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1).reshape(-1, 3)
        twins.append({cell: summary(ranges) for cell, ranges in sphere_cells(seen @ T[:3, :3].T + T[:3, 3]).items()})
    both = {cell: min(twin.get(cell, np.inf) for twin in twins) for cell in twins[0].keys() | twins[1].keys()}
    texts = ("Eq 5.2 to 5.4: ranges of the spherical grid", "5.4: stitched grids, the nearest wins")
    ours, wanted = (grids[0], stitch(grids)), (twins[0], both)
    return [_ranges(*one) for one in zip(texts, ours, wanted, strict=True)]


def _ranges(text: str, grid: SphereGrid, twin: dict[Cell, float]) -> Claim:
    ours, wanted = grid.range_m.T, _dense(twin)
    if ours.shape != wanted.shape:
        return same(text, ours, wanted)
    known = ~np.isnan(ours) | ~np.isnan(wanted)
    return same(text, ours[known], wanted[known], 1e-3, SHARE)


def _dense(twin: dict[Cell, float]) -> Floats:
    found = np.full((round(pi / STEP), round(2 * pi / STEP)), np.nan)
    for cell, value in twin.items():
        found[cell] = value
    return found


def probability(m: float, z: float, dz: float) -> float:
    """Eq 6.4 to 6.6."""
    a = K * (1 - UNKNOWN) * exp(-dz)
    if m <= z:
        return FREE + (a + UNKNOWN - FREE) * exp(-0.5 * ((m - z) / dz) ** 2)
    c = sqrt(log(1 + a / (a + 1 - 2 * FREE)) / log(2)) * dz
    return UNKNOWN + a * exp(-0.5 * ((m - z) / c) ** 2)


def evidence(eye: Floats, turn: Floats, ranges: dict[Cell, float]) -> dict[Cell, float]:
    """Eq 6.2: the strongest log-odds of each cell that rays of the spherical grid cross, up to four dz behind.

    z of Eq 6.4 and 6.9 is the distance from the grid's axis, as stereovox has it (the thesis leaves that open).
    """
    found: dict[Cell, list[float]] = defaultdict(list)
    for (i, j), rho in ranges.items():
        theta, phi = (i + 0.5) * STEP, (j + 0.5) * STEP - pi
        ray = turn @ [sin(theta) * cos(phi), sin(theta) * sin(phi), cos(theta)]
        flat = sin(theta)
        z = rho * flat
        dz = z * z / (BASELINE * FOCAL) * OFF_PX  # Eq 6.9
        own = tuple(np.floor((eye + rho * ray) / CELL).astype(int).tolist())
        cuts, end = {0.0}, (z + 4 * dz) / flat
        for axis in range(3):
            low, high = sorted((eye[axis], eye[axis] + end * ray[axis]))
            cuts |= {(CELL * n - eye[axis]) / ray[axis] for n in range(floor(low / CELL) + 1, floor(high / CELL) + 1)}
        borders = sorted(cuts | {end})
        for entered, left in pairwise(borders):
            middle = (entered + left) / 2
            cell = tuple(np.floor((eye + middle * ray) / CELL).astype(int).tolist())
            if cell != own:
                p = probability(middle * flat, z, dz)
                found[cell].append(log(p / (1 - p)))
        p = probability(z, z, dz)
        found[own].append(log(p / (1 - p)))
    return {cell: max(said) if max(said) >= 0.0005 else min(said) for cell, said in found.items()}


def map_claims() -> list[Claim]:
    """Return the claims on chapter 6: the map of three pairs, cell by cell, from their depth on."""
    mapper, pipeline = Mapper("valenti2018"), DepthPipeline(load_config("valenti2018"))
    kept: dict[Cell, float] = {}
    hits = set[Cell]()
    for seed in range(FRAMES):
        one = pair(seed)
        report = mapper.add(one)
        if report.refused:
            raise StereovoxError(report.detail)
        image = pipeline.matched(one)
        eye = one.T_world_sensor[:3, 3] + BASELINE * TURN[:, 0]
        z = np.where(image.reason == Reason.VALID, image.depth, np.nan).astype(float)
        v, u = np.nonzero((z >= 0.5) & (z <= 20))
        z = z[v, u]
        x, y = (u - (WIDTH - 1) / 2) / FOCAL * z, (v - (HEIGHT - 1) / 2) / FOCAL * z
        ranges = {
            cell: summary(rhos) for cell, rhos in sphere_cells(np.stack([z, -x, -y], axis=1).astype(float)).items()
        }
        for cell, said in evidence(eye, TURN @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), ranges).items():
            kept[cell] = min(max(kept.get(cell, 0) + said, -MOST), MOST)
            hits |= {cell} if said > 0 else set()
    cells = sorted(kept)
    places = (np.array(cells) + 0.5) * CELL
    ours = mapper.map.log_odds(places)
    twin, marked = np.array([kept[cell] for cell in cells]), np.array([cell in hits for cell in cells])
    return [
        same("Eq 6.2, 6.4 before: log-odds of cleared cells", ours[~marked], twin[~marked], ROUND, 0.97),
        same("Eq 6.4 to 6.6, 6.9: log-odds of marked cells", ours[marked], twin[marked], ROUND, 0.97),
        same_cells(
            "Eq 8.1: occupied cells, p above 0.7",
            mapper.map.state(places) == State.OCCUPIED,
            twin > log(0.7 / 0.3),
            0.95,
        ),
    ]


def noise() -> list[Claim]:
    """Return the claim on Eq 6.9 to 6.11: dz of a pinhole and of a spherical camera."""
    config, step = load_config("valenti2018").noise, 2.5 / 1200
    wide = SphericalCamera(400, 300, step, step, 200, 150, 0.1, subpixel=0.5)
    flat = PinholeCamera(600, 400, 500, 500, 300, 200, 0.1, subpixel=0.5)
    z = np.array([0.5, 2.0, 6.0, 15.0])
    d = np.arctan(0.1 / z) / step
    twin = [*(z**2 / (0.1 * 500) * 0.5), *(0.1 * step * (1 + 1 / np.tan(d * step) ** 2) * 0.5)]
    ours = [*RangeNoise.of(config, flat).sigma(z), *RangeNoise.of(config, wide).sigma(z)]
    return [same("Eq 6.9 to 6.11: dz against z", ours, twin, 1e-9)]


def _after_flight(config: Config, size: tuple[int, int, int], cell: Floats, moves: bool) -> tuple[set[Cell], set[Cell]]:
    """Return the cells of our map after a flight, and of a twin whose box stays, or moves when its centre is left."""
    voxel_map, rng, twin = make_map(config), np.random.default_rng(6), set[Cell]()
    half, place, T = np.array(size) // 2, np.array([0.02, 0.03, 0.04]), np.eye(4)
    centre = np.zeros(3, int) if moves else np.array([half[0], 0, 0])
    for i in range(40):
        place = place + rng.uniform(-0.15, 0.3, 3)
        T[:3, 3] = place
        voxel_map.storage.set_viewpoint(Viewpoint(eyes_camera(), T.copy(), i * 100_000_000))
        for axis in range(3 if moves else 0):  # 7.2.1: by whole cells, until the drone is in the middle again
            while abs(place[axis] - centre[axis] * cell[axis]) > cell[axis] / 2:
                centre[axis] += 1 if place[axis] > centre[axis] * cell[axis] else -1
        low, high = (centre - half).astype(int), (centre - half + size).astype(int)
        blocks = np.unique(rng.integers(low // 8 - 1, high // 8 + 1, (30, 3)), axis=0).astype(np.int32)
        values = np.zeros((len(blocks), 512), np.int16)
        values[:, [0, 219]] = 700  # cells (0, 0, 0) and (3, 3, 3) of each block
        voxel_map.add(Evidence(blocks, values, np.empty((0, 3), np.int32), np.empty(0, np.int16)))
        twin |= {tuple(one) for first in (0, 3) for one in (8 * blocks + first).tolist()}
        twin = {one for one in twin if (one >= low).all() and (one < high).all()}
    return set(map(tuple, voxel_map.cells()[0].tolist())), twin


def _kept(text: str, ours: set[Cell], twin: set[Cell]) -> Claim:
    either = sorted(ours | twin)
    return same_cells(text, np.array([one in ours for one in either]), np.array([one in twin for one in either]))


def global_map() -> list[Claim]:
    """Return the claim on 7.1: a fixed box with steps of its own on each axis."""
    size, steps = [100.0, 40.0, 10.0], [0.5, 0.5, 0.25]
    config = load_config("valenti2018", steps=steps, **{"window.size": size, "window.centre": [50.0, 0.0, 0.0]})
    found = _after_flight(config, (200, 80, 40), np.array(steps), False)
    size_of_cell = make_map(config).storage.cell_format.dtype.itemsize
    return [_kept("7.1, global map: cells after a flight", *found), same("7.1: bytes of a cell", [size_of_cell], [2])]


def local_map() -> list[Claim]:
    """Return the claim on 7.2: a box that moves by whole cells with the drone."""
    settings_of = {"window.size": [8.0, 8.0, 5.0], "window.trigger": 0.125}
    config = load_config("valenti2018", voxel_size=0.25, **settings_of)
    found = _after_flight(config, (32, 32, 20), np.full(3, 0.25), True)
    return [_kept("7.2, local map: cells after a flight", *found)]


def metrics() -> list[Claim]:
    """Return the claims on Eq 8.1 to 8.9: a made-up map and truth, cell by cell."""
    rng, config = np.random.default_rng(9), load_config("valenti2018")
    cells = np.indices((9, 8, 7)).reshape(3, -1).T
    actual, seen = rng.random(len(cells)) < 0.3, rng.random(len(cells)) < 0.8
    p = np.clip(rng.normal(0.35 + 0.35 * actual, 0.2), 0.05, 0.95)
    truth = VoxelMap.from_cells(config, cells, np.where(actual, 3.0, -3.0))
    found = score(VoxelMap.from_cells(config, cells[seen], np.log(p / (1 - p))[seen]), truth)
    tp = fp = tn = fn = 0
    error, known = 0.0, 0
    for observed, probability_, surface in zip(seen.tolist(), p.tolist(), actual.tolist(), strict=True):
        called = observed and probability_ > 0.7
        tp, fp = tp + (called and surface), fp + (called and not surface)
        tn, fn = tn + (not called and not surface), fn + (not called and surface)
        if observed:
            error, known = error + (probability_ - surface) ** 2, known + 1
    rates = [(tp + tn) / len(cells), tp / (tp + fp), tp / (tp + fn), tn / (fp + tn), tn / (tn + fn), error / known]
    ours = [found.accuracy, found.precision, found.recall, found.specificity, found.npv, found.error]
    likeness = [_correlation(np.where(seen, p, unseen), actual.astype(float)) for unseen in (0.5, 0.0)]
    return [
        same("Eq 8.1 to 8.7: rates and error", [float(value or 0) for value in ours], rates, 1e-3),
        same("Eq 8.8 and 8.9: correlation, unobserved at 0.5, and as free",
             [float(found.correlation or 0), float(found.correlation_free or 0)], likeness, 1e-3),
    ]  # fmt: skip


def _correlation(m: Floats, g: Floats) -> float:
    """Eq 8.8 and 8.9, divided by N."""
    n, mean_m, mean_g = len(m), float(m.mean()), float(g.mean())
    total = sum((a - mean_m) * (b - mean_g) for a, b in zip(m.tolist(), g.tolist(), strict=True))
    std = [sqrt(sum((a - mean) ** 2 for a in values.tolist()) / n) for values, mean in ((m, mean_m), (g, mean_g))]
    return total / n / (std[0] * std[1])


def appendix_a() -> list[Claim]:
    """Return the claim on Eq A.1 to A.3: points in a turned box, by the box's own coordinates."""
    rng = np.random.default_rng(12)
    q, size, origin = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.array([4.0, 1.7, 1.5]), np.array([3.0, -2.0, 0.4])
    points = origin + rng.uniform(-1, 5, (500, 3)) @ q.T
    own = (points - origin) @ q
    corners = (origin, *(origin + size[i] * q[:, i] for i in range(3)))
    twin = np.asarray(((own >= 0) & (own <= size)).all(axis=1), bool)
    return [same_cells("Eq A.1 to A.3: points in an annotated box", lidar_truth.inside(points, corners), twin)]


def profile() -> list[Claim]:
    """Return the claim on the profile's settings."""
    return [settings(load_config("valenti2018"), PRINTED, "Chapters 3 to 8")]


CHECKS = (matching, reprojection, spheres, map_claims, noise, global_map, local_map, metrics, appendix_a, profile)
