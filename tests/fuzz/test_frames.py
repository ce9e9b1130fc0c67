# SPDX-License-Identifier: Apache-2.0
"""A short run of `fuzz/frames.py`, and that it would see what it looks for."""

import time
import warnings
from collections import Counter
from dataclasses import replace

import lost_batches
import numpy as np
import pytest

import frames as fuzz
import stereovox as sv
import watched
from mapper_kinds import KINDS, SELDOM, Kind
from random_cameras import RandomCameras
from random_frames import Maker, room_depth
from stereovox.frame import Frame


def test_nothing_crashes_and_no_refused_frame_changes_a_map():
    tally = fuzz.run(1500, seed=7, timed_from=1500)
    assert tally.bad == []
    assert tally.changed_by_refused == 0
    assert set(tally.frames) == {"Frame", "StereoFrame", "Scan", "Cloud", "nonsense"}
    assert sum(tally.taken.values()) > 400
    often = {kind.name for kind in KINDS if kind.share > SELDOM}
    assert often <= set(tally.taken)
    seldom = fuzz.run(60, seed=7, timed_from=60, kinds=[kind for kind in KINDS if kind.share <= SELDOM])
    assert seldom.bad == []
    assert often | set(seldom.taken) == {kind.name for kind in KINDS}
    assert len(tally.refused) > 15


@pytest.mark.parametrize("callers", [1, 3])
@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("changes", "changed the map"),
        ("lines", "not one line"),
        ("forgets", "frames were counted"),
        ("dies", "ZeroDivisionError"),
        ("warns", "UserWarning"),
        ("waits", ""),
    ],
)
def test_what_is_wrong_is_seen(monkeypatch, broken, said, callers):
    real = sv.Mapper.add

    def add(self, frame):
        if broken == "dies":
            raise ZeroDivisionError
        if broken == "warns":
            warnings.warn("odd", stacklevel=1)
        if broken == "forgets":
            return sv.UpdateReport(refused="why", detail="one line")
        report = real(self, None)
        self.map.frames += broken == "changes"
        if broken == "waits":
            start = time.process_time()
            while time.process_time() < start + callers * 0.05:
                pass
        return replace(report, detail="two\nlines") if broken == "lines" else report

    monkeypatch.setattr(sv.Mapper, "add", add)
    monkeypatch.setattr(fuzz, "SLOW_S", 0.02 if broken == "waits" else 60.0)
    tally = fuzz.run(3 * callers, seed=1, timed_from=0, kinds=[Kind("default", callers=callers)])
    assert tally.failed
    if said:
        assert said in tally.bad[0]
    else:
        assert tally.slow == len(tally.slowest) == 3
        assert min(ms for ms, _, _ in tally.slowest) > 20


def test_the_same_batch_can_be_made_again():
    first, second = (fuzz.run(200, [3, 8], kinds=KINDS[:2]) for _ in range(2))
    assert (first.frames, first.refused, first.taken) == (second.frames, second.refused, second.taken)
    assert first.refused != fuzz.run(200, [3, 9], kinds=KINDS[:2]).refused


def test_images_of_the_room_agree_with_its_walls():
    """A camera in its middle that looks along x, turned by nothing: the wall ahead is as far as the room says."""
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    depth = room_depth(sv.PinholeCamera(9, 7, 9.0, 9.0, 4.0, 3.0), T)
    np.testing.assert_allclose(depth, 4.0, atol=1e-6)


def test_cameras_are_of_all_shapes():
    shapes = RandomCameras(np.random.default_rng(5))
    cameras = [shapes.camera() for _ in range(400)]
    kinds = Counter(type(camera).__name__ for camera in cameras)
    assert min(kinds.values()) > 30
    assert len(kinds) == 3
    assert {camera.width * camera.height == 1 for camera in cameras} == {True, False}
    focals = np.array([camera.fx for camera in cameras if hasattr(camera, "fx")])
    assert focals.min() < 0.1
    assert focals.max() > 5e5
    ordinary = RandomCameras(np.random.default_rng(5), odd=False)
    assert max(ordinary.camera().width for _ in range(400)) < 25


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_frames_are_of_all_kinds():
    maker = Maker(2)
    depth = [frame for frame in (maker.frame() for _ in range(500)) if isinstance(frame, Frame)]
    kinds = {str(getattr(frame.depth, "dtype", "")) for frame in depth}
    assert {"uint16", "float32", "float64", "float16", ">f4"} <= kinds
    assert {"", "left", "right"} <= {frame.sensor for frame in depth if isinstance(frame.sensor, str)}
    more = [frame for frame in (maker.frame() for _ in range(2000)) if isinstance(frame, Frame)]
    assert any(isinstance(frame.reason, np.matrix) for frame in depth + more)


def test_a_process_that_hangs_or_dies_is_seen_and_replaced(monkeypatch):
    """Batch 1 waits forever, 2 dies, 4 works forever; 0, 3 and 5 are well."""
    monkeypatch.setattr(watched, "HUNG_S", 1.0)
    monkeypatch.setattr(watched, "STUCK_S", 2.0)
    monkeypatch.setattr(watched, "LOOKS_S", 0.1)
    monkeypatch.setattr(watched, "_work", lost_batches.work)
    lines = []
    found = watched.Watched(6, [], lines.append)
    tally = found.run(6 * fuzz.BATCH, 600.0)
    assert dict(tally.frames) == {"Frame": 3}
    assert tally.hung == [f"[6, {batch}], frame 17: no answer for 1 s of work or 2 s" for batch in (1, 4)]
    assert tally.bad == ["[6, 2], frame 17: the process ended with 5"]
    assert found.memory == {"memory_mb": [1.0, 1.0]}
    assert tally.failed


def test_without_leaves_out():
    kinds, odd = fuzz.without(["callers", "grid", "odd cameras"])
    assert not odd
    assert {kind.callers for kind in kinds} == {1}
    assert not any(kind.grid for kind in kinds)
    assert fuzz.without([]) == (KINDS, True)
