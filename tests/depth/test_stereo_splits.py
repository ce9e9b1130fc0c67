# SPDX-License-Identifier: Apache-2.0
"""The benchmark that chooses stereo settings on some scenes and reports on others."""

import sys
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereovox.depth.stereo.disparity import Disparity

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(FOLDER))
    try:
        import stereo_splits

        yield stereo_splits
    finally:
        sys.path.remove(str(FOLDER))


def test_pixels_are_counted_from_each_confidence_on(bench):
    random = np.random.default_rng(0)
    truth = random.uniform(1, 60, (40, 50))
    disparity = (truth + 2 * random.standard_normal(truth.shape)).astype(np.float32)
    disparity[random.random(truth.shape) < 0.2] = np.nan
    truth[random.random(truth.shape) < 0.3] = np.nan
    sure = (random.integers(0, 1001, truth.shape) / 1000).astype(np.float32)
    sure[0, 0] = 1.0
    counts = bench.tally(Disparity(disparity, sure, np.zeros(truth.shape, np.uint8)), truth)
    assert counts[0, 0] == np.isfinite(truth).sum()
    for least in (0.0, 0.25, 0.5, 0.75):
        kept = np.isfinite(truth) & np.isfinite(disparity) & (sure >= np.float32(least))
        level = 1 + round(1000 * least)
        assert counts[0, level] == kept.sum()
        for row, limit in zip(counts[1:], bench.LIMITS, strict=True):
            assert row[level] == (np.abs(disparity - truth)[kept] > limit).sum()
    level = bench.level_of(counts, 30.0)
    assert counts[0, level] >= 0.3 * counts[0, 0] > counts[0, level + 1]
    assert bench.level_of(counts, 99.9) == 1  # there are not so many


def test_every_half_is_chosen_on_once(bench):
    found = list(bench.splits(6, []))
    assert [tuple(half) for half, _ in found] == list(combinations(range(6), 3))
    assert all(sorted(half + rest) == list(range(6)) for half, rest in found)
    assert list(bench.splits(4, [3, 1])) == [([3, 1], [0, 2])]


def one(bench, wrong):
    """A scene of 100 pixels, all found with confidence 1, of which so many are wrong."""
    counts = np.zeros((1 + len(bench.LIMITS), bench.LEVELS + 1), np.int64)
    counts[0], counts[1:] = 100, wrong
    return counts


def test_settings_are_chosen_on_one_half_and_judged_on_the_other(bench):
    wrong = [[5, 5, 5, 5], [1, 1, 9, 9], [9, 9, 2, 2]]  # of defaults and two settings, on four scenes
    counts = np.array([[one(bench, w) for w in row] for row in wrong])
    rows, picked = bench.compared(counts, 85.0, [0, 1])
    assert [best for best, _ in picked] == [1]
    got = {name: values[0].wrong[-1] for name, values in rows.items()}
    assert got == {
        "chosen, where chosen": 1, "chosen, on the other half": 9, "defaults, confidence chosen": 5,
        "defaults as they are": 5, "best there in hindsight": 2,
    }  # fmt: skip
    assert [best for best, _ in bench.compared(counts, 85.0, [2, 3])[1]] == [2]
    assert len(bench.compared(counts, 85.0, [])[1]) == 6


@pytest.mark.parametrize("names", [("im2.ppm", "im6.ppm", "disp2.pgm"), ("view1.png", "view5.png", "disp1.png")])
def test_pairs_are_found_and_matched(bench, tmp_path, names):
    random = np.random.default_rng(1)
    scene = random.integers(0, 255, (60, 130), np.uint8)
    true = np.full(scene.shape, 36, np.uint8)
    true[:20] = 0  # unknown
    (tmp_path / "plane").mkdir()
    for name, image in zip(names, (scene, np.roll(scene, -12, axis=1), true), strict=True):
        cv2.imwrite(str(tmp_path / "plane" / name), np.stack([image] * 3, axis=2) if name.endswith("ppm") else image)
    ((frame, truth),) = bench.middlebury(tmp_path, 3.0)
    assert frame.name == "plane"
    assert np.isnan(truth[:20]).all()
    assert (truth[20:] == 12).all()
    counts = bench.tallies({"stereo.disparities": 32}, [(frame, truth)])[0]
    found = bench.outcome(counts, 1)
    assert found.density > 50
    assert found.wrong[0] < 1


def test_what_the_right_image_does_not_show_is_left_out(bench):
    truth = np.full((3, 40), 2.0)
    truth[1, 15:20] = 8.0  # it covers columns 7 to 11 of the right image: 9 to 13 of the wall in the left one
    truth[2] = np.nan
    seen = np.isfinite(bench.seen_by_both(truth))
    assert np.flatnonzero(~seen[0]).tolist() == [0, 1]
    assert np.flatnonzero(~seen[1]).tolist() == [0, 1, 8, 9, 10, 11, 12, 13, 14]  # with a pixel to each side
    assert not seen[2].any()


def test_settings_of_a_grid(bench):
    made = bench.settings_of(["p1=8,16", "block_size=3,5"])
    assert made[0] == {}
    assert len(made) == 5
    assert made[-1] == {"stereo.p1": 16, "stereo.block_size": 5}
