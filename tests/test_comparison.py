# SPDX-License-Identifier: Apache-2.0
"""Where a camera would have to stand for its image to lie on the surfaces of a map."""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.comparison import pose_on_surfaces
from stereovox.config import load_config
from stereovox.depth import DepthPipeline
from stereovox.lab.checks.bad_images import displaced
from stereovox.se3 import inverse


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
