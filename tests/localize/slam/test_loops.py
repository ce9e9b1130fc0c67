# SPDX-License-Identifier: Apache-2.0
"""What is searched for loops, and what of that is believed: with a search that finds what a test says."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam.graph import Keyframe
from stereovox.localize.slam.line_map import Cloud, Match
from stereovox.localize.slam.loops import SHORT_CUT, LoopFinder, Submap
from stereovox.localize.slam.pipeline import Slam

ONE = Cloud(np.array([[1.0, 0.5]], np.float32), np.array([[-1.0, 0.0]], np.float32))
SCAN = Scan(np.array([1.0], np.float32), 0.0, 0.1, 0.02, 8.0, np.eye(4))


class Said:
    """Stands for ClosureSearch: finds what `tell(n)` says of the nth call, off by `offset` (3,) from the guess."""

    def __init__(self, tell):
        self.tell, self.windows = tell, []

    def set_target(self, earlier):
        pass

    def match(self, _cloud, guess, side, side_yaw):
        self.windows.append((side, side_yaw))
        told = self.tell(len(self.windows) - 1)
        if told is None:
            return None
        offset, information, share = {"offset": (0, 0, 0), "information": (1, 1, 1), "share": 0.9, **told}.values()
        pose = se2.compose(guess, offset)
        return Match(pose, 1e4 * np.diag(np.asarray(information, float)), share, 0.01)


def to_and_fro(times=2, length=16.0, step=0.5):
    """Keyframes of a robot that goes along a line and back."""
    one = np.arange(0, length, step)
    places = np.concatenate([one if i % 2 == 0 else one[::-1] + step for i in range(times)])
    return [
        Keyframe(np.array([x, 0.0, 0.0]), np.array([step, 0.0, 0.0]), ONE, SCAN, step * i) for i, x in enumerate(places)
    ]


def found(tell, keyframes=None, **settings):
    config = load_config(**{f"slam.{name}": value for name, value in {"submap_keyframes": 8, **settings}.items()})
    finder = LoopFinder(config.slam, keyframes or to_and_fro())
    finder._search = Said(tell)
    added = finder.update()
    assert added == finder.edges
    return finder, finder._search.windows


def test_findings_that_agree_are_believed():
    finder, windows = found(lambda _: {})
    assert len(windows) > 10
    assert finder.edges == finder.candidates
    assert len(finder.edges) == len(windows)
    for edge in finder.edges:
        a, b = (finder._keyframes[i].pose for i in (edge.first, edge.second))
        assert np.allclose(edge.motion, se2.relative(a, b))


def test_findings_that_no_other_bears_out_are_not():
    finder, _ = found(lambda i: {"offset": (1.0 * i, 0, 0)})
    assert len(finder.candidates) > 10
    assert finder.edges == []
    turned, _ = found(lambda i: {"offset": (0, 0, 0.05 * i)})
    assert turned.edges == []


def test_a_lone_finding_waits_for_its_witness():
    alone, _ = found(lambda i: {} if i == 3 else None)
    assert len(alone.candidates) == 1
    assert alone.edges == []
    borne_out, _ = found(lambda i: {} if i in (3, 4) else None)
    assert borne_out.edges == borne_out.candidates
    assert len(borne_out.edges) == 2
    long = to_and_fro(length=40.0)
    _, windows = found(lambda _: None, long)
    far, _ = found(lambda i: {} if i in (0, len(windows) - 1) else None, long)  # over 15 m of way apart
    assert len(far.candidates) == 2
    assert far.edges == []


@pytest.mark.parametrize(("weak", "taken"), [(0.02, False), (0.05, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_along_a_corridor_nothing_is_found(weak, taken, axis):
    information = np.ones(3)
    information[axis] = weak
    finder, windows = found(lambda _: {"information": information})
    assert len(finder.candidates) == taken * len(windows)


def test_the_nearest_places_are_tried_first_and_not_all(monkeypatch):
    monkeypatch.setattr("stereovox.localize.slam.loops.MAX_TRIED", 2)
    finder, windows = found(lambda _: {})
    later = [edge.second for edge in finder.edges]
    assert max(later.count(i) for i in later) == 2
    assert len(windows) == len(later)


def shortest(anchors, along, edges):
    """Floyd and Warshall."""
    ways = np.full((len(anchors), len(anchors)), np.inf)
    np.fill_diagonal(ways, 0)
    for i in range(len(anchors) - 1):
        ways[i, i + 1] = ways[i + 1, i] = along[i + 1] - along[i]
    for a, b in edges:
        ways[a, b] = ways[b, a] = min(ways[a, b], SHORT_CUT)
    for k in range(len(anchors)):
        ways = np.minimum(ways, ways[:, k, None] + ways[k])
    return ways[-1]


@pytest.mark.parametrize("edges", [[], [(1, 5)], [(1, 5)] * 3, [(0, 1), (6, 7)], [(0, 6), (0, 6), (2, 3), (3, 7)]])
def test_drift_adds_up_along_the_shortest_way(edges):
    finder = LoopFinder(load_config(**{"slam.submap_keyframes": 8}).slam, to_and_fro(2))
    finder._submaps = [Submap(4 * i, 4 * i + 8) for i in range(8)]
    anchors = [submap.anchor for submap in finder._submaps]
    finder.edges = [Edge(anchors[a], anchors[b], np.zeros(3), np.eye(3)) for a, b in edges]
    along = [finder._keyframes[anchor].travelled for anchor in anchors]
    assert np.allclose(finder._drift_distances(), shortest(anchors, along, edges), rtol=0, atol=1e-9)
    finder._submaps = finder._submaps[:1]
    finder.edges = []
    assert finder._drift_distances().tolist() == [0.0]


@pytest.mark.parametrize("wrong", [None, 0, 5, 11])
def test_any_new_edge_that_is_off_makes_the_graph_be_solved(monkeypatch, wrong):
    slam, solved = Slam(load_config()), []
    slam._follower.keyframes += to_and_fro(1)
    poses = [keyframe.pose for keyframe in slam.keyframes]
    edges = [Edge(i, i + 1, se2.relative(poses[i], poses[i + 1]), np.eye(3)) for i in range(12)]
    if wrong is not None:
        edges[wrong] = Edge(wrong, wrong + 1, np.array([0.0, 1.0, 0.0]), np.eye(3))
    monkeypatch.setattr(slam._loops, "update", lambda: edges)
    monkeypatch.setattr(slam._follower, "add", lambda _scan: True)
    monkeypatch.setattr(slam, "_solve", lambda *_: solved.append(1))
    slam.add(SCAN)
    assert len(solved) == (wrong is not None)
