# SPDX-License-Identifier: Apache-2.0
"""Pose graphs: the poses that best explain measured relative poses, and their uncertainty.

gtsam (Dellaert and contributors) solves them. Motions are (3,) x, y, yaw in the plane or (4, 4) in space;
covariances are for a small motion (3,) x, y, yaw or (6,) rotation, translation, in the second pose's own axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import MissingExtra, StereovoxError

OUTLIER = 3.0
"""Standard deviations from which a robust edge pulls less and less (Cauchy)."""
HELD = 1e-4
"""Default deviation of the first pose, in metres and radians."""
LITTLE = 1e-3
"""Information added to each edge, which may constrain nothing in some direction, as along a corridor."""
MAX_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class Edge:
    """The relative pose of two poses: `motion` is T_first_second; information: inverse of its covariance."""

    first: int
    second: int
    motion: NDArray[np.float64]
    information: NDArray[np.floating]


def information(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a covariance (N, N)."""
    return np.asarray(np.linalg.inv(covariance), np.float64)


@dataclass(frozen=True, eq=False)
class Upright:
    """The measured up direction at a pose: a unit vector (3,) in its axes, and its standard deviation in radians."""

    pose: int
    up: NDArray[np.float64]
    sigma: float


@dataclass(frozen=True, eq=False)
class Position:
    """A drift-free position of a pose (GNSS): (3,) metres in the graph's world, and its standard deviations."""

    pose: int
    place: NDArray[np.float64]
    sigma: NDArray[np.float64]


class PoseGraph:
    """A pose graph and its solution.

    Args:
        poses: (N, 3) or (N, 4, 4) initial values.
        steps: Edges that are certainly right.
        loops: Edges of which any may be wrong; Cauchy's function weights them.
        others: Other measurements of poses in space.
        world_up: (3,) unit vector; used if `others` hold up directions.
        held: Standard deviation in metres and radians that holds the first pose in place.

    Attributes:
        poses: The best poses, of the same shape.

    Raises:
        MissingExtra: gtsam is not installed.
        StereovoxError: The graph cannot be solved, since some constraints are far tighter than others.
    """

    def __init__(
        self,
        poses: NDArray[np.float64],
        steps: Iterable[Edge],
        loops: Iterable[Edge],
        others: Iterable[Upright | Position] = (),
        world_up: ArrayLike = (0.0, 0.0, 1.0),
        held: float = HELD,
    ):
        self._gtsam = gtsam = _gtsam()
        self._kind = "Pose2" if poses.ndim == 2 else "Pose3"
        self._graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for i, pose in enumerate(poses):
            values.insert(i, self._pose(pose))
        size = 3 if self._kind == "Pose2" else 6
        prior = getattr(gtsam, f"PriorFactor{self._kind}")
        self._graph.add(prior(0, self._pose(poses[0]), gtsam.noiseModel.Isotropic.Sigma(size, held)))
        robust = gtsam.noiseModel.mEstimator.Cauchy.Create(OUTLIER)
        for edge in steps:
            self._graph.add(self._between(edge, self._noise(edge)))
        for edge in loops:
            self._graph.add(self._between(edge, gtsam.noiseModel.Robust.Create(robust, self._noise(edge))))
        for other in others:
            self._graph.add(self._alone(other, np.asarray(world_up, float)))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(MAX_ITERATIONS)
        with _solvable():
            self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, values, parameters).optimize()
        at = getattr(self._values, f"at{self._kind}")
        self.poses = np.array([_numbers(at(i)) for i in range(len(poses))])

    def covariances(self, firsts: Sequence[int], second: int) -> list[NDArray[np.float64]]:
        """Return the uncertainty of a pose relative to each of several others: covariances of T_first_second.

        Args:
            firsts: Numbers of the other poses.
            second: Number of the pose.

        Returns:
            (3, 3) or (6, 6) for each of `firsts`.
        """
        with _solvable():
            marginals = self._gtsam.Marginals(self._graph, self._values)
        found = []
        at = getattr(self._values, f"at{self._kind}")
        for first in firsts:
            if first == second:
                found.append(np.zeros((3, 3) if self._kind == "Pose2" else (6, 6)))
                continue
            joint = marginals.jointMarginalCovariance([first, second])
            back = -(at(second).between(at(first))).AdjointMap()
            one, two, mixed = joint.at(first, first), joint.at(second, second), joint.at(first, second)
            crossed = back @ mixed
            found.append(back @ one @ back.T + crossed + crossed.T + two)
        return found

    def _pose(self, pose: NDArray[np.float64]) -> Any:
        return self._gtsam.Pose2(*pose) if self._kind == "Pose2" else self._gtsam.Pose3(pose)

    def _noise(self, edge: Edge) -> Any:
        information = edge.information + LITTLE * np.eye(len(edge.information))
        return self._gtsam.noiseModel.Gaussian.Information(information)

    def _between(self, edge: Edge, noise: Any) -> Any:
        factor = getattr(self._gtsam, f"BetweenFactor{self._kind}")
        return factor(edge.first, edge.second, self._pose(edge.motion), noise)

    def _alone(self, other: Upright | Position, world_up: NDArray[np.float64]) -> Any:
        gtsam = self._gtsam
        if isinstance(other, Upright):
            noise = gtsam.noiseModel.Isotropic.Sigma(2, other.sigma)
            return gtsam.AttitudeFactorPose3(other.pose, gtsam.Unit3(world_up), noise, gtsam.Unit3(other.up))
        noise = gtsam.noiseModel.Diagonal.Sigmas(other.sigma)
        robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(OUTLIER), noise)
        return gtsam.GPSFactor(other.pose, other.place, robust)


def _numbers(pose: Any) -> Any:
    return (pose.x(), pose.y(), pose.theta()) if hasattr(pose, "theta") else pose.matrix()


@contextmanager
def _solvable() -> Iterator[None]:
    """Replace gtsam's paragraph by one line."""
    try:
        yield
    except RuntimeError as error:
        if "ndeterminate linear system" not in str(error):
            raise
        raise StereovoxError(
            "the graph of poses cannot be solved: some are held far more firmly than others; give poses in metres and "
            "standard deviations that are not nearly 0"
        ) from None


def need_gtsam() -> None:
    """Raise MissingExtra if gtsam is not installed; call it before the work starts."""
    if find_spec("gtsam") is None:
        raise MissingExtra("gtsam", "slam")


def _gtsam() -> Any:
    need_gtsam()
    import gtsam

    return gtsam
