# SPDX-License-Identifier: Apache-2.0
"""Libraries under test: stereovox by profile, and every peer of `stereovox bench` whose cells can be read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from time import process_time
from typing import Any, Protocol

import numpy as np

import stereovox
from stereovox.config import load_config
from stereovox.errors import ConfigError, MissingExtra
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox_lab.bench.peers import blamed, find_peer
from stereovox_lab.bench.rows import insertion
from stereovox_lab.benchmark.data import Task, raw

OURS = "stereovox"
USUAL = (OURS, "octomap", "pyoctomap", "wavemap")
"""Libraries compared by default, if installed."""
HAIR = 1e-4
"""A cell of a library with one threshold is free below that minus this."""
WIDEST = 30.0
"""Limit of the log-odds of maps from other libraries."""


class Contestant(Protocol):
    """A map being made for one task. ms: processor time of each frame, of all threads."""

    ms: list[float]

    def add(self, frame: Frame) -> None:
        """Add a frame."""
        ...

    def map(self) -> VoxelMap:
        """Return the map as a voxel map, judged by its states."""
        ...

    def bytes(self) -> int:
        """Return the map's bytes as reported by the library."""
        ...


@dataclass(frozen=True)
class Library:
    """A library under a name. make: starts its map of a task; version, settings: in words."""

    name: str
    make: Callable[[Task], Contestant]
    version: str
    settings: str


def find_libraries(names: Sequence[str] | None = None) -> tuple[list[Library], list[str]]:
    """Return libraries by name, and for each default one that is not installed a line about how to get it.

    names: `stereovox`, `stereovox:PROFILE` (a profile or a file of settings), a peer of `stereovox bench`, or
    `module:Class`; None: the usual ones. Raises ConfigError for an unknown library and one with unreadable cells,
    MissingExtra for a named one that is not installed.
    """
    found, missing = [], []
    for name in dict.fromkeys(USUAL if names is None else names):
        try:
            found.append(_ours(name) if name == OURS or name.startswith(f"{OURS}:") else _peer(name))
        except MissingExtra as why:
            if names is not None:
                raise
            missing.append(f"{name}: {why}")
    if not found:
        raise ConfigError("no library to compare; name at least one, for example stereovox")
    return found, missing


def _ours(name: str) -> Library:
    profile = name.partition(":")[2] or "default"
    load_config(profile)  # fails here for an unknown one, before the work
    about = f"profile {profile}, one thread; its own depth preparation is part of it"
    return Library(name, lambda task: _Stereovox(profile, task), stereovox.__version__, about)


def _peer(name: str) -> Library:
    kind: Any = find_peer(name)
    if not (callable(getattr(kind, "cells", None)) and hasattr(kind, "occupied_above")):
        raise ConfigError(f"peer '{name}' lacks cells or occupied_above, by which its map is judged; add them")
    with blamed(f"peer '{name}' cannot be made", ConfigError):
        kind(1.0)
    about = getattr(kind, "about", "") if isinstance(getattr(kind, "about", ""), str) else ""
    return Library(name, lambda task: _Peer(name, kind, task), _version(getattr(kind, "package", "")), about)


def _version(package: str) -> str:
    try:
        return f"{package} {version(package)}" if package else "unknown"
    except PackageNotFoundError:
        return package


class _Stereovox:
    def __init__(self, profile: str, task: Task):
        sizes: dict[str, Any] = {"voxel_size": task.voxel_size, "max_range": task.max_range, "threads": 1}
        self._mapper = Mapper(load_config(profile, **sizes, **{"window.size": None}))
        self.ms: list[float] = []

    def add(self, frame: Frame) -> None:
        start = process_time()
        self._mapper.add(frame)
        self.ms.append(1e3 * (process_time() - start))

    def map(self) -> VoxelMap:
        return self._mapper.map

    def bytes(self) -> int:
        return self._mapper.map.memory_bytes


class _Peer:
    """Gets every valid pixel; pixels beyond the range clear space up to it if the library supports that."""

    def __init__(self, name: str, kind: Any, task: Task):
        self._name, self._peer = name, kind(task.voxel_size)
        self.ms: list[float] = []
        self._config = raw(load_config(voxel_size=task.voxel_size, max_range=task.max_range, threads=1))
        self._range = 0.0
        if hasattr(self._peer, "reach"):
            self._range = task.max_range
            self._peer.reach(self._range)

    def add(self, frame: Frame) -> None:
        with blamed(f"peer '{self._name}'"):
            insert = insertion(self._peer, frame, self._config, self._range)
            start = process_time()
            insert()
            self.ms.append(1e3 * (process_time() - start))

    def map(self) -> VoxelMap:
        with blamed(f"peer '{self._name}'"):
            cells, log_odds = self._peer.cells()
        above = float(self._peer.occupied_above)
        decisions = {"map.prior": above, "map.occupied_above": above, "map.free_below": above - HAIR}
        limits = {"map.log_odds_min": -WIDEST, "map.log_odds_max": WIDEST}
        config = load_config(self._config, **decisions, **limits)
        return VoxelMap.from_cells(config, cells, np.clip(log_odds, -WIDEST, WIDEST))

    def bytes(self) -> int:
        return int(self._peer.bytes())
