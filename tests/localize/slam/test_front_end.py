# SPDX-License-Identifier: Apache-2.0
"""The map that scans are laid onto holds each of the last keyframes in sight once."""

import numpy as np
from made_drives import along, drive, ring

from stereovox.config import load_config
from stereovox.geometry import se2
from stereovox.localize.slam.front_end import MIN_NEAR_POINTS, Follower
from stereovox.localize.slam.line_map import LineMap, joined

OUT_AND_BACK = [(1, 1), (13, 1), (2, 1)]


def expected(keyframes, config, start):
    """The map made anew of the last keyframes, back to the first that is out of sight."""
    recent = []
    for keyframe in keyframes[-config.local_keyframes :][::-1]:
        if np.hypot(*(keyframe.pose - keyframes[-1].pose)[:2]) > config.max_range:
            break
        recent.insert(0, keyframe.cloud.moved(keyframe.pose - start))
    return LineMap(config.voxel_size, reach=0.2, fewest=MIN_NEAR_POINTS).build(joined(recent), start[:2]), len(recent)


def test_the_map_is_of_the_last_keyframes_in_sight():
    config = load_config(**{"slam.max_range": 3.0, "slam.local_keyframes": 40}).slam
    follower, sizes = Follower(config), []
    for scan in drive(ring(), along(OUT_AND_BACK, step=0.15), drift=(1.01, 0.002)):
        if not follower.add(scan):
            continue
        made, count = expected(follower.keyframes, config, np.array([1.0, 1.0, 0.0]))
        assert np.array_equal(follower._map.cells, made.cells)
        assert np.array_equal(follower._map.lines, made.lines)
        sizes.append(count)
    steps = np.diff(sizes)
    assert steps.max() > 1  # turned back: old ones came into sight again
    assert steps.min() < 0
    assert max(sizes) > 20


def test_keyframes_that_the_graph_moved_take_the_map_along():
    follower = Follower(load_config().slam)
    for scan in drive(ring(), along([(1, 1), (4, 1)], step=0.15)):
        follower.add(scan)
    before, pose, shift = follower._map.lines.copy(), follower.pose, np.array([0.5, -0.25, 0.0])
    last = follower.keyframes[-1].pose
    for keyframe in follower.keyframes:
        keyframe.pose = keyframe.pose + shift
    follower.moved(last)
    assert np.allclose(follower.pose, pose + shift)
    assert len(follower._map.lines) == len(before)
    assert np.allclose(follower._map.lines[:, 4:6], before[:, 4:6], atol=0.02)
    made, _ = expected(follower.keyframes, load_config().slam, np.array([1.0, 1.0, 0.0]))
    assert np.array_equal(follower._map.lines, made.lines)


def test_the_pose_before_is_kept_by_a_blind_start():
    blind = drive(ring(), along([(1, 1), (2, 1)]), limit=0.1)
    follower = Follower(load_config().slam)
    for scan in blind:
        assert not follower.add(scan)
        assert np.allclose(se2.relative(scan.pose_world_base, follower.pose), 0, atol=1e-9)
