# SPDX-License-Identifier: Apache-2.0
"""Drives of a robot with a lidar between walls, with odometry that drifts: slow and obvious ray casting."""

import itertools

import numpy as np

from stereovox.frame import Scan
from stereovox.geometry import se2


def box(x0, y0, x1, y1):
    """Four walls (4, 4): x, y from and to."""
    return np.array([[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]], float)


def ring():
    """A corridor round a block, with things in it that no two sides have alike."""
    things = [
        (3.0, 1.4, 3.6, 2.0),
        (8.2, 0.0, 9.0, 0.4),
        (13.6, 4.0, 14.0, 5.1),
        (9.0, 9.6, 9.7, 10.0),
        (0.0, 6.0, 0.5, 6.9),
    ]
    return np.vstack([box(0, 0, 14, 10), box(2, 2, 12, 8), *(box(*thing) for thing in things)])


def ranges(walls, pose, angles, limit):
    """Distance to the nearest wall along each beam, +inf beyond `limit`."""
    found = np.full(len(angles), np.inf)
    for x0, y0, x1, y1 in walls:
        along, away = np.array([x1 - x0, y1 - y0]), np.array([x0, y0]) - pose[:2]
        ahead = np.column_stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])])
        cross = ahead[:, 0] * along[1] - ahead[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (away[0] * along[1] - away[1] * along[0]) / cross
            share = (away[0] * ahead[:, 1] - away[1] * ahead[:, 0]) / cross
        hit = (distance > 0) & (share >= 0) & (share <= 1)
        found = np.where(hit & (distance < found), distance, found)
    return np.where(found < limit, found, np.inf)


def along(corners, step=0.1, turn=0.1):
    """Poses (N, 3) from corner to corner, turning on the spot."""
    poses = []
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        way, yaw = np.hypot(x1 - x0, y1 - y0), np.arctan2(y1 - y0, x1 - x0)
        if poses:
            swing = float(se2.wrapped(yaw - poses[-1][2]))
            poses += [(x0, y0, poses[-1][2] + t) for t in np.linspace(0, swing, int(abs(swing) / turn) + 1)[1:]]
        poses += [(x0 + t * (x1 - x0), y0 + t * (y1 - y0), yaw) for t in np.linspace(0, 1, int(way / step) + 1)]
    return np.array(poses)


def drive(walls, poses, drift=(1.0, 0.0), noise=0.01, limit=8.0, beams=181, seed=0):
    """Scans over 240 degrees at the poses (N, 3), one each 0.1 s, with odometry that starts at the first pose.

    drift: what each step's length is multiplied with, and radians that a metre turns in addition.
    """
    rng = np.random.default_rng(seed)
    angles = np.radians(np.linspace(-120, 120, beams))
    odometry, scans = poses[0], []
    for i, pose in enumerate(poses):
        if i:
            step = se2.relative(poses[i - 1], pose)
            way = np.hypot(step[0], step[1])
            odometry = se2.compose(odometry, [*(drift[0] * step[:2]), step[2] + drift[1] * way])
        seen = ranges(walls, pose, angles, limit)
        seen = (seen + noise * rng.standard_normal(beams)).astype(np.float32)
        stamp = (i + 1) * 100_000_000
        step = float(angles[1] - angles[0])
        scans.append(Scan(seen, float(angles[0]), step, 0.02, limit, se2.lifted(odometry), stamp_ns=stamp))
    return scans
