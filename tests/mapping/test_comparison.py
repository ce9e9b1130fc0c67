# SPDX-License-Identifier: Apache-2.0
"""The pose at which a camera's image would be on the surfaces of a map."""

from dataclasses import replace

import numpy as np
import pytest
from entrance_cases import good

import stereovox as sv
from stereovox.config import load_config
from stereovox.depth import DepthPipeline
from stereovox.geometry.se3 import inverse
from stereovox.mapping.comparison import pose_on_surfaces
from stereovox_lab.checks.bad_images import displaced

NARROW = sv.PinholeCamera(64, 48, 400.0, 400.0, 31.5, 23.5, 0.1)


@pytest.fixture(scope="module")
def room():
    mapper = sv.Mapper(voxel_size=0.1)
    frames = list(sv.open_source("sim:room", frames=":60:3"))
    for frame in frames:
        mapper.add(frame)
    return mapper.map, frames[-1]


@pytest.mark.parametrize("shift_m", [(0.2, 0, 0), (0, -0.2, 0.1), (0, 0, 0)])
@pytest.mark.parametrize("turn_deg", [(0, 5, 0), (-3, 0, 4), (0, 0, 0)])
def test_a_displaced_camera_is_found(room, shift_m, turn_deg):
    voxel_map, frame = room
    image = DepthPipeline(load_config(voxel_size=0.1)).image(displaced(frame, np.array(shift_m), np.radians(turn_deg)))
    found = pose_on_surfaces(voxel_map, image)
    if not any(shift_m) and not any(turn_deg):
        assert found is None  # it is there already
        return
    off = inverse(np.asarray(frame.T_world_sensor, float)) @ found
    assert np.linalg.norm(off[:3, 3]) < 0.1  # a cell
    assert np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2)) < 2.0


def test_nothing_is_found_where_nothing_is_near(room):
    voxel_map, frame = room
    T = np.asarray(frame.T_world_sensor, float).copy()
    T[:3, 3] += 1000
    image = DepthPipeline(load_config(voxel_size=0.1)).image(frame)
    assert pose_on_surfaces(voxel_map, replace(image, T_world_sensor=T)) is None
    assert pose_on_surfaces(voxel_map, replace(image, depth_m=np.full_like(image.depth_m, np.inf))) is None


@pytest.mark.parametrize("height", [1, 4, 7])
def test_images_of_few_rows_are_looked_for_as_well(room, height):
    camera = sv.PinholeCamera(640, height, 300, 300, 319.5, (height - 1) / 2)
    voxel_map, frame = room
    image = DepthPipeline(load_config()).image(sv.Frame(np.full((height, 640), 2.0), camera, frame.T_world_sensor))
    assert pose_on_surfaces(voxel_map, image) is None or height == 7


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far_m", [1e9, 1e150])
def test_points_beyond_the_map_do_not_count(far_m):
    """A lidar may return any range, in enough points to have normals; a frame in doubt is compared with the map."""
    lean = np.random.default_rng(1).uniform(-1, 1, (400, 2))
    far = far_m * np.column_stack([np.ones(400), lean])
    found = []
    for more in (far[:0], far):
        mapper = sv.Mapper(voxel_size=0.1, max_range=5.0)
        clouds = [good("cloud", n) for n in range(5)]
        clouds[3] = replace(clouds[3], points=0.7 * clouds[3].points)
        reports = [mapper.add(replace(cloud, points=np.concatenate([cloud.points, more]))) for cloud in clouds]
        found.append(([report.refused for report in reports], mapper.map.counts()["occupied"]))
    assert found[0][0] == [None, None, None, "disagrees_with_map", None]
    assert found[0][0] == found[1][0]
    assert found[1][1] == pytest.approx(found[0][1], rel=0.03)  # what comes before them is seen through


def test_a_saved_map_holds_no_cells_that_cannot_be_read(tmp_path):
    """Poses beyond the range of cell numbers are refused earlier, whatever the cells' sides."""
    rng = np.random.default_rng(2)
    for steps in ((0.002, 0.002, 0.0005), (0.004, 0.001, 0.001)):
        mapper = sv.Mapper(steps=steps, max_range=1.0, **{"trust.max_speed_mps": 1e12, "trust.ordered": False})
        limits = 2**30 * np.array(steps)
        for n in range(6):
            place = np.minimum(0.9e6, limits * rng.choice([0.9, 0.997, 0.999, 1.001], 3))
            frame = good("depth image", n)
            T = np.array(frame.T_world_sensor)
            T[:3, 3] = place * rng.choice([-1, 1], 3)
            report = mapper.add(replace(frame, camera=NARROW, T_world_sensor=T))
            assert (report.refused == "pose_too_far") == bool((np.abs(place) > limits - 2**21 * np.array(steps)).any())
        mapper.save(tmp_path / "map")
        assert sv.load_map(tmp_path / "map").counts() == mapper.map.counts()
