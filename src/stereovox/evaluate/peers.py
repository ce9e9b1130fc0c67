# SPDX-License-Identifier: Apache-2.0
"""Other mapping libraries behind one small interface, so that `bench` can feed them the frames that stereovox gets.

octomap-python and pyoctomap each bring their own OctoMap 1.10. They live in one process without a clash (the first is
linked statically, the second's libraries carry a hash in their names); alone, together and in either order they give
the same trees.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.errors import ConfigError, MissingExtra, did_you_mean

PEERS = {
    "octomap": "stereovox.evaluate.peers:OctomapPython",
    "octomap-rays": "stereovox.evaluate.peers:OctomapPythonRays",
    "pyoctomap": "stereovox.evaluate.peers:PyOctomap",
}
"""Libraries by name; other packages add theirs with entry points in the group `stereovox.peers`."""

TREE_DEPTH = 16
"""Levels of an octree of OctoMap; a leaf at this depth is one cell."""


class Peer(Protocol):
    """A map of another library; its class is made with the cell size in metres and raises MissingExtra."""

    def __init__(self, voxel_size: float): ...

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Take in points (N, 3) in metres, in the world, seen from `origin` (3,). This, and only this, is timed."""
        ...

    def counts(self) -> tuple[int, int]:
        """Return the numbers of occupied and of free cells, a node that stands for many cells counted as that many."""
        ...

    def bytes(self) -> int:
        """Return the memory the map needs, as the library itself tells."""
        ...


def find_peer(name: str) -> type[Peer]:
    """Return the class registered as `name`. Raises ConfigError that suggests a known name."""
    known = registry.names("peers", PEERS)
    if name not in known:
        raise ConfigError(f"unknown peer '{name}'{did_you_mean(name, known)}")
    return registry.find("peers", PEERS, name)


class OctomapPython:
    """octomap-python with OctoMap's own settings: p 0.7 for a hit, 0.4 for a miss, clamping at 0.12 and 0.97.

    A cell is occupied above p = 0.5 and free below it, as everywhere in OctoMap.
    """

    discretize = True
    """True: points that share a cell become one ray. False: one ray a point."""

    def __init__(self, voxel_size: float):
        self._tree = _library("octomap", "octomap-python").OcTree(voxel_size)

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Cast a ray to every point."""
        self._tree.insertPointCloud(points, origin, -1.0, False, self.discretize)

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells."""
        return _count((leaf.getDepth(), self._tree.isNodeOccupied(leaf)) for leaf in self._tree.begin_leafs())

    def bytes(self) -> int:
        """Return what `memoryUsage` tells: the nodes and their child arrays."""
        return self._tree.memoryUsage()


class OctomapPythonRays(OctomapPython):
    """octomap-python with one ray a point: exact, and slow."""

    discretize = False


class PyOctomap:
    """pyoctomap with the settings of `OctomapPython`, points that share a cell made one ray."""

    def __init__(self, voxel_size: float):
        self._tree = _library("pyoctomap", "pyoctomap").OcTree(voxel_size)

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Cast a ray to every cell that holds a point."""
        self._tree.insertPointCloud(points, origin, -1.0, False, True)

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells."""
        leafs = self._tree.begin_leafs()
        return _count((leaf.getDepth(), self._tree.isNodeOccupied(leaf.current_node)) for leaf in leafs)

    def bytes(self) -> int:
        """Return what `memoryUsage` tells: the nodes and their child arrays."""
        return self._tree.memoryUsage()


def _library(module: str, package: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtra(package, "bench") from None


def _count(leafs: Iterator[tuple[int, bool]]) -> tuple[int, int]:
    """Add up the cells of leafs given as depth and whether occupied; a pruned leaf stands for 8 cells a level."""
    cells = [0, 0]
    for depth, occupied in leafs:
        cells[not occupied] += 8 ** (TREE_DEPTH - depth)
    return cells[0], cells[1]
