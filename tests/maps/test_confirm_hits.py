# SPDX-License-Identifier: Apache-2.0
"""An unknown cell is occupied after so many frames that hit it, not after fewer; told again in plain numbers."""

from math import floor, log

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import ConfigError
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence, GridEvidence
from stereovox.maps.grid_map import GridMap

NONE = np.empty((0, 3), np.int32)
UNITS = {"int16": (1000, 0), "int8": (32, 0), "uint8": (53 / log(0.7 / 0.3), 127)}


def rules(cell, hits, **more):
    return {"map.cell": cell, "map.confirm_hits": hits, **{f"map.{key}": value for key, value in more.items()}}


def frames_until_occupied(one, thousandths, most=300):
    values = np.full((1, 512), thousandths, np.int16)
    for frame in range(1, most):
        one.add(Evidence(np.zeros((1, 3), np.int32), values, NONE, 0))
        one.frames += 1
        if one.state([[0.01, 0.01, 0.01]])[0] == State.OCCUPIED:
            return frame
    return most


@pytest.mark.parametrize(("cell", "hits"), [
    ("int16", 1), ("int16", 2), ("int16", 3), ("int16", 7), ("int16", 50),
    ("int8", 2), ("int8", 3), ("int8", 7), ("uint8", 2), ("uint8", 3), ("uint8", 10),
])  # fmt: skip
@pytest.mark.parametrize("prior", [0.1, 0.5])
def test_as_many_frames_as_asked_for(cell, hits, prior):
    if prior == 0.5 and hits > 5 and cell != "int16":
        return  # too coarse
    one = VoxelMap(load_config(**rules(cell, hits, prior=prior)))
    assert frames_until_occupied(one, 30000) == hits


@pytest.mark.parametrize("cell", UNITS)
@pytest.mark.parametrize("hits", [2, 5, 20, 39])
def test_never_fewer_whatever_else_is_said(cell, hits):
    one = VoxelMap(load_config(**rules(cell, hits)))
    random = np.random.default_rng(hits)
    hit_frames, values = np.zeros(512, int), np.zeros((1, 512), np.int16)
    occupied = 0
    for _ in range(4 * hits):
        values[0] = random.choice([0, -40, 900, 32767], 512, p=[0.1, 0.1, 0.4, 0.4])
        one.add(Evidence(np.zeros((1, 3), np.int32), values, NONE, 0))
        one.frames += 1
        hit_frames += values[0] > 0
        states = one.storage.rules.states(one.storage.blocks()[1][0])
        assert (hit_frames[states == State.OCCUPIED] >= hits).all()
        occupied += int((states == State.OCCUPIED).sum())
    assert occupied


@pytest.mark.parametrize("cell", UNITS)
def test_equals_plain_numbers(cell):
    config = load_config(**rules(cell, 3))
    one, random = VoxelMap(config), np.random.default_rng(0)
    per_log_odds, unknown = UNITS[cell]
    limits = int(CellRules(config.map).lowest), int(CellRules(config.map).highest)
    start = max(round(unknown + log(0.1 / 0.9) * per_log_odds), limits[0])
    threshold = unknown + floor(round(log(0.4) * per_log_odds, 6)) + 1  # 1.4 (1 - p) < 1
    most = -(-(threshold - start) // 3)
    numbers = [unknown] * 512
    for frame in range(12):
        values = random.integers(-3000, 3000, 512)
        values[random.random(512) < 0.3] = 0
        one.add(Evidence(np.zeros((1, 3), np.int32), values.astype(np.int16)[None], NONE, 0))
        one.frames += 1
        shift = (0.5 + frame * ((5**0.5 - 1) / 2 if cell == "int8" else 0)) % 1
        for c, value in enumerate(values.tolist()):
            step = min(floor(value * per_log_odds / 1000 + shift), most) if value else 0
            if step:
                total = min(max((start if numbers[c] == unknown else numbers[c]) + step, limits[0]), limits[1])
                numbers[c] = total + (total == unknown)
        assert one.storage.blocks()[1][0].tolist() == numbers


def test_one_hit_is_enough_by_default_and_nothing_is_copied():
    one = VoxelMap(load_config())
    evidence = Evidence(np.zeros((1, 3), np.int32), np.full((1, 512), 32767, np.int16), NONE, 0)
    assert one.storage._in_my_units(evidence) is evidence
    assert CellRules(load_config().map).most_rise is None


@pytest.mark.parametrize("cell", UNITS)
@pytest.mark.parametrize("hits", [1, 2, 4])
def test_grids_need_as_many(cell, hits):
    grid = GridMap(load_config("ist2019", **rules(cell, hits)))
    for frame in range(1, 9):
        grid.add(GridEvidence(np.zeros((1, 3), np.int32), np.full((1, 4096), 20000, np.int16)))
        grid.frames += 1
        assert (grid.counts()["occupied"] > 0) == (frame >= hits)


@pytest.mark.parametrize(("cell", "prior", "hits"), [("int8", 0.1, 100), ("uint8", 0.5, 60), ("int16", 0.8, 2)])
def test_more_hits_than_numbers_can_count_are_one_line(cell, prior, hits):
    config = load_config(**rules(cell, hits, prior=prior, free_below=0.3, occupied_above=0.7))
    for make in (VoxelMap, lambda config: GridMap(load_config(config, **{"grid.prior": prior}))):
        with pytest.raises(ConfigError, match=r"map\.confirm_hits .* ask for fewer"):
            make(config)
