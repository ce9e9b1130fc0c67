# SPDX-License-Identifier: Apache-2.0
"""The agreement of a frame with a map: the kernel against plain Python, in each kind of cell, in any order."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.maps import VoxelMap
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.record import glance
from stereovox.maps.record.glance import FEW, KNOWN, SEEN_THROUGH, Agreement

FIRM = 1600


def made(cell, seed=0, blocks=12):
    """A map of some blocks in all states, one of them bare, and evidence on these and others."""
    random = np.random.default_rng(seed)
    config = load_config(**{"map.cell": cell})
    voxel_map = VoxelMap(config)
    coords = random.choice(6**3, blocks, replace=False)
    coords = np.stack([coords // 36, coords // 6 % 6, coords % 6], axis=1).astype(np.int32) - 3
    odds = random.choice([-9, -3.5, -2.5, -1, 0.5, 1.5, 2.5, 9], (blocks, 512))
    cells = voxel_map.storage.cell_format.stored(odds)
    cells[random.random(cells.shape) < 0.3] = voxel_map.storage.cell_format.unknown
    cells[0] = voxel_map.storage.cell_format.stored(-9)
    voxel_map.storage.insert(coords, cells)
    others = coords[: blocks // 2] + np.array([100, 0, 0], np.int32)
    wanted = np.concatenate([coords[:-3], others])
    values = random.choice([0, 0, -619, 300, 1599, 1600, 4000], (len(wanted), 512)).astype(np.int16)
    return voxel_map, Evidence(wanted, values, coords[-3:], -619)


def slow(voxel_map, evidence):
    """The same cell by cell, from the map's own answers."""
    out = dict.fromkeys(("hits", "passes", "into_free", "at_edge", "every"), 0.0)
    stored = {tuple(c): cells for c, cells in zip(*voxel_map.storage.blocks(), strict=True)}
    rules = voxel_map.storage.rules
    free_most, occupied_least = map(int, rules.thresholds)
    unlikely = min(int(rules.prior), int(rules.format.stored(np.log(0.3 / 0.7))))
    likely = max(occupied_least, int(rules.format.stored(np.log(0.7 / 0.3))))
    spoken = [*zip(evidence.coords, evidence.values, strict=True)]
    spoken += [(c, np.full(512, step)) for c, step in zip(evidence.uniform, evidence.uniform_values, strict=True)]
    for coords, values in spoken:
        cells = stored.get(tuple(coords), np.full(512, rules.format.unknown)).astype(int).reshape(8, 8, 8)
        known = cells != rules.format.unknown
        for x, y, z in np.ndindex(8, 8, 8):
            value, number = int(values[64 * x + 8 * y + z]), cells[x, y, z]
            if value >= FIRM:
                out["every"] += value
            if not known[x, y, z]:
                continue
            if number >= likely and value > 0:
                out["hits"] += value
            if number >= (likely + int(rules.highest)) / 2 and value < 0:
                out["passes"] -= value
            if number <= min(free_most, (unlikely + int(rules.lowest)) // 2) and value >= FIRM:
                out["into_free"] += value
                around = [(x - 1, y, z), (x + 1, y, z), (x, y - 1, z), (x, y + 1, z), (x, y, z - 1), (x, y, z + 1)]
                if any(min(at) >= 0 and max(at) < 8 and not known[at] for at in around):
                    out["at_edge"] += value
    return Agreement(**{name: weight / 1000 for name, weight in out.items()})


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
@pytest.mark.parametrize("seed", range(3))
def test_weights_are_those_of_plain_python(cell, seed):
    voxel_map, evidence = made(cell, seed)
    expected = slow(voxel_map, evidence)
    assert min(expected) > 0
    np.testing.assert_allclose(voxel_map.storage.agreement(evidence, FIRM), expected)


def test_the_sample_of_many_blocks_is_fair_and_does_not_depend_on_their_order(monkeypatch):
    voxel_map, evidence = made("int16", blocks=200)
    whole = voxel_map.storage.agreement(evidence, FIRM)
    monkeypatch.setattr(glance, "SAMPLE", 60)
    some = voxel_map.storage.agreement(evidence, FIRM)
    assert some != whole
    np.testing.assert_allclose(some, whole, rtol=0.35)
    order = np.random.default_rng(0).permutation(len(evidence.coords))
    turned = Evidence(evidence.coords[order], evidence.values[order], evidence.uniform[::-1].copy(), -619)
    assert voxel_map.storage.agreement(turned, FIRM) == some


def test_a_frame_is_judged_by_what_is_known_alone():
    assert Agreement(FEW, 0.0, 0.0, 0.0, FEW).against == 0
    assert Agreement(FEW - 1, 0.0, 0.0, 0.0, FEW).against is None
    assert Agreement(FEW, 0.0, 0.0, 0.0, 1.01 * FEW / KNOWN).against is None
    assert Agreement(300.0, 100 / SEEN_THROUGH, 0.0, 0.0, 300.0).against == pytest.approx(0.25)
    assert Agreement(0.0, FEW / SEEN_THROUGH + 1, 0.0, 0.0, 2 * FEW).against == 1
    assert Agreement(0.0, FEW / SEEN_THROUGH - 1, 0.0, 0.0, 2 * FEW).against is None
    assert Agreement(300.0, 0.0, 100.0, 0.0, 300.0).against == 0.25


def test_what_comes_to_light_at_the_edge_counts_no_more_than_the_rest():
    assert Agreement(300.0, 0.0, 200.0, 200.0, 300.0).against == 0
    assert Agreement(300.0, 50 / SEEN_THROUGH, 200.0, 200.0, 300.0).against == pytest.approx(0.25)
    assert Agreement(300.0, 50 / SEEN_THROUGH, 100.0, 50.0, 300.0).against == pytest.approx(1 / 3)
