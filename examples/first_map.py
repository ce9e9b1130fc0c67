# SPDX-License-Identifier: Apache-2.0
"""Make a map, ask it, save it, load it."""

import stereovox as sv

mapper = sv.Mapper("default", voxel_size=0.1)  # profile name, TOML file or Config; settings on top
for frame in sv.open_source("sim:room", frames=":10"):  # or a folder
    report = mapper.add(frame)  # UpdateReport: milliseconds, cells changed, why it was refused (None if it was not)

m = mapper.map
points = [[3.0, 0.0, 1.0], [3.0, 0.5, 1.0]]  # metres, world frame
m.state(points)  # 0 unknown, 1 free, 2 tentative, 3 occupied: sv.State
m.probability(points)  # 0.5 where nothing is known
m.occupied()  # (N, 3) centres of all occupied cells

m.save("room.svox")
m = sv.load_map("room.svox")
