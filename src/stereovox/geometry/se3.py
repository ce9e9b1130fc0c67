# SPDX-License-Identifier: Apache-2.0
"""Rigid motions as plain 4x4 float64 arrays. `T_a_b` maps coordinates in frame b to frame a."""

from __future__ import annotations

from math import acos, dist, isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

Transform = NDArray[np.float64]
"""(4, 4) float64 rigid motion."""


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a, exact for rigid motions."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def transform_points(T_a_b: Transform, points_b: ArrayLike) -> NDArray[np.float64]:
    """Map (N, 3) points in frame b to frame a."""
    return np.asarray(points_b, float) @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rigidity_error(T: ArrayLike) -> float:
    """Return the largest entry of |R^T R - I|; inf for reflections, NaN and wrong shapes."""
    T = np.asarray(T)
    if T.shape != (4, 4):
        return np.inf
    # plain numbers are five times as fast, and every frame is checked
    (a, b, c, x), (d, e, f, y), (g, h, i, z), (j, k, m, n) = T.tolist()
    if not (isfinite(x + y + z) and abs(j) + abs(k) + abs(m) + abs(n - 1) <= 1e-6):
        return np.inf
    if not a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0:
        return np.inf
    lengths = a * a + d * d + g * g - 1, b * b + e * e + h * h - 1, c * c + f * f + i * i - 1
    angles = a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i
    return max(map(abs, lengths + angles))


def orthonormalise(T: Transform) -> Transform:
    """Return the rigid motion nearest to `T` (polar decomposition), for rotations read from files with few digits."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    rigid = np.array(T, float)
    rigid[:3, :3] = u @ vt
    rigid[3] = 0, 0, 0, 1
    return rigid


def from_quaternion(translation: ArrayLike, quaternion_xyzw: ArrayLike) -> Transform:
    """Return the motion of a (3,) translation in metres and a (4,) quaternion x, y, z, w (of any length but zero)."""
    x, y, z, w = np.asarray(quaternion_xyzw, float) / np.linalg.norm(quaternion_xyzw)
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = translation
    return T


def rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3,) axis times angle in radians of a rotation matrix (logarithm of SO(3))."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine, cosine = np.linalg.norm(axis), (np.trace(R) - 1) / 2
    angle = np.arctan2(sine, cosine)
    if sine > 1e-9:
        return axis * (angle / sine)
    if cosine > 0:
        return axis
    column = np.argmax(np.diag(R))  # half a turn: R = 2 a a^T - I
    a = R[:, column] + np.eye(3)[column]
    return np.pi * a / np.linalg.norm(a)


def rotation_matrix(vector: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation matrix of an axis times angle in radians (Rodrigues)."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def rotation_between(one: ArrayLike, other: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that turns a unit vector (3,) into another one."""
    a, b = np.asarray(one, float), np.asarray(other, float)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:  # for half a turn any perpendicular axis will do
        return rotation_matrix(np.zeros(3)) if cosine > 0 else rotation_matrix(np.pi * _across(a))
    return rotation_matrix(axis * (np.arctan2(sine, cosine) / sine))


def covariance_at(covariance: NDArray[np.float64], lever: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of another point of a rigid body.

    To first order, a small rotation w about the first point shifts the other one by w x lever more.

    Args:
        covariance: (6, 6) of a small rotation (radians), then of the first point's shift (metres), along the world's
            axes.
        lever: (3,) metres along the world's axes, from the first point to the other.
    """
    x, y, z = lever
    change = np.eye(6)
    change[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    return change @ covariance @ change.T


def _across(a: NDArray[np.float64]) -> NDArray[np.float64]:
    axis = np.asarray(np.cross(a, np.eye(3)[np.argmin(np.abs(a))]), float)
    return axis / np.linalg.norm(axis)


def interpolate(T_a_b0: Transform, T_a_b1: Transform, share: float) -> Transform:
    """Return the motion at `share` between two (0 to 1; extrapolated beyond): linear in position and rotation angle."""
    T = np.eye(4)
    R0 = T_a_b0[:3, :3]
    T[:3, :3] = R0 @ rotation_matrix(share * rotation_vector(R0.T @ T_a_b1[:3, :3]))
    T[:3, 3] = (1 - share) * T_a_b0[:3, 3] + share * T_a_b1[:3, 3]
    return T


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0, 0, 1)) -> Transform:
    """Return T_world_camera of a camera at `eye` whose optical axis (z forward, x right, y down) meets `target`."""
    eye = np.asarray(eye, float)
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = _cross(forward, np.asarray(up, float))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, _cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def _cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross product of two vectors (3,), ten times as fast as `np.cross`."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])


def apart(before: tuple[float, ...], now: tuple[float, ...]) -> tuple[float, float]:
    """Return the distance between two poses (12 numbers each, row by row), in metres and radians."""
    a, b, c, x, d, e, f, y, g, h, i, z = before
    p, q, r, u, s, t, k, v, m, n, o, w = now
    cosine = (a * p + b * q + c * r + d * s + e * t + f * k + g * m + h * n + i * o - 1) / 2
    return dist((x, y, z), (u, v, w)), acos(min(1.0, max(-1.0, cosine)))
