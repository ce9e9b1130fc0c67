# SPDX-License-Identifier: Apache-2.0
"""Chien 2020: Alg 1 to 3, Eq 3.3 to 3.6, 3.20, 3.21, block minimum, bytes, map shifting, coordinates, Appendix A."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from math import pi, radians, tan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.wall import Points, fit
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.prepare import correct
from stereovox.errors import StereovoxError
from stereovox.frame import Frame, Viewpoint
from stereovox.mapper import Mapper
from stereovox.maps import State, VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.sources.poses import tracker
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.formulas import SHARE, same, same_cells, settings

Floats = NDArray[np.float64]
Walk = Iterator[tuple[NDArray[np.int64], Floats]]
"""Of all rays in step: the cells (N, 3) they are in, and the depths (N,) that stand for these."""
WIDTH, HEIGHT, HFOV_DEG, BASELINE, CELL = 848, 480, 91.2, 0.05, 0.2
"""Table 2.1, and the cell of 3.5.1."""
RATIO, SUBPIXEL, K, P_MIN, P_MOST, FAR, NEAR = 8, 0.08, 0.05, 0.25, 0.93, 10.0, 0.2
"""3.2, 2.2.4; k, p_min and the clamp are not printed: chosen, and stated in docs/chien2020.md."""
FOCAL = 0.5 * WIDTH / tan(radians(HFOV_DEG / 2))
"""Eq 3.6."""
PER_LOG_ODDS = (180 - 127) / np.log(0.7 / 0.3)
"""3.5: 127 is unknown, 180 the threshold, taken as p = 0.7."""
SHAPE = np.array([100, 30, 100])
"""Table 4.1."""
STEPS = 125
"""Cells along a ray: 10 m at 45 degrees, and four sigma behind."""
FRAMES = 2
BYTES = 2
"""One a frame: ours rounds to thousandths of log-odds, then to bytes, and tabulates the model."""
PRINTED: dict[str, Any] = {
    "voxel_size": 0.2, "min_range": 0.2, "max_range": 10.0, "blind_range": 0.0, "up": "-y", "integrator": "line",
    "depth.downsample": 8, "depth.denoise": False, "sensor.model": "andert", "sensor.k": 0.05,
    "sensor.p_free": 0.25, "sensor.p_max": 0.93, "map.log_odds_min": -2.1, "map.log_odds_max": 2.1,
    "noise.subpixel": 0.08, "noise.default_baseline": 0.05, "map.cell": "uint8", "map.prior": 0.5,
    "map.free_below": 0.3, "map.occupied_above": 0.7, "window.size": [20.0, 6.0, 20.0], "window.trigger": 1.0,
    "window.outside": "drop", "ray.update": "every",
}  # fmt: skip


def depth_image(seed: int) -> NDArray[np.float32]:
    """Return an image (480, 848) of a made-up scene in metres: a slanted wall, boxes, holes, and noise of 0.08 px."""
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    z = 3.6 + 3.8 * (u / WIDTH - 0.5) + 1.5 * (v / HEIGHT - 0.5)
    for _ in range(14):
        left, top, wide, high = rng.integers([0, 0, 24, 24], [WIDTH, HEIGHT, 224, 174])
        z[top : top + high, left : left + wide] = rng.uniform(0.3, 9.6)
    rng = np.random.default_rng(seed)
    z += rng.normal(0, SUBPIXEL, z.shape) * z**2 / (FOCAL * BASELINE)
    z[rng.random(z.shape) < 0.1] = 0
    z[200:260, 40:120], z[300:360, 500:560] = 0, 10.4
    return z.astype(np.float32)


def block_minimum(depth: NDArray[np.float32]) -> Floats:
    """3.2: the smallest valid depth of each block; inf if all that a block measured is too far; NaN without any."""
    small = np.full((HEIGHT // RATIO, WIDTH // RATIO), np.nan)
    for j in range(HEIGHT // RATIO):
        for i in range(WIDTH // RATIO):
            block = depth[RATIO * j : RATIO * (j + 1), RATIO * i : RATIO * (i + 1)].astype(float)
            valid = block[(block >= NEAR) & (block <= FAR)]
            small[j, i] = valid.min() if valid.size else np.inf if (block > FAR).all() else np.nan
    return small


def inverse_model(z: Floats, measured: Floats, longer: Floats | float = 1.0) -> Floats:
    """Alg 3 with Eq 3.3 to 3.5 (distance squared): log-odds at depth z.

    longer: the factor len/z of Alg 3 on sigma, for a model along the ray. It cancels but in the height of the peak,
    if z is measured along the optical axis, as it is in Eq 3.5 and here.
    """
    sigma = measured**2 * SUBPIXEL / (FOCAL * BASELINE)
    before = np.where(z <= measured, P_MIN, 0.5)
    p = before + (K / (longer * sigma * np.sqrt(2 * pi)) + 0.5 - before) * np.exp(-0.5 * ((z - measured) / sigma) ** 2)
    p = np.minimum(p, P_MOST)
    return np.log(p / (1 - p))


def line_drawing(eye: Floats, ray: Floats) -> Walk:
    """Alg 1: rays (N, 3) per metre of depth, sampled one cell apart along their longest axis."""
    for n in range(STEPS):
        depth = n * CELL / np.abs(ray).max(axis=1)
        yield np.floor((eye + depth[:, None] * ray) / CELL).astype(int), depth


def traversal(eye: Floats, ray: Floats) -> Walk:
    """Alg 2: each step crosses the nearest border of cells; a cell's depth is the middle of the way through it."""
    ray = np.where(ray == 0, 1e-12, ray)
    cell, step = np.tile(np.floor(eye / CELL).astype(int), (len(ray), 1)), np.sign(ray).astype(int)
    t_max, entered, each = ((cell + (step > 0)) * CELL - eye) / ray, np.zeros(len(ray)), np.arange(len(ray))
    for _ in range(2 * STEPS):
        axis = np.argmin(t_max, axis=1)
        left = t_max[each, axis]
        yield cell.copy(), (entered + left) / 2
        cell[each, axis] += step[each, axis]
        t_max[each, axis] += CELL / np.abs(ray[each, axis])
        entered = left


def weight(depth: Floats) -> Floats:
    """Eq 3.21 with the pixels of a cell at 1 m by Eq 3.6; at most one measurement (docs/formulas.md)."""
    return np.minimum(1.0, depth**2 * RATIO**2 / (FOCAL * CELL) ** 2)


def rays_of(T: Floats, small: Floats) -> tuple[Floats, Floats]:
    """Return the rays (N, 3) per metre of depth of all pixels with a value, in the world, and their depths (N,)."""
    j, i = np.nonzero(~np.isnan(small))
    middle = (RATIO - 1) / 2
    x, y = ((RATIO * a + middle - (n - 1) / 2) / FOCAL for a, n in ((i, WIDTH), (j, HEIGHT)))
    return np.stack([x, y, np.ones(len(x))], axis=1) @ T[:3, :3].T, small[j, i]


def frame_log_odds(
    T: Floats, small: Floats, low: NDArray[np.int64], walk: Callable[[Floats, Floats], Walk], along_ray: bool = False
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return each cell's sum of DW L over all rays of a frame (Eq 3.20), and the cells that hold points."""
    ray, measured = rays_of(T, small)
    longer = np.linalg.norm(ray, axis=1) if along_ray else 1.0
    total, hits, far = np.zeros(SHAPE), np.zeros(SHAPE, bool), np.isinf(measured)
    d = np.where(far, FAR, measured)
    own = np.floor((T[:3, 3] + d[:, None] * ray) / CELL).astype(int) - low
    end = np.where(far, FAR, d + 4 * d**2 * SUBPIXEL / (FOCAL * BASELINE))

    def give(cells: NDArray[np.int64], amount: Floats, which: NDArray[np.bool_]) -> None:
        inside = which & ((cells >= 0) & (cells < SHAPE)).all(axis=1)
        np.add.at(total, tuple(cells[inside].T), amount[inside])

    for cells, depth in walk(T[:3, 3], ray):
        free = np.full(len(depth), np.log(P_MIN / (1 - P_MIN)))
        gain = np.where(far, free, inverse_model(depth, d, longer))
        give(cells - low, weight(depth) * gain, (depth <= end) & (far | (cells - low != own).any(axis=1)))
    give(own, weight(d) * inverse_model(d, d, longer), ~far)
    inside = ~far & ((own >= 0) & (own < SHAPE)).all(axis=1)
    hits[tuple(own[inside].T)] = True
    return total, hits


def pose() -> Floats:
    """Return a pose (4, 4) that looks along no axis."""
    a, b = 0.11, 0.07
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn @ tilt, [0.053, 0.031, 0.047]
    return T


def camera() -> PinholeCamera:
    """Return the D435 by its field of view alone; the baseline is the profile's."""
    return PinholeCamera.from_field_of_view(WIDTH, HEIGHT, HFOV_DEG)


def dense(voxel_map: VoxelMap, low: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the map's bytes (100, 30, 100) from cell `low` on."""
    centres = (np.indices(tuple(map(int, SHAPE))).reshape(3, -1).T + low + 0.5) * CELL
    return voxel_map.storage.stored_at(centres).astype(np.int64).reshape(SHAPE)


def image_claims() -> list[Claim]:
    """Return the claim on 3.2."""
    depth = depth_image(1)
    image = prepare(Frame(depth, camera(), np.eye(4), depth_scale=1.0), load_config("chien2020"))
    return [same("3.2, block minimum: each pixel is the smallest valid depth of 8 x 8", image.depth_m,
                 block_minimum(depth), 1e-6)]  # fmt: skip


def map_claims() -> list[Claim]:
    """Return the claims on the map of some frames at one pose, cell by cell; first by Alg 1, then by Alg 2."""
    said, marked, twin, ours = _mapped(Mapper("chien2020"), line_drawing)
    free, beside = said & ~marked & (twin < 127), said & ~marked & (twin > 127)
    crossed, _, twin_by_ray, by_ray = _mapped(Mapper("chien2020", integrator="ray"), traversal)
    return [
        _cells("Alg 1, line drawing: the cells that rays mark or clear", said, twin, ours),
        same("Eq 3.4, 3.20, 3.21: bytes of the cells that rays clear", ours[free], twin[free], BYTES, SHARE),
        same("Eq 3.3 to 3.6, Alg 3: bytes of the cells that hold points", ours[marked], twin[marked], BYTES, SHARE),
        same("Eq 3.3, 3.4: bytes of marked cells without a point", ours[beside], twin[beside], BYTES, SHARE),
        _cells("Alg 2, voxel traversal: the cells that rays mark or clear", crossed, twin_by_ray, by_ray),
        _along_ray(),
    ]


def _along_ray() -> Claim:
    """Return how much sigma along the ray (Alg 3) changes, which is not mapped so."""
    (ours, hits), (theirs, _) = _of_image(0, line_drawing), _of_image(0, line_drawing, along_ray=True)
    off = int((np.abs(PER_LOG_ODDS * (ours - theirs))[hits] > BYTES).sum())
    changed = int(((127 + PER_LOG_ODDS * ours > 180) != (127 + PER_LOG_ODDS * theirs > 180)).sum())
    text = "Alg 3 with sigma along the ray in the height of the peak, too: cells with points that would differ"
    found = f"{off:,} of {hits.sum():,} by more than {BYTES} bytes; {changed} change between occupied and not"
    return Claim(text, "not mapped so (docs/formulas.md)", found, None)


def _cells(text: str, said: NDArray[np.bool_], twin: NDArray[np.int64], ours: NDArray[np.int64]) -> Claim:
    return same_cells(text, (ours != 127) & (said | (twin == 127)), said, SHARE)


def _mapped(mapper: Mapper, walk: Callable[[Floats, Floats], Walk]) -> tuple[NDArray[Any], ...]:
    """Return the cells of which frames say more than half a byte, those with points, the twin's bytes, and ours."""
    twin, marked, said = np.full(SHAPE, 127), np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    for i in range(FRAMES):
        report = mapper.add(Frame(depth_image(i), camera(), pose(), stamp_ns=i * 33_000_000, depth_scale=1.0))
        if report.refused:
            raise StereovoxError(report.detail)
        total, hits = _of_image(i, walk)
        steps = np.rint(PER_LOG_ODDS * total)
        new = np.clip(twin + steps, 0, 255).astype(int)
        twin = np.where(steps == 0, twin, np.where(new == 127, 128, new))  # 127 stays "unknown"
        marked, said = marked | hits, said | (np.abs(PER_LOG_ODDS * total) > 1)
    return said, marked, twin, dense(mapper.map, -SHAPE // 2)


@cache
def _of_image(
    seed: int, walk: Callable[[Floats, Floats], Walk], along_ray: bool = False
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return `frame_log_odds` of a made-up image: read-only, and the same whatever fault an audit applies."""
    found = frame_log_odds(pose(), block_minimum(depth_image(seed)), -SHAPE // 2, walk, along_ray)
    for array in found:
        array.flags.writeable = False
    return found


def bytes_claims() -> list[Claim]:
    """Return the claims on 3.5: the byte of probabilities, its limits, and the threshold of the display."""
    p = np.array([0.05, 0.2, 0.31, 0.45, 0.6, 0.69, 0.71, 0.8, 0.95])
    cells, config = np.arange(len(p))[:, None] * [1, 0, 0], load_config("chien2020", **{"window.size": None})
    voxel_map = VoxelMap.from_cells(config, cells, np.log(p / (1 - p)))
    places = (cells + 0.5) * CELL
    stored = voxel_map.storage.stored_at(places)
    twin = np.clip(np.rint(127 + PER_LOG_ODDS * np.log(p / (1 - p))), 0, 255)
    unknown = int(voxel_map.storage.stored_at(places[:1] + 50)[0])
    mapper = Mapper(config)
    for i in range(12):
        mapper.add(Frame(depth_image(i), camera(), pose(), stamp_ns=i * 33_000_000, depth_scale=1.0))
    found = dense(mapper.map, -SHAPE // 2)
    return [
        same("3.5: bytes from 0 to 255, 127 for unknown", [*stored, unknown, found.min(), found.max()],
             [*twin, 127, 0, 255], 0.5),
        same("3.5: occupied above a byte of 180", voxel_map.state(places) == State.OCCUPIED, twin > 180),
    ]  # fmt: skip


def shifting() -> list[Claim]:
    """Return the claim on 3.6: after a flight, the map holds what a map that shifts unit by unit holds."""
    config, rng = load_config("chien2020"), np.random.default_rng(5)
    voxel_map, twin, centre = make_map(config), dict[tuple[int, ...], int](), np.zeros(3, int)
    place, T = np.array([0.05, 0.05, 0.05]), np.eye(4)
    for i in range(60):
        place = place + rng.uniform(-0.2, [0.5, 0.4, 0.7])
        T[:3, 3] = place
        voxel_map.storage.set_viewpoint(Viewpoint(camera(), T.copy(), i * 100_000_000))
        for axis in range(3):
            while abs(place[axis] - centre[axis] * CELL) > 1.0:  # Table 4.1: the trigger box
                centre[axis] += 1 if place[axis] > centre[axis] * CELL else -1
        low, high = centre - SHAPE // 2, centre + SHAPE // 2
        twin = {cell: value for cell, value in twin.items() if (cell >= low).all() and (cell < high).all()}
        blocks = np.unique(rng.integers((low - 12) // 8, (high + 12) // 8, (40, 3)), axis=0).astype(np.int32)
        values = np.zeros((len(blocks), 512), np.int16)
        values[:, 73] = 1000
        voxel_map.add(Evidence(blocks, values, np.empty((0, 3), np.int32), np.empty(0, np.int16)))
        for cell in (8 * blocks + [1, 1, 1]).tolist():
            if (cell >= low).all() and (cell < high).all():
                twin[tuple(cell)] = twin.get(tuple(cell), 127) + round(PER_LOG_ODDS)
    ours = {tuple(cell) for cell in voxel_map.cells()[0].tolist()}
    both, text = len(ours & twin.keys()), "3.6, map shifting: cells left after a flight of 60 frames"
    return [Claim(text, f"the same {len(twin):,} cells", f"{both:,} of {len(ours | twin.keys()):,}",
                  both == len(ours | twin.keys()) > 100)]  # fmt: skip


def coordinates() -> list[Claim]:
    """Return the claim on 4.1: a T265's pose (x right, y up, z backward) in the map's axes."""
    rng = np.random.default_rng(8)
    q, T = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.eye(4)
    T[:3, :3], T[:3, 3] = q * np.linalg.det(q), rng.normal(size=3)
    ours = tracker.turned(T[None], "opengl", "optical")[0]
    point = rng.normal(size=3)  # as the body sees it: right, down, forward
    seen = T[:3, :3] @ [point[0], -point[1], -point[2]] + T[:3, 3]
    return [same("4.1: coordinates of the T265 in those of the map", ours[:3, :3] @ point + ours[:3, 3],
                 [seen[0], -seen[1], -seen[2]], 1e-9)]  # fmt: skip


def appendix_a() -> list[Claim]:
    """Return the claim on Eq A.1 to A.3: a wall whose depth is a quadratic in X becomes flat at its true distance."""
    true, (a, b, c), at = 1.4, (0.09, 0.02, 1.43), camera()
    x = (np.arange(WIDTH) - (WIDTH - 1) / 2) / FOCAL
    z = np.full(WIDTH, true)
    for _ in range(60):
        z = a * (x * z) ** 2 + b * x * z + c
    rows = slice(0, HEIGHT, 60)
    Z = np.tile(z, (HEIGHT, 1))
    y = (np.arange(HEIGHT) - (HEIGHT - 1) / 2) / FOCAL
    X, Y = (np.broadcast_to(one, Z.shape)[rows, ::8].ravel().astype(float) for one in (x, y[:, None]))
    fitted = fit("thesis", [Points(X, Y, 1 / Z[rows, ::8].ravel(), true, True)])
    depth = Z.astype(np.float32)
    correct(depth, replace(at, correction=fitted))
    p1, p2, p3 = np.polyfit(x * z, z, 2)
    twin = z - (p1 * (x * z) ** 2 + p2 * x * z + p3 - true)
    return [same("Eq A.1 to A.3, fit subtracted: a distorted wall is flat", depth[100], twin, 2e-4)]


def profile() -> list[Claim]:
    """Return the claim on the profile's settings."""
    return [settings(load_config("chien2020"), PRINTED, "Table 4.1, chapters 2 and 3")]


CHECKS = (image_claims, map_claims, bytes_claims, shifting, coordinates, appendix_a, profile)
