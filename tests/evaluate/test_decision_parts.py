# SPDX-License-Identifier: Apache-2.0
"""Decisions by range, thickness and looks: each part against the slow reference, and the parts by hand."""

import itertools
import math
from dataclasses import asdict

import made_decisions
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_scores import neighbours

import stereovox as sv
from stereovox.evaluate.decisions import decide, decision_parts, looks, views
from stereovox.evaluate.scores import score
from stereovox.evaluate.truth import indices, keys
from stereovox.evaluate.truth_cells import Neighbourhood, Thickness, TruthCells, thickness
from stereovox.geometry.se3 import look_at

SIZE = 0.5
LEVELS = {"free": -2.0, "tentative": 0.2, "occupied": 2.0}
CONFIG = sv.load_config(
    voxel_size=SIZE, **{"map.prior": 0.5, "map.log_odds_min": -2.5, "map.free_below": 0.3, "map.occupied_above": 0.7}
)
CELL = st.tuples(*[st.integers(-9, -6) | st.integers(6, 8)] * 3)  # across the borders of blocks, below zero too
OURS = st.dictionaries(CELL, st.sampled_from(list(LEVELS)), max_size=60)
TRUTH = st.dictionaries(CELL, st.booleans(), min_size=1, max_size=60)


def made(cells):
    return sv.VoxelMap.from_cells(CONFIG, list(cells) or np.empty((0, 3)), list(cells.values()))


def made_truth(truth, tolerance=1):
    return TruthCells(made({cell: 3.0 if surface else -2.0 for cell, surface in truth.items()}), tolerance)


def naive_thickness(cell, surface):
    near = np.array([other for other in neighbours(cell, 2) if other in surface], float)
    extents = np.sqrt(12 * np.linalg.eigvalsh(np.cov(near.T, bias=True)) + 1) if len(near) > 1 else np.ones(3)
    wide = sum(extent >= 2.5 for extent in sorted(extents)[:2])
    return ("line", "sheet", "bulk")[wide]


@settings(max_examples=40, deadline=None)
@given(st.sets(CELL, min_size=1, max_size=40), st.integers(2, 4), st.integers(0, 2))
def test_the_spread_is_the_covariance_of_what_lies_near(cells, reach, within):
    found = Neighbourhood(keys(sorted(cells)), reach).spread(within)
    for cell, covariance in zip(sorted(cells), found, strict=True):
        near = np.array([other for other in neighbours(cell, within) if other in cells], float)
        assert covariance == pytest.approx(np.cov(near.T, bias=True) if len(near) > 1 else np.zeros((3, 3)), abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(OURS, TRUTH, st.integers(0, 2), st.data())
def test_a_part_of_the_truth_is_judged_as_those_cells_of_the_whole(ours, truth, tolerance, data):
    chosen = data.draw(st.sets(st.sampled_from(sorted(truth)), min_size=1))
    cells = made_truth(truth, tolerance)
    mask = np.array([tuple(cell) in chosen for cell in indices(cells.cells).tolist()])
    part, voxel_map = cells.part(mask), made({cell: LEVELS[name] for cell, name in ours.items()})
    reading, whole = part.read(voxel_map), cells.read(voxel_map)
    assert asdict(decide(reading, part)) == pytest.approx(made_decisions.decisions(ours, truth, tolerance, chosen))
    assert decide(reading, part) == decide(whole, cells, mask)
    assert np.array_equal(reading.best_within(2), whole.best_within(2)[mask[cells.occupied]])
    assert np.array_equal(part.near_within(1), cells.near_within(1)[mask])
    by = {(one.by, one.name): one.decisions.surface for one in decision_parts(reading, part)}
    lines = [cell for cell in chosen if truth[cell] and naive_thickness(cell, {c for c in truth if truth[c]}) == "line"]
    assert by.get(("thickness", "line"), 0) == len(lines)


SHAPES = {
    "line": [
        {(0, 0, z) for z in range(20)},
        {(x, y, z) for x in (0, 1) for y in (0, 1) for z in range(20)},  # two by two cells
        {(i, i, 2 * i // 3) for i in range(-10, 10)},  # a slanting wire
        {(round(math.sin(i / 5) * 9), i, 4) for i in range(30)},
        {(3, 4, 5)},
    ],
    "sheet": [
        {(x, y, 0) for x in range(15) for y in range(15)},
        {(x, y, z) for x in range(15) for y in range(15) for z in (0, 1)},  # two cells thick
        {(i, i + d, z) for i in range(15) for d in (0, 1) for z in range(15)},  # a diagonal wall, as stairs
        {(x, y, (x + 2 * y) // 3) for x in range(15) for y in range(15)},
    ],
    "bulk": [{(x, y, z) for x in range(9) for y in range(9) for z in range(9)}],
}


@pytest.mark.parametrize(("kind", "cells"), [(kind, cells) for kind, made in SHAPES.items() for cells in made])
def test_lines_sheets_and_bulk_are_told_apart(kind, cells):
    around = Neighbourhood(keys(sorted(cells)), 2)
    found = thickness(around)
    assert np.mean(found == Thickness[kind.upper()]) > (0.8 if kind == "line" else 0.6)
    assert (found != Thickness.LINE).all() or kind == "line"  # edges and corners of a sheet are none


@settings(max_examples=40, deadline=None)
@given(OURS, TRUTH, st.integers(0, 2))
def test_each_part_agrees_with_the_slow_reference(ours, truth, tolerance):
    cells = made_truth(truth, tolerance)
    path, edges = [[-3.0, -3.0, -3.0], [4.0, 4.0, 4.0]], [0.0, 1.0, 2.0, 5.0]
    surface = sorted(cell for cell in truth if truth[cell])
    looked = np.array([i % 40 for i in range(len(surface))], float)
    groups = {}
    for cell in truth:
        near = min(math.dist([(i + 0.5) * SIZE for i in cell], place) for place in path)
        for low, high in itertools.pairwise(edges):
            if low <= near < high:
                groups.setdefault(("range", f"{low:g} to {high:g} m"), set()).add(cell)
    for cell, number in zip(surface, looked, strict=True):
        name = ["0", "1 to 2", "3 to 9", "10 to 29", "30 or more"][sum(number >= least for least in (1, 3, 10, 30))]
        groups.setdefault(("looks", name), set()).add(cell)
        groups.setdefault(("thickness", naive_thickness(cell, set(surface))), set()).add(cell)
    parts = decision_parts(
        cells.read(made({cell: LEVELS[name] for cell, name in ours.items()})), cells, path, edges, looked
    )
    assert {(part.by, part.name) for part in parts} == set(groups)
    for part in parts:
        wanted = made_decisions.decisions(ours, truth, tolerance, groups[part.by, part.name])
        assert asdict(part.decisions) == pytest.approx(wanted), part.by


def naive_views(surface, pose, camera, max_range):
    """Cells with a face whose middle is in the image and reached: the line there is followed in tiny steps."""
    seen, origin = set(), pose[:3, 3]
    for cell in surface:
        for axis, sign in itertools.product(range(3), (-1, 1)):
            face = np.eye(3)[axis] * sign
            point = (np.array(cell) + 0.5 + 0.499 * face) * SIZE
            x, y, z = pose[:3, :3].T @ (point - origin)
            if (origin - point) @ face <= 0 or not 0 < z <= max_range:
                continue
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            if not (-0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5):
                continue
            steps = np.floor((origin + np.linspace(0, 1, 3000)[:, None] * (point - origin)) / SIZE).astype(int)
            first = next(tuple(step) for step in steps.tolist() if tuple(step) in surface)
            if first == cell:
                seen.add(cell)
    return seen


@pytest.mark.parametrize("seed", range(4))
def test_a_cell_is_seen_where_a_line_to_one_of_its_faces_meets_no_other(seed):
    random = np.random.default_rng(seed)
    surface = {(6, y, z) for y in range(-5, 6) for z in range(-3, 4)} | {(3, 0, z) for z in range(-3, 4)}
    surface |= {(x, y, -4) for x in range(7) for y in range(-5, 6)}
    truth = made_truth(dict.fromkeys(surface, True) | {(9, 9, 9): False})
    camera = sv.PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5)
    poses = [look_at(random.uniform(-0.9, 0.9, 3), [3.1, *random.uniform(-1, 1, 2)]) for _ in range(3)]
    found = views(truth, poses, camera, 2.8)
    each = [naive_views(surface, pose, camera, 2.8) for pose in poses]
    wanted = [sum(tuple(cell) in seen for seen in each) for cell in indices(truth.cells[truth.occupied]).tolist()]
    assert found.tolist() == wanted
    assert 0 < np.count_nonzero(found) < len(found)


def test_the_looks_of_a_map_are_those_of_its_own_path(tmp_path):
    frames = list(sv.open_source("sim:box", frames=":8"))
    mapper = sv.Mapper(voxel_size=0.1)
    for frame in frames:
        mapper.add(frame)
    truth = TruthCells(mapper.map)
    found = looks(mapper.map, truth)
    path = mapper.map.history.path
    assert found is not None
    poses = path.poses(next(iter(path.stops)))
    assert found.tolist() == views(truth, poses, frames[0].camera, mapper.map.config.max_range).tolist()
    assert 0 < found.max() <= len(poses)
    names = {part.by for part in score(mapper.map, truth).parts}
    assert names == {"range", "thickness", "looks"}
    mapper.map.save(tmp_path / "box.svox")
    again = looks(sv.load_map(tmp_path / "box.svox"), truth)
    assert again is not None
    assert np.array_equal(again, found)
    assert looks(made({(0, 0, 0): 1.0}), truth) is None
