# SPDX-License-Identifier: Apache-2.0
"""Frames that show what was seen from elsewhere are found whatever their noise, and good frames are not."""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.depth import DepthPipeline
from stereovox.frame import CheckedCloud
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mapping.gate import CHECKED, FEW, STEP, FrozenViews, is_frozen, jumped, moved_on, with_glance
from stereovox.maps.record.glance import binned
from stereovox.maps.record.history import MAX_GLANCES, StampedPose
from stereovox_lab.checks.bad_images import metres

CONFIG = load_config(voxel_size=0.1)
VIEWS = FrozenViews(CONFIG)


@pytest.fixture(scope="module")
def images():
    pipeline = DepthPipeline(CONFIG)
    return [pipeline.image(frame) for frame in sv.open_source("sim:room?image_width=160&seed=5", frames=":40")]


def at(T, stamp_ns=0):
    return StampedPose(stamp_ns, tuple(T[:3].ravel().tolist()))


def glances_of(images):
    found = ()
    for image in images:
        found = with_glance(found, at(image.T_world_sensor, image.stamp_ns), VIEWS.ranges(image))
    return found


def frozen(glances, image, T=None):
    T = image.T_world_sensor if T is None else T
    return is_frozen(*VIEWS.unmoved(glances, image.camera, T, VIEWS.ranges(image)))


def test_good_frames_are_not_frozen(images):
    for n in range(1, len(images), 3):
        assert not frozen(glances_of(images[:n]), images[n])


def test_an_image_from_elsewhere_is_frozen(images):
    glances, there = glances_of(images[:31]), images[34].T_world_sensor
    assert frozen(glances, images[30], there)
    assert not frozen(glances, images[30])
    noise = 1 + 0.002 * np.random.default_rng(0).standard_normal(images[30].depth_m.shape)
    assert frozen(glances, replace(images[30], depth_m=(images[30].depth_m * noise).astype(np.float32)), there)


def test_from_afar_points_are_unmoved_by_chance_and_do_not_count(images):
    far = images[0].T_world_sensor.copy()
    far[:3, 3] += 3.0
    assert VIEWS.unmoved(glances_of(images[:1]), images[1].camera, far, VIEWS.ranges(images[1])) == (0, 0)


def test_points_are_counted_as_one_does_by_hand(images):
    """Each glance by itself; a point counts where it would be seen, and only if the two hypotheses differ."""
    camera, (height, width) = images[0].camera, images[0].depth_m.shape
    blocks = np.random.default_rng(2).uniform(1, 3, (height // 20 + 1, width // 20 + 1))
    depth = np.kron(blocks, np.ones((20, 20)))[:height, :width].astype(np.float32)
    image = replace(images[0], depth_m=depth, T_world_sensor=np.eye(4))
    glances = with_glance((), at(np.eye(4)), VIEWS.ranges(image))
    aside = np.eye(4)
    aside[0, 3] = 0.25
    in_sensor, in_world = VIEWS.unmoved(glances, camera, aside, VIEWS.ranges(image))
    assert in_sensor > FEW
    assert in_world < in_sensor / 3
    assert VIEWS.unmoved(glances * 2, camera, aside, VIEWS.ranges(image)) == (2 * in_sensor, 2 * in_world)
    assert VIEWS.unmoved(glances, camera, np.eye(4), VIEWS.ranges(image)) == (0, 0)
    assert VIEWS.unmoved((), camera, aside, VIEWS.ranges(image)) == (0, 0)


@pytest.mark.parametrize(
    ("in_sensor", "in_world", "found"),
    [(FEW, 0, True), (FEW - 1, 0, False), (60, 40, False), (61, 40, True), (0, 0, False)],
)
def test_how_many_points_show_it(in_sensor, in_world, found):
    assert is_frozen(in_sensor, in_world) is found


def test_glances_are_kept_from_poses_apart(images):
    T, ranges = images[0].T_world_sensor, VIEWS.ranges(images[0])
    one = with_glance((), at(T), ranges)
    assert with_glance(one, at(T), ranges) is one
    ahead, turned = T.copy(), T.copy()
    ahead[:3, 3] += 0.11 * one[0].typical_m * T[:3, 2]
    turned[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0.15, 0])
    assert len(with_glance(one, at(ahead), ranges)) == len(with_glance(one, at(turned), ranges)) == 2
    many = one
    for _ in range(2 * MAX_GLANCES):
        T = T.copy()
        T[:3, 3] += one[0].typical_m
        many = with_glance(many, at(T), ranges)
    assert len(many) == MAX_GLANCES
    assert many[-1].pose == tuple(T[:3].ravel().tolist())


@pytest.mark.parametrize(
    ("step_m", "step_deg", "ms", "found"),
    [(0.1, 0, 100, False), (0.6, 0, 100, True), (0.6, 0, 600, False), (0, 30, 100, True), (0, 2, 100, False)],
)
def test_a_pose_that_jumps_is_not_a_frozen_image(images, step_m, step_deg, ms, found):
    """The sensor moved by 0.1 m in each 100 ms until then: 0.6 m in 600 ms are no jump."""
    ranges = VIEWS.ranges(images[0])
    T = images[0].T_world_sensor
    before, now = T.copy(), T.copy()
    before[0, 3] += 0.1
    now[0, 3] += 0.1 + step_m
    now[:3, :3] = T[:3, :3] @ rotation_matrix([0, np.radians(step_deg), 0])
    glances = with_glance((), at(T), ranges)
    assert jumped(glances, at(before, 10**8), at(now, 10**8 + ms * 10**6)) is found
    assert not jumped(glances, at(before, 0), at(now, ms * 10**6))  # how fast it moved is unknown
    assert not jumped((), at(before, 10**8), at(now, 10**9))


def test_frames_are_compared_once_the_sensor_has_moved_a_part_of_a_step(images):
    (glance,) = with_glance((), at(np.eye(4)), VIEWS.ranges(images[0]))
    part_m = STEP * glance.typical_m / CHECKED

    def pose(parts, deg=0.0):
        T = np.eye(4)
        T[0, 3], T[:3, :3] = parts * part_m, rotation_matrix([0, np.radians(deg), 0])
        return at(T).pose

    assert not moved_on(glance, pose(0.1), pose(0.9))
    assert moved_on(glance, pose(0.9), pose(1.1))
    assert moved_on(glance, pose(0.1), pose(0.1, 2.1))
    assert not moved_on(glance, pose(2.1, 1), pose(2.9, 1.9))
    assert moved_on(glance, pose(0), pose(3.5))


def test_clouds_have_directions_too():
    ends = np.array([[2.0, 0, 0.1], [0, 3.0, 0.1], [0, 0, 4.0], [1e9, 1, 0], [0, -5.0, 0]])
    cloud = CheckedCloud(ends, None, np.array([True] * 4 + [False]), sv.Lidar(), np.eye(4))
    found = VIEWS.ranges(cloud)
    assert np.array_equal(found, binned(ends[:3]))
    assert (found > 0).sum() == 3


def freeze(frame, still, random):
    noisy = (still * (1 + 0.002 * random.standard_normal(still.shape))).astype(np.float32)
    return replace(frame, depth=noisy, depth_scale=1.0, reason=None)


def test_a_frozen_camera_frees_hardly_anything_in_a_young_map():
    frames = list(sv.open_source("sim:room?image_width=160", frames=":90"))
    still, random = metres(frames[29]), np.random.default_rng(0)
    guarded, open_ = sv.Mapper(voxel_size=0.1), sv.Mapper(voxel_size=0.1, **{"trust.frozen": False})
    freed = []
    for mapper in (guarded, open_):
        for frame in frames[:30]:
            assert mapper.add(frame).refused is None
        points = mapper.map.centers(mapper.map.cells()[0])
        points = points[mapper.map.state(points) == sv.State.OCCUPIED]
        reports = [mapper.add(freeze(frame, still, random)) for frame in frames[30:]]
        freed.append((mapper.map.state(points) == sv.State.FREE).sum())
    assert not any("a view from elsewhere" in report.detail for report in reports)  # the last mapper's
    assert freed[0] < 0.25 * freed[1]


def test_a_frozen_camera_is_refused_with_its_cure_and_good_frames_follow():
    frames = list(sv.open_source("sim:room?image_width=160&seed=8", frames=":60"))
    mapper = sv.Mapper(voxel_size=0.1)
    for frame in frames[:32]:
        mapper.add(frame)
    report = mapper.add(freeze(frames[37], metres(frames[31]), np.random.default_rng(1)))
    assert report.refused == "frozen_image"
    assert report.detail.startswith(f"{frames[37].name}: it repeats a view from elsewhere (")
    assert report.detail.endswith("or correct its pose")
    assert mapper.add(frames[37]).refused is None
