# SPDX-License-Identifier: Apache-2.0
"""The law: a map is the same bit for bit for any number of threads and any split of the run by save and load."""

import tempfile

import made_flights as made
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereovox.config import load_config
from stereovox.maps import load_map, make_map
from stereovox.maps.cells import cell_pool
from stereovox.maps.cells.evidence import GridEvidence
from stereovox.maps.grid_map import GridMap, load_grid

WINDOWS = {
    "unbounded": {},
    "drop": {"window.size": [3.2, 3.3, 2.5], "window.trigger": 0.3},
    "keep": {"window.size": [3.2, 3.3, 2.5], "window.trigger": 0.3, "window.outside": "keep"},
}


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 999), threads=st.sampled_from([2, 3]), cuts=st.sets(st.integers(0, 13), max_size=2))
def test_threads_and_splits_change_nothing(window, cell, seed, threads, cuts):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell_pool, "WORTH_A_THREAD", 2)
        map_rules = {"map.cell": cell, "map.keep_times": True, "map.forget_s": 2.0, "map.confirm_hits": 2}
        config = load_config("default", voxel_size=0.1, **map_rules, **WINDOWS[window])
        moments = list(made.flight(seed, 14))
        whole = made.fly(make_map(config), moments)
        parallel = load_config(config, threads=threads)
        split, done = make_map(parallel), 0
        for cut in sorted(cuts):
            made.fly(split, moments[done:cut])
            with tempfile.TemporaryDirectory() as folder:
                split.save(f"{folder}/m")
                split.close()
                split, done = make_map(parallel, load_map(f"{folder}/m")), cut
        made.fly(split, moments[done:])
        made.assert_same(split, whole)
        split.close()
        whole.close()


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
def test_a_grid_is_the_same_for_any_split(cell, tmp_path):
    config = load_config("ist2019", **{"map.cell": cell, "map.confirm_hits": 2})
    random, whole, split = np.random.default_rng(0), GridMap(config), GridMap(config)
    for frame in range(9):
        if frame in (3, 7):
            split.save(tmp_path / "grid.npz")
            split = load_grid(tmp_path / "grid.npz")
            split.storage.continue_with(config)
        coords = np.array([[frame // 3, 0, 0], [9, frame % 2, 0]], np.int32)
        evidence = GridEvidence(coords, random.integers(-900, 900, (2, 4096)).astype(np.int16))
        for one in (whole, split):
            one.storage.check_room(evidence)
            one.add(evidence)
            one.frames += 1
    for a, b in zip(whole.storage.tiles(), split.storage.tiles(), strict=True):
        np.testing.assert_array_equal(a, b)
