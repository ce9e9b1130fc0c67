# SPDX-License-Identifier: Apache-2.0
"""A floor's map for a ground robot: from a lidar's scans, and from a 3-D map seen from above."""

import numpy as np

import stereovox as sv
from stereovox.formats.map_server import write_map_server
from stereovox.products.projection import project

mapper = sv.GridMapper(voxel_size=0.05)
for number in range(10):  # a lidar that drives forward in a corridor 2 m wide; replace this by yours
    angles = np.radians(np.arange(-120.0, 120.0))
    ranges = np.minimum(1 / np.maximum(np.abs(np.sin(angles)), 0.01), 8.0)  # 8 m and more: no echo
    ranges[ranges >= 5.6] = np.inf
    T_world_lidar = np.eye(4)
    T_world_lidar[0, 3] = 0.1 * number
    mapper.add(sv.Scan(ranges, angles[0], np.radians(1.0), 0.05, 5.6, T_world_lidar, stamp_ns=number * 100_000_000))
write_map_server(mapper.occupancy(), "corridor.yaml")
print(mapper.occupancy().cells.shape, "cells of the corridor")

space = sv.Mapper(voxel_size=0.1)
for frame in sv.open_source("sim:room", frames=":4"):
    space.add(frame)
grid = project(space.map, heights=(0.1, 1.8))  # what a robot of 1.8 m occupies above the floor, which is found
write_map_server(grid, "room.yaml")
print(grid.cells.shape, "cells of the room, states", sorted(set(grid.states.ravel().tolist())))
