# SPDX-License-Identifier: Apache-2.0
"""Cells of one byte: Chien's, 127 unknown, 0 free, 255 occupied above 180 (Chien 2020, 3.5), and the signed one."""

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.maps import State, VoxelMap, load_map, make_map
from stereovox.maps.cells.cell_format import FORMATS, CellRules
from stereovox.maps.cells.evidence import Evidence

WIDE = {"map.log_odds_min": -9.0, "map.log_odds_max": 9.0}
THESIS = {"map.free_below": 0.3, "map.occupied_above": 0.7}
CENTRES = np.array([[0.05, 0.05, 0.05 + 0.1 * k] for k in range(8)])


def byte_map(prior=0.5):
    return VoxelMap(load_config("default", voxel_size=0.1, **{
        "map.cell": "uint8", "map.log_odds_min": -2.1, "map.log_odds_max": 2.1,
        **THESIS, "map.prior": prior}))  # fmt: skip


def add(voxel_map, *first_cells):
    values = np.zeros((1, 512), np.int16)
    values[0, : len(first_cells)] = first_cells
    voxel_map.add(Evidence(np.zeros((1, 3), np.int32), values, np.empty((0, 3), np.int32), 0))


def stored(voxel_map):
    return voxel_map.storage.blocks()[1][0][:8].tolist()


def test_the_thesis_numbers():
    bytes_ = FORMATS["uint8"]
    assert bytes_.stored([0, 100, -100]).tolist() == [127, 255, 0]
    assert bytes_.stored(np.log(0.7 / 0.3)) == 180
    np.testing.assert_allclose(bytes_.log_odds(np.array([180, 127], np.uint8)), [np.log(0.7 / 0.3), 0], rtol=1e-5)


def test_a_byte_adds_up_saturates_and_never_looks_unknown_again():
    one = byte_map()
    per_step = 1000 / FORMATS["uint8"].per_log_odds
    add(one, 800, -800, 8000, -8000, 3, round(per_step))
    assert stored(one) == [177, 77, 255, 0, 127, 128, 127, 127]  # 3 thousandths are less than half a step
    add(one, -800, 800, 8000, -8000, 0, -round(per_step))
    assert stored(one) == [128, 128, 255, 0, 127, 128, 127, 127]  # back at the start is not "unknown"
    add(one, 840)
    assert one.state(CENTRES[:1]) == State.OCCUPIED
    assert one.memory_bytes < 0.6 * VoxelMap(load_config("default")).memory_bytes + 1024 * 20


STATES = [(180, "TENTATIVE"), (181, "OCCUPIED"), (127, "UNKNOWN"), (128, "TENTATIVE"), (73, "FREE"), (75, "TENTATIVE")]


@pytest.mark.parametrize(("number", "state"), STATES)
def test_states_of_bytes(number, state):
    one = byte_map()
    one.storage.insert(np.zeros((1, 3), np.int32), np.full((1, 512), number, np.uint8))
    assert one.state(CENTRES[:1]) == State[state]


def test_a_byte_starts_from_the_prior():
    one = byte_map(prior=0.25)
    start = 127 + round(np.log(0.25 / 0.75) * FORMATS["uint8"].per_log_odds)
    assert start == 58
    step = round(0.4 * FORMATS["uint8"].per_log_odds)
    for n in (1, 2):
        add(one, 400, -400)
        assert stored(one)[:3] == [start + n * step, start - n * step, 127]


def test_free_blocks_reach_zero_and_stay():
    one = byte_map()
    for _ in range(10):
        one.add(Evidence(np.empty((0, 3), np.int32), np.empty((0, 512), np.int16), np.zeros((1, 3), np.int32), -400))
    assert set(stored(one)) == {0}
    add(one, 500)
    assert stored(one)[0] == 31


def test_evidence_too_small_for_a_byte_changes_nothing():
    one = byte_map()
    one.add(Evidence(np.empty((0, 3), np.int32), np.empty((0, 512), np.int16), np.zeros((1, 3), np.int32), -5))
    assert one.counts() == {"free": 0, "tentative": 0, "occupied": 0}
    assert len(one.storage.blocks()[0]) == 0


def test_save_and_load(tmp_path):
    one = byte_map()
    add(one, 800, -800, 8000)
    one.save(tmp_path / "map")
    again = load_map(tmp_path / "map")
    assert again.storage.blocks()[1].dtype == np.uint8
    np.testing.assert_array_equal(again.storage.blocks()[1], one.storage.blocks()[1])
    np.testing.assert_array_equal(again.cells()[1], one.cells()[1])


def test_the_profile_of_the_thesis():
    config = load_config("chien2020")
    rolling = make_map(config)
    assert rolling.storage.cell_format.dtype == np.uint8
    assert (rolling.storage.rules.lowest, rolling.storage.rules.highest) == (0, 255)
    assert (config.voxel_size, config.depth.downsample, config.integrator) == (0.2, 8, "line")
    assert np.prod(np.array(config.window.size) / 0.2).round() == 100 * 30 * 100


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
@pytest.mark.parametrize("prior", [0.05, 0.1, 0.4])
def test_what_evidence_made_likelier_is_never_free(cell, prior):
    config = load_config(**{"map.prior": prior, "map.cell": cell, "map.log_odds_min": -2.0})
    for steps, wanted in (((60,), State.TENTATIVE), ((60, 60), State.TENTATIVE), ((-400,), State.FREE)):
        voxel_map = VoxelMap(config)
        for step in steps:
            values = np.full((1, 512), step, np.int16)
            voxel_map.add(Evidence(np.zeros((1, 3), np.int32), values, np.empty((0, 3), np.int32), 0))
        at_most_free = prior < 0.3 or wanted != State.FREE
        assert voxel_map.state([[0.01, 0.01, 0.01]]).tolist() == [wanted if at_most_free else State.TENTATIVE]


def signed_map(**limits):
    return VoxelMap(load_config(voxel_size=0.1, **{"map.cell": "int8", **THESIS, "map.prior": 0.5}, **limits))


def test_the_signed_byte_holds_the_default_limits():
    signed = FORMATS["int8"]
    assert signed.stored([0, 1, -1, 3.5, -4, -30, 30]).tolist() == [0, 32, -32, 112, -128, -128, 127]
    np.testing.assert_array_equal(signed.log_odds(np.array([112, -128, 0], np.int8)), [3.5, -4, 0])
    one = signed_map()
    assert (one.storage.rules.lowest, one.storage.rules.highest) == (-128, 112)
    add(one, 800, -800, 8000, -8000, 32, -31)
    assert stored(one) == [26, -26, 112, -128, 1, -1, 0, 0]
    add(one, -800, 800, 8000, -8000)
    assert stored(one)[:4] == [1, 1, 112, -128]  # back at the start is not "unknown"
    assert one.storage.blocks()[1].dtype == np.int8
    assert one.memory_bytes < 512 + 12 + VoxelMap(load_config()).memory_bytes + 1


SIGNED_STATES = [
    (-28, "FREE"),
    (-27, "TENTATIVE"),
    (1, "TENTATIVE"),
    (27, "TENTATIVE"),
    (28, "OCCUPIED"),
    (0, "UNKNOWN"),
]


@pytest.mark.parametrize(("number", "state"), SIGNED_STATES)  # 0.3 and 0.7 are -27.1 and 27.1
def test_states_of_signed_bytes(number, state):
    one = signed_map()
    one.storage.insert(np.zeros((1, 3), np.int32), np.full((1, 512), number, np.int8))
    assert one.state(CENTRES[:1]) == State[state]


@pytest.mark.parametrize(("frames", "weak"), [(100, [1, 3, -1, -3, 14, -14, 23, -23]), (1000, [1, 3, -1, -3])])
def test_weak_evidence_adds_up_over_frames(frames, weak):
    """Less than a step in each frame; after a while as many steps as int16 would have counted, to one or two."""
    one = signed_map()
    for one.frames in range(frames):
        add(one, *weak)
    np.testing.assert_allclose(stored(one)[: len(weak)], np.array(weak) * 0.032 * frames, atol=2)


def test_a_frame_before_and_after_a_save_count_alike(tmp_path):
    """What is rounded up in a frame depends on its number, which is saved."""
    whole, half = signed_map(), signed_map()
    steps = np.random.default_rng(0).integers(-60, 60, (50, 512))
    for frame, values in enumerate(steps):
        if frame == 20:
            half.save(tmp_path / "half")
            half = load_map(tmp_path / "half")
        for one in (whole, half):
            add(one, *values)
            one.frames += 1
    np.testing.assert_array_equal(whole.storage.blocks()[1], half.storage.blocks()[1])


def test_chiens_byte_rounds_to_the_nearest_in_every_frame():
    one = byte_map()
    for one.frames in (0, 1, 17):
        add(one, 7, -7, 9)
    assert stored(one)[:3] == [127, 127, 130]


@pytest.mark.parametrize(("missed_obstacle", "false_alarm"), [(18.0, 1.4), (3.0, 3.0), (50.0, 1.05), (2.5, 20.0)])
def test_a_cell_gets_the_state_of_least_expected_cost(missed_obstacle, false_alarm):
    """All three costs are written down for every storable number, and the smallest wins."""
    rules = CellRules(sv.load_config(**{"map.missed_obstacle": missed_obstacle, "map.false_alarm": false_alarm}).map)
    stored = np.arange(rules.lowest, rules.highest + 1)
    stored = stored[stored != rules.format.unknown]
    p = 1 / (1 + np.exp(-stored / 1000))
    costs = np.stack([p * missed_obstacle, np.ones(len(p)), (1 - p) * false_alarm])
    expected = np.array([State.FREE, State.TENTATIVE, State.OCCUPIED])[np.argmin(costs, axis=0)]
    expected[(stored > rules.prior) & (expected == State.FREE)] = State.TENTATIVE
    assert len(set(expected.tolist())) == 3
    np.testing.assert_array_equal(rules.states(stored), expected)


def test_thresholds_of_ones_own_come_before_costs():
    config = sv.load_config(**{"map.free_below": 0.2, "map.missed_obstacle": 50}).map
    assert config.decision == (0.2, pytest.approx(1 - 1 / config.false_alarm))


@pytest.mark.parametrize("prior", [0.03, 0.3, 0.5, 0.7])
def test_with_another_prior_the_same_evidence_decides(prior):
    evidence = np.linspace(-4, 4, 801)
    at = [np.log(p / (1 - p)) for p in (0.1, prior)]
    usual, other = (CellRules(sv.load_config(**{"map.prior": p} | WIDE).map) for p in (0.1, prior))
    expected, found = (
        rules.states(np.rint(1000 * (evidence + start)).astype(int))
        for rules, start in zip((usual, other), at, strict=True)
    )
    assert np.count_nonzero(expected != found) <= 2  # at a threshold, by rounding


@pytest.mark.parametrize("profile", ["default", "safe", "crisp", "chien2020", "valenti2018"])
@pytest.mark.parametrize("cell", FORMATS)
def test_weak_evidence_counts_in_unknown_cells_and_yields_to_what_is_known(profile, cell):
    """Whatever number stands for "unknown": with a prior of 0.1 it is above the threshold of occupied cells."""
    rules = CellRules(load_config(profile, **{"map.cell": cell}).map)
    free, occupied, unknown = *map(int, rules.thresholds), rules.format.unknown
    sure, start = int(rules.sure[2]), int(rules.prior)
    cells = np.array([unknown, start, free, occupied, sure, rules.highest])
    up, down = np.full(6, 40, np.int16), np.full(6, -40, np.int16)
    assert (rules.yielding(up, cells, again=False) > 0).tolist() == [True, True, True, False, False, False]
    assert (rules.yielding(down, cells, again=False) < 0).tolist() == [True, True, True, occupied < sure, False, False]
    assert (rules.yielding(up, cells, again=True) > 0).tolist() == [False, start <= free, True, False, False, False]
    assert not rules.yielding(down, cells, again=True).any()
