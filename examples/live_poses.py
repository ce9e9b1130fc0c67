# SPDX-License-Identifier: Apache-2.0
"""Map a live camera with the poses of your own tracker: python examples/live_poses.py"""

import threading
from time import time_ns

import numpy as np

import stereovox as sv

poses, ended = sv.LivePoses("my tracker"), threading.Event()


def tracker():
    """Send poses as a tracker would; these stand still while the camera moves, so some images are refused."""
    while not ended.wait(0.005):
        poses.add(time_ns(), np.eye(4))  # T_world_body; NaN if it is lost


threading.Thread(target=tracker).start()
cameras = [sv.LiveCamera("sim:room?frames=20&image_width=160", "front")]
try:
    with sv.LiveRun(cameras, "room.svox", poses=poses, seconds=3, voxel_size=0.1) as run:
        run.add_outputs(sphere=True)
        done = run.finish()  # or finish([observer]), with a method after(frame, report)
finally:
    ended.set()
print(run.sphere.grid()[0].known.mean(), done.live["poses"]["added"])
