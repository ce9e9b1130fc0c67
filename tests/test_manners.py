# SPDX-License-Identifier: Apache-2.0
"""What Python users expect: names that complete, types that are found, objects that say what is in them."""

from functools import cache
from importlib.resources import files

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.rigs import Eyes


def test_all_public_names_complete():
    assert set(sv.__all__) <= set(dir(sv))
    assert "import_module" in dir(sv)  # as a module without `__dir__` has it


def test_types_are_found():
    assert files("stereovox").joinpath("py.typed").is_file()


def test_objects_say_what_is_in_them():
    mapper = sv.Mapper(voxel_size=0.2)
    assert repr(mapper.map).startswith(
        "<VoxelMap of 0.2 m cells: 0 free, 0 tentative, 0 occupied; 0 frames, 0 refused; "
    )
    for frame in sv.open_source("sim:room?image_width=160", frames=":3"):
        mapper.add(frame)
    counts = mapper.map.counts()
    said = repr(mapper)
    assert said.startswith("<Mapper: profile 'default'; <VoxelMap of 0.2 m cells: ")
    assert (
        f"{counts['free']:,} free, {counts['tentative']:,} tentative, {counts['occupied']:,} occupied; 3 frames" in said
    )
    assert repr(sv.VoxelMap(sv.load_config(steps=(0.1, 0.1, 0.05), voxel_size=0.1))).startswith(
        "<VoxelMap of 0.1 x 0.1 x 0.05 m"
    )
    field = sv.DistanceField(mapper.map, (0, 0, 0), (2, 1, 1), max_distance=1.0)
    assert repr(field) == "<DistanceField of 10 x 5 x 5 cells of 0.2 x 0.2 x 0.2 m>"
    floor = sv.GridMapper(voxel_size=0.1)
    floor.add(sv.Scan(np.full(90, 2.0, np.float32), -1.5, 0.03, 0.1, 4.0, np.eye(4)))
    assert repr(floor).startswith("<GridMapper: profile 'default'; <GridMap of 0.1 m cells: ")
    assert "1 frames, 0 refused" in repr(floor)


USED = {
    "VoxelMap": "add age ages bounds cast_rays cells cells_in centers check_boxes check_capsules close config counts "
    "frames frames_refused free from_cells history kept_frames listeners lock log_odds memory_bytes nearest_obstacle "
    "occupied overview path probability recording reserved_bytes save snapshot state storage viewpoint voxel_size",
    "GridMap": "add bounds cells config counts frames frames_refused free from_occupancy history lock log_odds "
    "memory_bytes occupancy occupied origin probability recording save state storage voxel_size",
}


@pytest.mark.parametrize("name", USED)
def test_maps_complete_to_what_users_want(name):
    one = getattr(sv, name)(sv.load_config(voxel_size=0.1))
    assert [name for name in dir(one) if not name.startswith("_")] == USED[name].split()


def test_the_nearest_obstacle_is_found_however_far_it_is():
    one = sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.1), [[0, 0, 0], [9000, 0, 0]], [-2.0, 2.0])
    assert one.nearest_obstacle([0.05, 0.05, 0.05]).distance == np.float32(900 - 0.05)
    assert one.nearest_obstacle([0.05, 0.05, 0.05], 5.0).distance == np.inf
    assert sv.VoxelMap(one.config).nearest_obstacle([0, 0, 0]).distance == np.inf


FLAT, DEEP, FLOOR = np.zeros((4, 2)), np.zeros((4, 3)), sv.load_config(voxel_size=0.1)
PICTURE = sv.OccupancyGrid(np.zeros((4, 5), np.int8), 0.1)
EYE = np.eye(3)
CAMERA = sv.PinholeCamera(4, 3, 2.0, 2.0, 1.5, 1.0)


@cache
def space():
    """Not made when tests are collected: that would compile it in each worker."""
    return sv.VoxelMap.from_cells(FLOOR, [[0, 0, 0]], [-2.0])


@cache
def grid():
    return sv.GridMap(FLOOR)


@cache
def field():
    return sv.DistanceField(space(), (0, 0, 0), (1, 1, 1))


MISSHAPEN = {
    "points are (4, 2) float64; give (N, 3) metres": [
        lambda: space().log_odds(FLAT),
        lambda: space().probability(FLAT),
        lambda: space().state(FLAT),
        lambda: space().age(FLAT),
        lambda: space().nearest_obstacle(FLAT),
        lambda: field().distance(FLAT),
        lambda: field().gradient(FLAT),
    ],
    "points are (4, 3) float64; give (N, 2) metres": [
        lambda: grid().log_odds(DEEP),
        lambda: grid().probability(DEEP),
        lambda: grid().state(DEEP),
        lambda: PICTURE.indices(DEEP),
    ],
    "origins are (4, 2) float64; give (N, 3) metres": [lambda: space().cast_rays(FLAT, DEEP, 1.0)],
    "directions are (4, 2) float64; give (N, 3)": [lambda: space().cast_rays(DEEP, FLAT, 1.0)],
    "low is (4, 2) float64; give (N, 3) metres": [lambda: space().check_boxes(FLAT, DEEP)],
    "end is (4, 2) float64; give (N, 3) metres": [lambda: space().check_capsules(DEEP, FLAT, 0.1)],
    "radius is (4, 2) float64; give (N,) metres, or one": [lambda: space().check_capsules(DEEP, DEEP, FLAT)],
    "indices are (4, 2) float64; give (N, 3) whole": [
        lambda: space().centers(FLAT),
        lambda: sv.VoxelMap.from_cells(FLOOR, FLAT, np.zeros(4)),
    ],
    "log_odds are (5,) float64; give (4,)": [lambda: sv.VoxelMap.from_cells(FLOOR, DEEP, np.zeros(5))],
    "low is (2,) int64; give (3,) metres": [lambda: sv.DistanceField(space(), (0, 0), (1, 1))],
    "size is (2,) int64; give (3,) metres": [lambda: sv.DistanceField(space(), size=(1, 1))],
    "start is (2,) int64; give (3,) metres": [lambda: sv.frontiers(space(), start=(0, 1))],
    "waypoints are (4, 2) float64; give (N, 3)": [lambda: sv.check_path(space(), FLAT, 0.1)],
    "origin is (2,) float64; give (3,)": [
        lambda: sv.GridMap(FLOOR, (1.0, 2.0)),
        lambda: sv.OccupancyGrid(PICTURE.cells, 0.1, (1.0, 2.0)),
    ],
    "cells are (4,) int8; give (rows, columns)": [lambda: sv.OccupancyGrid(np.zeros(4, np.int8), 0.1)],
    "rows are (2,) int64; give (N,), as many as columns, which are (3,)": [lambda: PICTURE.centres([1, 2], [1, 2, 3])],
    "T_left_right is (3, 3)": [lambda: Eyes(None, None, EYE)],
}


@pytest.mark.parametrize(("words", "call"), [(words, call) for words, calls in MISSHAPEN.items() for call in calls])
def test_errors_about_shapes_name_the_shape(words, call):
    with pytest.raises(sv.StereovoxError) as error:
        call()
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("depth image is (5, 6)", {"depth": np.ones((5, 6), np.float32)}),
        ("depth image is (3, 4, 1)", {"depth": np.ones((3, 4, 1), np.float32)}),
        ("its shape is (3, 3)", {"T_world_sensor": EYE}),
        ("reason is (2, 2) uint8", {"reason": np.zeros((2, 2), np.uint8)}),
    ],
)
def test_refused_frames_name_the_shape(words, changed):
    frame = sv.Frame(**{"depth": np.ones((3, 4), np.float32), "camera": CAMERA, "T_world_sensor": np.eye(4), **changed})
    assert words in sv.Mapper(voxel_size=0.2).add(frame).detail


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("ranges are (9, 2)", {"ranges": np.ones((9, 2), np.float32)}),
        ("its shape is (3, 3)", {"T_world_sensor": EYE}),
        ("its shape is (3, 3)", {"T_base_sensor": EYE}),
        ("clear is (3,) float32", {"clear": np.ones(3, np.float32)}),
    ],
)
def test_refused_scans_name_the_shape(words, changed):
    given = {"ranges": np.ones(9, np.float32), "T_world_sensor": np.eye(4), **changed}
    scan = sv.Scan(angle_min=0.0, angle_step=0.1, range_min=0.1, range_max=5.0, **given)
    assert words in sv.GridMapper(voxel_size=0.2).add(scan).detail
