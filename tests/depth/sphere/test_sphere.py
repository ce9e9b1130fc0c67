# SPDX-License-Identifier: Apache-2.0
"""The spherical grid against loops over single points, and its laws."""

import math

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import Config, SphereConfig, load_config
from stereovox.depth.sphere import (
    NEVER,
    T_BODY_OPTICAL,
    SphereGrid,
    SphereLayout,
    accumulate,
    empty,
    gather,
    moved,
    stitch,
)
from stereovox.errors import ConfigError
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import rotation_matrix

CAMERAS = {
    "pinhole": PinholeCamera.from_field_of_view(60, 40, 90, 0.15),
    "spherical": SphericalCamera.from_field_of_view(60, 50, 160, 140, 0.15),
    "cylindrical": CylindricalCamera.from_field_of_view(60, 40, 120, 140, 0.15),
}


def settings(step: float = 5.0, **sphere) -> Config:
    return load_config(
        min_range=0.2, max_range=8.0, **{f"sphere.{k}": v for k, v in {"step_deg": step, **sphere}.items()}
    )


def image_of(camera, seed=0) -> DepthImage:
    """A random image with all kinds of pixels; smooth enough that cells have small deviations."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = (3 + 1.5 * np.sin(u / 9) + np.cos(v / 7) + random.normal(0, 0.02, u.shape)).astype(np.float32)
    blocks = np.kron(random.integers(0, 12, (10, 10)), np.ones((6, 6), int))[: camera.height, : camera.width]
    reason = np.where(blocks < 6, blocks, 0).astype(np.uint8)
    none = np.array([0, np.nan, -np.inf, np.inf, np.nan, np.nan], np.float32)[reason]
    return DepthImage(np.where(reason == 0, depth, none), reason, camera, np.eye(4), 1234)


def slow(image, T_body_sensor, config, layout):
    """Valenti 2018, Eq 5.2 to 5.4, pixel by pixel: {cell: (range, reason, count)}, and how near to a border it came."""
    columns, rows = image.camera.rays()
    found, close = {}, set()
    for v in range(image.camera.height):
        for u in range(image.camera.width):
            why = Reason(image.reason[v, u])
            if why in (Reason.UNMATCHED, Reason.MASKED, Reason.UNKNOWN):
                continue
            d = {Reason.VALID: image.depth_m[v, u], Reason.TOO_NEAR: config.min_range, Reason.TOO_FAR: config.max_range}
            x, y, z = T_body_sensor[:3, :3] @ (float(d[why]) * np.array([columns[u], *rows[v]])) + T_body_sensor[:3, 3]
            rho = math.sqrt(x * x + y * y + z * z)
            theta, phi = math.degrees(math.acos(z / rho)), math.degrees(math.atan2(y, x))
            step = 180 / layout.per_half_turn
            i = math.floor((phi + 180) / step) - layout.first_azimuth
            i, j = i % (2 * layout.per_half_turn), math.floor(theta / step) - layout.first_polar
            if i < layout.azimuths and 0 <= j < layout.polars:
                found.setdefault((i, j), []).append((why, rho))
            part = np.array([(phi + 180) / step % 1, theta / step % 1])
            if (np.minimum(part, 1 - part) < 1e-4).any():
                close.update({(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)})
    return {cell: summary(points, config.sphere) for cell, points in found.items()}, close


def summary(points, sphere):
    ranges = np.array([rho for why, rho in points if why == Reason.VALID])
    if any(why == Reason.TOO_NEAR for why, _ in points):
        return 0.0, Reason.TOO_NEAR, len(ranges)
    if not len(ranges):
        return min(rho for _, rho in points), Reason.TOO_FAR, 0
    robust = ranges.mean() - sphere.spread * ranges.std()
    use_robust = sphere.statistic == "robust" and ranges.std() < sphere.std_threshold and robust > 0
    return robust if use_robust else ranges.min(), Reason.VALID, len(ranges)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize(
    "sphere",
    [
        {},
        {"statistic": "minimum"},
        {"std_threshold": 0.03, "spread": 2.0, "polar_deg": (40, 111), "azimuth_deg": (-100.0, 33.0)},
        {"azimuth_deg": (80.0, 300.0)},
    ],
)
def test_equals_the_slow_one(name, sphere):
    config = settings(**sphere)
    layout = SphereLayout.configured(config.sphere)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0.3, -0.4, 1.1]) @ T_BODY_OPTICAL[:3, :3], [0.2, -0.1, 0.05]
    image = image_of(CAMERAS[name])
    grid = accumulate(image, T, config)
    wanted, close = slow(image, T, config, layout)
    compared = 0
    for (i, j), (rho, reason, count) in wanted.items():
        if (i, j) not in close:
            assert (grid.reason[i, j], grid.count[i, j]) == (reason, count)
            assert grid.range_m[i, j] == pytest.approx(rho, rel=2e-5, abs=2e-5)
            assert grid.stamp_ns[i, j] == 1234
            compared += 1
    assert compared > 20
    assert set(map(int, grid.reason.ravel())) >= {0, 5}
    narrow = np.sin(layout.polar()) * layout.step < 0.2  # holes between pixels near the poles are filled
    for i, j in np.argwhere(grid.known):
        assert (i, j) in wanted or (i, j) in close or narrow[j]


def test_points_make_the_same_grid_as_their_image():
    config = settings(statistic="minimum")
    image = image_of(CAMERAS["pinhole"])
    columns, rows = image.camera.rays()
    rays = np.stack(np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:]), axis=-1)
    valid = image.reason == Reason.VALID
    points = np.full((*valid.shape, 3), np.nan)
    points[valid] = (rays * image.depth_m[..., None])[valid] @ T_BODY_OPTICAL[:3, :3].T
    of_points, of_image = gather(points, 1234, config.sphere), accumulate(image, T_BODY_OPTICAL, config)
    both = (of_image.reason == Reason.VALID) & (of_points.count == of_image.count)
    assert both.sum() > 0.98 * (of_image.reason == Reason.VALID).sum()  # a point on a border may fall to either side
    np.testing.assert_allclose(of_points.range_m[both], of_image.range_m[both], rtol=1e-5)


def test_mean_less_three_deviations_or_the_minimum():
    """Eq 5.4 by hand: ranges 2.0, 2.1, 2.2 in one cell."""
    points = np.array([[2.0, 0.05, 0.05], [2.1, 0.05, 0.05], [2.2, 0.05, 0.05]])
    ranges = np.linalg.norm(points, axis=1)
    for threshold, wanted in ((0.09, ranges.mean() - 3 * ranges.std()), (0.07, ranges.min())):
        grid = gather(points, 5, SphereConfig(step_deg=5, std_threshold=threshold))
        assert grid.range_m[grid.known] == pytest.approx([wanted], rel=1e-5)
        assert grid.count.sum() == 3
    almost_here = gather(np.array([[0.02, 0, 0.001], [0.2, 0, 0.001]]), 5, SphereConfig(step_deg=30))
    assert almost_here.range_m[almost_here.known] == pytest.approx([0.02], rel=0.01)  # never behind one's back


def test_a_large_count_does_not_lose_a_small_deviation():
    """float32 sums of squares would: 40,000 ranges of 50 m +- 1 cm."""
    random = np.random.default_rng(0)
    rho = random.normal(50, 0.01, 40_000)
    grid = gather(rho[:, None] * [1, 0.0001, 0.0001], 5, SphereConfig(step_deg=1))
    assert grid.range_m[grid.known] == pytest.approx([50 - 0.03], abs=1e-3)


def random_grid(seed, **bounds) -> SphereGrid:
    config = settings(10.0, **bounds)
    random = np.random.default_rng(seed)
    grid = empty(SphereLayout.configured(config.sphere))
    grid.reason[:] = random.choice(list(map(int, Reason)), grid.reason.shape, p=[0.5, 0, 0.1, 0.2, 0, 0.2])
    known = grid.reason != Reason.UNKNOWN
    grid.range_m[known] = random.integers(1, 6, known.sum())
    grid.range_m[grid.reason == Reason.TOO_NEAR] = 0
    grid.stamp_ns[known] = random.integers(0, 100, known.sum())
    grid.count[known] = 1
    return grid


def test_stitching_takes_the_nearest_and_its_age():
    grids = [random_grid(seed) for seed in (1, 2, 3)]
    whole = stitch(grids)
    for place in np.ndindex(whole.layout.shape):
        here = [(g.reason[place], g.range_m[place], g.stamp_ns[place]) for g in grids]
        order = [[Reason.TOO_NEAR, Reason.VALID, Reason.TOO_FAR].index(why) for why, _, _ in here if why != 5]
        best = min(
            ((o, rho, -stamp) for o, (_, rho, stamp) in zip(order, [h for h in here if h[0] != 5], strict=True)),
            default=(None, math.nan, -NEVER),
        )
        assert (whole.reason[place], whole.stamp_ns[place]) == (
            Reason.UNKNOWN if best[0] is None else [Reason.TOO_NEAR, Reason.VALID, Reason.TOO_FAR][best[0]],
            -best[2] if best[0] is not None else NEVER,
        )
        np.testing.assert_equal(float(whole.range_m[place]), float(best[1]))


def test_stitching_does_not_ask_for_an_order():
    a, b, c = (random_grid(seed) for seed in (4, 5, 6))
    for one, other in ((stitch([a, b, c]), stitch([c, stitch([b, a])])), (stitch([a, a]), a)):
        for name in ("range_m", "reason", "stamp_ns"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_grids_of_different_bounds_are_stitched_where_they_belong():
    """Left, rear (round the back) and front: each direction comes from the grid that holds it."""
    config = SphereConfig(step_deg=10)
    bounds = {"left": (30.0, 120.0), "rear": (120.0, 230.0), "front": (-45.0, 45.0)}
    grids = {}
    for n, (name, azimuth) in enumerate(bounds.items()):
        layout = SphereLayout.of(10, (40, 140), azimuth)
        grids[name] = gather((n + 1.0) * layout.directions().reshape(-1, 3), n, config, layout)
        assert grids[name].known.all()
    whole = stitch(list(grids.values()))
    assert whole.layout.polars == 10
    assert whole.layout.azimuths == 28  # -50 to 230 degrees
    phi = np.degrees(whole.layout.azimuth()) % 360
    wanted = np.where((phi > 30) & (phi < 120), 1.0, np.where((phi > 120) & (phi < 230), 2.0, 3.0))
    np.testing.assert_allclose(whole.range_m, np.broadcast_to(wanted[:, None], whole.range_m.shape), rtol=1e-6)
    np.testing.assert_array_equal(whole.stamp_ns, (wanted[:, None] - 1).astype(int) + np.zeros((1, 10), int))


def test_unequal_steps_are_refused():
    with pytest.raises(ConfigError, match="these have 5 and 10 deg"):
        stitch([empty(SphereLayout.of(10)), empty(SphereLayout.of(5))])
    with pytest.raises(ConfigError, match="step_deg must divide 180"):
        SphereLayout.of(7)
    with pytest.raises(ConfigError, match="polar_deg"):
        SphereLayout.of(10, (90, 20))
    with pytest.raises(ConfigError, match=r"sphere\.step_deg is not set"):
        SphereLayout.configured(SphereConfig())


def test_directions_and_cells_are_inverse():
    for layout in (SphereLayout.of(3), SphereLayout.of(2.5, (30, 95), (150, 260))):
        cells = layout.cells_of(layout.directions().reshape(-1, 3) * 3)
        np.testing.assert_array_equal(cells, np.arange(len(cells)))
    part = SphereLayout.of(10, (40, 140), (-45, 45))
    np.testing.assert_array_equal(part.cells_of([[0, 0, 1], [-1, 0, 0], [0, 1, 0]]), -1)


def test_cells_between_the_pixels_of_the_pole_are_filled():
    """A camera that looks straight down has fewer pixels there than the grid has cells."""
    camera = PinholeCamera.from_field_of_view(60, 60, 90, 0.15)
    T_down = np.eye(4)
    T_down[:3, :3] = np.column_stack([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    image = DepthImage(np.full((60, 60), 2, np.float32), np.zeros((60, 60), np.uint8), camera, np.eye(4), 7)
    grid = accumulate(image, T_down, settings(3.0))
    below = grid.layout.polar() > np.radians(140)
    assert grid.known[:, below].all()
    truth = 2 / np.abs(np.cos(grid.layout.polar()[below]))
    np.testing.assert_allclose(grid.range_m[:, below], np.broadcast_to(truth, grid.range_m[:, below].shape), rtol=0.06)
    assert not grid.known[:, grid.layout.polar() < np.radians(110)].any()


def test_a_moved_grid_keeps_its_surfaces_and_their_age():
    config = SphereConfig(step_deg=2, statistic="minimum")
    random = np.random.default_rng(3)
    old = gather(random.normal(size=(400, 3)) * 2 + [4, 0, 0], 77, config)
    T_new_old = np.eye(4)
    T_new_old[:3, :3], T_new_old[:3, 3] = rotation_matrix([0, 0, np.pi / 2]), [0, 0.5, 0]
    new = moved(old, T_new_old)
    before = old.points() @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    after = new.points()
    gaps = np.linalg.norm(after[:, None] - before[None], axis=-1).min(axis=1)
    assert len(after) > 0.8 * len(before)
    assert (gaps < 0.0248 * np.linalg.norm(after, axis=1) + 1e-6).all()  # to the middle of a cell: half its diagonal
    assert set(new.stamp_ns[new.known]) == {77}
    same = moved(old, np.eye(4))
    np.testing.assert_allclose(same.range_m, old.range_m, rtol=1e-6)


def test_what_is_old_is_unknown():
    grid = random_grid(8)
    young = grid.since(50)
    assert ((grid.stamp_ns >= 50) == young.known).all()
    assert np.isnan(young.range_m[~young.known]).all()
    assert (young.reason[~young.known] == Reason.UNKNOWN).all()
    np.testing.assert_array_equal(young.range_m[young.known], grid.range_m[young.known])
