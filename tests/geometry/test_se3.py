# SPDX-License-Identifier: Apache-2.0
"""Laws of rigid motions, and agreement with SciPy's rotations."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation, Slerp

from stereovox.geometry import se3

DOWN = np.array([0.0, 0.0, 0.0, 1.0])
numbers = st.floats(-100, 100, allow_subnormal=False)
vectors = arrays(float, 3, elements=numbers)
clouds = arrays(float, (5, 3), elements=numbers)


@st.composite
def quaternions(draw):
    """Any quaternion x, y, z, w that is not nearly zero, of any length."""
    q = draw(arrays(float, 4, elements=st.floats(-1, 1, allow_subnormal=False)))
    assume(np.linalg.norm(q) > 1e-3)
    return q


@st.composite
def motions(draw):
    """Any rigid motion, made without the module under test."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(draw(quaternions())).as_matrix()
    T[:3, 3] = draw(vectors)
    return T


@st.composite
def turns(draw, largest=np.pi):
    """An axis times an angle between 0 and `largest`."""
    axis = draw(arrays(float, 3, elements=st.floats(-1, 1, allow_subnormal=False)))
    assume(np.linalg.norm(axis) > 1e-3)
    return axis / np.linalg.norm(axis) * draw(st.floats(0, largest, allow_subnormal=False))


@given(motions(), motions(), clouds)
def test_inverse_undoes_and_motions_chain(T_a_b, T_b_c, points):
    np.testing.assert_allclose(se3.inverse(T_a_b) @ T_a_b, np.eye(4), atol=1e-11)
    there = se3.transform_points(T_a_b, points)
    np.testing.assert_allclose(se3.transform_points(se3.inverse(T_a_b), there), points, atol=1e-10)
    step_by_step = se3.transform_points(T_a_b, se3.transform_points(T_b_c, points))
    np.testing.assert_allclose(se3.transform_points(T_a_b @ T_b_c, points), step_by_step, atol=1e-9)


@given(motions(), clouds)
def test_a_batch_is_its_single_points(T, points):
    homogeneous = np.column_stack([points, np.ones(len(points))])
    np.testing.assert_allclose(se3.transform_points(T, points), (homogeneous @ T.T)[:, :3], atol=1e-10)


@given(vectors, quaternions(), st.floats(0.01, 100))
def test_quaternions_as_scipy_reads_them(position, q, length):
    T = se3.from_quaternion(position, length * q)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], position)
    np.testing.assert_array_equal(T[3], DOWN)
    np.testing.assert_allclose(se3.from_quaternion(position, -q)[:3, :3], T[:3, :3], atol=1e-12)


@given(turns())
def test_rotation_vector_and_matrix_are_each_others_inverse(vector):
    R = se3.rotation_matrix(vector)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-11)
    np.testing.assert_allclose(se3.rotation_matrix(se3.rotation_vector(R)), R, atol=1e-7)


@given(turns(largest=np.pi - 1e-3))
def test_rotation_vector_comes_back_below_half_a_turn(vector):
    np.testing.assert_allclose(se3.rotation_vector(se3.rotation_matrix(vector)), vector, atol=1e-8)


@given(turns(), st.sampled_from([0.0, 1e-12, 1e-10, 1e-8, 1e-6]))
def test_half_a_turn_about_any_axis(vector, short_of_it):
    assume(np.linalg.norm(vector) > 1e-6)
    axis = vector / np.linalg.norm(vector)
    R = Rotation.from_rotvec(axis * (np.pi - short_of_it)).as_matrix()
    back = se3.rotation_vector(R)
    assert np.linalg.norm(back) == pytest.approx(np.pi - short_of_it, abs=1e-7)
    np.testing.assert_allclose(se3.rotation_matrix(back), R, atol=1e-6)


def test_no_turn_is_a_zero_vector():
    np.testing.assert_array_equal(se3.rotation_vector(np.eye(3)), np.zeros(3))
    np.testing.assert_array_equal(se3.rotation_matrix(np.zeros(3)), np.eye(3))


@given(motions(), motions())
def test_interpolation_starts_and_ends_right(T0, T1):
    apart = Rotation.from_matrix(T0[:3, :3].T @ T1[:3, :3]).magnitude()
    assume(apart < np.pi - 1e-6)
    np.testing.assert_allclose(se3.interpolate(T0, T1, 0.0), T0, atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(T0, T1, 1.0), T1, atol=1e-6)


@given(motions(), turns(largest=np.pi - 0.01), vectors, st.floats(0, 1))
def test_interpolation_is_slerp_and_a_straight_line(T0, turn, position, share):
    T1 = np.eye(4)
    T1[:3, :3] = T0[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    T1[:3, 3] = position
    slerp = Slerp([0, 1], Rotation.from_matrix([T0[:3, :3], T1[:3, :3]]))
    between = se3.interpolate(T0, T1, share)
    np.testing.assert_allclose(between[:3, :3], slerp(share).as_matrix(), atol=1e-7)
    np.testing.assert_allclose(between[:3, 3], (1 - share) * T0[:3, 3] + share * position, atol=1e-10)
    assert se3.rigidity_error(between) < 1e-9


@given(motions(), arrays(float, (3, 3), elements=st.floats(-1e-3, 1e-3)))
def test_orthonormalise_mends_small_faults_and_leaves_good_ones(T, noise):
    faulty = T.copy()
    faulty[:3, :3] += noise
    mended = se3.orthonormalise(faulty)
    assert se3.rigidity_error(mended) < 1e-12
    np.testing.assert_allclose(mended[:3, :3], T[:3, :3], atol=5e-3)
    np.testing.assert_array_equal(mended[:3, 3], T[:3, 3])
    np.testing.assert_allclose(se3.orthonormalise(T), T, atol=1e-12)


@given(motions(), st.floats(1e-6, 0.5))
def test_rigidity_error_measures_stretch(T, stretch):
    assert se3.rigidity_error(T) < 1e-12
    stretched = T.copy()
    stretched[:3, :3] = T[:3, :3] @ np.diag([1 + stretch, 1, 1])
    assert se3.rigidity_error(stretched) == pytest.approx((1 + stretch) ** 2 - 1, rel=1e-6)


@pytest.mark.parametrize(
    "T",
    [
        np.diag([1.0, 1, -1, 1]),
        np.full((4, 4), np.nan),
        np.zeros((4, 4)),
        np.eye(3),
        np.vstack([np.eye(4)[:3], [0, 0, 1, 1]]),
    ],
    ids=["mirror", "nan", "zeros", "3x3", "last row"],
)
def test_what_is_no_rigid_motion_at_all(T):
    assert se3.rigidity_error(T) == np.inf


@given(vectors, vectors)
def test_look_at_meets_its_target(eye, target):
    away = target - eye
    assume(np.linalg.norm(away) > 0.1)
    assume(np.hypot(away[0], away[1]) > 0.01 * np.linalg.norm(away))  # not straight up or down
    T_world_camera = se3.look_at(eye, target)
    assert se3.rigidity_error(T_world_camera) < 1e-9
    seen = se3.transform_points(se3.inverse(T_world_camera), target[None])[0]
    np.testing.assert_allclose(seen, [0, 0, np.linalg.norm(away)], atol=1e-8)
    assert T_world_camera[2, 1] < 0, "the image's y axis points down"
    assert abs(T_world_camera[2, 0]) < 1e-12, "the horizon is level"


@pytest.mark.parametrize("one", [(0, 0, 1), (0.6, 0, 0.8), (1, 0, 0)])
@pytest.mark.parametrize("other", [(0, 0, 1), (0, 0, -1), (0, -0.8, 0.6), (-0.6, 0, -0.8)])
def test_the_least_rotation_between_two_directions(one, other):
    R = se3.rotation_between(one, other)
    np.testing.assert_allclose(R @ one, other, atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    angle = np.arccos(np.clip(np.dot(one, other), -1, 1))
    assert np.linalg.norm(se3.rotation_vector(R)) == pytest.approx(angle, abs=1e-7)


def test_the_covariance_of_another_point_of_a_body_is_that_of_its_errors():
    """Of 20,000 bodies that err as the first says: those of the second, at the end of a lever."""
    rng, lever = np.random.default_rng(0), np.array([0.5, -0.3, 0.2])
    root = rng.normal(size=(6, 6)) * [[0.01], [0.02], [0.03], [0.005], [0.01], [0.02]]
    errors = rng.normal(size=(20_000, 6)) @ root.T
    shifts = np.array([error[3:] + se3.rotation_matrix(error[:3]) @ lever - lever for error in errors])
    found = se3.covariance_at(root @ root.T, lever)
    found_by_errors = np.cov(np.column_stack([errors[:, :3], shifts]).T)
    scale = np.sqrt(np.diag(found))
    np.testing.assert_allclose(found_by_errors / scale / scale[:, None], found / scale / scale[:, None], atol=0.03)
