# SPDX-License-Identifier: Apache-2.0
"""Laws of poses on a floor, against 4x4 matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereovox.geometry import se2

METRES = st.floats(-100, 100)
POSES = st.tuples(METRES, METRES, st.floats(-20, 20)).map(np.array)


def same(a, b):
    """Whether poses are equal, also where yaw is just below and just above half a turn."""
    off = np.asarray(a) - b
    return np.allclose(off[..., :2], 0, atol=1e-7) and np.allclose(np.exp(1j * off[..., 2]), 1, atol=1e-9)


@given(POSES, POSES)
def test_composing_is_multiplying_matrices(a, b):
    assert np.allclose(se2.lifted(se2.compose(a, b)), se2.lifted(a) @ se2.lifted(b), atol=1e-7)


@given(POSES)
def test_the_inverse_is_that_of_the_matrix_from_either_side(a):
    assert np.allclose(se2.lifted(se2.inverse(a)), np.linalg.inv(se2.lifted(a)), atol=1e-7)
    assert same(se2.compose(a, se2.inverse(a)), np.zeros(3))
    assert same(se2.compose(se2.inverse(a), a), np.zeros(3))
    assert same(se2.inverse(se2.inverse(a)), a)


@given(POSES, POSES, POSES)
def test_composing_is_associative_and_relative_undoes_it(a, b, c):
    assert same(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    assert same(se2.relative(a, se2.compose(a, b)), b)
    assert same(se2.compose(a, se2.relative(a, b)), b)


@given(POSES, POSES)
def test_points_move_as_poses_do(a, b):
    assert np.allclose(se2.transform(a, b[None, :2])[0], se2.compose(a, b)[:2])
    assert np.allclose(se2.transform(a, [b[:2]] * 3), [(se2.lifted(a) @ [*b[:2], 0, 1])[:2]] * 3)


@given(POSES)
def test_a_pose_comes_back_from_its_matrix(a):
    T = se2.lifted(a)
    assert same(se2.flattened(T), a)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3))
    assert T[2].tolist() == [0, 0, 1, 0]
    assert T[3].tolist() == [0, 0, 0, 1]


def test_a_quarter_turn_to_the_left_shows_the_sign():
    assert se2.compose((1.0, 2.0, np.pi / 2), (3.0, 0.0, 0.1)) == pytest.approx([1, 5, np.pi / 2 + 0.1])
    assert se2.relative((1.0, 2.0, np.pi / 2), (1.0, 5.0, np.pi / 2)) == pytest.approx([3, 0, 0])


@given(st.floats(-1e4, 1e4))
def test_wrapped_is_the_same_angle_within_half_a_turn(angle):
    found = float(se2.wrapped(angle))
    assert -np.pi <= found < np.pi
    assert abs(np.exp(1j * found) - np.exp(1j * angle)) < 1e-9


def test_wrapped_at_the_ends():
    assert se2.wrapped([np.pi, -np.pi, 0, 3 * np.pi]).tolist() == [-np.pi, -np.pi, 0, -np.pi]
    assert se2.wrapped(np.nextafter(-np.pi, -4)) == -np.pi


@given(POSES)
def test_yaw_of_every_result_is_wrapped(a):
    for found in (se2.compose(a, a), se2.inverse(a), se2.relative(a, 2 * a)):
        assert -np.pi <= found[2] < np.pi


@given(st.lists(st.tuples(POSES, POSES), min_size=1, max_size=5))
def test_many_at_once_are_as_one_at_a_time(pairs):
    a, b = (np.array(poses) for poses in zip(*pairs, strict=True))
    for law in (se2.compose, se2.relative):
        assert np.allclose(law(a, b), [law(*pair) for pair in pairs])
        assert np.allclose(law(a[0], b), [law(a[0], one) for one in b])
        assert np.allclose(law(a, b[0]), [law(one, b[0]) for one in a])
        assert law(a[:, None], b).shape == (len(a), len(b), 3)
    assert np.allclose(se2.inverse(a), [se2.inverse(one) for one in a])
    assert np.allclose(se2.wrapped(a), [se2.wrapped(one) for one in a])
