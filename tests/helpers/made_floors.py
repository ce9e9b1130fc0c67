"""Small floors' maps for tests."""

from dataclasses import replace

import numpy as np

from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid

FREE, WALL = 0, 100


def room(side=0.05, width=6.0, height=4.0, origin=(0.0, 0.0, 0.0)):
    """A room with an inner wall, a doorway and a box in one corner: nothing about it is symmetric."""
    cells = np.full((round(height / side), round(width / side)), FREE, np.int8)
    n = max(1, round(0.1 / side))
    cells[:n], cells[-n:], cells[:, :n], cells[:, -n:] = WALL, WALL, WALL, WALL
    inner = round(2.2 / side)
    cells[:, inner : inner + n] = WALL
    cells[round(1.0 / side) : round(1.9 / side), inner : inner + n] = FREE
    cells[round(0.4 / side) : round(0.9 / side), round(4.5 / side) : round(5.3 / side)] = WALL
    cells[round(2.5 / side) : round(2.5 / side) + n, inner : round(4.0 / side)] = WALL
    return OccupancyGrid(cells, side, origin)


def looked_up(grid, side, origin, shape):
    """What another robot would draw of a floor: the value at each middle of its own cells."""
    there = OccupancyGrid(np.full(shape, UNKNOWN, np.int8), side, origin)
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    found = grid.indices(there.centres(rows, columns))
    inside = ((found >= 0) & (found < grid.cells.shape)).all(axis=1)
    there.cells.reshape(-1)[inside] = grid.cells[tuple(found[inside].T)]
    return there


def random_floor(seed, shape=(9, 12), side=0.5, origin=(0.0, 0.0, 0.0)):
    values = np.random.default_rng(seed).choice([-1, 0, 20, 50, 100], shape, p=[0.25, 0.35, 0.1, 0.05, 0.25])
    return OccupancyGrid(values.astype(np.int8), side, origin)


def changed(grid, cells):
    return replace(grid, cells=np.asarray(cells, np.int8))
