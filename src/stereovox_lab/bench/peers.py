# SPDX-License-Identifier: Apache-2.0
"""Other mapping libraries behind one small interface, so that `bench` feeds them the same frames as stereovox.

octomap-python and pyoctomap each bring their own OctoMap 1.10. They coexist in one process (the first is linked
statically, the second's libraries have a hash in their names); alone, together and in either order they give the same
trees.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.errors import ConfigError, MissingExtra, StereovoxError, did_you_mean
from stereovox.formats.octomap import read_octomap
from stereovox_lab.bench.machine import on_one_processor

PEERS = {
    "octomap": "stereovox_lab.bench.peers:OctomapPython",
    "octomap-rays": "stereovox_lab.bench.peers:OctomapPythonRays",
    "pyoctomap": "stereovox_lab.bench.peers:PyOctomap",
    "wavemap": "stereovox_lab.bench.peers:Wavemap",
    "octomap-cpp": "stereovox_lab.bench.native:OctomapCpp",
    "bonxai": "stereovox_lab.bench.native:Bonxai",
    "ufomap": "stereovox_lab.bench.native:Ufomap",
    "wavemap-cpp": "stereovox_lab.bench.native:WavemapCpp",
}
"""Libraries by name; other packages add theirs with entry points in the group `stereovox.peers`."""

USUAL = ("octomap", "pyoctomap", "wavemap")
"""Default peers, if installed."""

WAVEMAP_FROM = "git+https://github.com/ethz-asl/wavemap#subdirectory=library/python"
"""Its documented pip source; it is not on PyPI."""
UNKNOWN = 1e-6
"""Log-odds nearer to zero than this count as no evidence in wavemap's maps, whose cells are sums of wavelets."""
OCTOMAP_SETTINGS = "OctoMap's defaults: p 0.7 for a hit, 0.4 for a miss, from 0.12 to 0.97, occupied above 0.5"
TREE_DEPTH = 16
"""Levels of an octree of OctoMap; a leaf at this depth is one cell."""


class Peer(Protocol):
    """Map of another library, a plug-in of `stereovox bench`.

    Two optional methods: `reach(max_range)` is called once, before the first frame, if points beyond this range shall
    clear space up to it; a map without it is not timed on such frames.
    `prepared(points, origin)` returns a function that inserts them, and only that function is timed (`prepared_image`
    for depth images). A map with `one_processor` True is pinned to one, with all its threads.

    Args:
        voxel_size: Cell size in metres.

    Raises:
        MissingExtra: The library is not installed.
    """

    def __init__(self, voxel_size: float): ...

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Insert points. This, and only this, is timed.

        Args:
            points: (N, 3) metres, world frame.
            origin: (3,) position of the camera in metres, world frame.
        """
        ...

    def counts(self) -> tuple[int, int]:
        """Count cells.

        Returns:
            The numbers of occupied and of free cells; a node that covers many cells counts as that many.
        """
        ...

    def bytes(self) -> int:
        """Report memory.

        Returns:
            The bytes of the map, as reported by the library.
        """
        ...


@runtime_checkable
class ImagePeer(Protocol):
    """Peer that takes depth images instead of points.

    Args:
        voxel_size: Cell size in metres.

    Raises:
        MissingExtra: The library is not installed.
    """

    def __init__(self, voxel_size: float): ...

    def insert_image(
        self, depth_m: NDArray[np.float32], camera: VirtualCamera, T_world_camera: NDArray[np.float64]
    ) -> None:
        """Insert a depth image. This, and only this, is timed.

        Args:
            depth_m: (height, width) float32 metres, 0 if there is no value.
            camera: Camera of the image.
            T_world_camera: (4, 4) pose of the optical frame.
        """
        ...

    def counts(self) -> tuple[int, int]:
        """Count cells.

        Returns:
            The numbers of occupied and of free cells.
        """
        ...

    def bytes(self) -> int:
        """Report memory.

        Returns:
            The bytes of the map.
        """
        ...


@runtime_checkable
class CellsPeer(Protocol):
    """Peer with readable cells, as required by `stereovox benchmark`.

    occupied_above: probability above which a cell is occupied, below which it is free. about: the library's settings.
    package: the distribution whose version is reported.
    """

    occupied_above: float
    about: str
    package: str

    def cells(self) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
        """Return the indices (N, 3) of all known cells, of the smallest size, and their log-odds (N,)."""
        ...


PeerClass = type[Peer] | type[ImagePeer]


def find_peer(name: str) -> PeerClass:
    """Return the class registered as `name`, or for `module:Class` that class of an importable module.

    Raises ConfigError, one line, that suggests a known name or reports the failed import or the missing method.
    """
    known = registry.names("peers", PEERS)
    if ":" not in name and name not in known:
        raise ConfigError(f"unknown peer '{name}'{did_you_mean(name, known)}")
    with blamed(f"peer '{name}'", ConfigError):
        kind = _class_in(name) if ":" in name else registry.find("peers", PEERS, name)
    _check_class(name, kind)
    return kind


@contextmanager
def blamed(who: str, kind: type[StereovoxError] = StereovoxError) -> Iterator[None]:
    """Turn a peer's exceptions into one line of this `kind` that names it; stereovox errors already are."""
    try:
        yield
    except (StereovoxError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        words = " ".join(str(error).split())
        raise kind(f"{who}: {type(error).__name__}{': ' * bool(words)}{words}") from error


def installed(names: Sequence[str] = USUAL) -> tuple[list[str], list[str]]:
    """Return the usable ones of `names`, and for each other one a line about what to install."""
    here, missing = [], []
    for name in names:
        try:
            find_peer(name)(1.0)
            here.append(name)
        except MissingExtra as why:
            missing.append(f"{name}: {why}")
    return here, missing


def _class_in(name: str) -> PeerClass:
    module, _, attribute = name.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"peer '{name}': {error}; write module:Class, the module where Python finds it") from None


def _check_class(name: str, kind: Any) -> None:
    """Raise ConfigError for a non-class, or a class without a required method."""
    if not isinstance(kind, type):
        raise ConfigError(f"peer '{name}' is not a class but {type(kind).__name__}; write module:Class")
    wanted = ("insert_image" if hasattr(kind, "insert_image") else "insert", "counts", "bytes")
    lacking = [method for method in wanted if not callable(getattr(kind, method, None))]
    if lacking:
        raise ConfigError(
            f"peer '{name}' has no {' and no '.join(lacking)}; it needs insert or insert_image, counts and bytes"
        )


class OctomapPython:
    """octomap-python with OctoMap's own settings: p 0.7 for a hit, 0.4 for a miss, clamping at 0.12 and 0.97.

    A cell is occupied above p = 0.5 and free below it, as everywhere in OctoMap.
    """

    discretize = True
    """True: points that share a cell become one ray. False: one ray per point."""
    occupied_above = 0.5
    about = f"{OCTOMAP_SETTINGS}; points that share a cell made one ray"
    package = "octomap-python"

    def __init__(self, voxel_size: float):
        self._tree = _library("octomap", "octomap-python").OcTree(voxel_size)
        self._max_range = -1.0

    def reach(self, max_range: float) -> None:
        """Let points farther than `max_range` metres clear space up to there."""
        self._max_range = max_range

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Cast a ray to every point."""
        self._tree.insertPointCloud(points, origin, self._max_range, False, self.discretize)

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells."""
        return _count((leaf.getDepth(), self._tree.isNodeOccupied(leaf)) for leaf in self._tree.begin_leafs())

    def cells(self) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
        """Return indices and log-odds of all known cells."""
        return _cells_of(lambda file: self._tree.write(os.fsencode(file)))

    def bytes(self) -> int:
        """Return `memoryUsage`: the nodes and their child arrays."""
        return self._tree.memoryUsage()


class OctomapPythonRays(OctomapPython):
    """octomap-python with one ray per point: exact, and slow."""

    discretize = False
    about = f"{OCTOMAP_SETTINGS}; one ray a point"


class PyOctomap:
    """pyoctomap with the settings of `OctomapPython`, with one ray for points that share a cell."""

    occupied_above = 0.5
    about = f"{OCTOMAP_SETTINGS}; points that share a cell made one ray"
    package = "pyoctomap"

    def __init__(self, voxel_size: float):
        self._tree = _library("pyoctomap", "pyoctomap").OcTree(voxel_size)
        self._max_range = -1.0

    def reach(self, max_range: float) -> None:
        """Let points farther than `max_range` metres clear space up to there."""
        self._max_range = max_range

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Cast a ray to every cell that contains a point."""
        self._tree.insertPointCloud(points, origin, self._max_range, False, True)

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells."""
        leafs = self._tree.begin_leafs()
        return _count((leaf.getDepth(), self._tree.isNodeOccupied(leaf.current_node)) for leaf in leafs)

    def cells(self) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
        """Return indices and log-odds of all known cells."""
        return _cells_of(lambda file: self._tree.write(os.fspath(file)))

    def bytes(self) -> int:
        """Return `memoryUsage`: the nodes and their child arrays."""
        return self._tree.memoryUsage()


class Wavemap:
    """wavemap's hashed, chunked wavelet octree with the settings of its Python example, on one processor.

    It takes depth images of a pinhole camera. A cell is occupied above p = 0.5 and free below it.
    """

    occupied_above = 0.5
    about = "its Python example: range sigma 0.01 m, scaling 0.2 free and 0.4 occupied, occupied above 0.5"
    package = "pywavemap"
    NEAREST_M = 0.1
    """Least depth; nearer ones, and so zeros, have no value for wavemap."""

    def __init__(self, voxel_size: float):
        try:
            self._wave = import_module("pywavemap")
        except ImportError:
            raise MissingPackage("pywavemap", WAVEMAP_FROM) from None
        kind = {"type": "hashed_chunked_wavelet_octree", "min_cell_width": {"meters": voxel_size}}
        self._map = self._wave.Map.create(kind)
        self._pipeline = on_one_processor(self._wave.Pipeline, self._map)
        self._voxel_size = voxel_size
        self._camera: VirtualCamera | None = None
        self._reach = 0.0
        self._limit = np.inf
        self._seen: list[NDArray[np.float64]] = []

    def reach(self, max_range: float) -> None:
        """Let depths farther than `max_range` metres clear space up to there."""
        self._limit = max_range

    def insert_image(
        self, depth_m: NDArray[np.float32], camera: VirtualCamera, T_world_camera: NDArray[np.float64]
    ) -> None:
        """Let the pipeline integrate the image."""
        deepest = min(float(depth_m.max()), self._limit)
        if camera is not self._camera or deepest > self._reach:
            self._use_camera(camera, min(np.ceil(deepest), self._limit))
        wave = self._wave
        posed = wave.PosedImage(wave.Pose(T_world_camera), wave.Image(depth_m.T))
        self._pipeline.run_pipeline(["camera"], posed)
        self._seen.append(T_world_camera[:3, 3])

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells of the smallest size."""
        occupied = free = 0
        for _, values in self._layers():
            occupied, free = occupied + int((values > UNKNOWN).sum()), free + int((values < -UNKNOWN).sum())
        return occupied, free

    def cells(self) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
        """Return indices and log-odds of all known cells of the smallest size."""
        known = [(cells[np.abs(v) > UNKNOWN], v[np.abs(v) > UNKNOWN]) for cells, v in self._layers()]
        return np.concatenate([cells for cells, _ in known]), np.concatenate([values for _, values in known])

    def _layers(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.float32]]]:
        """Yield all cells (N, 3) that may have been seen and their values (N,), layer by layer."""
        far = self._reach * self._widest
        low = np.floor((np.min(self._seen, axis=0) - far) / self._voxel_size).astype(int)
        high = np.ceil((np.max(self._seen, axis=0) + far) / self._voxel_size).astype(int)
        layer = np.mgrid[0:1, low[1] : high[1], low[2] : high[2]].reshape(3, -1).T.astype(np.int32)
        for x in range(low[0], high[0]):
            layer[:, 0] = x
            yield layer, np.asarray(self._map.get_cell_values(layer))

    def bytes(self) -> int:
        """Return `memory_usage`."""
        return self._map.memory_usage

    def _use_camera(self, camera: VirtualCamera, reach: float) -> None:
        """Set up for this camera; cells beyond `reach` metres, where the images end, are skipped."""
        if not isinstance(camera, PinholeCamera):
            raise StereovoxError("wavemap is compared on pinhole cameras only; leave it out with --peers")
        columns, rows = camera.ray_slopes()
        self._widest = float(np.sqrt(1 + np.square(columns).max() + np.square(rows).max()))
        self._camera, self._reach = camera, reach
        size = {"width": camera.width, "height": camera.height}
        lens = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
        limits = {"min_range": {"meters": self.NEAREST_M}, "max_range": {"meters": reach}}
        self._pipeline.clear_integrators()
        self._pipeline.add_integrator("camera", {
            "projection_model": {"type": "pinhole_camera_projector", **size, **lens},
            "measurement_model": {"type": "continuous_ray", "range_sigma": {"meters": 0.01},
                                  "scaling_free": 0.2, "scaling_occupied": 0.4},
            "integration_method": {"type": "hashed_chunked_wavelet_integrator", **limits},
        })  # fmt: skip


class MissingPackage(MissingExtra):
    """A library outside stereovox's extras is not installed."""

    def __init__(self, library: str, source: str):
        StereovoxError.__init__(self, f"{library} is not installed; run: pip install '{source}'")


def _library(module: str, package: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtra(package, "bench") from None


def _cells_of(write: Callable[[Path], object]) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
    """Return indices and log-odds of the cells in the `.ot` file that `write` makes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "tree.ot")
        return read_octomap(Path(folder) / "tree.ot").cells()


def _count(leafs: Iterator[tuple[int, bool]]) -> tuple[int, int]:
    """Count the cells of leaves given as depth and whether occupied; a pruned leaf covers 8 cells per level."""
    cells = [0, 0]
    for depth, occupied in leafs:
        cells[not occupied] += 8 ** (TREE_DEPTH - depth)
    return cells[0], cells[1]
