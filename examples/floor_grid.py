# SPDX-License-Identifier: Apache-2.0
"""A floor's map for a ground robot: from a lidar's scans, and from a 3-D map seen from above."""

import stereovox as sv
from stereovox.products.map_server import write_map_server
from stereovox.products.projection import project
from stereovox.sources.robot import open_robot

robot = open_robot("sim:floor?plan=testbed&seconds=6")  # or a bag
mapper = sv.GridMapper(voxel_size=0.1)
for scan in robot.scans[:20]:
    mapper.add(scan)  # at the pose that odometry tells; SLAM and localisation: docs/robots.md
write_map_server(mapper.occupancy(), "lidar.yaml")

space = sv.Mapper(voxel_size=0.1)
for frame in sv.open_source("sim:room", frames=":5"):
    space.add(frame)
grid = project(space.map, heights=(0.1, 1.8))  # what is 0.1 to 1.8 m high marks; what is free at any height clears
write_map_server(grid, "room.yaml")
print(grid.cells.shape, "cells, states", sorted(set(grid.states.ravel().tolist())))
