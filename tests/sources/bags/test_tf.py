# SPDX-License-Identifier: Apache-2.0
"""A tree of frames over time, against a slow reference and by its laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import inverse
from stereovox.sources.bags.tf import Limits, Tf

MS = 1_000_000
STILL = [0.0, 0, 0, 0, 0, 0, 1]
BY_HEART = {"a": "root", "b": "a", "c": "b", "d": "a", "e": "root"}
"""Child and parent of the tree that most tests use; d and e are fixed."""
FIXED = ("d", "e")


def random_numbers(dice: np.random.Generator) -> np.ndarray:
    return np.concatenate([dice.normal(size=3), dice.normal(size=4)])


def recorded(seed: int, count: int = 6) -> list[tuple[str, str, int, np.ndarray, bool]]:
    """Transforms of the tree at uneven times within half a second."""
    dice, told = np.random.default_rng(seed), []
    for child, parent in BY_HEART.items():
        if child in FIXED:
            told.append((parent, child, int(dice.integers(9) * MS), random_numbers(dice), True))
            continue
        times = {0, 500 * MS, *(int(t) for t in dice.integers(0, 500 * MS, count - 2))}
        told += [(parent, child, t, random_numbers(dice), False) for t in sorted(times)]
    return told


def tree(told) -> Tf:
    tf = Tf("walk.bag /tf")
    for parent, child, stamp_ns, numbers, fixed in told:
        tf.add(parent, child, stamp_ns, numbers, fixed)
    return tf


def slow_edge(told, child: str, stamp_ns: int) -> np.ndarray:
    """T_parent_child by scipy's slerp, looking through all that was recorded."""
    mine = sorted((t, tuple(numbers)) for _, name, t, numbers, _ in told if name == child)
    T = np.eye(4)
    if child in FIXED:
        T[:3, :3], T[:3, 3] = Rotation.from_quat(mine[0][1][3:]).as_matrix(), mine[0][1][:3]
        return T
    times = [t for t, _ in mine]
    T[:3, :3] = Slerp(times, Rotation.from_quat([row[3:] for _, row in mine]))(stamp_ns).as_matrix()
    T[:3, 3] = [np.interp(stamp_ns, times, [row[axis] for _, row in mine]) for axis in range(3)]
    return T


def slow_lookup(told, target: str, source: str, stamp_ns: int) -> np.ndarray:
    """By way of the root, whatever the common ancestor is."""

    def in_root(frame: str) -> np.ndarray:
        return np.eye(4) if frame == "root" else in_root(BY_HEART[frame]) @ slow_edge(told, frame, stamp_ns)

    return np.linalg.inv(in_root(target)) @ in_root(source)


FRAMES = st.sampled_from(["root", *BY_HEART])
TIMES = st.integers(0, 500 * MS)


@given(seed=st.integers(0, 10**6), target=FRAMES, source=FRAMES, stamp_ns=TIMES)
@settings(max_examples=60, deadline=None)
def test_the_same_as_the_slow_reference(seed, target, source, stamp_ns):
    told = recorded(seed)
    found = tree(told).lookup(target, source, stamp_ns)
    np.testing.assert_allclose(found, slow_lookup(told, target, source, stamp_ns), atol=1e-9)


@given(seed=st.integers(0, 10**6), a=FRAMES, b=FRAMES, c=FRAMES, stamp_ns=TIMES, shuffled=st.randoms())
@settings(max_examples=40, deadline=None)
def test_laws_of_a_tree(seed, a, b, c, stamp_ns, shuffled):
    told = recorded(seed)
    tf = tree(told)
    T_a_b, T_b_c = tf.lookup(a, b, stamp_ns), tf.lookup(b, c, stamp_ns)
    np.testing.assert_allclose(tf.lookup(b, a, stamp_ns), inverse(T_a_b), atol=1e-9)
    np.testing.assert_allclose(tf.lookup(a, c, stamp_ns), T_a_b @ T_b_c, atol=1e-9)
    np.testing.assert_allclose(tf.lookup(a, a, stamp_ns), np.eye(4), atol=1e-9)
    shuffled.shuffle(told)
    slashed = [(f"/{parent}", f"/{child}", *rest) for parent, child, *rest in told]  # as tf1 writes names
    np.testing.assert_array_equal(tree(slashed).lookup(f"/{a}", b, stamp_ns), T_a_b)


def line(*stops: tuple[int, float], limits: Limits | None = None) -> Tf:
    tf = Tf("walk.bag /tf", limits)
    for milliseconds, x in stops:
        tf.add("odom", "base_link", milliseconds * MS, [x, *STILL[1:]])
    return tf


def x_at(tf: Tf, milliseconds: int) -> float:
    return float(tf.lookup("odom", "base_link", milliseconds * MS)[0, 3])


def refused(tf: Tf, target: str = "odom", source: str = "base_link", milliseconds: int = 0) -> str:
    with pytest.raises(FrameRefused) as caught:
        tf.lookup(target, source, milliseconds * MS)
    assert caught.value.reason == "no_pose"
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_ends_hold_for_a_while_and_no_longer():
    tf = line((1000, 1.0), (1200, 3.0))
    assert (x_at(tf, 900), x_at(tf, 1300), x_at(tf, 1150)) == (1.0, 3.0, 2.5)
    times = (900, 1000, 1150, 1200, 1300)
    assert [tf.off_ns("odom", "base_link", ms * MS) for ms in times] == [100 * MS, 0, 0, 0, 100 * MS]
    assert tf.off_ns("base_link", "odom", 900 * MS) == 100 * MS
    said = refused(tf, milliseconds=899)
    assert said.startswith("walk.bag /tf: odom -> base_link begins after 0.899000000 s, 0.101 s away (at most 0.1 s)")
    assert "odom -> base_link ends before 1.301000000 s, 0.101 s away" in refused(tf, milliseconds=1301)
    strict = line((1000, 1.0), (1200, 3.0), limits=Limits(extrapolate_s=0.0))
    assert x_at(strict, 1200) == 3.0
    refused(strict, milliseconds=1201)


def test_a_gap_is_bridged_up_to_the_limit():
    tf = line((0, 0.0), (500, 5.0), (1001, 10.0))
    assert x_at(tf, 250) == pytest.approx(2.5)
    said = refused(tf, milliseconds=600)
    assert "odom -> base_link has no transform for 0.501 s after 0.500000000 s (at most 0.5 s is bridged)" in said
    assert x_at(tf, 1001) == 10
    assert x_at(line((0, 0.0), (1000, 10.0), limits=Limits(max_gap_s=1.0)), 500) == pytest.approx(5)


def test_a_frame_that_never_moves_may_be_sent_seldom():
    tf = line((0, 1.0), (5000, 1.0), (9000, 1.0))
    assert x_at(tf, 7000) == 1
    assert x_at(tf, 9500) == x_at(tf, -500) == 1
    refused(tf, milliseconds=9501)
    assert not tf.moving("odom", "base_link")
    refused(line((0, 1.0)), milliseconds=101)  # once only: nobody knows
    tf.add("odom", "base_link", 9400 * MS, [2.0, *STILL[1:]])
    refused(tf, milliseconds=7000)
    assert tf.moving("odom", "base_link")


def test_fixed_frames_hold_at_all_times_and_the_last_one_counts():
    tf = Tf()
    tf.add("base_link", "laser", 5, [1.0, *STILL[1:]], fixed=True)
    tf.add("base_link", "laser", 3, [2.0, *STILL[1:]], fixed=True)
    assert tf.lookup("base_link", "laser", -(10**18))[0, 3] == 2
    assert not tf.moving("base_link", "laser")


def test_what_lies_above_the_common_ancestor_does_not_matter():
    tf = line((0, 0.0), (100, 1.0))
    for child, x in (("laser", 1.0), ("camera", 3.0)):
        tf.add("base_link", child, 0, [x, *STILL[1:]], fixed=True)
    assert tf.lookup("laser", "camera", 10**15)[0, 3] == 2  # where the robot was then is not known
    assert tf.lookup("base_link", "camera", 10**15)[0, 3] == 3
    refused(tf, "odom", "camera", 10**9)


def test_of_several_with_one_time_the_first_counts():
    assert x_at(line((0, 1.0), (0, 9.0), (100, 2.0)), 0) == 1


def test_unknown_frames_and_trees_that_nothing_connects():
    tf = line((0, 0.0), (100, 1.0))
    assert refused(tf, "odom", "bse_link") == "walk.bag /tf: no frame 'bse_link' in it (did you mean 'base_link'?)"
    tf.add("camera_link", "optical", 0, STILL, fixed=True)
    said = refused(tf, "odom", "optical")
    assert "nothing connects odom (root odom) and optical (root camera_link)" in said
    assert not tf.connected("odom", "optical")
    assert not tf.connected("odom", "nobody")
    assert tf.connected("/base_link", "odom")
    assert (tf.root("optical"), tf.root("camera_link")) == ("camera_link", "camera_link")


def test_a_loop_is_told():
    tf = line((0, 0.0))
    for parent, child in (("c", "a"), ("a", "b"), ("b", "c")):
        tf.add(parent, child, 0, STILL)
    said = refused(tf, "odom", "a")
    assert "loop: a -> c -> b -> a" in said
    tf.add("a", "hanger", 0, STILL)
    assert "loop: a -> c -> b -> a" in refused(tf, "hanger", "odom")


@pytest.mark.parametrize("fixed", [False, True])
def test_of_two_parents_the_fixed_or_more_frequent_one_counts(fixed):
    tf = line((0, 1.0), (10, 1.5), (20, 2.0))
    tf.add("map", "base_link", 10 * MS, [7.0, *STILL[1:]], fixed=fixed)
    winner, loser, x = ("map", "odom", 7.0) if fixed else ("odom", "map", 1.5)
    assert tf.lookup(winner, "base_link", 10 * MS)[0, 3] == x
    assert "nothing connects" in refused(tf, loser, "base_link", 10)
    assert tf.notes == (f"walk.bag /tf: base_link has several parents (odom, map); {winner} is used",)


def test_transforms_that_are_none_are_left_out_and_counted():
    tf = line((0, 0.0), (100, 1.0))
    tf.add("odom", "base_link", 50 * MS, [np.nan, *STILL[1:]])
    tf.add("odom", "base_link", 50 * MS, [9.0, 0, 0, 0, 0, 0, 0])
    tf.add("odom", "base_link", 50 * MS, [1e300, *STILL[1:]])
    tf.add("odom", "base_link", 50 * MS, STILL[1:])
    tf.add("odom", "odom", 50 * MS, STILL)
    tf.add("", "base_link", 50 * MS, STILL)
    assert x_at(tf, 50) == pytest.approx(0.5)
    assert tf.notes == ("walk.bag /tf: 6 transforms are invalid and were left out",)
    assert tf.frames == ("base_link", "odom")


def test_what_is_handed_out_is_not_what_is_stored():
    tf = Tf()
    tf.add("a", "b", 0, STILL, fixed=True)
    tf.lookup("a", "b", 0)[0, 3] = 7
    assert tf.lookup("a", "b", 0)[0, 3] == 0
