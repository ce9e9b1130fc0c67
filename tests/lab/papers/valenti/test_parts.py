# SPDX-License-Identifier: Apache-2.0
"""The parts of the evaluation of Valenti 2018: printed table, thresholds, verdicts, OctoMap, frames that are kept."""

from __future__ import annotations

import made_street
import numpy as np
import pytest

from stereovox import VoxelMap, load_config
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.curves import EXACT, TOLERANT, PrecisionRecall
from stereovox.evaluate.scores import score
from stereovox.frame import Frame, Reason
from stereovox.lab.papers.valenti.chapters import PRINTED
from stereovox.lab.papers.valenti.claims import CLAIMED, claims_of, results, speed_claim
from stereovox.lab.papers.valenti.figures import THRESHOLDS
from stereovox.lab.papers.valenti.judge import Judged
from stereovox.lab.papers.valenti.mappers import (
    DEFAULT,
    OCTOMAP,
    THESIS,
    Matched,
    OctomapContestant,
    Setting,
    config_of,
)
from stereovox.lab.papers.valenti.recordings import find_drives
from stereovox.lab.papers.valenti.speed import Speed
from stereovox.maps import State

SETTING = Setting(0.5, 20.0)
CELLS = np.array([[x, y, 0] for x in range(30) for y in range(30)])
SURFACE = CELLS[:, 0] % 6 == 0


def judged(mapper: str, log_odds: np.ndarray, setting: Setting = SETTING) -> Judged:
    config = load_config(voxel_size=setting.voxel_size, **{"map.log_odds_min": -6.0, "map.log_odds_max": 6.0})
    truth = VoxelMap.from_cells(config, CELLS, np.where(SURFACE, 6.0, -6.0))
    scores = score(VoxelMap.from_cells(config, CELLS, log_odds), truth, thresholds=THRESHOLDS)
    return Judged("drive", mapper, setting, 1, {"view": scores, "rays": scores})


PERFECT = np.where(SURFACE, 5.0, -5.0)
BLURRED = np.where(SURFACE, 1.0, -1.0) + np.random.default_rng(0).normal(0, 0.5, len(SURFACE))
USELESS = np.random.default_rng(1).normal(0, 2.0, len(SURFACE))


MISPRINTS = {("0002", "recall"), ("0005", "precision"), ("0005", "recall")}
"""Where the thesis's own counts say something else (a true positive count of 37727 would put 0005 right)."""


def test_the_printed_table_agrees_with_its_own_counts():
    for row in PRINTED:
        right, cells = row.tp + row.tn, row.tp + row.tn + row.fp + row.fn
        counted = {
            "accuracy": right / cells,
            "precision": row.tp / (row.tp + row.fp),
            "recall": row.tp / (row.tp + row.fn),
            "specificity": row.tn / (row.tn + row.fp),
            "npv": row.tn / (row.tn + row.fn),
        }
        off = {(row.sequence, name) for name, value in counted.items() if abs(value - getattr(row, name)) > 1.1e-3}
        assert off == {misprint for misprint in MISPRINTS if misprint[0] == row.sequence}


def test_the_best_threshold_is_the_one_with_the_largest_smaller_margin():
    threshold = np.array([0.2, 0.5, 0.8])
    precision, recall = np.array([0.5, 0.7, np.nan]), np.array([0.9, 0.6, 0.1])
    curve = PrecisionRecall(threshold, precision, recall, recall, precision)
    assert curve.best(EXACT)["threshold"] == 0.5
    assert curve.best(EXACT, (0.2, 0.7))["threshold"] == 0.2
    assert curve.best(TOLERANT)["tolerance_precision"] == 0.6


def test_a_perfect_map_reaches_all_targets_and_a_useless_one_none():
    found = {(SETTING, one.mapper): one for one in (judged(DEFAULT, PERFECT), judged(OCTOMAP, BLURRED))}
    assert [one.holds for one in results(found, SETTING, DEFAULT, CLAIMED)] == [True, True, True, True, None, True]
    found[SETTING, DEFAULT] = judged(DEFAULT, USELESS)
    assert [one.letter for one in results(found, SETTING, DEFAULT, CLAIMED) if one.holds] == []
    del found[SETTING, OCTOMAP]
    assert results(found, SETTING, DEFAULT, CLAIMED)[0].holds is None


def test_better_in_every_measure_means_every_one():
    far = Setting(0.5, 40.0)
    maps = [judged(name, log_odds, setting) for setting in (SETTING, far)
            for name, log_odds in ((THESIS, USELESS), (DEFAULT, BLURRED), (OCTOMAP, PERFECT))]  # fmt: skip
    claims = claims_of(maps)
    assert [claim.text[:3] for claim in claims] == ["(a)", "(b)", "(c)", "(d)", "(d)", "(e)", *["(f)"] * 4]
    assert [claim.holds for claim in claims[-4:]] == [True, False] * 2
    assert claims[-3].ours.count("(worse)") == 5
    assert not claims[0].holds  # OctoMap's map is the better one


def test_speed_is_claimed_of_default_only():
    times = {"match": {"median": 20.0}, "map": {"median": 3.0}}
    holds = [speed_claim(Speed(name, SETTING, "8x8", 5, hertz, times, 2)).holds
             for name, hertz in ((DEFAULT, 21.0), (DEFAULT, 19.9), (THESIS, 99.0))]  # fmt: skip
    assert holds == [True, False, None]


def test_octomap_gets_hits_in_range_and_clears_the_way_to_what_is_beyond():
    pytest.importorskip("octomap", reason="pip install 'stereovox[bench]'")
    camera = PinholeCamera(3, 1, 2.0, 2.0, 1.0, 0.0)
    depth = np.array([[np.nan, 30.0, 9.8]], np.float32)  # the right pixel looks along (0.5, 0, 1)
    reason = np.array([[Reason.TOO_FAR, Reason.VALID, Reason.VALID]], np.uint8)
    contestant = OctomapContestant(Setting(0.5, 10.0))
    T = np.eye(4)
    T[:3, 3] = 0.2
    contestant.add(Frame(depth, camera, T, reason=reason))
    voxel_map = contestant.map()
    ahead, left, right = (np.array([slope, 0, 1.0]) / np.hypot(slope, 1) for slope in (0.0, -0.5, 0.5))
    reach = np.array([1.0, 4.0, 9.5])[:, None]
    for direction in (ahead, left):
        assert (voxel_map.probability(0.2 + reach * direction) < 0.45).all()
        np.testing.assert_array_equal(voxel_map.state(0.2 + np.array([[11.0], [29.9]]) * direction), State.UNKNOWN)
    corner = np.array([[4.9, 0, 9.8]]) + 0.2  # in range by its depth, beyond it by its distance of 10.96
    assert voxel_map.probability(corner)[0] == pytest.approx(0.7, abs=1e-3)
    assert (voxel_map.probability(0.2 + reach * right) < 0.45).all()
    assert int((voxel_map.cells()[1] > 0).sum()) == 1


def test_frames_are_the_same_whether_they_are_kept_or_matched_anew(tmp_path, monkeypatch):
    made_street.sharpen(monkeypatch)
    drive = find_drives(made_street.raw(tmp_path, 3))[0]
    (tmp_path / "2011_09_26" / drive.name / "image_01/data/0000000001.png").unlink()
    config = config_of(DEFAULT, SETTING)
    kept, streamed = (Matched(drive, [0, 1, 2], config, room) for room in (1e9, 0))
    passes = [list(kept), list(kept), list(streamed), list(streamed)]
    assert [[number for number, _ in one] for one in passes] == [[0, 2]] * 4  # frame 1 is refused
    for one in passes[1:]:
        np.testing.assert_array_equal(one[1][1].depth, passes[0][1][1].depth)
    assert passes[0][0][1] is passes[1][0][1]
    assert passes[2][0][1] is not passes[3][0][1]
