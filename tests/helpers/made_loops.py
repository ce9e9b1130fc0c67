# SPDX-License-Identifier: Apache-2.0
"""Maps of simulated walks that kept their frames, for tests of loop closure."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np

import stereovox as sv
from stereovox.config import load_config
from stereovox.correct.loops.closer import LoopCloser
from stereovox.correct.loops.drift import difference
from stereovox.geometry.se3 import inverse, rotation_matrix
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


class _ShowNothing(dict):
    """Stands for Shapes: no submap shows anything, so no loops are found but those that a test names."""

    def __missing__(self, submap):
        return None


def blind(closer):
    """Return a new closer that sees nothing in its frames."""
    closer.shapes = _ShowNothing()
    return closer


def follow(closer, location, end):
    """Let a closer take in every second pose of a simulated walk, up to frame `end`, without images."""
    simulation = Simulation(location)
    for i in range(0, end, 2):
        stamp_ns, T = i * simulation.period_ns, simulation.pose(i)
        closer.add(SimpleNamespace(sensor="", stamp_ns=stamp_ns, T_world_sensor=T, pose_sigma=(0, 0)))


def bare_closer(R_world_level=None, **settings):
    """A closer that has taken in frames along a bent way, one submap each; z of the level world is up."""
    made = blind(LoopCloser(load_config(**settings)))
    turn = np.eye(4)
    turn[:3, :3] = np.eye(3) if R_world_level is None else R_world_level
    for i in range(30):
        T = np.eye(4)
        T[:3, :3] = rotation_matrix([0, 0, 0.2 * i]) @ rotation_matrix([0.4, 0, 0])  # a camera that looks down a bit
        T[:3, 3] = 3 * np.cos(0.2 * i), 3 * np.sin(0.2 * i), 1.5
        made.add(SimpleNamespace(sensor="", stamp_ns=10**9 * i, T_world_sensor=turn @ T, pose_sigma=(0, 0)))
    made.finish()
    return made


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
