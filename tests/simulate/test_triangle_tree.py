# SPDX-License-Identifier: Apache-2.0
"""The first triangle that rays meet, next to all triangles in plain float64 (Moeller and Trumbore 1997)."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh

from stereovox.simulate.scene import TriangleTree, box, cylinder

NOTHING = np.zeros(3)


def all_triangles(triangles, origin, directions):
    """Return what `TriangleTree.nearest` does: every ray is held against every triangle."""
    a, along, other = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    share, number = np.full(len(directions), np.inf), np.full(len(directions), -1)
    with np.errstate(all="ignore"):
        for i, d in enumerate(np.asarray(directions, float)):
            p = np.cross(d, other)
            inverse = 1 / np.einsum("ij,ij->i", along, p)
            u = np.einsum("ij,ij->i", origin - a, p) * inverse
            q = np.cross(origin - a, along)
            v, t = q @ d * inverse, np.einsum("ij,ij->i", other, q) * inverse
            t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
            share[i] = t.min()
            number[i] = t.argmin() if np.isfinite(share[i]) else -1
    return share, number


def soup(count, seed=0, size=1.0):
    random = np.random.default_rng(seed)
    return random.uniform(-5, 5, (count, 1, 3)) + random.normal(size=(count, 3, 3)) * size


def some_directions(count, seed=1):
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 9, 17, 300, 2000])
def test_the_first_triangle_is_that_of_all_triangles(count):
    triangles, directions, origin = soup(count, count, size=3.0), some_directions(700), np.array([0.3, -0.2, 0.1])
    share, number = TriangleTree(triangles).nearest(origin, directions)
    expected, which = all_triangles(triangles, origin, directions)
    np.testing.assert_array_equal(number, which)
    np.testing.assert_allclose(share, expected, rtol=3e-7)
    assert count < 4 or (which >= 0).sum() > 20


def test_a_mesh_of_many_triangles_far_from_the_origin():
    sphere = trimesh.creation.uv_sphere(radius=2.0, count=[230, 230])
    centre = np.array([1000.0, -2000.0, 30.0])
    triangles, directions = np.array(sphere.triangles) + centre, some_directions(5000)
    assert len(triangles) > 100_000
    tree = TriangleTree(triangles)
    eye = centre + np.array([0.5, 0.4, -0.3])
    share, number = tree.nearest(eye, directions)
    reached = eye - centre + directions * share[:, None]
    np.testing.assert_allclose(np.linalg.norm(reached, axis=1), 2.0, atol=2e-4)  # triangles lie a little within
    expected, which = all_triangles(triangles, eye, directions[:20])
    np.testing.assert_array_equal(number[:20], which)
    np.testing.assert_allclose(share[:20], expected, rtol=1e-6)


SOLIDS = {
    "box": box("a", "a", (-1.0, -2.0, -0.5), (2.0, 1.0, 1.5)),
    "turned box": box("a", "a", (-1.0, -2.0, -0.5), (2.0, 1.0, 1.5), turn=0.3),
    "bar": cylinder("a", "a", (0.1, 0.2, -3.0), (-0.3, 0.1, 3.0), 2.0),
}


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), (0.11, -0.07, 0.23)])
def test_no_ray_leaves_a_closed_body_by_a_corner_or_an_edge(name, eye):
    triangles = SOLIDS[name].triangles
    weights = np.random.default_rng(0).uniform(size=(400, 1, 1))
    ends, others = triangles, np.roll(triangles, 1, axis=1)
    on_edges = (ends * weights[:, None] + others * (1 - weights[:, None])).reshape(-1, 3)
    middles = (ends + others).reshape(-1, 3) / 2
    targets = np.concatenate([triangles.reshape(-1, 3), middles, on_edges])
    share, number = TriangleTree(triangles).nearest(np.array(eye), (targets - eye).astype(np.float32))
    assert (number >= 0).all()
    np.testing.assert_allclose(share, 1, rtol=1e-6)


def test_rays_along_the_axes_and_in_a_triangle_s_plane():
    cube = TriangleTree(box("a", "a", (-1, -1, -1), (1, 1, 1)).triangles)
    axes = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    np.testing.assert_array_equal(cube.nearest(NOTHING, axes)[0], 1)  # each on the diagonal of a face
    np.testing.assert_array_equal(cube.nearest(NOTHING, 4 * axes)[0], 0.25)
    along_a_side = cube.nearest(np.array([-3.0, 1.0, 1.0]), axes[:1])[0]
    assert along_a_side == 2 or np.isinf(along_a_side)
    past, number = cube.nearest(np.array([-3.0, 1.0 + 1e-9, 0.3]), axes)
    assert np.isinf(past).all()
    assert (number == -1).all()
    floor = TriangleTree(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]))
    assert np.isinf(floor.nearest(np.array([-1.0, 0.2, 0.0]), axes)[0]).all()
    assert np.isinf(floor.nearest(np.array([0.2, 0.2, 0.0]), axes)[0]).all()  # from the surface itself


def test_triangles_without_area_are_never_met():
    real = np.array([[[2.0, -1, -1], [2, 1, -1], [2, 0, 1]]])
    flat = np.array([[[1.0, 0, 0]] * 3, [[1, -1, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 0]]])
    directions = np.array([[1, 0, 0], [1, 0.1, 0], [1, 0, 0.1], [0, 1, 0], [1, -0.2, 0]], np.float32)
    share, number = TriangleTree(np.concatenate([flat, real])).nearest(NOTHING, directions)
    np.testing.assert_array_equal(number, [3, 3, 3, -1, 3])
    np.testing.assert_allclose(share, [2, 2, 2, np.inf, 2])


def test_rays_that_are_none_meet_nothing():
    nan = np.float32(np.nan)
    directions = np.array([[0, 0, 0], [nan, nan, nan], [1, nan, 0], [1, 0, 0]], np.float32)
    share, number = TriangleTree(box("a", "a", (-1, -1, -1), (1, 1, 1)).triangles).nearest(NOTHING, directions)
    np.testing.assert_array_equal(share, [np.inf, np.inf, np.inf, 1])
    assert (number[:3] == -1).all()
    assert TriangleTree(soup(9)).nearest(NOTHING, np.empty((0, 3), np.float32))[0].shape == (0,)


def test_a_ray_does_not_depend_on_its_neighbours_nor_on_threads():
    tree, directions = TriangleTree(soup(3000, size=0.5)), some_directions(4001)
    share, number = tree.nearest(NOTHING, directions)
    order = np.random.default_rng(5).permutation(len(directions))
    for found, expected in zip(tree.nearest(NOTHING, directions[order]), (share, number), strict=True):
        np.testing.assert_array_equal(found, expected[order])
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: tree.nearest(NOTHING, directions), range(8)):
            np.testing.assert_array_equal(found[0], share)
            np.testing.assert_array_equal(found[1], number)


PLAIN = """
import sys
import numpy as np
from stereovox.simulate.scene import TriangleTree
given = np.load(sys.argv[1])
np.savez(sys.argv[2], *TriangleTree(given["triangles"]).nearest(np.array([0.3, 0.1, -0.2]), given["directions"]))
"""


def test_distances_are_rounded_as_numpy_rounds_and_so_the_same_on_every_processor(tmp_path):
    triangles, directions = soup(40, size=3.0), some_directions(100)
    np.savez(tmp_path / "given.npz", triangles=triangles, directions=directions)
    words = [sys.executable, "-c", PLAIN, str(tmp_path / "given.npz"), str(tmp_path / "found.npz")]
    subprocess.run(words, check=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONWARNINGS": "ignore"})
    found = np.load(tmp_path / "found.npz")
    share, number = TriangleTree(triangles).nearest(np.array([0.3, 0.1, -0.2]), directions)
    assert np.isfinite(share).sum() > 30
    np.testing.assert_array_equal(found["arr_0"].view(np.int32), share.view(np.int32))
    np.testing.assert_array_equal(found["arr_1"], number)
