# SPDX-License-Identifier: Apache-2.0
"""Trajectories in space whose errors are known or random, and files of them."""

import numpy as np
from scipy.spatial.transform import Rotation

from stereovox.sources.poses.poses import Poses, seconds_from_ns

RATE_NS = 100_000_000


def transforms(positions, rotations):
    """Return (N, 4, 4) motions of (N, 3) positions and a scipy Rotation of N."""
    T = np.zeros((len(positions), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = rotations.as_matrix(), positions, 1
    return T


def flight(number=300, speed=0.1):
    """Return (N, 4, 4) poses along a smooth curve in space of about `speed` metres a step."""
    t = np.arange(number) * speed
    positions = np.column_stack([t, 3 * np.sin(t / 4), 0.5 * np.cos(t / 3)])
    return transforms(positions, Rotation.from_euler("zyx", np.column_stack([np.sin(t / 5), t / 9, np.cos(t / 7)])))


def shaken(T, seed, metres=0.05, radians=0.02):
    """Return poses with random errors added to each."""
    random = np.random.default_rng(seed)
    off = transforms(
        random.normal(0, metres, (len(T), 3)), Rotation.from_rotvec(random.normal(0, radians, (len(T), 3)))
    )
    return T @ off


def moved():
    """Return a (4, 4) motion far from the identity."""
    return transforms(np.array([[40.0, -7.0, 3.0]]), Rotation.from_rotvec([[0.4, -1.1, 2.0]]))[0]


def timed(T, stamps_ns=None):
    """Return `Poses` of (N, 4, 4), ten a second unless `stamps_ns` says otherwise."""
    return Poses(np.arange(len(T)) * RATE_NS if stamps_ns is None else stamps_ns, T)


def write_tum(path, poses):
    """Write `Poses` as lines `stamp tx ty tz qx qy qz qw`."""
    quaternions = Rotation.from_matrix(poses.T_world_body[:, :3, :3]).as_quat()
    rows = np.column_stack([poses.T_world_body[:, :3, 3], quaternions])
    lines = [
        f"{seconds_from_ns(stamp)} " + " ".join(f"{number:.9f}" for number in row)
        for stamp, row in zip(poses.stamps_ns, rows, strict=True)
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_kitti(path, T):
    """Write (N, 4, 4) poses as lines of 12 numbers."""
    np.savetxt(path, T[:, :3].reshape(len(T), 12), fmt="%.12e")
    return path
