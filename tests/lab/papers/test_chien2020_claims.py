# SPDX-License-Identifier: Apache-2.0
"""What the thesis claims of its boxes and its aisle holds in small variants of the experiments."""

import pytest

from stereovox.lab.papers.chien.aisle import compare_aisles
from stereovox.lab.papers.chien.boxes import Placement, find_box, find_boxes, random_placements
from stereovox.maps import VoxelMap


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


def test_the_far_end_of_the_aisle_is_lost_by_block_minima_and_kept_by_the_footprint_rule():
    found, _ = compare_aisles(frames=12)
    shares = {(one.variant.integrator, one.variant.update, one.variant.downsample): one for one in found}
    assert shares["ray", "once", 1].found > 0.9
    assert shares["projective", "every", 1].against_full >= 0.95
    assert shares["line", "every", 8].against_full < 0.2
    assert shares["projective", "every", 1].near_found > 0.9
