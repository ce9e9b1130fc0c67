# SPDX-License-Identifier: Apache-2.0
"""The air of a simulated scene, and the share of it that a map knows to be free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.evaluate.truth import interior_cells, touched_cells
from stereovox.maps import State, VoxelMap
from stereovox.simulate.scene import Scene


class Air:
    """The cells of a scene that touch nothing, have surfaces above and below, and are connected with a place.

    Connected means by faces: rooms behind closed doors and the insides of solids do not count, nor does the outdoors,
    without a ceiling, beyond an open window. Exact, by the triangles of the scene.

    Args:
        scene: The scene.
        cell: Size of the map's cells in metres.
        place: (3,) metres, in the air.

    Attributes:
        centres: (N, 3) metres, centres of the cells.

    Raises:
        SourceError: The place is not in the air.
    """

    def __init__(self, scene: Scene, cell: float, place: NDArray[np.float64]):
        from scipy.ndimage import label

        corners = scene.triangles.reshape(-1, 3)
        first, last = (np.floor(end / cell).astype(int) for end in (corners.min(axis=0), corners.max(axis=0)))
        solid = np.zeros(last - first + 1, bool)
        for one in scene.solids:
            for cells in (touched_cells(one.triangles, cell), interior_cells(one, cell)):
                solid[tuple((cells - first).T)] = True
        below = np.logical_or.accumulate(solid, axis=2)
        above = np.logical_or.accumulate(solid[:, :, ::-1], axis=2)[:, :, ::-1]
        groups = np.zeros(solid.shape, np.int32)
        label(~solid & below & above, output=groups)
        here = np.floor(place / cell).astype(int) - first
        inside = bool((here >= 0).all() and (here < solid.shape).all())
        if not inside or not groups[tuple(here)]:
            raise SourceError(f"{np.round(place, 2).tolist()} is not in the air of this scene; start elsewhere")
        self._air, self._first, self._cell = groups == groups[tuple(here)], first, cell
        self.centres = (np.argwhere(self._air) + first + 0.5) * cell

    def known(self, voxel_map: VoxelMap) -> float:
        """Return the share of the air known to be free in the map."""
        return float((voxel_map.state(self.centres) == State.FREE).mean())

    def room(self, place: NDArray[np.float64], half_height: float) -> tuple[float, float]:
        """Return the horizontal radius of air around a place in metres, and the largest anywhere at its height.

        place: (3,) metres. half_height: metres above and below it that must also be air. Accurate to half a cell.
        """
        from scipy.ndimage import distance_transform_edt

        here = np.floor(np.asarray(place) / self._cell).astype(int) - self._first
        ends = np.array([place[2] - half_height, place[2] + half_height])
        low, high = (np.floor(ends / self._cell).astype(int) - self._first[2]).tolist()
        columns = np.pad(self._air[:, :, max(low, 0) : high + 1].all(axis=2), 1)
        room = np.asarray(distance_transform_edt(columns, sampling=self._cell))[1:-1, 1:-1]
        return float(room[tuple(here[:2])]), float(room.max())
