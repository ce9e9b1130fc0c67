# SPDX-License-Identifier: Apache-2.0
"""What earlier glances say of a frame: does it look through what stood there, or show what was seen from elsewhere?"""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.depth import DepthPipeline
from stereovox.frame import CheckedCloud
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mapping.comparison import _is_in_steps
from stereovox.mapping.glancing import ENOUGH, FEW, NOTHING_SEEN, Looker, kept
from stereovox.maps.record.glance import Glance, binned
from stereovox.maps.record.history import MAX_GLANCES
from stereovox_lab.checks.bad_images import metres

CONFIG = load_config(voxel_size=0.1)
LOOKER = Looker(CONFIG)


@pytest.fixture(scope="module")
def images():
    pipeline = DepthPipeline(CONFIG)
    return [pipeline.image(frame) for frame in sv.open_source("sim:room?image_width=160", frames=":40")]


def looked(image, T=None):
    return image.T_world_sensor if T is None else T, LOOKER.ranges(image)


def said(glances, image, T=None):
    T, ranges = looked(image, T)
    return LOOKER.lately(glances, image.camera, T, ranges)


def glances_of(images):
    found = ()
    for image in images:
        found = kept(found, *looked(image))
    return found


def test_good_frames_agree_with_what_was_seen_lately(images):
    for n in range(1, len(images), 3):
        lately = said(glances_of(images[:n]), images[n])
        assert lately.seen > ENOUGH
        assert lately.through < 0.05 * lately.seen
        assert lately.sensor < 0.5 * lately.world + FEW
        assert not lately.contradicts


def test_an_image_from_elsewhere_is_old(images):
    glances = glances_of(images[:31])
    assert said(glances, images[30], images[35].T_world_sensor).old
    assert not said(glances, images[30]).old
    noise = 1 + 0.002 * np.random.default_rng(0).standard_normal(images[30].depth_m.shape)
    noisy = replace(images[30], depth_m=(images[30].depth_m * noise).astype(np.float32))
    assert said(glances, noisy, images[35].T_world_sensor).old


def test_from_afar_much_is_somewhere_by_chance_and_does_not_count(images):
    far = images[0].T_world_sensor.copy()
    far[:3, 3] += 3.0
    lately = said(glances_of(images[:1]), images[1], far)
    assert (lately.world, lately.sensor) == (0, 0)


def test_what_looks_through_the_known_contradicts(images):
    glances = glances_of(images[:12])
    longer = replace(images[12], depth_m=1.3 * images[12].depth_m)
    assert said(glances, longer).looks_through
    nearer = replace(images[12], depth_m=np.float32(0.5) * images[12].depth_m)
    assert not said(glances, nearer).looks_through  # that marks cells and frees none


def test_a_little_says_nothing(images):
    assert said((), images[0]) == NOTHING_SEEN
    assert not NOTHING_SEEN.contradicts
    assert not NOTHING_SEEN._replace(seen=ENOUGH - 1, through=ENOUGH - 1).contradicts
    assert not NOTHING_SEEN._replace(seen=ENOUGH, sensor=FEW - 1).contradicts
    assert NOTHING_SEEN._replace(seen=ENOUGH, sensor=FEW).contradicts


def test_an_image_repeats_a_glance_from_elsewhere_only(images):
    glance = Glance.of(LOOKER.ranges(images[0]), images[0].T_world_sensor)
    there = replace(images[0], T_world_sensor=images[-1].T_world_sensor)
    assert LOOKER.repeats(glance, there, LOOKER.ranges(there))
    assert not LOOKER.repeats(glance, images[0], LOOKER.ranges(images[0]))
    assert not LOOKER.repeats(glance, images[-1], LOOKER.ranges(images[-1]))
    assert not LOOKER.repeats(None, there, LOOKER.ranges(there))


def test_glances_are_kept_from_poses_apart(images):
    T, ranges = looked(images[0])
    one = kept((), T, ranges)
    assert kept(one, T, ranges) is one
    ahead, turned = T.copy(), T.copy()
    ahead[:3, 3] += 0.11 * one[0].typical_m * T[:3, 2]
    turned[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0.15, 0])
    assert len(kept(one, ahead, ranges)) == len(kept(one, turned, ranges)) == 2
    many = one
    for _ in range(2 * MAX_GLANCES):
        T = T.copy()
        T[:3, 3] += one[0].typical_m
        many = kept(many, T, ranges)
    assert len(many) == MAX_GLANCES
    assert many[-1].pose == tuple(T[:3].ravel().tolist())


def test_clouds_are_looked_at_as_well():
    ends = np.array([[2.0, 0, 0.1], [0, 3.0, 0.1], [0, 0, 4.0], [1e9, 1, 0], [0, -5.0, 0]])
    cloud = CheckedCloud(ends, None, np.array([True] * 4 + [False]), sv.Lidar(), np.eye(4))
    found = LOOKER.ranges(cloud)
    assert np.array_equal(found, binned(ends[:3]))
    assert (found > 0).sum() == 3


def test_a_frozen_camera_frees_nothing_in_a_young_map():
    frames = list(sv.open_source("sim:room?image_width=160", frames=":90"))
    mapper = sv.Mapper(voxel_size=0.1)
    for frame in frames[:30]:
        assert mapper.add(frame).refused is None
    before = mapper.map.state(mapper.map.centers(mapper.map.cells()[0]))
    points = mapper.map.centers(mapper.map.cells()[0])[before == sv.State.OCCUPIED]
    still, random = metres(frames[29]), np.random.default_rng(0)
    reports = [
        mapper.add(
            replace(
                frame,
                depth=(still * (1 + 0.002 * random.standard_normal(still.shape))).astype(np.float32),
                depth_scale=1.0,
                reason=None,
            )
        )
        for frame in frames[30:]
    ]
    refused = [report.refused for report in reports]
    assert refused.count(None) <= 12  # until the camera has moved enough
    assert None not in refused[12:]
    assert (mapper.map.state(points) == sv.State.FREE).mean() < 1e-3
    assert any("seen from elsewhere" in report.detail for report in reports)


def test_depths_in_steps_are_told_from_walls():
    random = np.random.default_rng(5)
    points, off = random.uniform(0.3, 5, (500, 3)), np.full(500, 0.1)
    assert not _is_in_steps(points, off)
    steps = points * [1, 1, 0] + [0, 0, 1] * np.rint(2 * points) / 2
    assert _is_in_steps(steps, off)
    assert not _is_in_steps(steps[:100], off[:100])
    assert not _is_in_steps(steps, 6 * off)  # finer than the noise
    wall = points * [1, 1, 0] + [0, 0, 2]
    assert not _is_in_steps(wall + [0, 0, 0.001] * random.integers(0, 9, (500, 1)), off)
    far = steps / np.linalg.norm(steps, axis=1)[:, None] * np.rint(steps[:, 2:] + 1)
    assert _is_in_steps(far, off)
