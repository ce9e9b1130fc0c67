# SPDX-License-Identifier: Apache-2.0
"""Every setting of the section `amcl` changes what it should."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox import load_config
from stereovox.config.robot import AmclConfig
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import Localiser
from stereovox.localize.track import beams_of
from stereovox.simulate.floors.plan import FloorPlan, block
from stereovox.simulate.floors.view import cast

PLAN = FloorPlan([(0, 0, 6, 4)], [block("things", "box", (4.0, 0.4, 5.0, 0.8), (0, 1))])
GRID = PLAN.truth(0.05, (1, 1))
ANGLES = np.radians(np.arange(-120, 121, 4.0))
BASE = {"particles_min": 50, "particles_max": 400, "candidates": 2, "recovery_least": 0.0, "update_min_d": 0.05}


def drive():
    """Scans from a way through the room; somebody stands in some of them."""
    rng, scans = np.random.default_rng(0), []
    for n in range(14):
        pose = np.array([1.0 + 0.2 * n, 2.0 + 0.05 * n, 0.1 * n])
        ranges = cast(PLAN.outline(0.2, 0.4), pose[:2], ANGLES + pose[2], 8.0) + rng.normal(0, 0.02, len(ANGLES))
        ranges[20:28] = np.where(n % 3 == 2, 0.7, ranges[20:28])
        ranges[50] = np.inf
        scans.append(Scan(ranges.astype(np.float32), ANGLES[0], np.radians(4), 0.02, 8.0, se2.lifted(pose), stamp_ns=n))
    return scans


SCANS = drive()
START = (1.0, 2.0, 0.0)


def localiser(start=START, **settings):
    return Localiser(
        GRID, load_config(**{f"amcl.{name}": value for name, value in {**BASE, **settings}.items()}), start
    )


OTHERS = {
    "particles_min": 150,
    "particles_max": 300,
    "kld_error": 0.3,
    "kld_z": 1.0,
    "kld_bin": 0.05,
    "kld_bin_deg": 1.0,
    "alpha1": 0.2,
    "alpha2": 0.2,
    "alpha3": 0.2,
    "alpha4": 0.2,
    "update_min_d": 0.5,
    "update_min_a": 0.05,
    "resample_interval": 3,
    "model": "beam",
    "max_beams": 20,
    "max_range": 2.0,
    "trust": 0.5,
    "z_hit": 0.4,
    "z_short": 0.6,
    "z_max": 0.4,
    "z_rand": 0.6,
    "sigma_hit": 0.3,
    "lambda_short": 3.0,
    "field_distance": 0.2,
    "beam_skip": False,
    "beam_skip_distance": 2.0,
    "beam_skip_share": 0.0,
    "beam_skip_most": 0.01,
    "alpha_slow": 0.3,
    "alpha_fast": 0.9,
    "recovery_least": 0.9,
    "candidates": 7,
    "start_std": (0.05, 0.05, 0.02),
}
"""Another value of each setting."""
AROUND = {
    "z_short": {"model": "beam"},
    "z_max": {"model": "beam"},
    "lambda_short": {"model": "beam", "z_short": 0.4},
    "update_min_a": {"update_min_d": 0.5},
}
"""What a setting needs next to it to matter."""


def test_no_setting_is_missing_in_the_table():
    assert set(OTHERS) == set(AmclConfig.model_fields)


def followed(settings, start):
    found = localiser(start, **settings)
    estimates = [found.add(scan) for scan in SCANS]
    return np.array([[*estimate.pose_map_base, len(estimate.particles)] for estimate in estimates])


@pytest.mark.parametrize("name", OTHERS)
def test_each_setting_matters(name):
    around = AROUND.get(name, {})
    start = None if name == "candidates" else START
    other = around | {name: OTHERS[name]}
    assert not np.array_equal(followed(around, start), followed(other, start))


def watched(monkeypatch, found):
    """Return the beams, to be filled with all that the sensor model is asked for."""
    asked, plain = [], found._sensor.log_likelihood

    def log_likelihood(particles, beams):
        asked.append(beams)
        return plain(particles, beams)

    monkeypatch.setattr(found._sensor, "log_likelihood", log_likelihood)
    return asked


@pytest.mark.parametrize(("settings", "count"), [({}, 60), ({"max_beams": 7}, 7), ({"max_beams": 300}, 60)])
def test_so_many_beams_are_used(monkeypatch, settings, count):
    found = localiser(**settings)
    asked = watched(monkeypatch, found)
    found.add(SCANS[0])  # of 61 beams one met nothing
    assert [len(beams.ranges) for beams in asked] == [count]


@pytest.mark.parametrize(("max_range", "expected"), [(None, 8.0), (2.5, 2.5), (100.0, 8.0)])
def test_nothing_is_met_beyond_the_longest_range(monkeypatch, max_range, expected):
    found = localiser(max_range=max_range)
    asked = watched(monkeypatch, found)
    found.add(SCANS[0])
    assert asked[0].range_max == expected
    assert asked[0].ranges.max() < expected
    assert len(asked[0].ranges) == (np.asarray(SCANS[0].ranges) < expected).sum()


@pytest.mark.parametrize("trust", [0.05, 0.4, 1.0])
def test_trust_is_the_power_of_the_likelihood(trust):
    logs = []
    for power in (0.1, trust):
        found = localiser(trust=power, resample_interval=9)
        found.add(SCANS[0])
        logs.append(np.log(found._weights / found._weights.max()))
    some = logs[0] > -40
    assert some.sum() > 20
    assert logs[1][some] == pytest.approx(logs[0][some] * trust / 0.1)


@pytest.mark.parametrize("interval", [1, 2, 3])
def test_particles_are_drawn_anew_after_so_many_updates(interval):
    found = localiser(resample_interval=interval)
    drawn = []
    for scan in SCANS[:6]:
        assert found.add(scan).moved
        drawn.append(np.ptp(found._weights) == 0)
    assert drawn == [n % interval == 0 for n in range(1, 7)]


@pytest.mark.parametrize(
    ("settings", "used"),
    [
        ({}, [3, 4, 5]),
        ({"beam_skip_share": 0.2}, [2, 3, 4, 5]),
        ({"beam_skip_share": 0.6}, [5]),
        ({"beam_skip_most": 0.5}, [3, 4, 5]),
        ({"beam_skip_most": 0.49}, [0, 1, 2, 3, 4, 5]),
        ({"beam_skip": False}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_beams_that_too_few_particles_fit_are_left_out_unless_they_are_too_many(monkeypatch, settings, used):
    found = localiser(**settings)
    found._settled = True
    shares = np.array([0.0, 0.1, 0.25, 0.35, 0.5, 1.0])
    monkeypatch.setattr(found._sensor, "agreeing", lambda *_: shares)
    ranges = np.arange(1, 7, dtype=np.float32)
    beams = beams_of(replace(SCANS[0], ranges=ranges))
    assert found._fitting(beams).ranges.tolist() == ranges[used].tolist()


def test_the_first_particles_lie_round_the_start():
    found = localiser(start_std=(0.3, 0.1, 0.05), particles_max=20_000)
    assert found._particles.std(0) == pytest.approx([0.3, 0.1, 0.05], rel=0.03)
    assert found._particles.mean(0) == pytest.approx(START, abs=0.01)


@pytest.mark.parametrize("candidates", [1, 5])
def test_so_many_poses_are_tried_for_each_random_one(candidates):
    found = localiser(None, candidates=candidates)
    assert len(found._particles) == 400 * candidates
    found = localiser(candidates=candidates)
    poses, weights = found._strangers(0.5, beams_of(SCANS[0]))
    assert len(poses) == 200 * candidates
    assert (np.ptp(weights) > 0) == (candidates > 1)
    assert weights.sum() == pytest.approx(1)
