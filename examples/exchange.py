# SPDX-License-Identifier: Apache-2.0
"""Write a map for other programs, and read it back."""

import stereovox as sv

mapper = sv.Mapper(voxel_size=0.1)
for frame in sv.open_source("sim:room", frames=":10"):
    mapper.add(frame)

for file in ("room.ot", "room.bt", "room.npz", "room.ply", "room.glb"):
    sv.export(mapper.map, file)

again = sv.import_map("room.npz")  # exactly the same cells and settings
assert (again.occupied() == mapper.map.occupied()).all()
cloud = sv.import_map("room.ply", voxel_size=0.2)  # each cell that holds a point is occupied, nothing is free
print(again.counts(), cloud.counts())
