# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twins of the integrators in float64 NumPy. They share no code with the kernels.

All return evidence on cells as two arrays: indices (N, 3) int64 in ascending order, log-odds (N,) float64 without
zeros. Tests compare the kernels with them, and them with OctoMap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import RangeSensor
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import CheckedCloud, DepthImage
from stereovox.sensors.noise import PoseNoise, RangeNoise
from stereovox.sensors.protocol import COLUMNS, REACH_SIGMA, ROWS, InverseSensorModel, SensorTable, tabulate

WINDOW_SHARE, RIM_SHARE, NEAR_PLANE, MAX_LEVEL = 0.27, 0.35, 1e-3, 8

Cells = tuple[NDArray[np.int64], NDArray[np.float64]]


def cast_rays(image: DepthImage, config: Config, sensor: InverseSensorModel) -> Cells:
    """Walk every pixel's ray through all grid planes it crosses; `config.ray.update` says how rays share a cell."""
    return _shared(image, config, sensor, _crossed)


def draw_lines(image: DepthImage, config: Config, sensor: InverseSensorModel) -> Cells:
    """Sample every pixel's ray once in each layer of cells along its longest axis (Chien 2020, Alg 1)."""
    return _shared(image, config, sensor, _sampled)


def _shared(image: DepthImage, config: Config, sensor: InverseSensorModel, depths_of: Callable) -> Cells:
    table = _table(image, config, sensor)
    indices, evidence, depths = zip(*_rays(image, config, table, depths_of), strict=True)
    indices, evidence, depths = np.concatenate(indices), np.concatenate(evidence), np.concatenate(depths)
    if config.ray.update == "once":
        return _strongest(indices, evidence)
    focal_px = image.camera.focal_px / image.camera.binning
    weight = np.minimum(1.0, (depths / (focal_px * config.voxel_size)) ** 2)  # Chien 2020, Eq 3.21
    cells, of_cell = _distinct(indices)
    return _known(cells, np.bincount(of_cell, weight * evidence))


def cast_points(cloud: CheckedCloud, config: Config, sensor: InverseSensorModel) -> Cells:
    """Walk the ray of each point through all grid planes it crosses; the strongest evidence counts in each cell."""
    noise, pose_noise = RangeNoise(cloud.lidar.sigma, 0, 0), PoseNoise.of(config.noise)
    table = tabulate(sensor, noise, config.max_range, config.voxel_size, pose_noise)
    table = replace(table, **{name: np.round(getattr(table, name), 3) for name in ("log_odds", "hit", "passed")})
    T, size = cloud.T_world_sensor, np.array(config.cell)
    reach = REACH_SIGMA * table.sigma
    marks = bool((table.log_odds > 0).any())
    indices, evidence = [np.empty((0, 3), np.int64)], [np.empty(0)]
    for number, end in enumerate(cloud.ends):
        origin = np.zeros(3) if cloud.origins is None else cloud.origins[number]
        start, point = (T[:3, :3] @ place + T[:3, 3] for place in (origin, end))
        length = np.linalg.norm(point - start)
        direction = (point - start) / length
        hit = cloud.hits[number] and length <= config.max_range
        d = length if hit else np.inf
        row = _row(table, min(d, config.max_range))
        free = min(max(length - (reach[-1] if cloud.hits[number] else 0), 0), config.max_range)
        middle = _crossed(start / size, direction / size, d + (reach[row] if marks else 0) if hit else free)
        cells = np.floor((start + middle[:, None] * direction) / size).astype(np.int64)
        given = _look_up(table, middle, np.full(len(middle), d), config)
        most = np.where(middle > config.blind, table.passed[_row(table, np.minimum(middle, config.max_range))], 0)
        given = np.maximum(given, most)
        if hit:
            its = np.floor(point / size).astype(np.int64)
            others = (cells != its).any(axis=1)
            cells, given = np.vstack([cells[others], its]), np.append(given[others], table.hit[row])
        indices.append(cells)
        evidence.append(given)
    return _strongest(np.concatenate(indices), np.concatenate(evidence))


def project(image: DepthImage, config: Config, sensor: InverseSensorModel) -> Cells:
    """Project every cell within range into the image.

    Cells that hold a measured point get the hit evidence at their centre's depth: in full where `full_share` of their
    footprint measures a depth within half a cell, with less by the square root of the part. Other cells get the
    positive evidence of the pixel at their centre where there is any, else the negative evidence of how far
    one sees through a window about their own size, of which only `edge_share` counts unless they lie plainly before
    everything in an area about twice as wide.
    """
    table = _table(image, config, sensor)
    hits, hit_evidence = _weighed(_distinct(_hit_cells(image, config))[0], image, config, table)
    cells = _cells_in_range(image, config)
    pixels, z, size_px, seen = _projected(cells, image, config)
    cells, pixels, z, size_px = cells[seen], pixels[seen], z[seen], size_px[seen]
    farthest, nearest = _window(image, pixels, size_px)
    clear = np.minimum(_look_up(table, z, farthest, config), 0)
    least = table.passed[_row(table, _depth_of_block(cells, image, config))]
    plain = (farthest > 0) & (z < _plainly_free_to(table, nearest, config))
    at_edge = np.floor(1000 * config.projective.edge_share * least) / 1000
    clear = np.where(plain, least, np.maximum(clear, at_edge))
    mark = np.maximum(_look_up(table, z, _at_centre(image, pixels), config), 0)
    beside = np.where(mark > 0, mark, np.where(z > config.blind, clear, 0))
    return _strongest(np.concatenate([hits, cells]), np.concatenate([hit_evidence, beside]))


def _table(image: DepthImage, config: Config, sensor: InverseSensorModel) -> SensorTable:
    noise, pose_noise = RangeNoise.of(config.noise, image.camera), PoseNoise.of(config.noise)
    table = tabulate(sensor, noise, config.max_range, config.voxel_size, pose_noise)
    numbers = {name: np.round(getattr(table, name), 3) for name in ("log_odds", "hit", "passed")}  # as a map keeps them
    return replace(table, **numbers)


def _rays(
    image: DepthImage, config: Config, table: SensorTable, depths_of: Callable
) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    """Yield for each ray the cells it gives evidence to, that evidence, and the depth that stands for each cell."""
    slopes = _points_at_one(image.camera).reshape(-1, 3)
    T = image.T_world_sensor
    marks = bool((table.log_odds > 0).any())
    for d, slope in zip(image.depth_m.ravel().astype(float), slopes, strict=True):
        if not d > 0:
            continue
        row = _row(table, min(d, config.max_range))
        end = config.max_range if np.isinf(d) else d + (REACH_SIGMA * table.sigma[row] if marks else 0)
        direction = T[:3, :3] @ slope
        start = T[:3, 3] / config.voxel_size
        middle = depths_of(start, direction / config.voxel_size, end)
        cells = np.floor(start + middle[:, None] * direction / config.voxel_size).astype(np.int64)
        evidence = _look_up(table, middle, np.full(len(middle), d), config)
        most = np.where(middle > config.blind, table.passed[_row(table, np.minimum(middle, config.max_range))], 0)
        evidence = np.maximum(evidence, most)
        if np.isfinite(d):
            hit = np.floor((T[:3, 3] + d * direction) / config.voxel_size).astype(np.int64)
            others = (cells != hit).any(axis=1)
            cells, evidence, middle = cells[others], evidence[others], middle[others]
            cells, evidence, middle = np.vstack([cells, hit]), np.append(evidence, table.hit[row]), np.append(middle, d)
        yield cells, evidence, middle


def _pinhole(image: DepthImage) -> PinholeCamera:
    assert isinstance(image.camera, PinholeCamera)
    return image.camera


def _points_at_one(camera: VirtualCamera) -> NDArray[np.float64]:
    """Return the point (height, width, 3) that each pixel sees at depth 1; see `cameras` for wide ones."""
    if isinstance(camera, PinholeCamera):
        return camera.back_project(np.ones((camera.height, camera.width)))
    columns, rows = camera.rays()
    points = np.empty((camera.height, camera.width, 3))
    for v in range(camera.height):
        for u in range(camera.width):
            points[v, u] = columns[u], rows[v, 0], rows[v, 1]
    return points


def _crossed(start: NDArray, direction: NDArray, end: float) -> NDArray:
    """Return the depth at the middle of every cell that a ray crosses."""
    cuts = np.concatenate([[0.0], _plane_crossings(start, direction, end), [end]])
    return (cuts[:-1] + cuts[1:]) / 2


def _sampled(start: NDArray, direction: NDArray, end: float) -> NDArray:
    """Return the depths of samples one cell apart along the longest axis, from the camera on."""
    step = 1 / np.abs(direction).max()
    return step * np.arange(int(end / step) + 1)


def _plane_crossings(start: NDArray, direction: NDArray, end: float) -> NDArray:
    """Return the sorted depths at which start + depth * direction meets whole numbers on any axis, below `end`."""
    found = []
    for s, step in zip(start, direction, strict=True):
        if step != 0:
            low, high = sorted((s, s + step * end))
            found.append((np.arange(np.ceil(low), np.floor(high) + 1) - s) / step)
    depths = np.sort(np.concatenate(found))
    return depths[(depths > 0) & (depths < end)]


def _hit_cells(image: DepthImage, config: Config) -> NDArray[np.int64]:
    depth = image.depth_m.astype(float)
    points = _pinhole(image).back_project(depth)[np.isfinite(depth)]
    world = points @ image.T_world_sensor[:3, :3].T + image.T_world_sensor[:3, 3]
    return np.floor(world / config.voxel_size).astype(np.int64)


def _weighed(
    cells: NDArray[np.int64], image: DepthImage, config: Config, table: SensorTable
) -> tuple[NDArray, NDArray]:
    x, y, z = _centres_in_camera(cells, image, config)
    z = np.maximum(z, NEAR_PLANE)  # large cells hold points before the camera although their centre lies behind it
    uv, size_px = _pixels_at(x, y, z, image, config)
    evidence = table.hit[_row(table, np.minimum(z, config.max_range))]
    full, weights = config.projective.full_share, np.ones(len(cells))
    if full > 0:
        shares = [_share(image, *numbers, config.voxel_size) for numbers in zip(uv, z, size_px, strict=True)]
        weights = np.where(evidence > 0, np.sqrt(np.minimum(1, np.array(shares) / full)), 1.0)
    return cells, np.where(evidence > 0, np.maximum(np.round(evidence * weights, 3), 0.001), 0.0)


def _share(image: DepthImage, uv: NDArray, z: float, size_px: float, voxel_size: float) -> float:
    height, width = image.depth_m.shape
    size_px = min(size_px, width)
    n = int(np.clip(size_px, 1, 4))
    steps = ((np.arange(n) + 0.5) / n - 0.5) * size_px
    u, v = np.floor(uv[0] + steps).astype(int), np.floor(uv[1] + steps).astype(int)
    u, v = u[(u >= 0) & (u < width)], v[(v >= 0) & (v < height)]
    samples = image.depth_m[np.ix_(v, u)]
    return max(float((np.abs(samples - z) <= voxel_size / 2).sum()), 0.5) / max(samples.size, 1)


def _cells_in_range(image: DepthImage, config: Config) -> NDArray[np.int64]:
    """Return all cells (N, 3) of a box round what the camera sees up to the maximum range, with room to spare."""
    far = 1.1 * config.max_range * _points_at_one(image.camera)[[0, 0, -1, -1], [0, -1, 0, -1]]
    corners = np.vstack([np.zeros(3), far]) @ image.T_world_sensor[:3, :3].T + image.T_world_sensor[:3, 3]
    low = np.floor(corners.min(axis=0) / config.voxel_size).astype(int) - 2
    high = np.floor(corners.max(axis=0) / config.voxel_size).astype(int) + 2
    return np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)


def _projected(cells: NDArray, image: DepthImage, config: Config) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return pixel (N, 2) column and row, depth and size in pixels of each cell, and whether it is seen."""
    camera = _pinhole(image)
    x, y, z = _centres_in_camera(cells, image, config)
    ahead = (z > NEAR_PLANE) & (z <= config.max_range)
    z_safe = np.where(ahead, z, 1.0)
    uv, size_px = _pixels_at(x, y, z_safe, image, config)
    rim, end = RIM_SHARE * config.voxel_size / z_safe[:, None] * [camera.fx, camera.fy], [camera.width, camera.height]
    seen = ahead & ((uv >= -rim) & (uv < end + rim)).all(axis=1)
    return uv, z, size_px, seen


def _centres_in_camera(cells: NDArray, image: DepthImage, config: Config) -> NDArray[np.float64]:
    """Return x, y and z (3, N) of the cells' centres along the camera's axes, in metres."""
    T = image.T_world_sensor
    return (((cells + 0.5) * config.voxel_size - T[:3, 3]) @ T[:3, :3]).T


def _depth_of_block(cells: NDArray, image: DepthImage, config: Config) -> NDArray[np.float64]:
    """Return the depth (N,) of the middle of each cell's block of 8 x 8 x 8, within 0 and the maximum range."""
    middle = 8 * (cells // 8) + 3.5
    return np.clip(_centres_in_camera(middle, image, config)[2], 0, config.max_range)


def _pixels_at(x: NDArray, y: NDArray, z: NDArray, image: DepthImage, config: Config) -> tuple[NDArray, NDArray]:
    """Return column and row (N, 2), counted from the image's border, and the size of a cell in pixels (N,)."""
    camera = _pinhole(image)
    uv = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1) + 0.5
    return uv, camera.fx * config.voxel_size / z


def _window(image: DepthImage, uv: NDArray, size_px: NDArray) -> tuple[NDArray, NDArray]:
    """Return the farthest (N,) of the 3x3 tiles about the pixel, and the nearest pixel (N,) in 3x3 tiles twice as wide.

    Tiles are of a power of two near 0.27 cell sizes. Cells much smaller than a pixel take the pixel itself. Depths that
    see nothing are infinite; no value is 0 for the farthest, and left out for the nearest.
    """
    depth = np.where(image.depth_m > 0, image.depth_m, 0).astype(float)
    height, width = depth.shape
    tiles, open_ones, nearest_ones = [depth, depth], depth > 0, np.where(depth > 0, depth, np.inf)
    for _ in range(1, MAX_LEVEL):
        open_ones = _quarters(open_ones).sum(axis=0) >= 2
        nearest_ones = _quarters(nearest_ones).min(axis=0)
        tiles.append(np.where(open_ones, nearest_ones, 0))
    level = np.clip(np.floor(np.log2(WINDOW_SHARE * size_px)) + 2, 0, MAX_LEVEL).astype(int)
    u, v = np.clip(uv[:, 0], 0, width - 1).astype(int), np.clip(uv[:, 1], 0, height - 1).astype(int)
    side = 2 ** np.maximum(level - 1, 0)
    places, of_place = _distinct(np.stack([level, v // side, u // side], axis=1))  # cells of one tile see the same
    looked = np.array([_looked_at(depth, tiles, *place) for place in places]).reshape(-1, 2)
    return looked[of_place, 0], looked[of_place, 1]


def _looked_at(depth: NDArray, tiles: list[NDArray], level: int, row: int, column: int) -> tuple[float, float]:
    """Return what `_window` does, for a tile of a level, or a pixel at level 0."""
    farthest = _around(tiles[level], row, column).max() if level > 0 else depth[row, column]
    v, u = row * 2 ** max(level - 1, 0), column * 2 ** max(level - 1, 0)
    side = 2 ** (min(level + 1, MAX_LEVEL) - 1)
    rows, columns = (slice(max(at // side - 1, 0) * side, (at // side + 2) * side) for at in (v, u))
    some = depth[rows, columns]
    return farthest, some[some > 0].min(initial=np.inf)


def _around(image: NDArray, row: int, column: int) -> NDArray:
    return image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]


def _plainly_free_to(table: SensorTable, nearest: NDArray, config: Config) -> NDArray:
    """Return the depth (N,) up to which any measurement of at least `nearest` says plainly "free"."""
    reach = REACH_SIGMA * table.sigma
    to_rows = np.append(np.arange(ROWS) / table.rows_per_metre - reach, config.max_range)
    row = _row(table, np.minimum(nearest, config.max_range))
    least_from = np.minimum.accumulate(to_rows[::-1])[::-1]
    later = least_from[row + 1]
    return np.where(np.isfinite(nearest), np.minimum(nearest - reach[row], later), np.inf)


def _quarters(image: NDArray) -> NDArray:
    """Return the four parts (4, rows, columns) of each 2x2 of an image, whose last row and column count twice."""
    padded = np.pad(image, [(0, size % 2) for size in image.shape], mode="edge")
    return np.array([padded[y::2, x::2] for y in (0, 1) for x in (0, 1)])


def _at_centre(image: DepthImage, uv: NDArray) -> NDArray:
    height, width = image.depth_m.shape
    inside = np.all((uv >= 0) & (uv < [width, height]), axis=1)
    u, v = np.where(inside[:, None], uv, 0).astype(int).T
    return np.where(inside & np.isfinite(image.depth_m[v, u]), image.depth_m[v, u], 0).astype(float)


def _look_up(table: SensorTable, z: NDArray, d: NDArray, config: Config) -> NDArray[np.float64]:
    """Return the evidence (N,) at depth z on rays that measured d; nothing where d is 0."""
    row = _row(table, np.minimum(d, config.max_range))
    t = (z - d) / table.sigma[row]
    column = np.floor((t / REACH_SIGMA + 1) / 2 * COLUMNS)
    inside = np.clip(column, 0, COLUMNS - 1)
    evidence = table.log_odds[row, np.where(np.isfinite(inside), inside, 0).astype(int)]
    evidence = np.where(column < 1, table.log_odds[0, 0], evidence)
    return np.where(d > 0, evidence, 0.0)


def _row(table: SensorTable, d: NDArray | float) -> NDArray[np.int64]:
    return np.minimum(np.asarray(d) * table.rows_per_metre, ROWS - 1).astype(int)


def _strongest(indices: NDArray, evidence: NDArray) -> Cells:
    """Keep for each cell its largest positive evidence, or without any its most negative."""
    cells, of_cell = _distinct(indices)
    best, worst = np.zeros(len(cells)), np.zeros(len(cells))
    np.maximum.at(best, of_cell, evidence)
    np.minimum.at(worst, of_cell, evidence)
    return _known(cells, np.where(best > 0, best, worst))


def _distinct(indices: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct cells (N, 3) in ascending order, and for each index the number of its cell."""
    if not len(indices):
        return indices, np.empty(0, np.int64)
    low = indices.min(axis=0)
    box = indices.max(axis=0) - low + 1
    numbers, of_cell = np.unique(np.ravel_multi_index(tuple((indices - low).T), tuple(box)), return_inverse=True)
    return np.stack(np.unravel_index(numbers, tuple(box)), axis=1) + low, of_cell.ravel()


def _known(cells: NDArray, evidence: NDArray) -> Cells:
    known = np.abs(evidence) >= 0.0005
    return cells[known], evidence[known]


def cone(distance: float, T: NDArray, beam: float, sigma: float, config: Config) -> tuple[dict, dict, dict]:
    """Return cells of a sonar's reading: surely before its arc, surely on it, and surely outside, by their evidence.

    Each cell is judged by 8 x 8 x 8 points in it, without any ray; those that its edge or its noise cut are in none.
    Of those far from all that, one in a hundred is looked at.
    Moravec and Elfes 1985: the shares of all cells of the arc sum to 0.9 of one echo.
    """
    size, half, reach = np.array(config.cell), beam / 2, REACH_SIGMA * sigma
    far = distance + 3 * size.max()
    low, high = (np.floor((T[:3, 3] + sign * far) / size).astype(int) for sign in (-1, 1))
    cells = np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    middle = ((cells + 0.5) * size - T[:3, 3]) @ T[:3, :3]
    length = np.linalg.norm(middle, axis=1)
    near = (middle[:, 0] > np.cos(min(half + 0.3, np.pi)) * length) & (length < distance + 2 * size.max())
    cells = cells[near | (np.arange(len(cells)) % 100 == 0)]
    steps = np.stack(np.meshgrid(*3 * [np.linspace(0, 1, 8)], indexing="ij"), axis=-1).reshape(-1, 3)
    before, arc, outside = {}, {}, {}
    cap = 2 * np.pi * distance**2 * (1 - np.cos(half))
    share = 0.9 / max(cap / config.voxel_size**2, 1.0)
    for cell in cells:
        points = ((cell + steps) * size - T[:3, 3]) @ T[:3, :3]
        away = np.linalg.norm(points, axis=1)
        angle = np.arctan2(np.linalg.norm(points[:, 1:], axis=1), points[:, 0])
        gap = np.arcsin(np.minimum(size.min() / 2 / np.maximum(away, 1e-9), 1))
        on_it = (np.abs(away - distance) < size.min() / 20) & (angle < half - gap)
        key = tuple(cell.tolist())
        if (angle < half - gap).all() and away.max() < distance - reach - size.max() and away.min() > config.blind:
            before[key] = np.log(0.345 / 0.655)
        elif on_it.sum() >= 30:
            arc[key] = share
        elif (angle > half).all() or away.min() > distance:
            outside[key] = 0.0
    return before, arc, outside


def flat_cone(
    distance: float, T: NDArray, beam: RangeSensor, origin: Sequence[float], config: Config
) -> tuple[dict, dict, dict]:
    """Return cells of a sonar's reading in a grid: surely before its arc, surely on it, and surely outside.

    Each cell is judged by 20 x 20 points in it, without any ray; those that an edge of the cone cuts are in none. The
    evidence of the arc is that of one echo from somewhere on it (thousandths), with noise tried by random numbers.
    """
    size, half, x, y, yaw = config.voxel_size, beam.beam / 2, *origin
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])  # of the world's axes to the grid's
    place, ahead = turn @ (T[:2, 3] - [x, y]), turn @ T[:2, 0]
    shrunk = np.linalg.norm(ahead)  # leaning shortens everything
    reach = int((distance + 0.5) / size) + 2
    middle = np.floor(place / size).astype(int)
    steps = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 20)]), axis=-1).reshape(-1, 2)
    before, arc, outside = {}, {}, {}
    at, moved = np.random.default_rng(0).uniform(size=(2, 300_000)), np.random.default_rng(1).normal(size=300_000)
    stays = np.mean(np.floor(at[0] + moved * beam.sigma / size) == 0)
    q = 0.9 * stays / max(beam.beam * distance / size, 1.0)
    p = 0.1 + 0.9 * q
    value = 800 * (np.log(p / (1 - p)) - np.log(1 / 9))
    for cell in np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)]), axis=-1).reshape(-1, 2) + middle:
        arms = ((cell + steps) * size - place) / shrunk
        away = np.linalg.norm(arms, axis=1)
        angle = np.abs(np.angle(np.exp(1j * (np.arctan2(arms[:, 1], arms[:, 0]) - np.arctan2(ahead[1], ahead[0])))))
        edge = size / np.maximum(away, size)
        within = angle < half - edge
        if within.all() and beam.range_min < away.min() and away.max() < distance - 4 * beam.sigma:
            before[tuple(cell.tolist())] = np.log(0.345 / 0.655)
        elif (np.abs(away - distance) < size / 40)[within].sum() >= 16:
            arc[tuple(cell.tolist())] = value
        elif (angle > half + 1e-6).all() or away.min() > distance or away.max() < beam.range_min:
            outside[tuple(cell.tolist())] = 0.0
    return before, arc, outside
