# SPDX-License-Identifier: Apache-2.0
"""The pose graph: keyframes that agree with the odometry, with their matches and with each other (gtsam)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.errors import MissingExtra
from stereovox.localize.slam_keyframe import Edge

OUTLIER = 3.0
"""Standard deviations from which on a robust edge pulls less and less (Cauchy)."""


def optimised(
    poses: planar.Pose, steps: Iterable[Edge], edges: Iterable[Edge], scale: float = 1.0, outlier: float = OUTLIER
) -> planar.Pose:
    """Return the poses (N, 3) that explain all edges best; the first one stays.

    steps: edges that are surely right. edges: edges any of which may be wrong, as their information times `scale`; they
    are weighted by Cauchy's function.
    Raises MissingExtra where gtsam is not installed.
    """
    gtsam = _gtsam()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, (x, y, yaw) in enumerate(poses):
        values.insert(i, gtsam.Pose2(x, y, yaw))
    graph.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)))
    robust = gtsam.noiseModel.mEstimator.Cauchy.Create(outlier)
    for edge in steps:
        graph.add(_factor(gtsam, edge, _noise(gtsam, edge.information)))
    for edge in edges:
        noise = gtsam.noiseModel.Robust.Create(robust, _noise(gtsam, edge.information * scale))
        graph.add(_factor(gtsam, edge, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(50)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return np.array([_numbers(found.atPose2(i)) for i in range(len(poses))])


def _gtsam() -> Any:
    try:
        import gtsam
    except ImportError:
        raise MissingExtra("gtsam", "slam") from None
    return gtsam


def _noise(gtsam: Any, information: NDArray[np.float64]) -> Any:
    return gtsam.noiseModel.Gaussian.Information(information + 1e-3 * np.eye(3))


def _factor(gtsam: Any, edge: Edge, noise: Any) -> Any:
    return gtsam.BetweenFactorPose2(edge.first, edge.second, gtsam.Pose2(*edge.motion), noise)


def _numbers(pose: Any) -> tuple[float, float, float]:
    return pose.x(), pose.y(), pose.theta()
