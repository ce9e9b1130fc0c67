# SPDX-License-Identifier: Apache-2.0
"""A camera of your own, mapped while it runs: the newest frame counts, and the map says when it is out of date."""

import time

import numpy as np

import stereovox as sv

WIDTH, HEIGHT = 160, 120


def camera(frames=20, hz=30):
    """Yield frames as a driver would; replace this by yours."""
    lens = sv.PinholeCamera(WIDTH, HEIGHT, 120.0, 120.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, baseline=0.05)
    for number in range(frames):
        depth_mm = np.full((HEIGHT, WIDTH), 2000 - 10 * number, np.uint16)  # a wall that comes nearer
        T_world_camera = np.array([[0, 0, 1, 0.01 * number], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1.0]])
        yield sv.Frame(depth_mm, lens, T_world_camera, stamp_ns=time.monotonic_ns(), depth_scale=0.001)
        time.sleep(1 / hz)


settings = {"voxel_size": 0.1, "deadline_ms": 30}
sv.Mapper(**settings).add(next(camera()))  # loads the kernels, the first time ever compiles them, before time counts
mapper = sv.Mapper(**settings)
for frame in sv.Latest(camera(), waiting=2):  # a thread reads the camera; two frames wait, older ones are dropped
    report = mapper.add(frame)
    if report.refused:
        print(f"refused ({report.refused}): {report.detail}")
    if mapper.health().state in ("stale", "lost"):
        print("stop: the map is out of date")

print(mapper.health().text)
print(mapper.map.counts())
