# SPDX-License-Identifier: Apache-2.0
"""Least squares near an expected pose, against NumPy's and against a closed form."""

import numpy as np
import pytest

from stereovox.geometry.se3 import inverse, rotation_matrix, rotation_vector
from stereovox.track.fit import Stage, both, holding, solve_stages


def pose(turn, shift):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn), shift
    return T


EXPECTED = pose([0.3, -1.2, 0.8], [2.0, -3.0, 1.0])


def off(T, expected=EXPECTED):
    """Return by how much a pose differs from another: rotation vector and shift, in the map's axes."""
    return np.append(rotation_vector(T[:3, :3] @ expected[:3, :3].T), T[:3, 3] - expected[:3, 3])


def linear(A, b):
    """Return a stage whose residuals b - A x, x as `off` has it, have variance 1."""
    return Stage(lambda T: (A.T @ A, A.T @ (b - A @ off(T))), 1e-12)


def spread(seed):
    """Return a covariance in which all is correlated, of a few centimetres and degrees."""
    L = 0.02 * np.random.default_rng(seed).standard_normal((6, 6)) + 0.03 * np.eye(6)
    return L @ L.T


@pytest.mark.parametrize("seed", range(4))
def test_a_linear_problem_is_solved_as_numpy_solves_it(seed):
    random, doubt = np.random.default_rng(seed), spread(seed)
    A, b = 2000 * random.standard_normal((20, 6)), 10 * random.standard_normal(20)
    T, covariance = solve_stages([linear(A, b)], EXPECTED, doubt)
    expectation = np.linalg.inv(np.linalg.cholesky(doubt))
    x, *_ = np.linalg.lstsq(np.vstack([A, expectation]), np.append(b, np.zeros(6)), rcond=None)
    assert np.abs(x).max() > 1e-4
    assert off(T) == pytest.approx(x, abs=1e-9)
    assert covariance == pytest.approx(np.linalg.inv(A.T @ A + np.linalg.inv(doubt)), rel=1e-6, abs=1e-15)


def test_what_is_expected_counts_by_its_covariance():
    """One measurement as good as the expectation, along z: the pose is halfway."""
    A, doubt = np.zeros((1, 6)), np.diag([0.1, 0.1, 0.1, 0.2, 0.2, 0.05]) ** 2
    A[0, 5] = 1 / 0.04
    T, covariance = solve_stages([linear(A, np.array([0.1 / 0.04]))], EXPECTED, doubt)
    z = 0.1 / 0.04**2 / (1 / 0.04**2 + 1 / 0.05**2)
    assert off(T) == pytest.approx([0, 0, 0, 0, 0, z], abs=1e-9)
    assert np.diag(covariance)[5] == pytest.approx(1 / (1 / 0.04**2 + 1 / 0.05**2))


@pytest.mark.parametrize("open_axis", range(6))
def test_an_axis_without_information_stays_as_expected_with_its_covariance(open_axis):
    """Wherever the search begins."""
    random, doubt = np.random.default_rng(open_axis), np.diag([0.1, 0.2, 0.1, 0.3, 0.2, 0.1]) ** 2
    A, b = 500 * random.standard_normal((30, 6)), 5 * random.standard_normal(30)
    A[:, open_axis] = 0
    start = pose([0.01, -0.02, 0.01], [0.02, 0.01, -0.03]) @ EXPECTED
    T, covariance = solve_stages([linear(A, b)], EXPECTED, doubt, start)
    assert off(T)[open_axis] == pytest.approx(0, abs=1e-9)
    assert np.abs(np.delete(off(T), open_axis)).max() > 1e-4
    assert covariance[open_axis] == pytest.approx(doubt[open_axis], abs=1e-9)
    others = np.delete(np.arange(6), open_axis)
    assert np.diag(covariance)[others].max() < 0.01 * np.diag(doubt)[others].min()


@pytest.mark.parametrize("seed", range(3))
def test_an_oblique_direction_without_information_does_so_too(seed):
    random, doubt = np.random.default_rng(seed), spread(seed)
    L = np.linalg.cholesky(doubt)
    along = random.standard_normal(6)
    along /= np.linalg.norm(along)  # in deviations of the expectation
    A = 200 * random.standard_normal((30, 6)) @ (np.eye(6) - np.outer(along, along)) @ np.linalg.inv(L)
    T, covariance = solve_stages([linear(A, 50 * random.standard_normal(30))], EXPECTED, doubt)
    moved = np.linalg.solve(L, off(T))
    assert np.abs(moved).max() > 0.01
    assert along @ moved == pytest.approx(0, abs=1e-7)
    assert np.linalg.solve(L, np.linalg.solve(L, covariance).T) @ along == pytest.approx(along, abs=1e-4)


def test_what_holds_less_than_the_expectation_does_not_hold():
    doubt = np.diag([0.1] * 6) ** 2
    for ratio, holds in ((0.5, False), (2.0, True)):
        A = np.diag([300, 300, 300, 300, 300, np.sqrt(ratio) / 0.1])
        T, covariance = solve_stages([linear(A, A @ np.full(6, 0.05))], EXPECTED, doubt)
        assert off(T)[5] == pytest.approx(0.05 * ratio / (1 + ratio) if holds else 0, abs=1e-6)
        assert covariance[5, 5] == pytest.approx(0.01 / (1 + ratio) if holds else 0.01)


def test_each_stage_goes_on_from_the_one_before_and_the_last_one_counts():
    asked = []

    def measured(x, sigma):
        def equations(T):
            asked.append((sigma, off(T)))
            return np.eye(6) / sigma**2, (x - off(T)) / sigma**2

        return Stage(equations, 1e-9)

    coarse, fine = np.full(6, 0.04), np.full(6, 0.05)
    T, covariance = solve_stages([measured(coarse, 0.01), measured(fine, 0.001)], EXPECTED, np.diag([1.0] * 6))
    assert off(T) == pytest.approx(fine, abs=1e-6)
    assert np.diag(covariance) == pytest.approx(1e-6, rel=1e-3)
    first_of_fine = next(x for sigma, x in asked if sigma == 0.001)
    assert first_of_fine == pytest.approx(coarse, abs=1e-4)


def test_large_turns_are_found_as_the_closed_form_finds_them():
    """Points onto points (Kabsch 1976), with a start that is far off and nothing expected of weight."""
    random = np.random.default_rng(2)
    here = random.standard_normal((40, 3))
    truth = pose([0.5, 0.4, -0.6], [0.3, -0.2, 0.5]) @ EXPECTED
    there = here @ truth[:3, :3].T + truth[:3, 3] + 0.01 * random.standard_normal((40, 3))

    def equations(T):
        arms = here @ T[:3, :3].T
        information, gradient = np.zeros((6, 6)), np.zeros(6)
        for arm, place in zip(arms, there, strict=True):
            J = np.column_stack([*(np.cross(axis, arm) for axis in np.eye(3)), *np.eye(3)])
            information += J.T @ J / 0.01**2
            gradient += J.T @ (place - arm - T[:3, 3]) / 0.01**2
        return information, gradient

    T, _ = solve_stages([Stage(equations, 1e-12)] * 3, EXPECTED, np.diag([1e4] * 6))
    U, _, V = np.linalg.svd((here - here.mean(0)).T @ (there - there.mean(0)))
    R = V.T @ np.diag([1, 1, np.sign(np.linalg.det(U) * np.linalg.det(V))]) @ U.T
    assert T[:3, :3] == pytest.approx(R, abs=1e-7)
    assert T[:3, 3] == pytest.approx(there.mean(0) - R @ here.mean(0), abs=1e-7)
    assert inverse(truth) @ T == pytest.approx(np.eye(4), abs=0.02)


@pytest.mark.parametrize("seed", range(4))
def test_what_holds_nothing_takes_nothing_away_from_what_does(seed):
    """A wall holds three directions, and of the others less than nothing once what noise feigns is taken off."""
    random, doubt = np.random.default_rng(seed), spread(seed)
    A = 20_000 * random.standard_normal((3, 6))
    wall = linear(A, np.zeros(3)).equations
    feigned = lambda T: (wall(T)[0] - 3e7 * np.eye(6), wall(T)[1])  # noqa: E731
    B, b = 900 * random.standard_normal((20, 6)), 10 * random.standard_normal(20)
    seen = linear(B, b)
    alone = solve_stages([seen], EXPECTED, doubt)[1]
    T, covariance = solve_stages([Stage(both(holding(feigned, doubt), seen.equations), 1e-12)], EXPECTED, doubt)
    assert np.linalg.eigvalsh(alone - covariance).min() > -1e-12  # more is known, in no direction less
    assert np.trace(covariance) < 0.9 * np.trace(alone)
    without = solve_stages([Stage(both(feigned, seen.equations), 1e-12)], EXPECTED, doubt)[1]
    assert np.trace(without) > 2 * np.trace(alone)  # the control: as it would be
    assert np.linalg.norm(off(T)) < 0.05


def test_what_holds_all_is_held_as_it_is():
    random, doubt = np.random.default_rng(0), spread(0)
    one = linear(2000 * random.standard_normal((20, 6)), 10 * random.standard_normal(20)).equations
    T = pose([0.3, -1.2, 0.79], [2.0, -3.01, 1.0])
    for found, wanted in zip(holding(one, doubt)(T), one(T), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())
