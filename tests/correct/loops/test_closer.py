# SPDX-License-Identifier: Apache-2.0
"""Loops of simulated walks: the right ones are found, offices that look the same are not mistaken for each other."""

from dataclasses import replace

import numpy as np
import pytest
from made_loops import OFFICES, RING, bare_closer, closed, errors, mapped, off, truths

from stereovox.config import load_config
from stereovox.correct.loops.closer import Loop, LoopCloser
from stereovox.correct.loops.search import Repeats
from stereovox.correct.loops.submaps import FLOOR, Match
from stereovox.geometry.se3 import inverse, rotation_matrix


@pytest.fixture
def unrepeated(monkeypatch):
    """From when it is called, nobody looks for what repeats, which takes longest: `test_repeats.py`."""
    return lambda: monkeypatch.setattr(Repeats, "look", lambda *_: None)


def test_a_ring_is_closed_and_the_way_becomes_right():
    closer = closed(RING)
    truth = truths(closer, RING)
    assert len(closer.loops) >= 2
    assert errors(closer.loops, truth).max() < 0.15
    before = off([submap.T_odom_anchor for submap in closer.submaps], truth)
    assert off([submap.T_map_anchor for submap in closer.submaps], truth) < 0.6 * before


def test_offices_that_look_the_same_are_told_apart():
    location = f"{OFFICES}&walk=1&seed=1"
    closer = closed(location)
    truth = truths(closer, location)
    assert len(closer.loops) > 10
    assert errors(closer.loops, truth).max() < 0.3  # the next office is 4 m away
    before = off([submap.T_odom_anchor for submap in closer.submaps], truth)
    assert off([submap.T_map_anchor for submap in closer.submaps], truth) < 0.5 * before


def test_a_loop_that_the_poses_do_not_allow_is_refused_and_told(unrepeated):
    unrepeated()
    made = mapped(RING.replace("drift=0.02", "drift=0.08"))
    closer = LoopCloser(load_config(made.config, **{"loops.drift": 0.002, "loops.drift_deg": 0.02}))
    for frame in made.kept_frames.frames:
        closer.add(frame)
    closer.finish()
    assert not closer.loops
    assert any("loops.drift" in loop.why for loop in closer.refused)
    for frame in made.kept_frames.frames:
        np.testing.assert_allclose(closer.corrected()[frame.sensor, frame.stamp_ns], frame.T_world_sensor, atol=1e-9)


def test_frames_between_anchors_move_smoothly():
    closer, made = closed(RING), mapped(RING)
    new = closer.corrected()
    before = np.array([frame.T_world_sensor[:3, 3] for frame in made.kept_frames.frames])
    after = np.array([new[frame.sensor, frame.stamp_ns][:3, 3] for frame in made.kept_frames.frames])
    assert set(new) == {(frame.sensor, frame.stamp_ns) for frame in made.kept_frames.frames}
    steps = np.linalg.norm(np.diff(after - before, axis=0), axis=1)
    assert steps.max() < 0.1
    anchors = {(s.frames[s.anchor].sensor, s.stamp_ns): s.T_map_anchor for s in closer.submaps}
    for key, T in anchors.items():
        np.testing.assert_allclose(new[key], T, atol=1e-9)


def test_poses_that_are_known_badly_are_bent_more(unrepeated):
    made, sure = mapped(RING), closed(RING)
    unrepeated()
    frames = made.kept_frames.frames
    assert {frame.pose_sigma for frame in frames} == {(0.0, 0.0)}
    shaky, found = range(len(frames) // 3, len(frames) // 2), []
    unsure = LoopCloser(made.config)
    for n, frame in enumerate(frames):
        unsure.add(replace(frame, pose_sigma=(0.015, 0.3)) if n in shaky else frame)
    unsure.finish()
    for closer in (sure, unsure):
        bends = [submap.bend[:3, 3] for submap in closer.submaps]
        stamps = [submap.stamp_ns for submap in closer.submaps]
        ends = np.searchsorted(stamps, [frames[shaky[0]].stamp_ns, frames[shaky[-1]].stamp_ns])
        whole = np.linalg.norm(bends[-1] - bends[0])
        found.append(np.linalg.norm(bends[ends[1]] - bends[ends[0]]) / whole)
    assert found[1] > 1.5 * found[0]


def test_two_cameras_back_to_back_are_one_body(unrepeated):
    unrepeated()
    made, T_front_rear = mapped(RING, 0, 60), np.eye(4)
    T_front_rear[:3, :3], T_front_rear[:3, 3] = rotation_matrix([0, np.pi, 0]), [0.2, 0, -0.3]
    one, both = LoopCloser(made.config), LoopCloser(made.config)
    for frame in made.kept_frames.frames:
        one.add(frame)
        both.add(frame)
        both.add(replace(frame, sensor="rear", T_world_sensor=frame.T_world_sensor @ T_front_rear))
    one.finish()
    both.finish()
    assert len(both.submaps) <= len(one.submaps) + 1
    assert both.submaps[-1].travelled < 1.1 * one.submaps[-1].travelled
    assert set(both.corrected()) == {(s, f.stamp_ns) for f in made.kept_frames.frames for s in (f.sensor, "rear")}


def test_frames_may_come_in_any_order_of_time(unrepeated):
    unrepeated()
    made = mapped(RING, 0, 60)
    closer = LoopCloser(made.config)
    for frame in made.kept_frames.frames:
        closer.add(replace(frame, stamp_ns=10**12 - frame.stamp_ns))
    closer.finish()
    for n, submap in enumerate(closer.submaps):
        submap.T_map_anchor = submap.T_map_anchor.copy()
        submap.T_map_anchor[2, 3] += 0.1 * n
    new = closer.corrected()
    for submap in closer.submaps:
        anchor = submap.frames[submap.anchor]
        np.testing.assert_allclose(new[anchor.sensor, anchor.stamp_ns], submap.T_map_anchor, atol=1e-9)


def test_a_loop_is_confirmed_by_another_submap_only():
    """Two findings of one submap may be the same mistake; the next submap's is a second look."""
    closer = bare_closer()
    last = len(closer.submaps) - 1

    def loop(first, second):
        between = inverse(closer.submaps[first].T_odom_anchor) @ closer.submaps[second].T_odom_anchor
        return Loop(first, second, Match(between, FLOOR, 1.0, held=True), 0.0, 0.0)

    for first in (0, 1):
        closer._judge(loop(first, last))
        assert not closer.loops
    closer._judge(loop(0, last - 1))
    assert {(one.first, one.second) for one in closer.loops} == {(0, last), (1, last), (0, last - 1)}
    assert not closer._waiting
