# SPDX-License-Identifier: Apache-2.0
"""The apartment's walls are measured as what they are, in maps made by hand and in a short scan."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.truth import indices, keys, touched_cells
from stereovox.maps import VoxelMap
from stereovox.simulate.recorder import OPENGL, follow
from stereovox.simulate.scene import box
from stereovox.simulate.simulation import Simulation
from stereovox.simulate.t265 import T265
from stereovox_lab.papers.chien.apartment import Scan, scan_apartment
from stereovox_lab.papers.chien.rooms import grown, measure_face, measure_rooms, outer_corners

SIZE = 0.05


@pytest.fixture(scope="module")
def stage():
    simulation = Simulation("sim:apartment")
    return simulation.stage.moved(OPENGL @ follow(simulation, T265())[1])


@pytest.fixture(scope="module")
def face_cells(stage):
    """The cells that each side of each room touches."""
    return {face.name: touched_cells(face.corners[[[0, 1, 2], [0, 2, 3]]], SIZE) for face in stage.faces}


def map_of(cells):
    return VoxelMap.from_cells(load_config(voxel_size=SIZE), cells, np.full(len(cells), 3.0))


@pytest.fixture(scope="module")
def perfect(face_cells):
    cells = np.concatenate(list(face_cells.values()))
    return map_of(cells), np.unique(keys(cells))


@pytest.fixture(scope="module")
def measured(stage, perfect):
    """The rooms of the perfect map."""
    return measure_rooms("perfect", perfect[0], stage, perfect[1])


def test_a_perfect_map_is_thin_straight_and_square(measured):
    figures = measured.figures()
    assert figures["walls"] == 24
    assert figures["missing"] == {}
    assert figures["solid_share"] == figures["found"]
    assert figures["thickness_p95"] <= 2
    assert figures["straightness_max_m"] < SIZE / 2
    assert figures["corners"] == 24
    assert set(figures["outer_corners_deg"]) == {"west south", "south east", "east north", "north west"}
    assert figures["outer_corner_error_max_deg"] < 0.2
    assert [wall["thickness_p95"] for wall in figures["outer_walls"]] == [1] * 4


def test_a_wall_that_is_thick_and_only_that_one(stage, face_cells, perfect):
    face = next(face for face in stage.faces if face.name == "kitchen east")
    shift = np.rint(face.normal).astype(int)
    cells = np.concatenate([indices(perfect[1]), *(face_cells[face.name] + n * shift for n in (1, 2))])
    doubled, seen = map_of(np.unique(cells, axis=0)), perfect[1]
    assert np.median(measure_face(doubled, face, seen).thickness) == 3
    other = next(face for face in stage.faces if face.name == "study south")
    assert np.percentile(measure_face(doubled, other, seen).thickness, 95) <= 2


def test_the_far_side_of_an_inner_wall_is_another_rooms(stage, face_cells, perfect):
    near, far = (next(face for face in stage.faces if face.name == name) for name in ("bath east", "study west"))
    both = map_of(np.unique(np.concatenate([face_cells[near.name], face_cells[far.name]]), axis=0))
    for face in (near, far):
        found = measure_face(both, face, perfect[1])
        assert np.percentile(found.thickness, 95) <= 2
        assert abs(found.offset) < SIZE


def test_a_wall_that_was_seen_and_is_not_there_makes_the_walls_less_than_solid(stage, face_cells, perfect, measured):
    lost = "kitchen east"
    cells = np.concatenate([cells for name, cells in face_cells.items() if name != lost])
    found = measure_rooms("without", map_of(np.unique(cells, axis=0)), stage, perfect[1])
    assert found.missing == {lost: measured.walls[lost].columns}
    figures = found.figures()
    assert figures["found"] > 0.95
    assert figures["solid_share"] < 0.97 * measured.figures()["solid_share"]


def test_a_map_without_walls_is_refused_in_one_line(stage, perfect):
    with pytest.raises(StereovoxError, match="empty: not one wall stands"):
        measure_rooms("empty", VoxelMap(load_config(voxel_size=SIZE)), stage, perfect[1])


def test_a_turned_wall_turns_two_corners(measured):
    walls = measured.outer
    turn = np.radians(3)
    west = walls["west"]
    x, y, z = west.normal
    turned = np.array([np.cos(turn) * x + np.sin(turn) * z, y, np.cos(turn) * z - np.sin(turn) * x])
    corners = outer_corners({**walls, "west": type(west)(west.name, west.thickness, 1, 0.0, 0.0, turned)})
    assert sorted(abs(corners[name] - 90) > 2 for name in corners) == [False, False, True, True]
    assert abs(corners["south east"] - 90) < 0.2


def test_a_grown_box_is_larger_on_every_side():
    small = box("a", "b", (1, 2, 3), (2, 4, 6), turn=0.3)
    large = grown(small, 0.5)
    assert np.ptp(large.planes[:, 3] - small.planes[:, 3]) < 1e-9
    np.testing.assert_allclose(large.planes[:, 3] - small.planes[:, 3], 0.5, atol=1e-6)


def test_a_short_scan_sees_walls_where_they_are():
    scans = [Scan("default", poses, (("voxel_size", 0.1),)) for poses in ("T265", "exact")]
    found = scan_apartment(every=45, scans=scans)
    tracked, exact = (scan.figures() for scan in found.scans)
    assert (exact["frames"], exact["frames_refused"]) == (21, 0)
    assert tracked["frames"] >= 19
    assert exact["thickness_p95"] <= 2
    assert abs(exact["offset_rms_m"]) < 0.05
    assert tracked["offset_rms_m"] > exact["offset_rms_m"]
    off = found.drift_m[np.isfinite(found.drift_m)]
    assert 0.01 < np.median(off) < 0.3
    assert off[-1] < off.max() / 2  # it found its first places again
