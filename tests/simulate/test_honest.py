# SPDX-License-Identifier: Apache-2.0
"""Cameras that err as real ones do."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox import open_source
from stereovox.errors import SourceError
from stereovox.frame import Reason
from stereovox.simulate import _texture
from stereovox.simulate.d435 import CAMERA, D435, depth_camera, smooth_noise
from stereovox.simulate.honest import RealisticDepthCamera, honest_d435, honest_kinect
from stereovox.simulate.simulation import Simulation

SHAPE = CAMERA.height, CAMERA.width
PLAIN = RealisticDepthCamera(
    step=1e-4, of_surface=0, holes=0, holes_far=0, holes_steep=0, holes_dark=0, repetitive=0, farthest=60
)
"""Nothing but noise."""


def disparity(device, depth, seed, T=None):
    """Disparity in pixels, NaN if there is none."""
    millimetres, _ = device.measure(depth, seed, T)
    with np.errstate(divide="ignore"):
        return np.where(millimetres > 0, device.camera.fx * device.camera.baseline / (millimetres * 0.001), np.nan)


def errors(device, z, seed, T=None):
    """What the disparity of a wall at `z` is off, without the margin that the right eye does not see."""
    depth = np.full((device.camera.height, device.camera.width), z, np.float32)
    off = disparity(device, depth, seed, T) - device.camera.fx * device.camera.baseline / z
    return off[:, int(device.camera.fx * device.camera.baseline / z) + 2 :]


def alike(a, b):
    both = np.isfinite(a) & np.isfinite(b)
    return np.corrcoef(a[both], b[both])[0, 1]


@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize("sigma", [0.0, 0.4, 0.7, 1.5, 3.0])
def test_smooth_noise_keeps_its_size_and_is_correlated_as_two_gaussians(sigma, seed):
    """The correlation of a Gaussian kernel with itself is a Gaussian of sqrt(2) sigma."""
    noise = smooth_noise((500, 600), sigma, np.random.default_rng(seed))
    assert noise.shape == (500, 600)
    assert noise.std() == pytest.approx(1, rel=0.02)
    assert noise[:, 0].std() == pytest.approx(1, rel=0.15)
    for lag in range(1, 6):
        wanted = np.exp(-(lag**2) / (4 * sigma**2)) if sigma > 0.5 else None
        if wanted is not None:
            assert alike(noise[:, lag:], noise[:, :-lag]) == pytest.approx(wanted, abs=0.03)
            assert alike(noise[lag:], noise[:-lag]) == pytest.approx(wanted, abs=0.03)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(("subpixel", "correlation"), [(0.08, 0.0), (0.08, 0.7), (0.05, 1.5), (0.2, 1.5)])
def test_the_simple_camera_can_have_correlated_noise_too(subpixel, correlation, seed):
    off = errors(D435(subpixel=subpixel, correlation_px=correlation, farthest=20), 1.5, seed)
    assert np.nanstd(off) == pytest.approx(subpixel, rel=0.05)
    wanted = np.exp(-1 / (4 * correlation**2)) if correlation else 0
    assert alike(off[:, 1:], off[:, :-1]) == pytest.approx(wanted, abs=0.03)


def test_even_noise_has_unit_variance_everywhere_and_forgets_beyond_a_cell():
    random = np.random.default_rng(3)
    for inside in ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), (0.5, 0.0, 0.25)):
        points = (random.integers(-1000, 1000, (40_000, 3)) + inside).astype(np.float32)
        field, beside, other = (np.empty(len(points), np.float32) for _ in range(3))
        _texture.even(points, np.uint32(4), field)
        _texture.even(points + np.float32([2, 0, 0]), np.uint32(4), beside)
        _texture.even(points, np.uint32(5), other)
        assert field.mean() == pytest.approx(0, abs=0.02)
        assert field.std() == pytest.approx(1, rel=0.02)
        assert abs(alike(field, beside)) < 0.02
        assert abs(alike(field, other)) < 0.02


def test_noise_of_several_origins_has_the_stated_size_together():
    mixed = replace(PLAIN, of_surface=0.3, of_pixel=0.4)
    for z in (0.8, 1.3, 3.1):
        assert np.nanstd([errors(mixed, z, [s, 0])[:, -600:] for s in range(6)]) == pytest.approx(0.08, rel=0.06)


def test_a_share_of_the_noise_stays_where_the_camera_stands():
    mixed = replace(PLAIN, of_surface=0.3, of_pixel=0.2)
    frames = [errors(mixed, 1.5, [0, i]) for i in range(2)]
    assert alike(*frames) == pytest.approx(0.5, abs=0.05)
    assert abs(alike(errors(PLAIN, 1.5, [0, 0]), errors(PLAIN, 1.5, [0, 1]))) < 0.03


def test_noise_of_surfaces_stays_with_them_and_that_of_pixels_with_those():
    """The camera moves by ten pixels along the wall."""
    moved = np.eye(4)
    moved[0, 3] = 10 * 1.5 / CAMERA.fx
    for shares, at_place, at_pixel in (({"of_surface": 0.6}, 0.6, 0.0), ({"of_pixel": 0.6}, 0.0, 0.6)):
        before, after = (errors(replace(PLAIN, **shares), 1.5, [0, i], T) for i, T in enumerate((np.eye(4), moved)))
        assert alike(before[:, 10:], after[:, :-10]) == pytest.approx(at_place, abs=0.07)
        assert alike(before, after) == pytest.approx(at_pixel, abs=0.07)


def test_it_does_not_say_why_there_is_no_value():
    for device in (honest_d435(D435()), honest_kinect()):
        shape = device.camera.height, device.camera.width
        for z in (0.05, 1.5, 50.0, np.inf):
            depth, reason = device.measure(np.full(shape, z, np.float32), 0)
            np.testing.assert_array_equal(reason, np.where(depth > 0, Reason.VALID, Reason.UNKNOWN))
            assert (depth > 0).any() == (z == 1.5)


@pytest.mark.parametrize(("device", "step"), [(replace(PLAIN, step=1 / 32), 1 / 32), (honest_kinect(), 1 / 8)])
def test_disparity_comes_in_steps(device, step):
    z = 3.0
    seen = disparity(device, np.full((device.camera.height, device.camera.width), z, np.float32), 1)
    steps = seen[np.isfinite(seen)] / step
    rounding = device.camera.fx * device.camera.baseline / z**2 * 0.0005 / step  # whole millimetres
    assert np.abs(steps - np.rint(steps)).max() < 1.2 * rounding + 1e-3
    assert len(np.unique(np.rint(steps))) > 3


def without_value(device, depth, seed=0):
    margin = int(device.camera.fx * device.camera.baseline / np.nanmin(depth)) + 3
    return (device.measure(depth, seed)[0] == 0)[:, margin:].mean()


def test_holes_grow_with_range_and_angle_and_are_patchy():
    device = RealisticDepthCamera()
    flat = [np.mean([without_value(device, np.full(SHAPE, z, np.float32), s) for s in range(4)]) for z in (1, 4, 8)]
    assert 0.01 < flat[0] < flat[1] < flat[2] < 0.5
    x, _ = CAMERA.ray_slopes()
    tilted = [1.5 / (1 - np.tan(np.radians(tilt)) * x[None, :] * np.ones(SHAPE)) for tilt in (0, 30, 44)]
    shares = [without_value(replace(device, holes_dark=0, holes_far=0), t.astype(np.float32)) for t in tilted]
    assert shares[0] < shares[2]
    holes = device.measure(np.full(SHAPE, 4.0, np.float32), 0)[0] == 0
    assert holes[:, 31:][holes[:, 30:-1]].mean() > 3 * holes[:, 30:].mean()


def test_dark_surfaces_have_more_holes():
    from stereovox.simulate.honest import _Places

    device = replace(RealisticDepthCamera(), holes_dark=0.4)
    depth = np.full(SHAPE, 2.0, np.float32)
    grey = _Places.of(device, depth, None, 3).grey()[:, 30:]
    holes = (device.measure(depth, [3, 0])[0] == 0)[:, 30:]
    assert holes[grey < 40].mean() > 2 * holes[grey > 100].mean() > 0


def test_beside_an_edge_pixels_fly_between_and_some_are_lost():
    device = replace(PLAIN, flying=0.6, edge_loss=0.2)
    depth = np.full(SHAPE, 4.0, np.float32)
    depth[:, 500:] = 1.0
    seen = disparity(device, depth, 2)
    near, far = CAMERA.fx * 0.05 / 1.0, CAMERA.fx * 0.05 / 4.0
    right, between = seen[:, 502:], (seen > far + 1) & (seen < near - 1)
    assert between[:, 498:502].mean() > 0.1
    assert not between[:, 510:].any()
    assert np.isfinite(right).mean() > 0.99
    assert not between[:, 30:480].any()
    falling = np.full(SHAPE, 1.0, np.float32)
    falling[:, 500:] = 4.0  # nothing is hidden here: what is lost is lost at the edge
    lost = np.isnan(disparity(device, falling, 2))
    assert 0.1 < lost[:, 498:502].mean() < 0.3


def test_repetitive_texture_seems_nearer_by_its_period():
    device = replace(PLAIN, repetitive=0.5, mismatched=0.3, period=0.1)
    off = errors(device, 5.0, 4)
    wrong = np.abs(off) > 1
    assert 0.05 < wrong.mean() < 0.3
    assert np.median(off[wrong]) == pytest.approx(0.1 * CAMERA.fx / 5.0, rel=0.02)
    assert (np.abs(errors(device, 0.5, 4)) > 1).mean() < wrong.mean() / 3


def _seen(name, seed):
    return open_source(f"sim:room?camera={name}&seed={seed}&image_width=212").frame(9)


def test_the_same_seed_gives_the_same_image_and_another_another():
    for name in ("d435", "kinect"):
        once, again, other = (_seen(name, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(once.depth, again.depth)
        assert (once.depth != other.depth).mean() > 0.3


def test_cameras_are_chosen_by_name():
    simulation = Simulation("sim:aisle?camera=d435&subpixel=0.1&correlation=1.2&image_width=424")
    assert simulation.device == RealisticDepthCamera(
        depth_camera(424), subpixel=0.1, correlation_px=1.2, farthest=Simulation("sim:aisle").device.farthest
    )
    assert Simulation("sim:room?camera=kinect").camera.width == 640
    assert Simulation("sim:room?camera=kinect&image_width=320").frame(0).depth.shape == (240, 320)
    assert Simulation("sim:room?camera=simple").device == Simulation("sim:room").device == D435()
    with pytest.raises(SourceError, match=r"camera=d415 is unknown; use simple or d435 or kinect"):
        Simulation("sim:room?camera=d415")
    with pytest.raises(SourceError, match=r"correlation=-0\.5 must be between 0 and 5"):
        Simulation("sim:room?correlation=-0.5")


def test_a_smaller_kinect_takes_a_picture_of_the_same_noise():
    """In metres the noise of a smaller image is that of the full one."""
    sizes = []
    for width in (640, 320):
        device = replace(honest_kinect(width), of_pixel=0.0)
        z = np.concatenate(
            [device.measure(np.full((device.camera.height, width), 2.0, np.float32), s)[0].ravel() for s in range(3)]
        )
        sizes.append(z[z > 0].std())
    assert sizes[1] == pytest.approx(sizes[0], rel=0.1)
