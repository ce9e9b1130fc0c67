# SPDX-License-Identifier: Apache-2.0
"""Poses on a floor: x, y in metres and yaw (to the left) in radians, as (..., 3) float64 arrays.

Named like transforms: `pose_a_b` is the pose of frame b in frame a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.geometry.se3 import Transform

Pose = NDArray[np.float64]
"""(..., 3) float64: x, y, yaw."""


def wrapped(angle: ArrayLike) -> NDArray[np.float64]:
    """Return angles in radians wrapped into [-pi, pi)."""
    turned = (np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi
    return turned - 2 * np.pi * (turned >= np.pi)  # just below -pi rounds up to pi


def compose(pose_a_b: ArrayLike, pose_b_c: ArrayLike) -> Pose:
    """Return pose_a_c; both (..., 3), broadcast against each other."""
    a, b = np.asarray(pose_a_b, float), np.asarray(pose_b_c, float)
    cosine, sine = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + cosine * b[..., 0] - sine * b[..., 1]
    y = a[..., 1] + sine * b[..., 0] + cosine * b[..., 1]
    return np.stack([x, y, wrapped(a[..., 2] + b[..., 2])], axis=-1)


def inverse(pose_a_b: ArrayLike) -> Pose:
    """Return pose_b_a of (..., 3) poses."""
    a = np.asarray(pose_a_b, float)
    cosine, sine = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -cosine * a[..., 0] - sine * a[..., 1]
    y = sine * a[..., 0] - cosine * a[..., 1]
    return np.stack([x, y, wrapped(-a[..., 2])], axis=-1)


def relative(pose_a_b: ArrayLike, pose_a_c: ArrayLike) -> Pose:
    """Return pose_b_c: the pose of c in frame b."""
    return compose(inverse(pose_a_b), pose_a_c)


def transform(pose_a_b: ArrayLike, points_b: ArrayLike) -> NDArray[np.float64]:
    """Map (N, 2) points of frame b to frame a, for one pose (3,)."""
    x, y, yaw = np.asarray(pose_a_b, float)
    points = np.asarray(points_b, float)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.column_stack(
        [x + cosine * points[:, 0] - sine * points[:, 1], y + sine * points[:, 0] + cosine * points[:, 1]]
    )


def flattened(T_a_b: Transform) -> Pose:
    """Return the (3,) pose of a (4, 4) motion seen from above; yaw is the direction of its x axis."""
    return np.array([T_a_b[0, 3], T_a_b[1, 3], np.arctan2(T_a_b[1, 0], T_a_b[0, 0])])


def lifted(pose_a_b: ArrayLike) -> Transform:
    """Return the (..., 4, 4) motions of (..., 3) poses, upright and at height 0."""
    pose = np.asarray(pose_a_b, float)
    cosine, sine = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = cosine, -sine, sine, cosine
    T[..., 2, 2] = T[..., 3, 3] = 1
    T[..., :2, 3] = pose[..., :2]
    return T
