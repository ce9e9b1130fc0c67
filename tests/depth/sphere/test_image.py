# SPDX-License-Identifier: Apache-2.0
"""A spherical grid as a depth image: its pixels see what its cells hold."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import SphericalCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.sphere import SphereLayout, accumulate, empty, frame_of, gather, through_sphere
from stereovox.frame import DepthImage, Frame, Reason
from stereovox.geometry.se3 import rotation_matrix, transform_points
from stereovox.mapper import Mapper
from stereovox.sensors.noise import SUBPIXEL, RangeNoise


def settings(step=5.0, **sphere):
    named = {f"sphere.{key}": value for key, value in {"step_deg": step, **sphere}.items()}
    return load_config(min_range=0.2, max_range=8.0, **{"depth.denoise": False}, **named)


def pose(seed=0):
    random = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(random.normal(size=3)), random.normal(size=3)
    return T


def points_of(image):
    """World points (N, 3) of the valid pixels of a depth image, and where they are in it."""
    columns, rows = image.camera.rays()
    v, u = np.nonzero(image.reason == Reason.VALID)
    rays = np.column_stack([columns[u], rows[v]]).astype(float)
    return transform_points(image.T_world_sensor, rays * image.depth_m[v, u, None]), (v, u)


@pytest.mark.parametrize("bounds", [{}, {"polar_deg": (30.0, 121.0), "azimuth_deg": (100.0, 250.0)}])
def test_pixels_of_the_frame_see_the_points_of_the_grid(bounds):
    config = settings(**bounds)
    random = np.random.default_rng(1)
    points = random.normal(size=(500, 3)) * [1, 1, 0.7]
    points *= random.uniform(0.5, 4, (500, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    grid, T_world_body = gather(points, 99, config.sphere), pose()
    frame = frame_of(grid, T_world_body, config.max_range)
    assert frame.depth.dtype == np.float32
    assert frame.stamp_ns == 99
    image = prepare(frame, config)
    seen, _ = points_of(image)
    wanted = transform_points(T_world_body, grid.points())
    gaps = np.linalg.norm(seen[:, None] - wanted[None], axis=-1)
    assert gaps.min(axis=1).max() < 1e-4  # every pixel is a cell
    away = np.hypot(*grid.points()[:, :2].T)
    elevation = np.degrees(np.arctan2(np.abs(grid.points()[:, 2]), away))
    kept = gaps.min(axis=0) < 1e-4
    np.testing.assert_array_equal(kept, (elevation < 88) & (away >= 0.2))  # every cell is a pixel, but at the pole
    assert kept.mean() > 0.9


def test_reasons_of_the_frame():
    config = settings(30.0)
    grid = empty(SphereLayout.of(30))
    grid.range_m[:], grid.reason[:], grid.stamp_ns[:] = 3.0, Reason.VALID, 5
    grid.range_m[0], grid.reason[0] = 0, Reason.TOO_NEAR
    grid.range_m[1], grid.reason[1] = 8.5, Reason.TOO_FAR
    grid.range_m[2], grid.reason[2], grid.stamp_ns[2] = np.nan, Reason.UNKNOWN, 0
    image = prepare(frame_of(grid, np.eye(4), 8.0), config)
    assert set(image.reason[0]) == {Reason.TOO_NEAR}
    assert set(image.reason[2]) == {Reason.UNKNOWN}
    assert set(image.reason[3]) == {Reason.VALID}
    # 8.5 m is beyond 8 m from the axis at 15 degrees of elevation, but not at 45: nothing may be cleared there
    assert [Reason(r).name for r in image.reason[1]] == [
        "UNKNOWN", "UNKNOWN", "TOO_FAR", "TOO_FAR", "UNKNOWN", "UNKNOWN",
    ]  # fmt: skip


def checked(camera, depth, reason=None):
    reason = np.zeros(depth.shape, np.uint8) if reason is None else reason
    none = np.array([0, np.nan, -np.inf, np.inf, np.nan], np.float32)[reason]
    depth = np.where(reason == 0, depth, none).astype(np.float32)
    return DepthImage(depth, reason, camera, pose(4), 1234)


@pytest.mark.parametrize(
    "camera",
    [PinholeCamera.from_field_of_view(160, 90, 91, 0.15), SphericalCamera.from_field_of_view(160, 128, 150, 140, 0.15)],
    ids=["pinhole", "spherical"],
)
def test_through_the_sphere_a_wall_stays_where_it_is(camera):
    """A wall 3 m ahead; with one deviation's worth of nothing taken off, cells lie on it to within their own width."""
    config = settings(2.0, spread=0.0)
    _, rows = camera.rays()
    ahead = np.broadcast_to(rows[:, 1:], (camera.height, camera.width)).astype(float)
    depth = np.where(ahead > 0.1, 3.0 / np.maximum(ahead, 0.1), 0)
    reason = np.where((ahead > 0.1) & (depth < 8), Reason.VALID, Reason.UNMATCHED).astype(np.uint8)
    image = checked(camera, depth, reason)
    sphere = through_sphere(image, config)
    seen, (v, u) = points_of(sphere)
    local = transform_points(np.linalg.inv(image.T_world_sensor), seen)
    assert np.median(np.abs(local[:, 2] - 3)) < 0.03
    middle = np.hypot(local[:, 0], local[:, 1]) < 2
    assert np.abs(local[middle, 2] - 3).max() < 0.08
    assert sphere.depth_m[v, u].max() <= 8
    assert len(np.unique(v)) > 30
    assert sphere.stamp_ns == 1234
    assert (sphere.camera.height, sphere.camera.width) == sphere.depth_m.shape


def test_the_narrowest_pixels_make_a_camera_that_can_be():
    """A pixel of a millionth of a radian, of 1000 sensor pixels, goes 3e7 times into a step of 2 degrees."""
    eye = SphericalCamera(4, 3, 1e-6, 1e-6, 1.5, 1.0, baseline=0.05, binning=1000)
    image = DepthImage(np.full((3, 4), 2.0, np.float32), np.zeros((3, 4), np.uint8), eye, np.eye(4))
    camera = through_sphere(image, load_config(**{"sphere.step_deg": 2.0})).camera
    assert camera.binning == 1_000_000
    assert camera.focal_px * camera.baseline == pytest.approx(eye.focal_px * eye.baseline)


def test_through_the_sphere_nothing_is_cleared_that_the_image_does_not_clear():
    """All pixels TOO_FAR but a block of unmatched ones: free cells end within the image's own."""
    config, camera = settings(3.0), PinholeCamera.from_field_of_view(160, 90, 91, 0.15)
    reason = np.full((90, 160), Reason.TOO_FAR, np.uint8)
    reason[20:60, 40:90] = Reason.UNMATCHED
    reason[70:, 100:] = Reason.TOO_NEAR
    image = checked(camera, np.zeros((90, 160)), reason)
    sphere = through_sphere(image, config)
    columns, rows = sphere.camera.rays()
    v, u = np.nonzero(sphere.reason == Reason.TOO_FAR)
    assert len(v) > 200
    ends = transform_points(
        np.linalg.inv(image.T_world_sensor) @ sphere.T_world_sensor,
        8.0 * np.column_stack([columns[u], rows[v]]).astype(float),
    )
    assert (ends[:, 2] <= 8 + 1e-4).all()  # never beyond the image's maximum depth
    pixel_u = camera.fx * ends[:, 0] / ends[:, 2] + camera.cx
    pixel_v = camera.fy * ends[:, 1] / ends[:, 2] + camera.cy
    cell = 0.75 * np.radians(3) * camera.fx * 2.2  # what a cell covers, at the image's borders
    assert not ((pixel_u > 40 + cell) & (pixel_u < 90 - cell) & (pixel_v > 20 + cell) & (pixel_v < 60 - cell)).any()
    assert set(np.unique(sphere.reason)) == {Reason.UNKNOWN, Reason.TOO_NEAR, Reason.TOO_FAR}
    assert np.isposinf(sphere.depth_m[v, u]).all()


def test_without_a_step_the_image_goes_through_unchanged():
    image = checked(PinholeCamera.from_field_of_view(16, 9, 91, 0.15), np.full((9, 16), 2.0))
    assert through_sphere(image, load_config("default")) is image


@pytest.mark.parametrize("step", [0.5, 1.0, 3.0])
def test_noise_stays_that_of_the_stereo_camera(step):
    config = settings(step)
    for camera in (
        PinholeCamera.from_field_of_view(320, 180, 91, 0.15),
        SphericalCamera.from_field_of_view(320, 180, 150, 100, 0.15),
        PinholeCamera.from_field_of_view(640, 360, 91, 0.15).binned(2),
        replace(PinholeCamera.from_field_of_view(320, 180, 91, 0.15), subpixel=0.3),
    ):
        image = checked(camera, np.full((camera.height, camera.width), 2.0))
        own, through = (RangeNoise.of(config.noise, c) for c in (camera, through_sphere(image, config).camera))
        assert through.s2 == pytest.approx(own.s2, rel=1e-6)
        assert through.sigma(5.0) == pytest.approx(own.sigma(5.0), rel=0.01)


def test_camera_of_a_frame_knows_the_noisier_pair():
    from stereovox.depth.sphere import stitch

    config = settings()
    grids = [
        accumulate(checked(camera, np.full((camera.height, camera.width), 2.0)), np.eye(4), config)
        for camera in (PinholeCamera(40, 30, 300, 300, 20, 15, 0.15), PinholeCamera(40, 30, 100, 100, 20, 15, 0.15))
    ]
    for order in (grids, grids[::-1]):
        frame = frame_of(stitch(order), np.eye(4), 8.0)
        assert RangeNoise.of(config.noise, frame.camera).s2 == pytest.approx(SUBPIXEL / 15)


@pytest.mark.parametrize("camera", [PinholeCamera.from_field_of_view(320, 200, 91, 0.15)])
def test_an_empty_view_straight_ahead_stays_free(camera):
    image = checked(camera, np.zeros((200, 320)), np.full((200, 320), Reason.TOO_FAR, np.uint8))
    sphere = through_sphere(image, load_config("default", max_range=20.0, **{"sphere.step_deg": 2.0}))
    ahead = sphere.reason[np.abs(np.arange(len(sphere.reason)) - len(sphere.reason) / 2) < 3]
    assert (ahead == Reason.TOO_FAR).mean() > 0.9


def test_a_camera_that_sees_nothing_but_the_pole_is_refused():
    camera = SphericalCamera(16, 1, 0.002, 3.1, 8.0, 0.5)  # it looks round the whole of a thin ring, up and down
    mapper = Mapper(voxel_size=0.2, **{"sphere.step_deg": 1.0})
    frame = Frame(np.full((1, 16), 2.0, np.float32), camera, np.eye(4))
    report = mapper.add(frame)
    assert report.refused == "bad_camera"
    assert "sphere.step_deg" in report.detail
