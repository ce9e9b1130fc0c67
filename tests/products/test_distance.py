# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.distance import DistanceField, Transform, transformed

RANDOM = np.random.default_rng(8)
SHAPES = [((21, 37, 9), (1.0, 1.0, 1.0)), ((5, 40, 34), (0.05, 0.07, 0.2)), ((1, 30, 50), (0.1, 0.1, 0.1))]


def by_scipy(mask, sides, reach=np.inf):
    if not mask.any():
        return np.full(mask.shape, np.inf)
    away = distance_transform_edt(~mask, sampling=sides)
    return np.where(away > reach * (1 + 1e-7), np.inf, away)


def one_by_one(mask, sides, nearer):
    """Each cell against each obstacle."""
    cells, obstacles = np.indices(mask.shape).reshape(3, -1).T, np.argwhere(mask)
    off = np.maximum(np.abs(cells[:, None] - obstacles) - nearer, 0) * sides
    return np.sqrt((off**2).sum(axis=2).min(axis=1)).reshape(mask.shape)


@pytest.mark.parametrize(("shape", "sides"), SHAPES)
@pytest.mark.parametrize("cells", [np.inf, 4])
def test_after_any_change_it_is_what_it_would_be_anew_and_what_scipy_says(shape, sides, cells):
    reach = cells * min(sides)
    transform, mask = Transform(shape, sides, reach), np.zeros(shape, bool)
    for step in range(40):
        share = RANDOM.choice([0.0005, 0.005, 0.2])
        changed = mask ^ (RANDOM.random(shape) < share) if step % 4 else RANDOM.random(shape) < share / 4
        if step in (10, 20):
            changed = np.full(shape, step == 10)
        now, before = changed.transpose(transform.order), mask.transpose(transform.order)
        transform.field.mask[:, :, : transform.lanes] = now
        transform.update((now != before).any(axis=(1, 2)).astype(np.uint8), 1 + step % 2)
        mask = changed
        np.testing.assert_array_equal(transform.metres, transformed(mask, sides, reach))
        np.testing.assert_allclose(transform.metres, by_scipy(mask, sides, reach), rtol=1e-6)


@pytest.mark.parametrize("nearer", [0, 0.5, 1, 2])
def test_what_is_measured(nearer):
    mask, sides = RANDOM.random((11, 6, 9)) < 0.02, np.array([0.1, 0.3, 0.2])
    found = transformed(mask, sides, nearer=nearer)
    np.testing.assert_allclose(found, one_by_one(mask, sides, nearer), rtol=1e-6)


def a_map(cell="int16", **settings):
    return VoxelMap(load_config(voxel_size=0.1, **{"map.cell": cell}, **settings))


def put(voxel_map, cells, log_odds):
    """Set cells (N, 3) as a frame would: whole blocks with new numbers."""
    known, numbers = voxel_map.cells()
    anew = VoxelMap.from_cells(
        voxel_map.config, np.concatenate([known, cells]), np.concatenate([numbers, np.full(len(cells), log_odds)])
    )
    voxel_map.storage.insert(*anew.storage.blocks())


def wanted_metres(voxel_map, field, to):
    places = np.indices(field.metres.shape).reshape(3, -1).T
    states = voxel_map.state(field.origin + (places + 0.5) * voxel_map.config.cell).reshape(field.metres.shape)
    return by_scipy(np.isin(states, to), voxel_map.config.cell)


@pytest.mark.parametrize("cell", ["int16", "uint8"])
@pytest.mark.parametrize("to", [[State.OCCUPIED], [State.OCCUPIED, State.UNKNOWN]])
@pytest.mark.parametrize("steps", [None, (1.0, 0.5, 2.0)])
def test_a_field_follows_its_map(cell, to, steps):
    settings = {} if steps is None else {"steps": list(np.multiply(steps, 0.1))}
    voxel_map = a_map(cell, **settings)
    low, high = np.array([-11, -4, 3]) * voxel_map.config.cell, np.array([12, 13, 22]) * voxel_map.config.cell
    field = DistanceField(voxel_map, low, high, to=to)
    assert field.metres.shape == (23, 17, 19)
    for log_odds in (2.0, -2.0, 2.0, -2.0, 2.0):
        put(voxel_map, RANDOM.integers(-14, 24, (60 if log_odds > 0 else 4000, 3)), log_odds)
        before = field.obstacles.copy()
        assert field.update() == (field.obstacles != before).sum()
        np.testing.assert_allclose(field.metres, wanted_metres(voxel_map, field, to), rtol=1e-6)
        np.testing.assert_array_equal(field.metres, DistanceField(voxel_map, low, high, to=to).metres)
    assert field.update() == 0


def stand(voxel_map, *position):
    pose = np.eye(4)
    pose[:3, 3] = position
    voxel_map.storage.set_viewpoint(Viewpoint(0, pose))


def test_a_window_follows_the_camera_and_keeps_nothing_of_where_it_was():
    voxel_map = a_map()
    put(voxel_map, RANDOM.integers(-40, 80, (300, 3)), 2.0)
    field = DistanceField(voxel_map, size=(3, 4, 2))
    with pytest.raises(StereovoxError, match="add a frame"):
        field.update()
    with pytest.raises(StereovoxError, match="add a frame"):
        field.distance([0, 0, 0])
    places = []
    for x in (0.0, 0.3, 1.4, 6.0, 1.5, -1.0):
        stand(voxel_map, x, 0.5, 0.1)
        field.update()
        places.append(field.origin[0])
        middle = field.origin + np.array(field.metres.shape) * 0.05
        assert np.abs(middle - [x, 0.5, 0.1]).max() <= 0.81
        np.testing.assert_allclose(field.metres, wanted_metres(voxel_map, field, [State.OCCUPIED]), rtol=1e-6)
        again = DistanceField(voxel_map, field.origin, field.origin + np.array([3, 4, 2]))
        np.testing.assert_array_equal(field.metres, again.metres)
    assert places[0] == places[1], "it stays while the camera is near its middle"
    assert len(set(places)) >= 4


def test_distances_and_gradients_at_points():
    voxel_map = a_map()
    put(voxel_map, np.array([[0, 0, 0]]), 2.0)
    field = DistanceField(voxel_map, (-1, -1, -1), (1, 1, 1), max_distance=0.75)
    points = [
        [0.05, 0.05, 0.05],
        [0.31, 0.05, 0.05],
        [0.35, 0.45, 0.05],
        [0.95, 0.95, 0.95],
        [1.5, 0, 0],
        [np.nan, 0, 0],
    ]
    np.testing.assert_allclose(field.distance(points), [0, 0.3, 0.5, np.inf, np.nan, np.nan], rtol=1e-6)
    gradient = field.gradient(points)
    np.testing.assert_allclose(gradient[0], 0, atol=1e-6)
    np.testing.assert_allclose(gradient[1], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(gradient[2], [0.6, 0.8, 0], atol=0.02)
    assert np.isnan(gradient[3:]).all()
    np.testing.assert_allclose(field.gradient([-0.95, 0.05, 0.05]), [[np.nan] * 3])
    for measure, metres in {"centres": 0.3, "faces": 0.25, "gap": 0.2}.items():
        assert DistanceField(voxel_map, (-1, -1, -1), (1, 1, 1), measure=measure).distance(points[1]) == pytest.approx(
            metres
        )
    unlimited = DistanceField(voxel_map, (-1, -1, -1), (1, 1, 1))
    np.testing.assert_allclose(unlimited.gradient([-0.95, 0.05, 0.05]), [[-1, 0, 0]], atol=1e-5)
    assert unlimited.distance([0.95, 0.05, 0.05]) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({}, "low and high"),
        ({"low": (0, 0, 0), "high": (1, 1, 0)}, "lower one first"),
        ({"low": (0, 0, np.nan), "high": (1, 1, 1)}, "lower one first"),
        ({"size": (1, 1)}, "size"),
        ({"size": (1, -1, 1)}, "three lengths"),
        ({"size": (1e4, 1e4, 1)}, "too large"),
        ({"low": (0, 0, 0), "high": (1, 1, 1), "to": [State.FREE]}, "to: give one or more"),
        ({"low": (0, 0, 0), "high": (1, 1, 1), "max_distance": 0}, "max_distance 0"),
        ({"low": (0, 0, 0), "high": (1, 1, 1), "measure": "corners"}, "centres, faces, gap"),
    ],
)
def test_wrong_use_ends_in_one_line(asked, told):
    with pytest.raises(StereovoxError, match=told):
        DistanceField(a_map(), **asked)
