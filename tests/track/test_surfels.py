# SPDX-License-Identifier: Apache-2.0
"""The kernels of tracking against plain Python."""

import naive_tracking as naive
import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import SphericalCamera
from stereovox.frame import DepthImage
from stereovox.geometry.se3 import rotation_matrix
from stereovox.track import _surfels
from stereovox.track.surfels import FIRST, Patches, Surfels, patches_of

PINHOLE = PinholeCamera.from_field_of_view(88, 60, 80.0, baseline=0.05)
WIDE = SphericalCamera.from_field_of_view(90, 62, 120.0, 90.0, baseline=0.1)
NOTHING = np.array([np.nan, np.inf, -np.inf, 0], np.float32)
"""What marks a pixel without depth, and 0, which none of the kernels may take for one."""


def holed_image(camera, seed):
    """Return a folded surface with steps, a little noise, and holes of all kinds: single pixels and whole blocks."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = 2 + 0.01 * u - 0.005 * v + np.where(u > random.integers(20, 60), 0.7, 0) + 0.05 * np.abs(v - 28)
    depth = (depth * (1 + 0.01 * random.standard_normal(depth.shape))).astype(np.float32)
    lost = random.random(depth.shape) < 0.1
    depth[lost] = random.choice(NOTHING, lost.sum())
    for y, x in random.integers(0, 50, (5, 2)):
        depth[y : y + 9, x : x + 9] = random.choice(NOTHING)
    return depth


def rays_of(camera):
    return tuple(np.ascontiguousarray(rays, np.float32) for rays in camera.rays())


@pytest.mark.parametrize("camera", [PINHOLE, WIDE], ids=["pinhole", "spherical"])
@pytest.mark.parametrize("step", [1, 2, 3, 5])
def test_patches_and_their_normals_are_those_of_the_twin(camera, step):
    depth, (columns, rows) = holed_image(camera, step), rays_of(camera)
    shape = (camera.height // step, camera.width // step, 3)
    point, normal = np.full(shape, 7, np.float32), np.full(shape, 7, np.float32)
    _surfels.patches(depth, columns, rows, step, point)
    expected = naive.patch_points(depth, columns, rows, step)
    assert 0.2 < expected.any(axis=2).mean() < 1
    np.testing.assert_allclose(point, expected, rtol=1e-5, atol=1e-6)
    _surfels.normals(point, normal)
    expected = naive.patch_normals(point)
    assert expected.any(axis=2).sum() > 20
    np.testing.assert_allclose(normal, expected, atol=2e-4)


def test_patches_of_a_plane_lie_on_it_and_look_at_the_camera():
    depth = np.full((PINHOLE.height, PINHOLE.width), 1.5, np.float32)
    image = DepthImage(depth, np.zeros(depth.shape, np.uint8), PINHOLE, np.eye(4))
    seen = patches_of(image, np.linspace(0, 1, 101), 10.0)
    assert len(seen.points) == 88 * 60
    assert seen.points[:, 2] == pytest.approx(1.5)
    assert seen.normals == pytest.approx(np.tile([0, 0, -1], (88 * 60, 1)), abs=1e-4)
    away = np.linalg.norm(seen.points, axis=1)
    np.testing.assert_allclose(seen.sigma, np.floor(away * 10) / 100, atol=0.0101)  # the table goes by the distance


def random_patches(number, seed, extent=0.6):
    """Return patches in a small space, so that cells get several, most with normals of one kind."""
    random = np.random.default_rng(seed)
    points = random.uniform(-extent, extent, (number, 3)).astype(np.float32)
    normals = (0, 0, 1) + 0.4 * random.standard_normal((number, 3))
    normals[random.random(number) < 0.2] *= -1
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Patches(points, normals.astype(np.float32), random.uniform(0.005, 0.03, number).astype(np.float32))


def pose(seed):
    random = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(random.uniform(-2, 2, 3)), random.uniform(-3, 3, 3)
    return T


def filled(size=0.1, times=3):
    """Return surfels and their twin after some images."""
    level, twin = Surfels(size), naive.NaiveSurfels(size)
    for seed in range(times):
        seen = random_patches(800, seed)
        level.add(seen, pose(0))
        twin.add(*seen, pose(0))
    return level, twin


def kept(level):
    """Return the surfels of a table by cell."""
    used = level._keys != _surfels.EMPTY
    return {naive.cell_of(int(key)): row for key, row in zip(level._keys[used], level._surfels[used], strict=True)}


def same_surfels(level, twin):
    expected, found = twin.surfels(), kept(level)
    assert set(found) == set(expected)
    assert level.number == len(expected)
    for cell, surfel in expected.items():
        row, corner = found[cell], np.array(cell) * twin.size
        assert row[0] == pytest.approx(surfel.weight, rel=1e-4)
        assert row[1:4] == pytest.approx(surfel.position - corner, abs=1e-6)
        assert row[4:7] == pytest.approx(surfel.normal, abs=1e-5)
        assert row[7] == pytest.approx(surfel.variance, rel=1e-4)
        assert row[8] == surfel.number
    return expected


def test_surfels_are_the_means_of_the_patches_in_their_cells():
    surfels = same_surfels(*filled())
    assert len(surfels) > 500
    assert max(surfel.number for surfel in surfels.values()) >= 5
    assert {coordinate < 0 for cell in surfels for coordinate in cell} == {True, False}


def test_a_heavy_surfel_becomes_a_running_mean():
    keys, surfels = np.full(16, _surfels.EMPTY), np.zeros((16, _surfels.FIELDS), np.float32)
    normal, sigma = np.array([[0, 0, 1]], np.float32), np.array([0.01], np.float32)  # of weight 1
    position = 0.0
    for n in range(200):
        point = np.array([[0.2 if n < 100 else 0.8, 0.5, 0.5]], np.float32)
        _surfels.put(keys, surfels, np.float32(1), point, normal, sigma, np.eye(3), np.zeros(3), np.float32(10))
        position += (point[0, 0] - position) / min(n + 1, 10)
    (row,) = surfels[keys != _surfels.EMPTY]
    assert row[0] == 10
    assert row[1] == pytest.approx(position, abs=1e-5)
    assert row[1] > 0.79  # the old place is forgotten


def test_a_table_that_is_nearly_full_loses_nothing():
    """Keys that fall into one place go on to the next, round the end."""
    keys, surfels = np.full(64, _surfels.EMPTY), np.zeros((64, _surfels.FIELDS), np.float32)
    cells = np.random.default_rng(1).permutation(
        [(x, y, z) for x in (-2, 0, 9) for y in range(-3, 4) for z in (5, 6, 7)]
    )
    points, same = (cells[:63] + 0.5).astype(np.float32), np.ones((63, 3), np.float32)
    for times in (1, 2):
        new = _surfels.put(
            keys, surfels, np.float32(1), points, same, same[:, 0].copy(), np.eye(3), np.zeros(3), np.float32(1e9)
        )
        assert new == (63 if times == 1 else 0)
        used = keys != _surfels.EMPTY
        assert {naive.cell_of(int(key)) for key in keys[used]} == {tuple(cell) for cell in cells[:63].tolist()}
        assert np.all(surfels[used, 8] == times)


@pytest.mark.parametrize("limit", [3.0, 5.5, 6.5])
@pytest.mark.parametrize("seed", range(6))
def test_what_stays_in_a_nearly_full_table_is_found_after_others_are_dropped(seed, limit):
    """Keys that went on to the next place, round the end, move back where one before them goes."""
    random = np.random.default_rng(seed)
    keys, surfels = np.full(64, _surfels.EMPTY), np.zeros((64, _surfels.FIELDS), np.float32)
    cells = random.permutation([(x, y, z) for x in range(-8, 8) for y in (-3, 4) for z in (5, -6)])[:60]
    points, same = (cells + random.uniform(0.1, 0.9, cells.shape)).astype(np.float32), np.ones((60, 3), np.float32)
    _surfels.put(keys, surfels, np.float32(1), points, same, same[:, 0].copy(), np.eye(3), np.zeros(3), np.float32(1e9))
    before = {naive.cell_of(int(key)): surfels[i].copy() for i, key in enumerate(keys) if key != _surfels.EMPTY}
    centre = np.array([1.0, 0.5, 0.0])
    near = {cell for cell in before if np.abs(np.array(cell) - centre).max() < limit}
    dropped = _surfels.drop(keys, surfels, 1.0, centre, limit)
    assert dropped == len(before) - len(near)
    assert (surfels[keys == _surfels.EMPTY] == 0).all()
    after = {naive.cell_of(int(key)): surfels[i] for i, key in enumerate(keys) if key != _surfels.EMPTY}
    assert set(after) == near
    assert all(np.array_equal(after[cell], before[cell]) for cell in near)
    again = np.array([points[i] for i, cell in enumerate(cells.tolist()) if tuple(cell) in near], np.float32)
    one = np.ones((len(again), 3), np.float32)
    new = _surfels.put(
        keys, surfels, np.float32(1), again.reshape(-1, 3), one, one[:, 0].copy(), np.eye(3), np.zeros(3),
        np.float32(1e9),
    )  # fmt: skip
    assert new == 0  # each is found where a search looks for it


def test_tables_grow_and_keep_what_they_hold():
    random, level, twin = np.random.default_rng(3), Surfels(0.05), naive.NaiveSurfels(0.05)
    for _ in range(2):
        seen = random_patches(5000, random.integers(1000), extent=2.0)
        level.add(seen, np.eye(4))
        twin.add(*seen, np.eye(4))
    assert len(level._keys) > FIRST
    assert 2 * level.number <= len(level._keys)
    same_surfels(level, twin)


def test_what_is_far_is_forgotten_and_what_is_near_stays():
    level, twin = filled()
    centre, before = pose(0)[:3, 3], kept(level)
    level.forget(centre, 0.3)
    near = {cell for cell in before if np.abs(np.array(cell) * twin.size - centre).max() < 0.3}
    assert 0 < len(near) < len(before) / 2
    after = kept(level)
    assert set(after) == near
    assert level.number == len(near)
    assert all(np.array_equal(after[cell], before[cell]) for cell in near)
    level.add(random_patches(800, 0), pose(0))  # forgotten cells are new ones
    fresh, again = kept(filled(times=1)[0]), kept(level)
    assert set(again) == near | set(fresh)
    assert all(np.array_equal(again[cell], fresh[cell]) for cell in set(fresh) - near)


@pytest.mark.parametrize("shift", [0.0, 0.02, 0.05])
def test_equations_are_those_of_the_twin(shift):
    level, twin = filled(times=6)
    seen, T = random_patches(700, 50), pose(0)
    T[:3, 3] += shift * np.array([1, -0.5, 0.8])
    found = raw_equations(level, seen, T)
    patches = [
        naive.Patch(T[:3, :3] @ p + T[:3, 3], T[:3, :3] @ n, float(s))
        for p, n, s in zip(seen.points.astype(float), seen.normals.astype(float), seen.sigma, strict=True)
    ]
    expected = naive.equations(twin.surfels(), 0.1, patches, T[:3, 3], 0.01, 3.0)
    assert 100 < len(expected.ratios) < 700
    for one, other in zip(found, expected, strict=False):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3 * np.abs(other).max())


def raw_equations(level, seen, T):
    """Return what the kernel fills: information, gradient, spread, and the ratios of those patches that are known."""
    filled = np.full((6, 6), 7.0), np.full(6, 7.0), np.full(10, 7.0), np.full(len(seen.points), 7.0, np.float32)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    slots = level.nearest(seen, T)
    known = _surfels.equations(
        level._keys, level._surfels, level.size, slots, *seen, R, t, np.float32(0.01), 3.0, *filled
    )
    return *filled[:3], filled[3][:known]


def test_the_gradient_is_that_of_the_robust_cost():
    """By finite differences, on three walls where patch and surfel have the same normal."""
    random, twin, level = np.random.default_rng(4), naive.NaiveSurfels(0.2), Surfels(0.2)
    points = random.uniform(0.3, 1.3, (360, 3))
    normals = np.repeat(np.eye(3), 120, axis=0)
    points -= normals * (np.einsum("ij,ij->i", points, normals) - 0.1)[:, None]
    walls = Patches(points.astype(np.float32), normals.astype(np.float32), np.full(360, 0.02, np.float32))
    for _ in range(20):
        level.add(walls, np.eye(4))
        twin.add(*walls, np.eye(4))
    surfels, off = twin.surfels(), np.array([0.01, -0.02, 0.015])

    def cost(motion):
        R, t = rotation_matrix(motion[:3]), motion[3:] + off
        moved = [naive.Patch(R @ p + t, n, 0.02) for p, n in zip(points, normals, strict=True)]
        return naive.equations(surfels, 0.2, moved, t, 0.01, 3.0).cost

    T = np.eye(4)
    T[:3, 3] = off
    information, gradient, _, ratios = raw_equations(level, walls, T)
    assert len(ratios) > 340
    step = 1e-5
    slopes = [(cost(step * axis) - cost(-step * axis)) / (2 * step) for axis in np.eye(6)]
    np.testing.assert_allclose(gradient, -np.array(slopes), rtol=0.02, atol=0.02 * np.abs(slopes).max())
    assert np.array_equal(information, information.T)
    assert np.linalg.eigvalsh(information)[0] > 0


def test_surfels_of_mixed_normals_and_other_sides_hold_nothing():
    seen = random_patches(500, 0)
    level = Surfels(0.1)
    level.add(seen, np.eye(4))
    level.add(seen._replace(normals=-seen.normals), np.eye(4))
    assert len(raw_equations(level, seen, np.eye(4))[3]) == 0
    level = Surfels(0.1)
    level.add(seen, np.eye(4))
    known = len(raw_equations(level, seen, np.eye(4))[3])
    turned = len(raw_equations(level, seen._replace(normals=-seen.normals), np.eye(4))[3])
    assert turned < 0.5 * known
