# SPDX-License-Identifier: Apache-2.0
"""Maps of simulated walks that kept their frames, for tests of loop closure."""

from dataclasses import replace
from functools import cache

import numpy as np

import stereovox as sv
from stereovox.config import load_config
from stereovox.loops.closer import LoopCloser, difference
from stereovox.se3 import inverse, rotation_matrix
from stereovox.simulate.simulation import Simulation

RING = "sim:loop?length=30&laps=1&image_width=106&drift=0.02&seed=3"
OFFICES = "sim:offices?offices=6&visits=3&image_width=106&drift=0.02"
RACKS = "sim:racks?bays=8&passes=3&image_width=96&drift=0.02&seed=1"
ELSEWHERE = np.eye(4)
ELSEWHERE[:3, :3], ELSEWHERE[:3, 3] = rotation_matrix([0, 0, 2.1]), [5, -3, 0.4]


@cache
def mapped(location, start=0, end=None, *, elsewhere=False):
    """Return the map of every second frame; their world turned and shifted where it is `elsewhere`."""
    simulation = Simulation(location)
    mapper = sv.Mapper(voxel_size=0.1, **{"map.keep_frames": True})
    for i in range(len(simulation))[start:end:2]:
        frame = simulation.frame(i)
        T = ELSEWHERE @ frame.T_world_sensor if elsewhere else frame.T_world_sensor
        mapper.add(replace(frame, T_world_sensor=T))
    return mapper.map


@cache
def closed(location, start=0, end=None, *, elsewhere=False, drift=None):
    """Return the finished closer of such a map. It must not be changed."""
    made = mapped(location, start, end, elsewhere=elsewhere)
    closer = LoopCloser(made.config if drift is None else load_config(made.config, **{"loops.drift": drift}))
    for frame in made.kept_frames.frames:
        closer.add(frame)
    closer.finish()
    return closer


def truths(closer, location):
    """Return where the submaps' anchors really were (N, 4, 4)."""
    simulation = Simulation(location)
    return np.array([simulation.true_pose(round(one.stamp_ns / simulation.period_ns)) for one in closer.submaps])


def errors(loops, truth):
    """Return by how many metres each loop is wrong."""
    return np.array(
        [np.linalg.norm(difference(inverse(truth[one.first]) @ truth[one.second], one.match.T_earlier_later)[3:])
         for one in loops]
    )  # fmt: skip


def off(poses, truth):
    """Return the root of the mean square of the distance from the truth, after both are laid onto each other."""
    a, b = np.array(poses)[:, :3, 3], np.array(truth)[:, :3, 3]
    u, _, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    R = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return float(np.sqrt((((a - a.mean(0)) @ R.T + b.mean(0) - b) ** 2).sum(axis=1).mean()))
