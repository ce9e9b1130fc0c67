# SPDX-License-Identifier: Apache-2.0
"""The page and pictures of an evaluation."""

import io
import re

import numpy as np
import pytest
from matplotlib.image import imread

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.evaluate.decisions import Outcome, Outcomes, outcomes, percent
from stereovox.evaluate.scores import score
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.view.evaluation import EXACT_COLOURS as EXACT
from stereovox.view.evaluation import MISS, RIGHT, WRONG, curves_png, mixed, outcomes_png, series_png
from stereovox.view.evaluation import TOLERANT_COLOURS as TOLERANT
from stereovox.view.report.evaluation import Evaluated, evaluation_page, write_evaluation_report
from stereovox_lab.papers.valenti.judge import ScoreSeries

CONFIG = sv.load_config(voxel_size=0.5)
CELLS = np.argwhere(np.ones((12, 8, 3)))


def drawn(png):
    return imread(io.BytesIO(png))[..., :3]


def holds(image, colour):
    """Whether at least a few pixels have just this colour."""
    from matplotlib.colors import to_rgb

    return (np.abs(image - to_rgb(colour)).max(axis=2) < 0.01).sum() > 20


@pytest.fixture(scope="module")
def truth():
    surface = CELLS[:, 0] == 5
    return TruthCells(sv.VoxelMap.from_cells(CONFIG, CELLS, np.where(surface, 3.0, -2.0)))


@pytest.fixture(scope="module")
def ours():
    random = np.random.default_rng(1)
    level = np.where(CELLS[:, 0] == 5 + (CELLS[:, 1] > 5), 2.0, -1.0) + 0.3 * random.standard_normal(len(CELLS))
    return sv.VoxelMap.from_cells(CONFIG, CELLS, level)


def series(truth, ours):
    found = ScoreSeries(truth)
    found.add(0, sv.VoxelMap(CONFIG))
    found.add(1, ours)
    return found.arrays()


def test_the_charts_show_something(truth, ours):
    for png in (
        curves_png(score(ours, truth)),
        curves_png(score(ours, truth, path=[0, 0, 0])),
        curves_png(score(sv.VoxelMap(CONFIG), truth)),
        series_png(series(truth, ours)),
    ):
        assert (drawn(png) < 0.9).any(axis=2).mean() > 0.01


def test_the_top_view_has_the_colours_of_what_is_there(truth, ours):
    image = drawn(outcomes_png(outcomes(truth.read(ours), truth, 0.7)))
    assert all(holds(image, colour) for colour in (RIGHT, WRONG, MISS))
    missed = Outcomes(np.array([[0, 0, 0], [3, 9, 0]], np.int32), np.full(2, Outcome.MISSED, np.uint8), 0.5, "z")
    legend_only = drawn(outcomes_png(missed))
    assert (np.abs(legend_only - image[0, 0]).max() > 0.1).any()
    outcomes_png(Outcomes(np.empty((0, 3), np.int32), np.empty(0, np.uint8), 0.5, "z"))
    with pytest.raises(StereovoxError, match="'w'"):
        outcomes_png(missed, "w")


def test_a_column_mixes_the_colours_of_its_cells():
    from matplotlib.colors import to_rgb

    places = np.array([[0, 0], [0, 0], [0, 0], [2, 1]])
    outcome = np.array([Outcome.HIT, Outcome.HIT, Outcome.MISSED, Outcome.NEAR], np.uint8)
    image = mixed(places, outcome, (3, 2), EXACT)
    assert image.shape == (2, 3, 3)
    assert image[0, 0] == pytest.approx((2 * np.array(to_rgb(RIGHT)) + to_rgb(MISS)) / 3)
    assert image[1, 2] == pytest.approx(to_rgb(WRONG))
    assert image[0, 1].tolist() == [1, 1, 1]
    assert mixed(places, outcome, (3, 2), TOLERANT)[1, 2] == pytest.approx(to_rgb(RIGHT))


def test_the_page_has_every_result_and_needs_no_other_file(truth, ours):
    shown = outcomes(truth.read(ours), truth, 0.7)
    results = [
        Evaluated("one <b>", score(ours, truth), series(truth, ours), shown),
        Evaluated("two", score(ours, truth, 0.5)),
        Evaluated("nothing", score(sv.VoxelMap(CONFIG), truth)),
    ]
    page = evaluation_page(results, "lidar & co")
    assert "one &lt;b&gt;" in page
    assert "<b>one" not in page
    assert "lidar &amp; co" in page
    for one in results:
        for name in ("precision", "recall", "correlation", "tolerance_recall", "ece"):
            value = getattr(one.scores, name)
            assert ("-" if value is None else f"{value:.3f}") in page, name
    assert page.index("What it decides: one") < page.index("Table 8.1")
    for one in results:
        for share in (one.scores.decisions.surface_free, one.scores.decisions.occupied_near):
            assert percent(share) in page
        assert all(f"<td>{part.by}: {part.name}</td>" in page for part in one.scores.parts)
    assert page.count("data:image/png") == 5  # top view, series and three pages of charts
    assert "{{" not in page
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import""", page)


def test_mistakes_are_one_line(truth, ours, tmp_path):
    with pytest.raises(StereovoxError, match="no result"):
        evaluation_page([], "truth")
    (tmp_path / "file").write_text("")
    with pytest.raises(StereovoxError, match="cannot write the report"):
        write_evaluation_report(tmp_path / "file", [Evaluated("a", score(ours, truth))], "truth")
