# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.frame import Reason
from stereovox.simulate.d435 import CAMERA, D435, depth_camera
from stereovox.simulate.simulation import Simulation

WALL = np.full((480, 848), 1.4, np.float32)


def seen(device: D435, depth_m: float) -> np.ndarray:
    """Median depth of every column before a flat wall."""
    depth, reason = device.measure(np.full((480, 848), depth_m, np.float32), seed=3)
    return np.nanmedian(np.where(reason == Reason.VALID, depth * 0.001, np.nan)[:, 40:], axis=0)


def test_a_barrel_makes_the_borders_ten_per_cent_too_far():
    depth = D435(barrel=0.1).distorted(WALL)
    u = np.arange(848) - 423.5
    np.testing.assert_allclose(depth, np.tile(1.4 * (1 + 0.1 * (u / 423.5) ** 2), (480, 1)), rtol=1e-5)
    columns = seen(D435(barrel=0.1), 1.4)
    assert columns[-1] == pytest.approx(1.54, abs=0.003)
    assert columns[424 - 40] == pytest.approx(1.4, abs=0.003)
    np.testing.assert_allclose(seen(D435(barrel=0.1), 2.8) / columns, 2, atol=0.02)


def test_a_turned_eye_makes_a_barrel_that_grows_with_the_depth():
    device = D435(toe_in=np.radians(0.178))
    near, far = device.distorted(WALL)[240, -1] / 1.4 - 1, device.distorted(2 * WALL)[240, -1] / 2.8 - 1
    assert near == pytest.approx(0.1, abs=0.002)
    # a disparity that is d0 too small: z / (1 - z d0 / (f B)), so 10 % at z is 22 % at 2 z
    assert far == pytest.approx(1 / (1 - 2 * (1 - 1 / (1 + near))) - 1, rel=1e-3)
    assert seen(device, 1.4)[-1] == pytest.approx(1.54, abs=0.003)


def test_what_is_too_far_stays_too_far():
    nothing = np.full((480, 848), np.inf, np.float32)
    for device in (D435(barrel=0.1), D435(toe_in=0.003), D435(toe_in=-0.003)):
        depth = device.distorted(nothing)
        assert (depth > 10).all()
        assert not np.isnan(depth).any()


def test_straight_eyes_change_nothing():
    assert D435().distorted(WALL) is WALL


def test_the_simulation_takes_both_from_its_name():
    exact = Simulation("sim:wall?distance=1.4&barrel=0.1&noise=0").frame(0)
    assert exact.depth[240, 0] == pytest.approx(1.54, rel=1e-5)
    assert Simulation("sim:wall?toe_in=0.178").device.toe_in == pytest.approx(np.radians(0.178))
    assert Simulation("sim:wall?subpixel=0.04&farthest=7").device == D435(subpixel=0.04, farthest=7)


def test_smaller_images_have_the_same_field_of_view():
    for width, height in ((848, 480), (424, 240), (212, 120)):
        camera = depth_camera(width)
        assert (camera.width, camera.height, camera.baseline) == (width, height, 0.05)
        assert camera.fx / width == pytest.approx(CAMERA.fx / 848)
