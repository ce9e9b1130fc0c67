# SPDX-License-Identifier: Apache-2.0
"""The air of a scene: what touches nothing, is indoors, and is connected with the start."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import SourceError
from stereovox.maps import VoxelMap
from stereovox.simulate.scene import Scene, box
from stereovox.simulate.simulation import Simulation
from stereovox_lab.flights.air import Air

CELL = 0.1
INSIDE = np.array([1.05, 1.05, 1.05])


def building(window: bool = False, roof: bool = True) -> Scene:
    """Two rooms of 2 x 2 x 2 m, not connected, the first with a pillar; its window leads outdoors."""
    walls = [
        box("floor", "floor", (-3, -3, -0.2), (7, 5, 0)),
        box("walls", "south", (-0.2, -0.2, 0), (4.4, 0, 2)),
        box("walls", "north", (-0.2, 2, 0), (4.4, 2.2, 2)),
        box("walls", "middle", (2, 0, 0), (2.2, 2, 2)),
        box("walls", "east", (4.2, 0, 0), (4.4, 2, 2)),
        box("pillar", "pillar", (0.31, 0.31, 0), (0.69, 0.69, 2)),
        box("walls", "west", (-0.2, 0, 0), (0, 1.2 if window else 2, 2)),
    ]
    if roof:
        walls.append(box("ceiling", "ceiling", (-0.2, -0.2, 2), (4.4, 2.2, 2.2)))
    return Scene(walls)


def test_air_is_one_room_without_what_stands_in_it():
    centres = Air(building(), CELL, INSIDE).centres
    assert (centres > 0).all()
    assert (centres < 2).all()
    pillar = (centres[:, :2] > 0.3).all(axis=1) & (centres[:, :2] < 0.7).all(axis=1)
    assert not pillar.any()
    whole = round(2 / CELL) ** 3
    assert 0.75 * whole < len(centres) < whole


def test_outdoors_does_not_count():
    open_room, closed = (Air(building(window), CELL, INSIDE).centres for window in (True, False))
    assert len(open_room) > len(closed)  # the window itself
    assert open_room[:, 0].min() > -0.3


def test_a_place_in_a_wall_or_outdoors_is_refused():
    for place in ([2.1, 1, 1], [-1, 1, 1], [50, 0, 0]):
        with pytest.raises(SourceError, match="not in the air"):
            Air(building(), CELL, np.array(place))
    with pytest.raises(SourceError, match="not in the air"):
        Air(building(roof=False), CELL, INSIDE)


def test_known_is_the_share_that_is_free():
    air = Air(building(), CELL, INSIDE)
    cells = np.floor(air.centres / CELL).astype(int)
    half = np.arange(len(cells)) % 2 == 0
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=CELL), cells, np.where(half, -3.0, 3.0))
    assert air.known(voxel_map) == pytest.approx(half.mean())


def test_room_is_the_way_to_the_nearest_surface():
    air = Air(building(), CELL, INSIDE)
    here, most = air.room(INSIDE, 0.3)
    assert here == pytest.approx(np.hypot(0.35, 0.35), abs=CELL)  # to the corner of the pillar
    assert here < most <= 1.0
    assert air.room(np.array([0.15, 1.55, 1.05]), 0.3)[0] == pytest.approx(0.15, abs=CELL)


def test_air_of_a_hall_touches_none_of_its_solids():
    simulation = Simulation("sim:hall?plan=3")
    air = Air(simulation.scene, CELL, simulation.pose(0)[:3, 3])
    assert len(air.centres) > 200_000
    assert not any(solid.contains(air.centres).any() for solid in simulation.scene.solids)
