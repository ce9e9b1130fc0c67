# SPDX-License-Identifier: Apache-2.0
"""What the thesis claims of its boxes and its aisle holds in small variants of the experiments."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.maps import VoxelMap
from stereovox_lab.papers.chien.aisle import AisleFound, Variant, compare_aisles
from stereovox_lab.papers.chien.aisle import claims_of as aisle_claims
from stereovox_lab.papers.chien.boxes import Placement, claims_of, find_box, find_boxes, random_placements


@pytest.fixture(scope="module")
def two_boxes():
    return find_boxes([Placement("large", 2.0), Placement("small", 2.0)], updates=40)


def test_both_boxes_are_two_cells_wide_at_two_metres(two_boxes):
    assert [(found.placement.size, found.integrator, found.width) for found in two_boxes] == [
        ("large", "line", 2), ("large", "ray", 2), ("small", "line", 2), ("small", "ray", 2)]  # fmt: skip


def test_boxes_are_no_more_than_a_cell_off_and_hide_what_is_behind(two_boxes):
    for found in (*two_boxes, *find_boxes(list(random_placements(3, seed=5)), updates=20)):
        assert found.within_one_cell, found.figures()
        assert found.hidden_known == 0
    assert two_boxes[0].hidden > 30


def test_a_box_out_of_place_is_noticed(two_boxes):
    found = two_boxes[0]
    moved = find_box(found.voxel_map, Placement("large", 2.0, x=0.7))
    assert not moved.within_one_cell
    assert not find_box(VoxelMap(found.voxel_map.config), found.placement).within_one_cell


def broken(voxel_map, how):
    """A map of the same scene that is wrong."""
    cells, log_odds = voxel_map.cells()
    limits = voxel_map.config.map
    cells, log_odds = cells.astype(np.int64), np.clip(log_odds, limits.log_odds_min, limits.log_odds_max)
    wrong = {
        "aside": (cells + np.array([2, 0, 0]), log_odds),
        "opposite": (cells, -log_odds),
        "nothing": (cells[:0], log_odds[:0]),
        "all occupied": (cells, np.full(len(cells), limits.log_odds_max)),
        "all free": (cells, np.full(len(cells), limits.log_odds_min)),
    }
    return VoxelMap.from_cells(load_config(voxel_map.config, **{"window.size": None}), *wrong[how])


def test_every_claim_about_boxes_fails_with_some_broken_map(two_boxes):
    names = ("aside", "opposite", "nothing", "all occupied", "all free")
    held, failed = claims_of(two_boxes, two_boxes), {}
    assert [claim.holds for claim in held] == [True] * 6
    for how in names:
        wrong = [find_box(broken(one.voxel_map, how), one.placement, one.integrator) for one in two_boxes]
        for n, claim in enumerate(claims_of(wrong, wrong)):
            failed.setdefault(n, []).extend([how] * (claim.holds is False))
    assert all(failed.values()), failed
    assert {how for found in failed.values() for how in found} == set(names)


def test_a_shadow_that_holds_no_cell_is_not_judged(two_boxes):
    none = [replace(one, hidden=0, hidden_known=0) for one in two_boxes]
    shadows = [claim for claim in claims_of(none, none) if "shadow" in claim.text]
    assert [(claim.holds, claim.unjudged != "") for claim in shadows] == [(None, True)] * 2


def test_every_claim_about_the_aisle_fails_with_some_result():
    def variant(name, integrator, downsample=1, wanted=False, found=0.5, against=0.97, stray=0.2):
        return AisleFound(
            Variant(name, integrator, downsample, wanted=wanted), None, 100, found, 1.0, against, stray, 1.0
        )

    exact, far, near = variant("exact", "ray", found=0.95), variant("4", "line", 4, found=0.4), variant("8", "line", 8)
    good = [exact, replace(far, found=0.6), replace(near, found=0.1), variant("ours", "projective", wanted=True)]
    assert [claim.holds for claim in aisle_claims(good)] == [True] * 4
    wrong = [
        [good[0], good[2], good[1], good[3]],
        [replace(exact, found=0.5), *good[1:]],
        [*good[:3], replace(good[3], against_full=0.9)],
        [*good[:3], replace(good[3], stray=0.3)],
    ]
    assert [[claim.holds for claim in aisle_claims(each)].index(False) for each in wrong] == [0, 1, 2, 3]
    assert not aisle_claims([*good[:3], replace(good[3], found=0.0, stray=0.0)])[3].holds


def test_the_far_end_of_the_aisle_is_lost_by_block_minima_and_kept_by_the_footprint_rule():
    found, _ = compare_aisles(frames=12)
    shares = {(one.variant.integrator, one.variant.update, one.variant.downsample): one for one in found}
    assert shares["ray", "once", 1].found > 0.9
    assert shares["projective", "every", 1].against_full >= 0.95
    assert shares["line", "every", 8].against_full < 0.2
    assert shares["projective", "every", 1].near_found > 0.9
