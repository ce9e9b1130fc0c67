# SPDX-License-Identifier: Apache-2.0
"""The graph's poses are those of a slow, obvious least squares, and so is how well they are known."""

import sys

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import approx_fprime, least_squares

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import HELD, LITTLE, OUTLIER, Edge, PoseGraph, Position, Upright, need_gtsam
from stereovox.geometry.se3 import inverse, rotation_matrix, rotation_vector

UP = np.array([0.0, 0.0, 1.0])


class Plane:
    """Poses (3,): what a small motion does to one, and which motion (logarithm) leads from one to another."""

    size, random = 3, (0.05, 0.05, 0.03)

    @staticmethod
    def moved(pose, motion):
        return se2.compose(pose, motion)

    @staticmethod
    def motion(one, other):
        return Space.motion(se2.lifted(one), se2.lifted(other))[[3, 4, 2]]

    compose, relative = staticmethod(se2.compose), staticmethod(se2.relative)


class Space:
    """The same for poses (4, 4); a motion is (6,) rotation, shift."""

    size, random = 6, (0.03, 0.03, 0.03, 0.05, 0.05, 0.05)

    @staticmethod
    def moved(pose, motion):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_matrix(motion[:3]), motion[3:]
        return pose @ T

    @staticmethod
    def motion(one, other):
        T = inverse(one) @ other
        turn = rotation_vector(T[:3, :3])
        angle = max(np.linalg.norm(turn), 1e-9)
        W = np.cross(np.eye(3), turn / angle)
        V = np.eye(3) + (1 - np.cos(angle)) / angle * W + (1 - np.sin(angle) / angle) * W @ W
        return np.array([*turn, *np.linalg.solve(V, T[:3, 3])])

    compose, relative = staticmethod(np.matmul), staticmethod(lambda one, other: inverse(one) @ other)


KINDS = pytest.mark.parametrize("kind", [Plane, Space])


def whitened(information, left):
    return np.linalg.cholesky(information + LITTLE * np.eye(len(information))).T @ left


def doubted(left):
    """Residuals whose square is Cauchy's loss of the length of `left`."""
    length = np.linalg.norm(left)
    return left * np.sqrt(np.log1p((length / OUTLIER) ** 2)) * OUTLIER / max(length, 1e-12)


def residuals(kind, poses, start, steps, loops, others=()):
    def left(edge):
        there = kind.relative(poses[edge.first], poses[edge.second])
        return whitened(edge.information, kind.motion(edge.motion, there))

    def alone(other):
        if isinstance(other, Upright):
            return (poses[other.pose][:3, :3] @ other.up)[:2] / other.sigma  # the sine of the angle to UP
        return doubted((poses[other.pose][:3, 3] - other.place) / other.sigma)

    first = kind.motion(start[0], poses[0]) / HELD
    return np.concatenate(
        [first, *map(left, steps), *(doubted(left(edge)) for edge in loops), *(alone(other) for other in others)]
    )


def slow(kind, start, steps, loops, others=()):
    """The poses that explain all best, by scipy."""

    def at(moves):
        return [kind.moved(pose, move) for pose, move in zip(start, moves.reshape(-1, kind.size), strict=True)]

    def cost(moves):
        return residuals(kind, at(moves), start, steps, loops, others)

    found = least_squares(cost, np.zeros(len(start) * kind.size), method="lm")
    return np.array(at(found.x))


def way(kind, count=7, seed=0, noise=1.0):
    """True poses of a bent way, its steps as measured, and where these lead."""
    rng = np.random.default_rng(seed)
    step = np.array([1.0, 0.1, 0.7]) if kind is Plane else np.array([0.2, -0.1, 0.6, 1.0, 0.1, 0.05])
    true = [np.array([0.5, -0.3, 0.4]) if kind is Plane else Space.moved(np.eye(4), [0.1, 0.2, 0.3, 1, 2, 3])]
    drifted, steps = [true[0]], []
    spread = np.diag(np.array(kind.random) ** -2.0)
    for i in range(count - 1):
        true.append(kind.moved(true[-1], step + 0.1 * rng.standard_normal(kind.size)))
        off = noise * np.array(kind.random) * rng.standard_normal(kind.size)
        motion = kind.moved(kind.relative(true[i], true[i + 1]), off)
        steps.append(Edge(i, i + 1, motion, tilted(spread, rng)))
        drifted.append(kind.compose(drifted[-1], motion))
    return np.array(true), steps, np.array(drifted)


def tilted(information, rng):
    """Information whose directions are no axes."""
    turn = np.linalg.qr(rng.standard_normal(information.shape))[0]
    return information + 0.5 * turn @ information @ turn.T


def seen_again(kind, true, pairs, off=0.01, seed=1):
    rng = np.random.default_rng(seed)
    information = np.eye(kind.size) * 50.0**2
    return [
        Edge(a, b, kind.moved(kind.relative(true[a], true[b]), off * rng.standard_normal(kind.size)), information)
        for a, b in pairs
    ]


def apart(kind, found, other):
    return max(np.abs(kind.motion(one, two)).max() for one, two in zip(found, other, strict=True))


@KINDS
def test_poses_are_those_of_least_squares(kind):
    pytest.importorskip("gtsam")
    true, steps, drifted = way(kind)
    loops = seen_again(kind, true, [(0, 6), (1, 5)], off=0.05)
    found = PoseGraph(drifted, steps, loops).poses
    assert found.shape == drifted.shape
    assert apart(kind, found, slow(kind, drifted, steps, loops)) < 1e-4
    assert apart(kind, found[:1], drifted[:1]) < 1e-6
    assert apart(kind, found, drifted) > 0.02
    assert np.array_equal(PoseGraph(drifted, steps, loops).poses, found)


@KINDS
def test_a_wrong_loop_hardly_pulls(kind):
    pytest.importorskip("gtsam")
    true, steps, drifted = way(kind, count=9)
    right = seen_again(kind, true, [(0, 8), (1, 7), (2, 6)])
    far = np.array([1.0, -1.0, 0.3]) if kind is Plane else np.array([0.1, 0.1, 0.1, 1.0, -1.0, 0.5])
    wrong = Edge(0, 7, kind.moved(right[1].motion, far), right[0].information)
    without, robust = (PoseGraph(drifted, steps, loops).poses for loops in (right, [*right, wrong]))
    believed = PoseGraph(drifted, [*steps, wrong], right).poses
    assert apart(kind, robust, without) < 0.01
    assert apart(kind, believed, without) > 10 * apart(kind, robust, without)


@KINDS
def test_covariances_are_those_of_the_inverse_hessian(kind):
    pytest.importorskip("gtsam")
    true, steps, _ = way(kind, noise=0)
    loops = seen_again(kind, true, [(1, 6)], off=0)
    graph = PoseGraph(true, steps, loops)

    def at(moves):
        return [kind.moved(pose, move) for pose, move in zip(true, moves.reshape(-1, kind.size), strict=True)]

    def seen(moves, first, second):
        poses = at(moves)
        there = kind.relative(poses[first], poses[second])
        return kind.motion(kind.relative(true[first], true[second]), there)

    none = np.zeros(len(true) * kind.size)
    J = approx_fprime(none, lambda moves: residuals(kind, at(moves), true, steps, loops), 1e-6)
    covariance = np.linalg.inv(J.T @ J)
    for second, firsts in ((6, [0, 3, 6]), (2, [5, 1])):
        for first, found in zip(firsts, graph.covariances(firsts, second), strict=True):
            K = approx_fprime(none, lambda moves, a=first, b=second: seen(moves, a, b), 1e-6)
            expected = K @ covariance @ K.T
            assert np.allclose(found, expected, rtol=0.01, atol=0.01 * np.abs(expected).max() + 1e-12)


@KINDS
def test_an_edge_may_say_nothing_of_a_direction(kind):
    """As along a corridor, however it runs: there the steps alone tell."""
    pytest.importorskip("gtsam")
    true, steps, drifted = way(kind, count=3)
    motion, rng = kind.relative(true[0], true[2]), np.random.default_rng(0)
    shifts = slice(0, 2) if kind is Plane else slice(3, 6)
    for _ in range(20):
        along = np.zeros(kind.size)
        along[shifts] = rng.standard_normal(along[shifts].shape)
        along /= np.linalg.norm(along)
        across = np.eye(kind.size) - np.outer(along, along)
        information = across @ np.diag(rng.uniform(3e5, 1e6, kind.size)) @ across
        here, there = (Edge(0, 2, one, information) for one in (motion, kind.moved(motion, 0.5 * along)))
        plain, shifted = (PoseGraph(drifted, steps, [edge]).poses for edge in (here, there))
        assert apart(kind, plain, shifted) < 1e-3
        assert apart(kind, plain, drifted) > 0.003


def test_what_says_which_way_is_up_levels_poses():
    pytest.importorskip("gtsam")
    true, steps, drifted = way(Space)
    ups = [Upright(i, pose[:3, :3].T @ UP, 0.002) for i, pose in enumerate(true)]
    loops = seen_again(Space, true, [(0, 6)])
    found = PoseGraph(drifted, steps, loops, ups).poses
    assert apart(Space, found, slow(Space, drifted, steps, loops, ups)) < 1e-4
    tilts = [np.abs(true[i][:3, :3] @ found[i][:3, :3].T @ UP)[:2].max() for i in range(len(true))]
    assert max(tilts) < 0.004
    without = PoseGraph(drifted, steps, loops).poses
    assert max(np.abs(true[i][:3, :3] @ without[i][:3, :3].T @ UP)[:2].max() for i in range(len(true))) > 0.01


def test_up_may_be_any_direction():
    """The same poses in a world that lies on its side."""
    pytest.importorskip("gtsam")
    true, steps, drifted = way(Space)
    side = np.eye(4)
    side[:3, :3] = rotation_matrix([-np.pi / 2, 0, 0])
    ups = [Upright(i, pose[:3, :3].T @ UP, 0.002) for i, pose in enumerate(true)]
    plain = PoseGraph(drifted, steps, [], ups).poses
    turned = PoseGraph(side @ drifted, steps, [], ups, world_up=side[:3, :3] @ UP).poses
    assert apart(Space, turned, side @ plain) < 1e-5


def test_places_that_are_known_pull_and_a_wrong_one_hardly():
    pytest.importorskip("gtsam")
    true, steps, drifted = way(Space, count=9)
    fixes = [Position(i, true[i][:3, 3], np.full(3, 0.02)) for i in (2, 5, 8)]
    found = PoseGraph(drifted, steps, [], fixes).poses
    assert apart(Space, found, slow(Space, drifted, steps, [], fixes)) < 1e-4
    assert np.linalg.norm((found[8] - true[8])[:3, 3]) < 0.05 < np.linalg.norm((drifted[8] - true[8])[:3, 3])
    wrong = Position(7, true[7][:3, 3] + [3.0, 0, 0], np.full(3, 0.02))
    astray = PoseGraph(drifted, steps, [], [*fixes, wrong]).poses
    assert np.abs(astray[:, :3, 3] - found[:, :3, 3]).max() < 0.02


def test_the_motions_of_the_reference_are_logarithms():
    x, y, z, *shift = np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0])
    log = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0.0]])
    log[:3, 3] = shift
    assert np.allclose(Space.motion(np.eye(4), expm(log)), [x, y, z, *shift])


def test_without_gtsam_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    true, steps, _ = way(Plane)
    with pytest.raises(MissingExtra, match=r"stereovox\[slam\]"):
        PoseGraph(true, steps, [])
    with pytest.raises(MissingExtra, match=r"stereovox\[slam\]"):
        need_gtsam()


@pytest.mark.parametrize("with_wrong", [False, True])
def test_a_long_loop_in_the_plane_is_closed(with_wrong):
    pytest.importorskip("gtsam")
    side = [se2.compose([0, 0, 0], [i, 0, 0]) for i in range(10)]
    corners = [(0, 0, 0), (10, 0, np.pi / 2), (10, 10, np.pi)]
    true = np.array([se2.compose(corner, p) for corner in corners for p in side])
    strong = np.diag([1e4, 1e4, 1e4])
    steps, drifted = [], [true[0]]
    for i in range(len(true) - 1):
        step = se2.relative(true[i], true[i + 1]) + np.array([0.01, 0.0, 0.004])
        steps.append(Edge(i, i + 1, step, np.diag([1e3, 1e3, 1e4])))
        drifted.append(se2.compose(drifted[-1], step))
    loops = [Edge(a, b, se2.relative(true[a], true[b]), strong) for a, b in ((0, 29), (2, 27), (5, 20))]
    if with_wrong:
        loops.append(Edge(3, 25, se2.relative(true[3], true[25]) + np.array([3.0, -2.0, 0.4]), strong))
    start = np.array(drifted)
    assert np.abs(start - true)[-1, :2].max() > 0.3
    found = PoseGraph(start, steps, loops).poses
    assert np.hypot(*(found - true)[-1, :2]) < 0.05
    assert np.hypot(*(found - true)[:, :2].T).max() < 0.25


def test_a_graph_that_cannot_be_solved_is_told_in_one_line():
    edges = [Edge(i, i + 1, np.eye(4), np.diag([1e-30] * 5 + [1e30])) for i in range(3)]
    graph = PoseGraph(np.array([np.eye(4)] * 4), edges, [Edge(0, 3, np.eye(4), 1e-30 * np.eye(6))])
    with pytest.raises(StereovoxError, match=r"cannot be solved: .* give poses in metres") as caught:
        graph.covariances([0], 3)
    assert "\n" not in str(caught.value)
