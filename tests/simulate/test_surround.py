# SPDX-License-Identifier: Apache-2.0
"""The simulated drone: its photographs are those of one scene, and its depths are true."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import SphericalCamera
from stereovox.errors import SourceError
from stereovox.frame import Reason, StereoFrame
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.opening import open_source
from stereovox.simulate.surround import MOUNTS, Surround

SMALL = "sim:surround?scale=0.25&moments=5"


@pytest.fixture(scope="module")
def drone():
    return Surround(SMALL)


def points_of(frame):
    """World points (N, 3) of the valid pixels of an exact depth image."""
    columns, rows = frame.camera.rays()
    v, u = np.nonzero(frame.reason == Reason.VALID)
    rays = np.column_stack([columns[u], rows[v]]).astype(float)
    return transform_points(frame.T_world_sensor, rays * frame.depth[v, u, None])


def test_pairs_deliver_in_turn_at_one_moment(drone):
    frames = [drone.frame(i) for i in range(4, 8)]
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    assert [frame.pair.name for frame in frames] == ["front", "left", "right", "down"]
    assert {frame.stamp_ns for frame in frames} == {100_000_000}
    assert len(drone) == 20
    bodies = [frame.T_world_sensor @ inverse(frame.pair.T_body_camera) for frame in frames]
    for body in bodies:
        np.testing.assert_allclose(body, drone.body_pose(4), atol=1e-12)
    np.testing.assert_allclose(bodies[0][:3, 2], [0, 0, 1], atol=1e-12)  # level
    assert not np.allclose(drone.body_pose(8), drone.body_pose(4))


def test_cameras_are_those_of_the_thesis():
    """Valenti 2018, Table 3.1, at half its resolution."""
    pairs = {pair.name: pair for pair in Surround().pairs}
    sizes = {name: (pair.eyes.left.width, pair.eyes.left.height) for name, pair in pairs.items()}
    assert sizes == {"front": (960, 540), "left": (640, 360), "right": (640, 360), "down": (640, 360)}
    assert all(pair.camera.baseline == 0.15 == pytest.approx(pair.eyes.baseline) for pair in pairs.values())
    for name, width in (("front", 91.0), ("down", 105.0)):
        camera = pairs[name].camera
        assert isinstance(camera, PinholeCamera)
        assert 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx)) == pytest.approx(width)
        assert pairs[name].eyes.left.fx == camera.fx
    assert isinstance(pairs["left"].camera, SphericalCamera)
    assert 640 / pairs["left"].eyes.left.fx == pytest.approx(np.radians(175))
    looks = {name: pair.T_body_camera[:3, 2] for name, pair in pairs.items()}
    np.testing.assert_allclose(looks["front"], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(looks["down"], [0, 0, -1], atol=1e-12)
    assert looks["left"][1] > 0.9 > 0 > looks["left"][0] > -0.4
    assert looks["right"][1] < -0.9
    np.testing.assert_allclose(pairs["left"].T_body_camera[:3, 1], [0, 0, -1], atol=1e-12)
    for name, pair in pairs.items():
        between = pair.T_body_camera[:3, 3] + 0.075 * pair.T_body_camera[:3, 0]
        np.testing.assert_allclose(between, MOUNTS[name].centre, atol=1e-12)


@pytest.mark.parametrize("i", range(4))
def test_exact_depth_lies_on_surfaces(drone, i):
    points = points_of(drone.exact(i))[::97]
    assert len(points) > 50
    on_one = np.zeros(len(points), bool)
    for solid in drone.scene.solids:
        distance = (solid.planes[:, :3] @ points.T - solid.planes[:, 3:]).max(axis=0)
        on_one |= np.abs(distance) < 2e-4
    assert on_one.all()


@pytest.mark.parametrize("i", range(4))
def test_both_photographs_show_the_same_surfaces(i):
    """A point of the exact depth image is as bright in the left photograph as in the right: lenses, poses and depth."""
    drone = Surround("sim:surround?scale=0.5&moments=5&noise=0")
    frame, points = drone.frame(i), points_of(drone.exact(i))
    eyes, T_world_left = frame.pair.eyes, frame.T_world_sensor
    brightness = []
    for image, lens, T in (
        (frame.left, eyes.left, T_world_left),
        (frame.right, eyes.right, T_world_left @ eyes.T_left_right),
    ):
        pixels = lens.project(transform_points(inverse(T), points))
        outside = ~((pixels > 0) & (pixels < [lens.width - 1, lens.height - 1])).all(axis=1)
        seen = map_coordinates(image.astype(float), np.nan_to_num(pixels.T[::-1]), order=1)
        brightness.append(np.where(outside, np.nan, seen))
    left, right = brightness
    both = np.isfinite(left) & np.isfinite(right)
    assert both.mean() > 0.8
    assert np.corrcoef(left[both], right[both])[0, 1] > 0.93  # what only one eye sees is in it
    assert np.median(np.abs(left[both] - right[both])) < 3
    assert left[both].std() > 12  # there is something to match
    moved = np.roll(right, 7)[both]
    assert np.median(np.abs(left[both] - moved)[np.isfinite(moved)]) > 4


def test_frames_are_the_same_whenever_they_are_asked_for(drone):
    again = Surround(SMALL)
    for i in (0, 7, -1):
        np.testing.assert_array_equal(drone.frame(i).left, again.frame(i).left)
        np.testing.assert_array_equal(drone.frame(i).right, again.frame(i).right)
    other = Surround(SMALL + "&seed=1").frame(0)
    assert 0 < np.abs(other.left.astype(int) - drone.frame(0).left).mean() < 5
    assert drone.frame(0).left.dtype == np.uint8
    with pytest.raises(IndexError):
        drone.frame(20)


def test_one_pair_can_be_picked():
    source = open_source(SMALL + "&pair=down")
    assert isinstance(source, Surround)
    assert len(source) == 5
    assert {frame.pair.name for frame in source} == {"down"}
    np.testing.assert_array_equal(source.frame(1).left.shape, Surround(SMALL).frame(7).left.shape)
    np.testing.assert_allclose(source.frame(1).T_world_sensor, Surround(SMALL).frame(7).T_world_sensor)


@pytest.mark.parametrize(
    ("text", "message"),
    [("pair=up", "pair=up is unknown"), ("scale=9", "scale=9 must be"), ("pairs=front", "did you mean 'pair'")],
)
def test_slips_of_the_pen(text, message):
    with pytest.raises(SourceError, match=message):
        open_source(f"sim:surround?{text}")


def test_masked_where_a_lens_sees_nothing(drone):
    for i in range(4):
        frame = drone.exact(i)
        lens, columns, rows = drone.pairs[i].eyes.left, *frame.camera.rays()
        rays = np.stack(np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:]), axis=-1).reshape(-1, 3)
        u, v = lens.project(rays).T
        outside = ~((u >= 0) & (u <= lens.width - 1) & (v >= 0) & (v <= lens.height - 1))
        masked = frame.reason.ravel() == Reason.MASKED
        assert masked[outside].all()
        assert masked.mean() < 0.3
