# SPDX-License-Identifier: Apache-2.0
"""Other libraries' C++, through adapters that `benchmarks/build_peers.py` builds; `benchmarks/peers/peer.h` says what
they must hold.

What a library is given is put into its own types before the clock starts, as in a program in C++.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.errors import MissingExtra, StereovoxError

FOLDER = "STEREOVOX_PEERS"
"""Environment variable: the folder of built adapters."""
POINTER, INTEGER, REAL = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "peer_about": (ctypes.c_char_p, []),
    "peer_error": (ctypes.c_char_p, []),
    "peer_new": (POINTER, [REAL, REAL]),
    "peer_free": (None, [POINTER]),
    "peer_cells": (ctypes.c_int, [POINTER, POINTER, POINTER]),
    "peer_bytes": (INTEGER, [POINTER]),
}
"""Result and argument types of functions in every adapter."""
OF_POINTS: dict[str, tuple[Any, list[Any]]] = {
    "peer_load": (ctypes.c_int, [POINTER, POINTER, INTEGER, POINTER]),
    "peer_insert": (ctypes.c_int, [POINTER]),
}
"""The same for adapters that take points."""
OF_IMAGES: dict[str, tuple[Any, list[Any]]] = {
    "peer_load_image": (ctypes.c_int, [POINTER, POINTER, ctypes.c_int, ctypes.c_int, POINTER, POINTER]),
    "peer_insert_image": (ctypes.c_int, [POINTER]),
}
"""The same for adapters that take depth images."""
OF_CLOUDS: dict[str, tuple[Any, list[Any]]] = {
    "peer_load_cloud": (ctypes.c_int, [POINTER, POINTER, INTEGER, POINTER, POINTER]),
    "peer_insert_cloud": (ctypes.c_int, [POINTER]),
    "peer_log_odds": (ctypes.c_int, [POINTER, POINTER, INTEGER, POINTER]),
}
"""The same for adapters that take clouds of a spinning lidar."""


class NotBuilt(MissingExtra):
    """An adapter is missing or unusable."""

    def __init__(self, name: str, why: str):
        StereovoxError.__init__(self, f"{name}: {why}; run benchmarks/build_peers.py and set {FOLDER} to its --out")


class NativePeer:
    """A map of a C++ library: cells of `voxel_size` metres.

    Raises NotBuilt if the adapter is missing or incompatible, StereovoxError with the library's message if it
    fails.
    """

    name: ClassVar[str]
    one_processor: ClassVar[bool] = False
    """Whether the library starts its own threads unavoidably, so that it is pinned to one processor."""
    functions: ClassVar[dict[str, tuple[Any, list[Any]]]]

    def __init__(self, voxel_size: float):
        self._library = _load(self.name, tuple(self.functions))
        self._voxel_size, self._map = voxel_size, None
        self.reach(0.0)

    def reach(self, max_range: float) -> None:
        """Start a new map: points beyond `max_range` metres clear space up to there; 0: all are surfaces."""
        self._free()
        self._map = self._library.peer_new(self._voxel_size, max_range)
        if not self._map:
            raise StereovoxError(f"{self.name}: {self._error()}")

    def counts(self) -> tuple[int, int]:
        """Return occupied and free cells of the smallest size."""
        occupied, free = np.zeros(1, np.int64), np.zeros(1, np.int64)
        self._check(self._library.peer_cells(self._map, _address(occupied), _address(free)))
        return int(occupied[0]), int(free[0])

    def bytes(self) -> int:
        """Return the memory that the library reports."""
        return self._library.peer_bytes(self._map)

    def about(self) -> str:
        """Return the library and its settings, in words."""
        return self._library.peer_about().decode()

    def _call(self, function: Callable[[Any], int]) -> None:
        self._check(function(self._map))

    def _check(self, failed: int) -> None:
        if failed:
            raise StereovoxError(f"{self.name}: {self._error()}")

    def _error(self) -> str:
        return " ".join(self._library.peer_error().decode(errors="replace").split())[:200]

    def _free(self) -> None:
        if self._map:
            self._library.peer_free(self._map)
            self._map = None

    def __del__(self):
        if hasattr(self, "_map"):
            self._free()


class NativePoints(NativePeer):
    """A library that takes points."""

    functions = FUNCTIONS | OF_POINTS

    def insert(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        """Insert points (N, 3) seen from `origin` (3,), in metres."""
        self.prepared(points, origin)()

    def prepared(self, points: NDArray[np.float64], origin: NDArray[np.float64]) -> Callable[[], None]:
        """Return the call that inserts them; with the points already in the library's types."""
        points, origin = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(origin, np.float64)
        self._check(self._library.peer_load(self._map, _address(points), len(points), _address(origin)))
        return partial(self._call, self._library.peer_insert)


class NativeImages(NativePeer):
    """A library that takes depth images of a pinhole camera."""

    functions = FUNCTIONS | OF_IMAGES

    def insert_image(
        self, depth_m: NDArray[np.float32], camera: VirtualCamera, T_world_camera: NDArray[np.float64]
    ) -> None:
        """Insert a depth image (height, width) in metres, 0: no value."""
        self.prepared_image(depth_m, camera, T_world_camera)()

    def prepared_image(
        self, depth_m: NDArray[np.float32], camera: VirtualCamera, T_world_camera: NDArray[np.float64]
    ) -> Callable[[], None]:
        """Return the call that inserts it; with the image already in the library's types."""
        if not isinstance(camera, PinholeCamera):
            raise StereovoxError(f"{self.name} is compared on pinhole cameras only; leave it out with --peers")
        depth_m, pose = np.ascontiguousarray(depth_m, np.float32), np.ascontiguousarray(T_world_camera, np.float64)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        size = camera.width, camera.height
        given = self._map, _address(depth_m), *size, _address(lens), _address(pose)
        self._check(self._library.peer_load_image(*given))
        return partial(self._call, self._library.peer_insert_image)


class OctomapCpp(NativePoints):
    """OctoMap, with one ray for points that share a cell."""

    name = "octomap-cpp"


class Bonxai(NativePoints):
    """Bonxai's probabilistic map."""

    name = "bonxai"


class Ufomap(NativePoints):
    """UFOMap 1, with one ray for points that share a cell; it adds hits on its own thread."""

    name = "ufomap"
    one_processor = True


class WavemapCpp(NativeImages):
    """wavemap's hashed, chunked wavelet octree: settings of its Python example, for clouds of its Ouster example."""

    name = "wavemap-cpp"
    functions = NativeImages.functions | OF_CLOUDS

    def prepared_cloud(
        self, points: NDArray[np.float64], T_world_lidar: NDArray[np.float64], turning: tuple[float, float, int, int]
    ) -> Callable[[], None]:
        """Return the call that inserts a cloud; with the cloud already in the library's types.

        points: (N, 3) metres along the axes of a lidar that turns about z. turning: lowest and highest elevation in
        radians, number of beams in elevation, number of directions.
        """
        points, pose = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(T_world_lidar, np.float64)
        numbers = np.array(turning, np.float64)
        given = self._map, _address(points), len(points), _address(pose), _address(numbers)
        self._check(self._library.peer_load_cloud(*given))
        return partial(self._call, self._library.peer_insert_cloud)

    def log_odds(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the log-odds (N,) of the cells that points (N, 3) in the world lie in, 0: unknown."""
        points, found = np.ascontiguousarray(points, np.float64), np.zeros(len(points), np.float32)
        self._check(self._library.peer_log_odds(self._map, _address(points), len(points), _address(found)))
        return found


def _load(name: str, functions: tuple[str, ...]) -> ctypes.CDLL:
    folder = os.environ.get(FOLDER)
    if not folder:
        raise NotBuilt(name, f"{FOLDER} is not set")
    return _open(name, Path(folder) / f"{name}.so", functions)


@cache
def _open(name: str, path: Path, functions: tuple[str, ...]) -> ctypes.CDLL:
    if not path.is_file():
        raise NotBuilt(name, f"there is no {path}")
    try:
        library = ctypes.CDLL(str(path.resolve()))
        for function in functions:
            found = getattr(library, function)
            found.restype, found.argtypes = (FUNCTIONS | OF_POINTS | OF_IMAGES | OF_CLOUDS)[function]
    except (OSError, AttributeError) as error:
        raise NotBuilt(name, f"{path} cannot be used ({str(error)[:120]})") from None
    return library


def _address(array: NDArray[Any]) -> int:
    return array.ctypes.data
