# SPDX-License-Identifier: Apache-2.0
"""Maps that kept their frames are merged to the map of one run, bit for bit; others are added up, and that is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_loops import ELSEWHERE, RING
from made_loops import mapped as of_walk
from made_threads import frames_of

import stereovox as sv
from stereovox.correct.loops.closer import check_one_way
from stereovox.correct.merge_maps import _follow, why_added
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.products.edit import merge as added

KITCHEN = Path(__file__).resolve().parents[3] / "shared/data/sevenscenes_redkitchen"
SETTINGS = {
    "voxel_size": 0.1,
    "map.keep_frames": True,
    "trust.max_disagreement": 1,
    "trust.frozen": False,
    "trust.max_speed_mps": 1e6,
}


def frames(each=20):
    return [frame for frame in frames_of(0, each) if not frame.fault]


def mapped(some, **settings):
    mapper = sv.Mapper("default", **{**SETTINGS, **settings})
    for frame in some:
        assert mapper.add(frame).refused is None
    return mapper.map


def equal(a, b):
    same = all(np.array_equal(x, y) for x, y in zip(a.storage.blocks(), b.storage.blocks(), strict=True))
    if same and a.config.map.keep_times:
        coords = a.storage.blocks()[0]
        same = np.array_equal(a.storage.times_of(coords), b.storage.times_of(coords))
    return same


@pytest.mark.parametrize(
    "settings", [{}, {"map.cell": "int8"}, {"map.keep_times": True, "map.forget_s": 1.0}, {"integrator": "ray"}]
)
@pytest.mark.parametrize("halves", [lambda n: n % 2 == 0, lambda n: n < 8, lambda n: n >= 8])
def test_merged_is_one_run_over_both(settings, halves):
    every = frames()
    first, second = ([f for n, f in enumerate(every) if halves(n) is one] for one in (True, False))
    a, b = mapped(first, **settings), mapped(second, **settings)
    assert why_added(a, b) is None
    before = a.snapshot(), b.snapshot()
    both, one = sv.merge(a, b), mapped(every, **settings)
    assert equal(both, one)
    assert both.frames == one.frames == len(both.kept_frames)
    assert both.history.path == one.history.path
    assert both.viewpoint.stamp_ns == one.viewpoint.stamp_ns
    assert equal(a, before[0])
    assert equal(b, before[1])


def test_frames_that_are_in_both_maps_count_once():
    """Evidence that counts twice is too sure of itself."""
    every = frames()
    a, b = mapped(every[:9]), mapped(every[5:])
    both, one = sv.merge(a, b), mapped(every)
    assert equal(both, one)
    assert both.frames == len(both.kept_frames) == sum(both.history.quality.values()) == len(every)
    shifted = [replace(frame, T_world_sensor=frame.T_world_sensor + np.eye(4, k=3)) for frame in every[:3]]
    assert equal(sv.merge(a, mapped(shifted)), a)


def test_a_merged_map_goes_on_and_is_corrected_as_one_run(tmp_path):
    every = frames()
    sv.merge(mapped(every[:6]), mapped(every[6:12])).save(tmp_path / "m")
    mapper = sv.Mapper("default", resume=sv.load_map(tmp_path / "m"), **SETTINGS)
    for frame in every[12:]:
        mapper.add(frame)
    T = every[2].T_world_sensor.copy()
    T[2, 3] += 0.15
    mapper.correct({every[2].stamp_ns: T})
    every[2] = replace(every[2], T_world_sensor=T)
    assert equal(mapper.map, mapped(every))


def test_a_guess_of_what_is_up_keeps_no_maps_apart(tmp_path):
    """Two recordings of one place were guessed to lean differently: heights and pictures follow it, cells do not."""
    every = frames()
    for name, some, lean in (("a", every[:7], 0.05), ("b", every[7:], -0.12)):
        mapped(some, up_direction=[lean, 0, (1 - lean**2) ** 0.5]).save(tmp_path / name)
    a, b = sv.load_map(tmp_path / "a"), sv.load_map(tmp_path / "b")
    assert why_added(a, b) is None
    assert equal(sv.merge(a, b), mapped(every))
    assert sv.merge(a, b).config.up_direction == a.config.up_direction


def test_worlds_that_differ_are_joined_by_their_transform():
    every = frames()
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation_matrix([0.1, -0.2, 0.7])
    T_a_b[:3, 3] = 1.23, -0.4, 0.07
    both = sv.merge(mapped(every[:7]), mapped(every[7:], up="-y"), T_a_b)
    there = [replace(f, T_world_sensor=T_a_b @ f.T_world_sensor) for f in every[7:]]
    assert equal(both, mapped([*every[:7], *there]))


def test_a_transform_that_leads_nowhere_is_refused():
    every = frames()
    T_a_b = np.eye(4)
    T_a_b[0, 3] = 1e9
    with pytest.raises(StereovoxError, match="the transform takes frames 1e\\+06 m away"):
        sv.merge(mapped(every[:7]), mapped(every[7:]), T_a_b)


@pytest.mark.parametrize(
    ("of_a", "of_b", "said"),
    [
        ({"map.keep_frames": False}, {}, "did not keep"),
        ({}, {"map.keep_frames": False}, "did not keep"),
        ({}, {"map.frames_budget": "10 kB"}, "only some"),
        ({}, {"window.size": [4, 4, 3]}, "bounds"),
        ({"max_memory": "64M"}, {}, "bounds"),
        ({}, {"max_range": 4.0}, r"max_range"),
        ({}, {"map.log_odds_max": 3.0}, r"map"),
    ],
)
def test_what_cannot_be_exact_is_added_and_said(of_a, of_b, said):
    every = frames()
    a, b = mapped(every[:7], **of_a), mapped(every[7:], **of_b)
    assert said in why_added(a, b)
    assert equal(sv.merge(a, b), added(a, b))


def test_what_loops_may_drift_does_not_keep_maps_apart():
    assert why_added(mapped(frames(2)), mapped(frames(2), **{"loops.drift": 0.05})) is None


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the 7-Scenes kitchen is not here")
def test_two_halves_of_a_real_kitchen_are_one_run():
    every = list(sv.open_source(KITCHEN, frames="::5"))
    a, b = mapped(every[::2]), mapped(every[1::2])
    assert equal(sv.merge(a, b), mapped(every))
    assert not equal(added(a, b), mapped(every))


def test_a_second_recording_is_found_and_the_map_is_that_of_one_run(monkeypatch):
    pytest.importorskip("gtsam")
    a, b = of_walk(RING, 0, 120), of_walk(RING.replace("seed=3", "seed=8"), 60, 120, elsewhere=True)
    for one in (a, b):
        monkeypatch.setattr(one, "recording", "walk")
    steps = []
    joined = sv.join(a, b, lambda done, total, doing: steps.append(doing))
    assert "locating the second map in the first" in steps
    assert joined.found >= 3
    assert joined.map.recording == "walk, poses corrected"  # it cannot be gone on with
    assert joined.map.history.loops.counts()["closed"] == joined.loops
    assert np.linalg.norm((joined.T_a_b @ ELSEWHERE)[:3, 3]) < 0.6  # both have drifted
    assert joined.map.history.recordings == 2  # their times overlap: no third one is sought in them as in one way
    with pytest.raises(StereovoxError, match="merged of 2 recordings"):
        sv.join(joined.map, b)
    kept = joined.map.kept_frames.frames
    np.testing.assert_allclose(kept[0].T_world_sensor, a.kept_frames.frames[0].T_world_sensor, atol=0.05)
    assert len(kept) == len(a.kept_frames) + len(b.kept_frames)
    trusting = {
        "trust.max_disagreement": 1,
        "trust.frozen": False,
        "trust.max_speed_mps": 1e6,
        "trust.max_turn_dps": 1e9,
    }
    run = sv.Mapper(a.config, **trusting)
    for n, one in enumerate(kept):  # their stamps are those of two walks at once
        assert run.add(replace(one.frame(), stamp_ns=n * 10**9)).refused is None
    assert equal(joined.map, run.map)


def test_a_recording_that_kept_no_frames_is_not_sought():
    with pytest.raises(StereovoxError, match="only from frames, and a map did not keep its frames"):
        sv.join(mapped(frames()), mapped(frames(), **{"map.keep_frames": False}))


def test_recordings_of_which_one_came_after_the_other_are_one_way():
    first, second = (mapped(some).kept_frames.frames for some in (frames()[:3], frames()[3:6]))
    assert _follow(first, second)
    assert _follow(second, first)
    assert not _follow(first, first)
    assert not _follow([first[0], first[2]], [first[1]])
    assert not _follow([first[1]], [first[0], first[2]])


def test_frames_that_have_one_stamp_are_no_way():
    repeated = [replace(frame, stamp_ns=7) for frame in frames(4)]
    voxel_map = mapped(repeated, **{"trust.ordered": False})
    with pytest.raises(StereovoxError, match=r"frames of camera 0 have the stamp 7; loop closure needs frames"):
        check_one_way(voxel_map.history, voxel_map.kept_frames.frames)
