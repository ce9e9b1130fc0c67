# SPDX-License-Identifier: Apache-2.0
"""Points, rays, capsules, boxes, nearest obstacles: what a planner asks."""

import numpy as np

from stereovox import Mapper, State, open_source

mapper = Mapper(voxel_size=0.1)
for frame in open_source("sim:room", ":12:2"):
    mapper.add(frame)
m = mapper.map
camera = m.viewpoint.T_world_camera[:3, 3]

# what is here
assert m.state([camera]).tolist() == [State.FREE]

# where does a ray stop; what is never hit has an infinite distance
ahead = m.viewpoint.T_world_camera[:3, 2]
hits = m.cast_rays(camera, [ahead, -ahead], max_distance=10.0)
print("ahead the wall is", hits.distance[0], "m away, in cell", hits.cell[0])
seen = m.cast_rays(camera, [ahead], 10.0, stop_at=[State.OCCUPIED, State.UNKNOWN])
assert seen.distance[0] <= hits.distance[0]

# is a path free for a body of 0.15 m; the last leg goes through the wall
path = camera + np.array([[1.0], [1.5], [2.0], [6.0]]) * ahead
worst = m.check_capsules(path[:-1], path[1:], radius=0.15)
assert worst.tolist() == [State.FREE, State.FREE, State.OCCUPIED]

# is there room for a box of 0.4 m
middles = path[:2]
assert m.check_boxes(middles - 0.2, middles + 0.2).tolist() == [State.FREE, State.FREE]

# how near may it go
near = m.nearest_obstacle(middles, max_distance=5.0)
known = m.nearest_obstacle(middles, max_distance=5.0, obstacles=[State.OCCUPIED, State.UNKNOWN])
print(near.distance, "m to what is occupied,", known.distance, "m to what is not known to be free")
