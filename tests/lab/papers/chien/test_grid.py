# SPDX-License-Identifier: Apache-2.0
"""Two boxes at many settings: each is mapped as it would be alone, and the verdict counts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.maps import VoxelMap
from stereovox_lab.papers.chien.boxes import Placement, find_boxes
from stereovox_lab.papers.chien.grid import CHOSEN, MODELS, SHARE, Extent, Setting, box_width, chapter, widths_over_grid

SMALL = Extent((CHOSEN,), (0.2,), ((0.0, 0.0), (0.5, 0.0)), (0.08,), (4, 8), ("line",))


def test_each_setting_is_what_it_would_be_alone():
    steps = []
    found = widths_over_grid(SMALL, step=lambda: steps.append(1))
    assert len(steps) == SMALL.images == 16
    assert [(one.place, one.updates) for one in found] == [
        ((0.0, 0.0), 4), ((0.0, 0.0), 8), ((0.5, 0.0), 4), ((0.5, 0.0), 8)]  # fmt: skip
    alone = find_boxes([Placement("large", 2.0), Placement("small", 2.0)], updates=8, integrators=["line"])
    assert found[1].widths == {one.placement.size: one.width for one in alone} == {"large": 2, "small": 2}
    assert found[3].widths["small"] != 2  # half a cell aside it fills one cell and touches two others


def test_a_row_of_cells_before_the_wall_is_counted():
    cells = np.array([[0, 0, 10], [1, 0, 10], [2, 0, 10], [0, 0, 11], [0, 1, 10], [5, 0, 19], [6, 0, 19], [7, 0, 19]])
    voxel_map = VoxelMap.from_cells(load_config("chien2020", **{"window.size": None}), cells, np.full(len(cells), 2.0))
    assert box_width(voxel_map, 3.5) == 3
    assert box_width(voxel_map, 2.0) == 0
    assert box_width(voxel_map, 9.0) == 3


@pytest.mark.parametrize(("wide", "holds"), [(10, True), (9, True), (8, False), (0, False)])
def test_a_statement_holds_where_nine_of_ten_settings_give_it(wide, holds):
    assert SHARE == 0.9
    one = Setting(CHOSEN, 0.2, (0.0, 0.0), 0.08, 50, "line", {"large": 2, "small": 2})
    others = [replace(one, noise=float(n), widths={"large": 2, "small": 2 if n < wide else 1}) for n in range(10)]
    found = [*others, replace(one, cell=0.15)]
    told = chapter(found)
    assert [claim.holds for claim in told.claims] == [holds] * 3
    assert told.claims[0].ours == f"{wide} of 10 settings"
    assert (told.numbers["give_it"], told.numbers["give_it_own_cells"]) == (wide + 1, wide)
    rows = {row[0]: row[1:] for row in told.sheets[0].rows}
    assert rows["all settings"][:4] == (11, 11, wide + 1, wide + 1)
    assert rows["cells of 0.15 m"][:4] == (1, 1, 1, 1)
    assert rows["line drawing"][:4] == (10, 10, wide, wide)


def test_the_first_constants_are_those_of_the_profile():
    profile = load_config("chien2020").sensor.parameters()
    assert MODELS[CHOSEN] == {}
    assert f"k {profile['k']:g} m, p_min {profile['p_free']:g}, clamp {profile['p_max']:g}" == CHOSEN
    for settings in MODELS.values():
        load_config("chien2020", **settings)
