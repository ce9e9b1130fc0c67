# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse, rigidity_error
from stereovox.opening import open_source
from stereovox.simulate.simulation import Simulation

SMALL = "image_width=32"


def told_and_true(location: str) -> tuple[np.ndarray, np.ndarray]:
    simulation = Simulation(f"{location}{'&' if '?' in location else '?'}{SMALL}")
    numbers = range(len(simulation))
    return np.array([simulation.pose(i) for i in numbers]), np.array([simulation.true_pose(i) for i in numbers])


def test_without_drift_all_is_exactly_as_it_was():
    plain, none = Simulation(f"sim:apartment?{SMALL}"), Simulation(f"sim:apartment?{SMALL}&drift=0")
    for i in (0, 40, 900):
        np.testing.assert_array_equal(plain.pose(i), plain.stage.path(i / 901))
        np.testing.assert_array_equal(plain.true_pose(i), plain.pose(i))
        np.testing.assert_array_equal(none.frame(i).T_world_sensor, plain.pose(i))


def test_poses_drift_and_images_do_not():
    plain, drifting = Simulation(f"sim:apartment?{SMALL}"), Simulation(f"sim:apartment?{SMALL}&drift=0.02")
    for i in (0, 40, 900):
        np.testing.assert_array_equal(drifting.true_pose(i), plain.pose(i))
        np.testing.assert_array_equal(drifting.frame(i).depth, plain.frame(i).depth)
        np.testing.assert_array_equal(drifting.frame(i).T_world_sensor, drifting.pose(i))
    assert not np.allclose(drifting.pose(900), plain.pose(900), atol=0.05)
    with pytest.raises(IndexError):
        drifting.true_pose(902)


def test_errors_grow_with_the_way_and_with_the_drift():
    def errors_m(drift: float, seed: int) -> np.ndarray:
        told, true = told_and_true(f"sim:apartment?drift={drift}&seed={seed}&frames=100")
        np.testing.assert_allclose(told[0], true[0], atol=1e-12)
        return np.linalg.norm((told - true)[:, :3, 3], axis=1)

    small, large = (np.mean([errors_m(drift, seed) for seed in range(6)], axis=0) for drift in (0.005, 0.02))
    assert 0.02 < small[-1] < 0.3  # on 32 m that end where they began
    assert 3 < large[-1] / small[-1] < 5
    assert large[10] < large[50] < 1


def test_the_heading_drifts_and_gravity_keeps_the_rest():
    told, true = told_and_true("sim:flight?length=400&drift=0.01&frames=300")
    turns = told[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)
    np.testing.assert_allclose(turns[:, 2], [[0, 0, 1]] * 300, atol=1e-9)
    np.testing.assert_allclose(turns[:, :, 2], [[0, 0, 1]] * 300, atol=1e-9)
    steps = np.degrees(np.diff(np.arctan2(turns[:, 1, 0], turns[:, 0, 0])))
    assert steps.std() == pytest.approx(0.05 * np.sqrt(400 / 299), rel=0.15)
    assert max(rigidity_error(T) for T in told) < 1e-9


def test_seeds_differ_and_the_number_of_frames_does_not_matter():
    ends = [
        told_and_true(f"sim:apartment?drift=0.01&{more}")[0][-1]
        for more in ("frames=11", "frames=101", "seed=1&frames=11")
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)
    assert np.abs(ends[0] - ends[2])[:3, 3].max() > 0.01


def test_optical_axes_drift_alike():
    world, true = told_and_true("sim:apartment?drift=0.01&frames=20")
    optical, _ = told_and_true("sim:apartment?drift=0.01&frames=20&axes=optical")
    np.testing.assert_allclose(optical, inverse(true[0]) @ world, atol=1e-9)


@pytest.mark.parametrize("drift", [-0.1, 0.5])
def test_drift_has_limits(drift):
    with pytest.raises(SourceError, match=f"drift={drift:g} must be between 0 and 0.2"):
        open_source(f"sim:room?drift={drift}")
