"""The contract every registered sensor model keeps, and each model's own formula."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import NoiseConfig, SensorConfig
from stereovox.errors import ConfigError
from stereovox.integrate.views import kernel_table
from stereovox.sensors import SENSORS, make_sensor
from stereovox.sensors.noise import PoseNoise, RangeNoise
from stereovox.sensors.protocol import COLUMNS, REACH_SIGMA, ROWS, offset_sigma, tabulate

CASES = [(0.5, 0.002), (2.0, 0.01), (4.0, 0.08), (8.0, 0.3)]
HALF = np.sqrt(2 * np.log(2))


def model_of(name, **parameters):
    return make_sensor(SensorConfig(model=name, **parameters))


def width_at(model, level, z_measured, sigma, side):
    """Distance from the measurement at which the model falls through `level`, by dense sampling."""
    offset = np.linspace(0, 8 * sigma, 200_001)[1:]
    p = model.probability(z_measured + side * offset, z_measured, sigma)
    below = np.flatnonzero(p < level)
    return offset[below[0]]


def said_of_the_hit(model, z_measured, sigma, voxel_size):
    """What a model says of the cell that holds the measured point."""
    if hasattr(model, "hit"):
        return float(model.hit(np.array([z_measured]), np.array([sigma]), voxel_size)[0])
    return float(model.probability(np.array(z_measured), z_measured, sigma))


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize(("z_measured", "sigma"), CASES)
def test_contract(name, z_measured, sigma):
    model = model_of(name)
    offset = np.linspace(-12, 12, 4801) * sigma
    p = model.probability(z_measured + offset, z_measured, sigma)
    peak = said_of_the_hit(model, z_measured, sigma, 0.05)
    assert ((p > 0) & (p < 1)).all()
    assert p[0] == pytest.approx(model.p_free, abs=1e-9)
    assert p[-1] == pytest.approx(model.p_unknown, abs=1e-9)
    assert peak == pytest.approx(p.max()) if not hasattr(model, "hit") else peak > p.max()
    assert model.p_unknown < peak < 1
    assert (np.diff(p[offset < 0]) >= 0).all()
    assert (np.diff(p[offset > 0]) <= 0).all()


@pytest.mark.parametrize(("z_measured", "sigma"), CASES)
@pytest.mark.parametrize("p_unknown", [0.5, 0.45])
def test_valenti_half_height_widths_agree(z_measured, sigma, p_unknown):
    """Valenti 2018, Eq 6.6 corrected: at p_unknown + a / 2 both sides are equally wide."""
    model = model_of("valenti", p_unknown=p_unknown)
    a = 0.75 * (1 - p_unknown) * np.exp(-sigma)
    level = p_unknown + a / 2
    before, behind = (width_at(model, level, z_measured, sigma, side) for side in (-1, 1))
    assert before == pytest.approx(behind, rel=1e-3)
    assert behind == pytest.approx(model.tail(sigma) * HALF, rel=1e-3)
    assert model.probability(z_measured, z_measured, sigma) == pytest.approx(p_unknown + a)


@pytest.mark.filterwarnings("error")
def test_valenti_knows_nothing_where_noise_is_larger_than_the_range():
    z = np.array([-1.0, 0.0, 1e-3, 1.0])
    assert model_of("valenti").probability(z, 0.0, 800.0) == pytest.approx(0.5, abs=1e-6)


def test_valenti_as_printed_for_one_half():
    sigma, a = 0.1, 0.75 * 0.5 * np.exp(-0.1)
    printed = sigma * np.sqrt(np.log(1 + a / (a + 1 - 2 * 0.3)) / np.log(2))
    assert model_of("valenti").tail(sigma) == pytest.approx(printed)


@pytest.mark.parametrize(("z_measured", "sigma"), [(2.0, 0.03), (4.0, 0.1)])
def test_andert_half_height_widths(z_measured, sigma):
    """A Gaussian on a step: each side falls to half its own height at sigma sqrt(2 ln 2)."""
    model = model_of("andert", k=0.02)
    peak = 0.5 + 0.02 / (sigma * np.sqrt(2 * np.pi))
    assert model.probability(z_measured, z_measured, sigma) == pytest.approx(peak)
    assert width_at(model, (peak + 0.3) / 2, z_measured, sigma, -1) == pytest.approx(sigma * HALF, rel=1e-3)
    assert width_at(model, (peak + 0.5) / 2, z_measured, sigma, 1) == pytest.approx(sigma * HALF, rel=1e-3)


def test_andert_is_clamped_below_one():
    assert model_of("andert", k=1.0).probability(1.0, 1.0, 0.001) == 0.95


@pytest.mark.parametrize("name", ["constant", "stereo"])
def test_point_models_mark_nothing_beside_the_hit(name):
    model = model_of(name)
    offset = np.array([-1e-6, 1e-6]) * 0.05
    assert (model.probability(2 + offset, 2.0, 0.05) <= model.p_unknown + 1e-9).all()
    assert said_of_the_hit(model, 2.0, 0.05, 0.1) >= 0.7


def test_stereo_clears_half_as_much_where_the_gaussian_is_half():
    """Half of what the Gaussian has gained by the end of the table, where p_free is reached."""
    lost = np.exp(-0.5 * (4 * 127 / 128 - 1.5) ** 2)
    there = np.sqrt(-2 * np.log((1 + lost) / 2))
    model = model_of("stereo", fade=1.5, p_free=0.35)
    assert model.probability(2.0 - 0.05 * (there + 1.5), 2.0, 0.05) == pytest.approx(0.35 + 0.15 * 0.5)


@pytest.mark.parametrize("fade", [0.1, 2.0, 3.9])
def test_stereo_is_never_below_p_free_and_reaches_it(fade):
    p = model_of("stereo", fade=fade).probability(3.0 - 0.05 * np.linspace(0, 14, 1000), 3.0, 0.05)
    assert p.min() == p[-1] == pytest.approx(0.3)
    assert (np.diff(p) <= 0).all()


def test_stereo_must_clear_within_its_table():
    with pytest.raises(ConfigError, match=r"sensor\.fade 4: must be less than 3\.97"):
        model_of("stereo", fade=4.0)


@pytest.mark.parametrize("name", ["constant", "andert", "valenti", "stereo"])
def test_far_before_a_measurement_the_table_says_exactly_p_free(name):
    """Also where noise is so small, next to the camera, that four sigma before a measurement Andert's peak is large."""
    model = model_of(name, p_free=0.3)
    table = tabulate(model, RangeNoise(0, 0, 0.001), 10.0)
    np.testing.assert_allclose(table.log_odds[:, 0], np.log(0.3 / 0.7), rtol=1e-12)
    assert kernel_table(table, 10.0).free == round(1000 * np.log(0.3 / 0.7))

    assert model_of("constant").probability(2.0, 2.0, 0.05) == 0.7


@pytest.mark.parametrize("ratio", [0.02, 0.3, 1.0, 4.0])
def test_a_hit_counts_as_its_noise_leaves_it_in_its_cell(ratio):
    """Points evenly spread over a cell, moved by noise of `ratio` cells, counted by hand; then the formula on top."""
    rng = np.random.default_rng(4)
    stays = np.mean(np.floor(rng.random(1_000_000) + ratio * rng.normal(size=1_000_000)) == 0)
    p = 0.9 * stays
    evidence = np.log(p / (1 - p)) - np.log(0.2 / 0.8)
    model = model_of("stereo", p_right=0.9, prior=0.2, p_least=0.6)
    expected = max(1 / (1 + np.exp(-evidence)), 0.6)  # a measured point is never evidence for free space
    assert said_of_the_hit(model, 3.0, ratio * 0.08, 0.08) == pytest.approx(expected, abs=2e-3)


def test_a_hit_counts_less_with_more_noise_and_more_in_larger_cells_but_always_something():
    model = model_of("stereo")
    sigma = np.geomspace(1e-6, 100.0, 60)
    p = np.array([model.hit(sigma, sigma, size) for size in (0.02, 0.05, 0.2, 1.0)])
    assert (np.diff(p, axis=1) <= 1e-12).all()
    assert (np.diff(p, axis=0) >= -1e-12).all()
    assert p[:, 0] == pytest.approx(1 / (1 + np.exp(-(np.log(0.95 / 0.05) - np.log(0.1 / 0.9)))), abs=1e-4)
    assert p[:, -1] == pytest.approx(0.8)


def test_stereo_says_nothing_right_before_what_was_measured():
    z = np.linspace(1.0, 3.0, 400)
    p = model_of("stereo", fade=2.0).probability(z, 2.0, 0.1)
    assert (p[z > 1.8] == 0.5).all()
    assert (p[z < 1.79] < 0.5).all()


@pytest.mark.parametrize("voxel_size", [0.02, 0.1])
def test_a_cell_that_is_looked_through_loses_at_most_a_share_of_a_hit(voxel_size):
    """So frames that miss a pole thinner than a pixel do not outvote those that see it."""
    z = np.linspace(0.1, 5.0, 50)
    sigma, model = 0.004 * z * z, model_of("stereo", passes=0.25)
    hit, passed = (np.log(p / (1 - p)) for p in (model.hit(z, sigma, voxel_size), model.passed(z, sigma, voxel_size)))
    assert passed == pytest.approx(-0.25 * hit)
    table = tabulate(model, RangeNoise(0, 0, 0.004), 5.0, voxel_size)
    assert (table.passed >= np.maximum(-0.25 * table.hit, np.log(0.3 / 0.7)) - 1e-9).all()
    assert tabulate(model_of("constant"), RangeNoise(0, 0, 0.004), 5.0).passed == pytest.approx(np.log(0.4 / 0.6))


def test_hits_count_less_where_poses_are_noisy():
    noise, model = RangeNoise(0, 0, 0.001), model_of("stereo")
    sure, shaken = (tabulate(model, noise, 5.0, 0.05, pose) for pose in (None, PoseNoise(0.02, 0.01)))
    z = (np.arange(ROWS) + 0.5) * 5 / ROWS
    width = np.sqrt(noise.sigma(z) ** 2 + 0.02**2 + (0.01 * z) ** 2)
    p = model.hit(z, width, 0.05)
    assert shaken.hit == pytest.approx(np.log(p / (1 - p)))
    assert (shaken.hit[10:60] < sure.hit[10:60]).all()
    assert (shaken.passed >= sure.passed).all()


def test_table_asks_a_model_that_knows_cells_for_its_hits():
    """`hit` is optional; the rest of the table does not depend on the voxel size."""
    noise = RangeNoise(0.01, 0, 0.004)
    small, large = (tabulate(model_of("stereo"), noise, 6.0, size) for size in (0.02, 0.2))
    assert (small.log_odds == large.log_odds).all()
    z_measured = (np.arange(ROWS) + 0.5) * 6 / ROWS
    p = model_of("stereo").hit(z_measured, noise.sigma(z_measured), 0.02)
    assert small.hit == pytest.approx(np.log(p / (1 - p)))
    assert (large.hit > small.hit).all()
    assert (small.hit > 0).all()
    for name in ("constant", "valenti"):
        assert (tabulate(model_of(name), noise, 6.0, 0.02).hit == tabulate(model_of(name), noise, 6.0, 0.2).hit).all()


def test_a_hit_beyond_certainty_is_refused():
    class Sure:
        p_free, p_unknown = 0.4, 0.5

        def probability(self, z, z_measured, sigma):
            return np.where(z < z_measured, 0.4, 0.5) + 0 * sigma

        def hit(self, z_measured, sigma, voxel_size):
            return np.ones_like(sigma)

    with pytest.raises(ConfigError, match="inside") as caught:
        tabulate(Sure(), RangeNoise(0.01, 0, 0), 5.0)
    assert "\n" not in str(caught.value)


def test_table_holds_the_model():
    model, noise = model_of("valenti"), RangeNoise(0.01, 0.002, 0.003)
    table = tabulate(model, noise, 6.0)
    assert table.log_odds.shape == (ROWS, COLUMNS)
    row, column = 57, 71
    z_measured = (row + 0.5) * 6.0 / ROWS
    sigma = 0.01 + 0.002 * z_measured + 0.003 * z_measured**2
    assert table.sigma[row] == pytest.approx(sigma)
    p = model.probability(z_measured + offset_sigma()[column] * sigma, z_measured, sigma)
    assert table.log_odds[row, column] == pytest.approx(np.log(p / (1 - p)))
    assert np.abs(offset_sigma()).max() < REACH_SIGMA
    assert (np.abs(offset_sigma()) > 0).all()


@pytest.mark.parametrize("name", ["stereo", "valenti"])
def test_noise_beyond_the_range_makes_no_longer_rays(name):
    found, most = (tabulate(model_of(name), RangeNoise(s0, 0, 0), 5.0) for s0 in (1e9, 5.0))
    np.testing.assert_array_equal(found.sigma, most.sigma)
    np.testing.assert_array_equal(found.log_odds, most.log_odds)
    assert found.sigma.max() == 5.0


def test_prior_is_not_counted_twice():
    """Valenti 2018, Eq 6.2: behind the measurement nothing is added, whatever p_unknown is."""
    table = tabulate(model_of("valenti", p_unknown=0.4), RangeNoise(0.05, 0, 0), 5.0)
    assert np.abs(table.log_odds[:, -1]).max() < 0.01


def test_stereo_noise_from_geometry():
    """Chien 2020, Eq 3.5 with the square: 848 px at 91.2 deg, 50 mm, 0.08 px give 15 mm at 2 m."""
    camera = PinholeCamera.from_field_of_view(848, 480, 91.2, 0.05)
    noise = RangeNoise.of(NoiseConfig(), camera)
    assert noise.sigma(2.0) == pytest.approx(2.0**2 * 0.08 / (camera.fx * 0.05))
    assert noise.sigma(2.0) == pytest.approx(0.0154, abs=2e-4)
    assert RangeNoise.of(NoiseConfig(s0=0.01, s2=0.002), camera).sigma(3.0) == pytest.approx(0.01 + 0.018)


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("sterio", {}, "did you mean 'stereo'"),
        ("constant", {"p_hitt": 0.7}, "did you mean 'p_hit'"),
        ("constant", {"p_hit": 1.0}, "between 0 and 1"),
        ("constant", {"p_hit": "high"}, "must be a number"),
        ("stereo", {"p_rihgt": 0.9}, "did you mean 'p_right'"),
        ("stereo", {"p_right": 1.0}, "between 0 and 1"),
        ("stereo", {"p_right": "high"}, "must be a number"),
        ("stereo", {"passes": 0.0}, "greater than 0"),
        ("valenti", {"p_free": 0.6}, "smaller than p_unknown"),
        ("andert", {"k": 0.0}, "greater than 0"),
    ],
)
def test_bad_settings_end_in_one_line(name, parameters, said):
    with pytest.raises(ConfigError, match=said) as caught:
        model_of(name, **parameters)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("p_far_before", "p_far_behind", "said"),
    [
        (0.4, 0.5, None),
        (0.45, 0.5, "must be p_free"),
        (0.4, 0.6, "must be p_unknown"),
        (0.0, 0.5, "p_free"),
        (0.4, np.nan, "p_unknown"),
    ],
)
def test_models_that_break_the_contract_are_refused(p_far_before, p_far_behind, said):
    class Broken:
        p_free, p_unknown = 0.4, 0.5

        def probability(self, z, z_measured, sigma):
            return np.where(z < z_measured, p_far_before, np.where(z > z_measured, p_far_behind, 0.7)) + 0 * sigma

    if said is None:
        tabulate(Broken(), RangeNoise(0.01, 0, 0), 5.0)
        return
    with pytest.raises(ConfigError, match=said):
        tabulate(Broken(), RangeNoise(0.01, 0, 0), 5.0)
