# SPDX-License-Identifier: Apache-2.0
import re

import pytest
from made_pages import Balanced

from stereovox.errors import StereovoxError
from stereovox.view.report.demo import report, write_report

TIMES = {"median": 1.25, "p90": 2.0, "p99": 3.0, "max": 4.0}
PART = {
    "pieces": 2,
    "missing": ["pole <2 cm>"],
    "seen_cells": 1234,
    "recall": 0.5,
    "tolerance_recall": None,
    "longest_gap": 0.25,
}
SUMMARY = {
    "source": "sim:room",
    "camera": "D435",
    "voxel_size": 0.05,
    "frames": 240,
    "settings": {"noise": {"s2": None}, "x": 7},
    "depth_ms": TIMES,
    "integrate_ms": TIMES,
    "frame_ms": {"median": 2.53, "p90": 4.0, "p99": 6.0, "max": 7.77},
    "occupied": 4321,
    "memory_bytes": 2_500_000,
    "min_frames": 20,
    "missing": ["pole <2 cm>"],
    "parts": {"poles": PART},
    "accuracy": {
        "tp": 1,
        "fp": 2,
        "tn": 3,
        "fn": 4,
        "excluded": 5,
        "free_in_solid": 6,
        "accuracy": 0.4,
        "precision": 0.333,
        "recall": 0.2,
        "specificity": 0.6,
        "npv": 0.43,
        "tolerance_precision": 0.9,
        "tolerance_recall": 0.987,
    },
}


def test_the_page_holds_the_figures_and_needs_no_other_file():
    page = report(SUMMARY, b"png")
    figures = ("98.7 %", "4,321", "2.5 ms", "7.77 ms", "2.5 MB", "25 cm", "cG5n")
    for text in (*figures, "pole &lt;2 cm&gt;", "noise.s2", "from the camera"):
        assert text in page, text
    assert "{{" not in page
    assert "through the window" in page.partition("<img")[2].partition("<h2>")[0], "what lies outside is explained"
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import""", page)
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []


def test_a_report_that_cannot_be_written_is_one_line(tmp_path):
    picture = tmp_path / "a.png"
    picture.write_bytes(b"png")
    with pytest.raises(StereovoxError, match=r"nowhere.*cannot be written"):
        write_report(tmp_path / "nowhere" / "report.html", SUMMARY, picture)
