# SPDX-License-Identifier: Apache-2.0
"""Each setting of SLAM changes what it should: one row each, and none without a row."""

from collections import Counter

import numpy as np
import pytest
from made_drives import along, box, drive, ranges

from stereovox.config import load_config
from stereovox.config.robot import SlamConfig
from stereovox.errors import ConfigError
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam.graph import Keyframe, patch_edges
from stereovox.localize.slam.line_map import Cloud, Match, cloud_of
from stereovox.localize.slam.loops import ClosureSearch, LoopFinder
from stereovox.localize.slam.pipeline import Slam, map_scans

HALL = np.vstack([box(-3, -2, 9, 3), box(1, 1, 2, 1.6), box(6, -2, 6.4, -1.5), box(-3, 0, -2.6, 1)])
STRAIGHT = drive(HALL, along([(0, 0), (5, 0)]), limit=20.0)
ONE = Cloud(np.array([[1.0, 0.5]], np.float32), np.array([[-1.0, 0.0]], np.float32))


def keyframes(config, scans=STRAIGHT):
    slam = Slam(config)
    for scan in scans:
        slam.add(scan)
    return slam.keyframes


def gaps(found, axes):
    return np.abs(np.diff([keyframe.pose for keyframe in found], axis=0)[:, axes]).max()


def side_of_cells(config):
    return map_scans(STRAIGHT[:5], config).grid.resolution


def farthest_hit(config):
    return max(np.linalg.norm(keyframe.cloud.points, axis=1).max() for keyframe in keyframes(config))


def gap_on_the_way(config):
    return gaps(keyframes(config), slice(2))


def gap_of_turns(config):
    turning = np.array([(0, 0, 0.05 * i) for i in range(50)])
    return gaps(keyframes(config, drive(HALL, turning, limit=20.0)), 2)


def keyframes_matched_with(config):
    slam = Slam(config)
    for scan in STRAIGHT:
        slam.add(scan)
    return len(slam._follower._moved)


def slip(config):
    """Metres that a step of 0.5 m that the odometry did not notice is off, found again by matching."""
    slam = Slam(config)
    for scan in STRAIGHT[:10]:
        slam.add(scan)
    angles = np.radians(np.linspace(-120, 120, 181))
    seen = ranges(HALL, np.array([1.4, 0.0, 0.0]), angles, 20.0).astype(np.float32)
    still = STRAIGHT[9].T_world_sensor
    slam.add(Scan(seen, float(angles[0]), float(angles[1] - angles[0]), 0.02, 20.0, still, stamp_ns=10**12))
    return abs(slam.pose[0] - 1.4)


def information_of_patches(config):
    """Mean information, all directions together, of where keyframes with 3 cm of noise stand to patches."""
    scans = drive(HALL, along([(0, 0), (3, 0)]), noise=0.03, limit=20.0)
    poses = [scan.pose_world_base for scan in scans]
    made = [Keyframe(p, p, cloud_of(s, 30.0), s, 0.0) for p, s in zip(poses, scans, strict=True)]
    return np.mean([np.trace(edge.information) for edge in patch_edges(made, config.slam)])


def farthest_pair(config):
    made = keyframes(config)
    pairs = [(edge.first, edge.second) for edge in patch_edges(made, config.slam)]
    return max(np.hypot(*(made[a].pose - made[b].pose)[:2]) for a, b in pairs)


def polishes(config):
    slam, rounds = Slam(config), []
    for scan in STRAIGHT[:20]:
        slam.add(scan)
    motion = se2.relative(slam.keyframes[0].pose, slam.keyframes[-1].pose)
    slam._loops.edges.append(Edge(0, len(slam.keyframes) - 1, motion, 1e4 * np.eye(3)))
    slam.finish(lambda done, total, _text: rounds.append((done, total)))
    return len(rounds)


def cleared(config):
    """Cells known to be free between two walls, where most beams end nowhere."""
    walls = np.array([[-2.0, 1.0, 2.0, 1.0]])
    scans = drive(walls, np.array([[0.0, 0.0, 0.0]]), limit=5.0)
    return int(np.sum(map_scans(scans, config).grid.cells >= 0))


class Search:
    """Stands for ClosureSearch; notes what is asked, and finds each time the place guessed, with 60 % of the points."""

    def __init__(self):
        self.windows = []

    def set_target(self, earlier):
        pass

    def match(self, _cloud, guess, side, side_yaw):
        self.windows.append((side, side_yaw))
        return Match(np.asarray(guess, float), 1e4 * np.eye(3), 0.6, 0.01)


def loops(config):
    """A finder that has seen a robot go to and fro, and the windows it searched."""
    places = np.concatenate([np.arange(0, 16, 0.5), np.arange(16, 0, -0.5)] * 3)
    scan = STRAIGHT[0]
    made = [Keyframe(np.array([x, 0.0, 0.0]), np.zeros(3), ONE, scan, 0.5 * i) for i, x in enumerate(places)]
    finder = LoopFinder(config.slam, made)
    finder._search = search = Search()
    finder.update()
    return finder, np.array(search.windows)


def keyframes_of_submap(config):
    return Counter(submap.last - submap.first for submap in loops(config)[0]._submaps).most_common()[0][0]


def shortest_loop(config):
    finder, _ = loops(config)
    along = [keyframe.travelled for keyframe in finder._keyframes]
    return min(along[edge.second] - along[edge.first] for edge in finder.candidates)


def window(config):
    return loops(config)[1][:, 0].max()


def window_of_turns(config):
    return loops(config)[1][:, 1].max()


def believed(config):
    return len(loops(config)[0].candidates)


def cloud(walls, pose):
    angles = np.radians(np.arange(0, 360, 0.7))
    found = ranges(walls, np.asarray(pose, float), angles, 20.0)
    ahead = np.column_stack([np.cos(angles), np.sin(angles)])
    hit = np.isfinite(found)
    return Cloud((found[hit, None] * ahead[hit]).astype(np.float32), (-ahead[hit]).astype(np.float32))


def found_in(config, here, there, pose):
    search = ClosureSearch(config.slam)
    search.set_target(cloud(here, [0, 0, 0]))
    return search.match(cloud(there, pose), [0.0, 0.0, 0.0], 2.5, 0.2) is not None


def found_half_hidden(config):
    """Half of what the later one sees is not on the earlier map: the mean likelihood is some 0.6."""
    moved = np.vstack([HALL, box(0.4, -1.5, 0.6, 1.0)])
    return found_in(config, HALL, moved, [0.2, 0.1, 0.05])


def found_among_niches(config):
    """A corridor with niches 2 m apart, and one thing that tells: its neighbours score some 0.85 of the place."""
    walls = np.array([[-40, -1, 40, -1], [-40, 1.5, 40, 1.5]], float)
    niches = [box(2.0 * i, 1.1, 2.0 * i + 0.4, 1.5) for i in range(-15, 15)]
    told = np.vstack([walls, *niches, box(-0.5, -1, 0.2, -0.3)])
    return found_in(config, told, told, [0.3, 0.2, 0.05])


ABOUT = 0.12
"""Metres and radians from one scan of a drive to the next, at most: that much a keyframe may come late."""
LONGEST = 18.0
"""Metres of way to the farthest place that `loops` searches, before closures make ways shorter."""
ROWS = [
    ("voxel_size", side_of_cells, {0.05: 0.05, 0.1: 0.1}),
    ("max_range", farthest_hit, {3.0: (2.5, 3.0), 7.0: (6.5, 7.0)}),
    ("sigma", information_of_patches, {0.03: (5e5, 9e5), 0.1: (7e4, 1.1e5)}),
    ("odometry", slip, {(0.02, 0.2, 0.07, 0.5): (0.2, 0.6), (0.3, 0.2, 0.07, 0.5): (0.0, 0.03)}),
    ("keyframe_distance", gap_on_the_way, {0.25: (0.25, 0.25 + ABOUT), 0.8: (0.8, 0.8 + ABOUT)}),
    ("keyframe_turn", gap_of_turns, {0.2: (0.2, 0.2 + ABOUT), 0.6: (0.6, 0.6 + ABOUT)}),
    ("local_keyframes", keyframes_matched_with, {3: 3, 6: 6}),
    ("submap_keyframes", keyframes_of_submap, {8: 8, 16: 16}),
    ("closure_path", shortest_loop, {5.0: (5.0, 12.0), 30.0: (30.0, 37.0)}),
    ("drift", window, {0.0: 0.5, 0.04: 0.5 + 0.04 * LONGEST, 0.08: 0.5 + 0.08 * LONGEST}),
    ("drift_turn", window_of_turns, {0.0: 0.1, 0.01: 0.1 + 0.01 * LONGEST}),
    ("closure_window", window, {0.4: 0.4, 0.7: 0.7}),
    ("closure_window_turn", window_of_turns, {0.08: 0.08, 0.11: 0.11}),
    ("closure_score", found_half_hidden, {0.3: True, 0.9: False}),
    ("closure_rival", found_among_niches, {0.5: False, 0.97: True}),
    ("closure_share", believed, {0.65: 0, 0.55: (10, 10_000)}),
    ("refine_rounds", polishes, {0: 0, 1: 1, 3: 3}),
    ("refine_distance", farthest_pair, {2.0: (1.7, 2.0), 4.0: (3.7, 4.0)}),
    ("clear_far", cleared, {False: (0, 3000), True: (6000, 40_000)}),
]


def test_every_setting_has_a_row():
    assert [row[0] for row in ROWS] == list(SlamConfig.model_fields)


@pytest.mark.parametrize(("name", "value", "measure", "expected"), [
    (name, value, measure, expected) for name, measure, rows in ROWS for value, expected in rows.items()
])  # fmt: skip
def test_a_setting_changes_what_it_should(name, value, measure, expected):
    if measure is polishes:
        pytest.importorskip("gtsam")
    found = measure(load_config(**{f"slam.{name}": list(value) if isinstance(value, tuple) else value}))
    low, high = expected if isinstance(expected, tuple) else (expected, expected)
    assert low - 1e-6 <= found <= high + 1e-6


@pytest.mark.parametrize("odometry", [[0, 0, 0, 0], [0, 0.2, 0.07, 0.5], [0.02, 0.2, 0, 0.5], [0.02, -0.1, 0.07, 0.5],
                                      [0.02, 0.1, 0.07, -0.5], [0.02, 0.2, -1, 0.5]])  # fmt: skip
def test_odometry_that_is_never_off_is_refused(odometry):
    with pytest.raises(ConfigError, match="odometry") as caught:
        load_config(**{"slam.odometry": odometry})
    assert "above 0" in str(caught.value)
    assert "\n" not in str(caught.value)
    load_config(**{"slam.odometry": [0.01, 0, 0.01, 0]})


def test_a_corridor_says_nothing_of_the_way_along_it():
    """All that a patch then tells is how far from the walls, and how turned, a keyframe stands."""
    walls = np.array([[-100, -1, 100, -1], [-100, 1, 100, 1]], float)
    scans = drive(walls, along([(0, 0), (4, 0)]), noise=0.01)
    poses = [scan.pose_world_base for scan in scans]
    made = [Keyframe(p, p, cloud_of(s, 30.0), s, 0.0) for p, s in zip(poses, scans, strict=True)]
    edges = list(patch_edges(made, load_config().slam))
    assert len(edges) > 100
    for edge in edges:
        assert abs(edge.information[0, 0]) < 1e-4 * edge.information[1, 1]
        assert edge.information[2, 2] > 1
