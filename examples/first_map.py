# SPDX-License-Identifier: Apache-2.0
"""Make a map, ask it, save it, load it."""

import stereovox as sv

mapper = sv.Mapper("default", voxel_size=0.1)  # profile name, TOML file or Config; settings on top
for frame in sv.open_source("sim:room", frames=":10"):  # or a folder
    report = mapper.add(frame)  # UpdateReport: milliseconds, cells changed, why it was refused (None if it was not)

m = mapper.map
points = [[4.0, -2.0, 1.0], [2.15, -2.35, 0.45], [3.0, 0.0, 1.0]]  # metres, world frame
print(m.state(points))  # 0 unknown, 1 free, 2 tentative, 3 occupied: sv.State
print(m.probability(points))  # 0.5 if nothing is known
m.occupied()  # (N, 3) centres of all occupied cells

m.save("room.svox")
m = sv.load_map("room.svox")
