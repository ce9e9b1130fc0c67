# SPDX-License-Identifier: Apache-2.0
"""Valenti's sensor model with the noise of wide cameras."""

import numpy as np
import pytest

from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import NoiseConfig, SensorConfig
from stereovox.sensors import make_sensor
from stereovox.sensors.noise import RangeNoise
from stereovox.sensors.protocol import offset_sigma, tabulate

FIGURE = SphericalCamera(1201, 3, 2.5 / 1200, 2.5 / 1200, 600.0, 1.0, 0.1)
"""The camera of Valenti 2018, Fig 6.2; k = 0.75, p_unknown = 0.5, p_free = 0.3 are the model's defaults."""


@pytest.mark.parametrize("z_measured", [0.5, 2.0, 5.0])
def test_model_of_the_spherical_camera_as_printed(z_measured):
    """Eq 6.4 to 6.6 with dz of Eq 6.10 and 6.11, written out."""
    d = np.arctan(0.1 / z_measured) / FIGURE.step_u
    dz = 0.1 * FIGURE.step_u * (1 + 1 / np.tan(d * FIGURE.step_u) ** 2) * 0.25
    a = 0.75 * (1 - 0.5) * np.exp(-dz)
    c = dz * np.sqrt(np.log(1 + a / (a + 1 - 2 * 0.3)) / np.log(2))
    z = z_measured + np.linspace(-5, 5, 101) * dz
    before = 0.3 + (a + 0.5 - 0.3) * np.exp(-0.5 * ((z - z_measured) / dz) ** 2)
    behind = 0.5 + a * np.exp(-0.5 * ((z - z_measured) / c) ** 2)
    sigma = RangeNoise.of(NoiseConfig(subpixel=0.25), FIGURE).sigma(z_measured)
    found = make_sensor(SensorConfig(model="valenti")).probability(z, z_measured, sigma)
    np.testing.assert_allclose(found, np.where(z <= z_measured, before, behind), rtol=1e-9)


def test_table_of_a_fisheye_with_much_noise():
    """Half a metre of noise at the end of the range: the table still says what the model says."""
    noise = RangeNoise.of(NoiseConfig(subpixel=0.25), FIGURE)
    model = make_sensor(SensorConfig(model="valenti"))
    table = tabulate(model, noise, 10.0)
    assert table.sigma[-1] > 0.4
    z = (len(table.sigma) - 0.5) * 10 / len(table.sigma)
    p = model.probability(z + offset_sigma() * table.sigma[-1], z, table.sigma[-1])
    np.testing.assert_allclose(table.log_odds[-1, 1:-1], np.log(p / (1 - p))[1:-1], atol=1e-9)
    assert (
        table.log_odds[-1, -1] == 0
    )  # the table ends in nothing and begins with p_free, whatever the model says there
    assert table.log_odds[-1, 0] == pytest.approx(np.log(0.3 / 0.7))


def test_noise_of_both_wide_cameras():
    """A fisheye pixel is worth as much in both; only the spherical one is noisy at no depth at all."""
    cylinder = CylindricalCamera(1201, 3, 480.0, 2.5 / 1200, 600.0, 1.0, 0.1)
    config = NoiseConfig(subpixel=0.1, s1=0.01)
    assert RangeNoise.of(config, cylinder) == RangeNoise(0.0, 0.01, 0.1 / 48)
    sphere = RangeNoise.of(config, FIGURE)
    assert (sphere.s0, sphere.s1) == (pytest.approx(0.1 * 0.1 / 480), 0.01)
    assert sphere.s2 == pytest.approx(0.1 / 48)
    nobody_knows = SphericalCamera(10, 3, 0.01, 0.01, 4.5, 1.0)
    assert RangeNoise.of(config, nobody_knows).s2 == pytest.approx(0.1 * 0.01 / config.default_baseline)
