# SPDX-License-Identifier: Apache-2.0
"""The test whether a point lies in a box, against a slow one that turns every point into the box's own frame."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereovox.evaluate.lidar_truth import corners_of, in_any_box, inside
from stereovox.geometry.se3 import rotation_matrix
from stereovox.sources.lidar import Box

RNG = np.random.default_rng(4)


def some_box(rng: np.random.Generator) -> Box:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(rng.normal(size=3)), rng.uniform(-2, 2, 3)
    return Box(T, tuple(rng.uniform(0.5, 4, 3)))


def slowly_inside(point: np.ndarray, box: Box, margin: float) -> bool:
    own = np.linalg.inv(box.T_world_box) @ [*point, 1]
    return all(abs(own[axis]) <= box.size[axis] / 2 + margin for axis in range(3))


@pytest.mark.parametrize("margin", [0.0, 0.25])
def test_it_agrees_with_the_slow_test(margin):
    boxes = [some_box(RNG) for _ in range(6)]
    points = RNG.uniform(-4, 4, (400, 3))
    expected = np.array([[slowly_inside(point, box, margin) for point in points] for box in boxes])
    assert 0.02 < expected.mean() < 0.5
    for box, wanted in zip(boxes, expected, strict=True):
        np.testing.assert_array_equal(in_any_box(points, [box], margin), wanted)
    np.testing.assert_array_equal(in_any_box(points, boxes, margin), expected.any(axis=0))
    assert not in_any_box(points, []).any()


def test_the_order_of_the_corners_does_not_matter():
    p0, *others = corners_of(some_box(RNG))
    points = RNG.uniform(-4, 4, (300, 3))
    found = [inside(points, (p0, *order)) for order in itertools.permutations(others)]
    assert found[0].any()
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_faces_belong_to_the_box():
    box = Box(np.eye(4), (2.0, 4.0, 6.0))
    on, off = [[1, 2, 3], [-1, -2, -3], [0, 0, 3]], [[1.001, 0, 0], [0, -2.001, 0], [0, 0, 3.001]]
    assert in_any_box(np.array(on, float), [box]).all()
    assert not in_any_box(np.array(off), [box]).any()


def test_as_printed_it_could_never_hold():
    """Eq A.3 asks for u, v and w that all point away from p0; no box and no order of corners has that."""
    p0, *others = corners_of(Box(np.eye(4), (2.0, 2.0, 2.0)))
    for p1, p3, p4 in itertools.permutations(others):
        u, v, w = np.cross(p0 - p3, p0 - p4), np.cross(p0 - p1, p0 - p4), np.cross(p0 - p1, p0 - p3)
        assert not (u @ p0 <= u @ p1 and v @ p0 <= v @ p3 and w @ p0 <= w @ p4)
