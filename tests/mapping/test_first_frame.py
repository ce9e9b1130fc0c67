# SPDX-License-Identifier: Apache-2.0
"""A first frame has no map to contradict: it counts once a second one agrees, and is taken out if that contradicts."""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.evaluate.metrics import summarise
from stereovox.mapping import comparison
from stereovox.maps.record.history import TRIES
from stereovox_lab.checks.lasting import FAULTS, Bad, Walk, _always

SETTINGS = {"voxel_size": 0.1, "max_range": 5.0}
WRONG = ["depth x 1.2", "mirrored", "upside down", "0.3 m too far", "plane at 1 m"]


@pytest.fixture(scope="module", params=[False, True], ids=["camera", "lidar"])
def walk(request):
    made = Walk(3, request.param)
    world = _always(made.stage.build())
    return made.frames(5, 0.4, 10, world), made.frames(25, 0.4, 10, world)


def spoilt(walk, kind):
    good, elsewhere = walk
    return FAULTS[kind](good[0], 0, Bad(good, elsewhere, np.random.default_rng(1)))


def same(a, b):
    blocks = zip(a.map.storage.blocks(), b.map.storage.blocks(), strict=True)
    return all(np.array_equal(mine, theirs) for mine, theirs in blocks)


def mapped(frames, **settings):
    mapper = sv.Mapper(**{**SETTINGS, **settings})
    return mapper, [mapper.add(frame) for frame in frames]


@pytest.mark.parametrize("kind", WRONG)
def test_a_bad_first_frame_is_taken_out_by_the_second(walk, kind):
    if kind in ("upside down", "plane at 1 m") and isinstance(walk[0][0], sv.Cloud):
        pytest.skip("a lidar sees nearly the same upside down; what is too near says nothing wrong of free space")
    mapper, (first, second, third) = mapped([spoilt(walk, kind), *walk[0][1:3]])
    assert (first.refused, second.refused, third.refused) == (None, None, None)
    assert (second.taken_out, third.taken_out) == (1, 0)
    assert "begins anew" in second.detail
    assert same(mapper, mapped(walk[0][1:3])[0])
    history = mapper.map.history
    assert (history.frames, dict(history.refused), history.unconfirmed) == (2, {"unconfirmed": 1}, 0)
    told = summarise(mapper.map, [first, second, third])
    assert (told["frames"], told["refused"]) == (2, {"unconfirmed": 1})


def test_until_then_the_map_is_nothing_to_act_on(walk):
    mapper, _ = mapped(walk[0][:1])
    assert mapper.health().state == "waiting"
    assert "no frame has confirmed" in mapper.health().text
    mapper.add(walk[0][1])
    assert (mapper.health().state, mapper.map.history.unconfirmed) == ("current", 0)
    assert mapper.map.frames == 2


def test_a_lone_frame_makes_a_map(walk, tmp_path):
    mapper, _ = mapped(walk[0][:1])
    mapper.save(tmp_path / "a.svox")
    loaded = sv.load_map(tmp_path / "a.svox")
    assert loaded.counts() == mapper.map.counts()
    assert loaded.counts()["free"] > 1000


@pytest.mark.parametrize(
    "settings",
    [{}, {"map.keep_frames": True}, {"window.size": (8.0, 8.0, 4.0)}, {"max_memory": "64MB"}, {"map.keep_times": True}],
    ids=str,
)
def test_nothing_is_left_of_it(walk, settings):
    """Neither cells, kept frames, window nor times; listeners are notified of every block that it saw."""
    mapper = sv.Mapper(**SETTINGS, **settings)
    changed = set()
    mapper.map.storage.listeners.append(lambda evidence: changed.update(map(tuple, evidence.uniform.tolist())))
    mapper.add(spoilt(walk, "depth x 1.2"))
    before = set(map(tuple, mapper.map.storage.coords_in_memory.tolist()))
    changed.clear()
    for frame in walk[0][1:]:
        mapper.add(frame)
    assert before <= changed
    fresh, _ = mapped(walk[0][1:], **settings)
    assert same(mapper, fresh)
    if "map.keep_frames" in settings:
        assert [one.stamp_ns for one in mapper.map.kept_frames.frames] == [one.stamp_ns for one in walk[0][1:]]


def test_a_run_that_stopped_after_it_goes_on_as_if_it_had_not(walk, tmp_path):
    mapper, _ = mapped([spoilt(walk, "mirrored")])
    mapper.save(tmp_path / "a.svox")
    again = sv.Mapper(resume=sv.load_map(tmp_path / "a.svox"), **SETTINGS)
    for frame in walk[0][1:]:
        again.add(frame)
    assert same(again, mapped(walk[0][1:])[0])


def test_a_map_that_was_there_is_never_emptied(walk, tmp_path):
    made, _ = mapped(walk[0])
    made.save(tmp_path / "a.svox")
    again = sv.Mapper(resume=sv.load_map(tmp_path / "a.svox"), **SETTINGS)
    before = again.map.counts()
    assert again.add(replace(spoilt(walk, "depth x 1.2"), stamp_ns=walk[0][-1].stamp_ns + 10**8)).taken_out == 0
    assert again.map.counts()["occupied"] >= before["occupied"] / 2


def test_what_sees_nothing_known_neither_confirms_nor_contradicts(walk):
    far = replace(walk[1][0], stamp_ns=walk[0][0].stamp_ns + 10**8, sensor="another")
    mapper, reports = mapped([walk[0][0], far])
    assert [report.taken_out for report in reports] == [0, 0]
    assert (mapper.map.frames, mapper.health().state) == (2, "waiting")
    assert mapper.add(walk[0][1]).taken_out == 0
    assert mapper.health().state == "current"


def test_many_frames_that_do_not_contradict_each_other_count_as_well(walk, monkeypatch):
    monkeypatch.setattr(comparison, "ENOUGH", 1)
    far = replace(walk[1][0], stamp_ns=walk[0][0].stamp_ns + 10**8, sensor="another")
    mapper, _ = mapped([walk[0][0], far])
    assert mapper.health().state == "current"


@pytest.mark.parametrize("voxel_size", [0.05, 0.02])
def test_small_cells_do_not_make_noise_a_contradiction(voxel_size):
    """A cell smaller than the noise holds no surface of the first frame if the second is off by that noise."""
    source = sv.open_source("sim:room?image_width=160")
    mapper, reports = mapped([source.frame(k) for k in range(2)], voxel_size=voxel_size)
    assert [report.taken_out for report in reports] == [0, 0]
    assert mapper.health().state == "current"


def test_frames_that_never_agree_do_not_begin_anew_for_ever(walk):
    good, bad = walk[0][0], spoilt(walk, "mirrored")
    frames = [replace(bad if n % 2 else good, stamp_ns=10**8 * n) for n in range(TRIES + 4)]
    mapper, reports = mapped(frames, **{"trust.frozen": False})
    assert sum(report.taken_out for report in reports) == TRIES
    assert mapper.map.frames >= 1
    assert mapper.map.history.refused["unconfirmed"] == TRIES


def test_without_a_comparison_everything_counts(walk):
    mapper, reports = mapped([spoilt(walk, "depth x 1.2"), walk[0][1]], **{"trust.max_disagreement": 1})
    assert [report.taken_out for report in reports] == [0, 0]
    assert mapper.health().state == "current"
