# SPDX-License-Identifier: Apache-2.0
import json
import re
from dataclasses import replace

import pytest
from made_pages import Balanced

from stereovox.errors import StereovoxError
from stereovox.simulate.simulation import Simulation
from stereovox_lab.papers import PAPERS, chien2020, reproduce
from stereovox_lab.papers.chapter import NO, UNJUDGED, YES, Chapter, Claim, Sheet, Shown, count
from stereovox_lab.papers.chien.own import map_own
from stereovox_lab.papers.output import report

CHAPTER = Chapter(
    "boxes",
    "Boxes <2>",
    "What was done.",
    [
        Claim("wide", "2", "2 cells", True),
        Claim("late & slow", "1 ms", "3 ms", False),
        Claim("beside", "-", "7", None),
        Claim("elsewhere", "3", "-", None, "no recording"),
    ],
    [Shown("Fig 4.6", "two cells", "ours & yours", b"png")],
    [Sheet("Rows", ("a", "b"), [(1, "<x>")])],
    ["A remark."],
    {"answer": 42},
)


def test_the_page_says_what_holds_and_needs_no_other_file():
    page = report("Title <1>", "Lead", [("3", "claims")], [CHAPTER])
    for text in ("Title &lt;1&gt;", "Boxes &lt;2&gt;", YES, NO, "late &amp; slow", "cG5n", "&lt;x&gt;", "A remark."):
        assert text in page, text
    failed = page.partition("What does not hold")[2].partition("<h2>")[0]
    assert "late &amp; slow" in failed
    assert "<td>wide</td>" not in failed
    assert f"{UNJUDGED}: no recording" in page
    held = report("T", "L", [], [replace(CHAPTER, claims=CHAPTER.claims[:1])])
    assert "Every claim that can be judged holds." in held
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import""", page)
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []


@pytest.fixture
def one_chapter(monkeypatch):
    monkeypatch.setattr(chien2020, "experiments", lambda sizes, steps, camera: [CHAPTER])
    monkeypatch.setattr(chien2020, "formulas", lambda paper: Chapter("formulas", "Formulas", paper, []))


def test_both_files_are_written_and_say_the_same(one_chapter, tmp_path):
    result = reproduce("chien2020", tmp_path / "new" / "folder", quick=True)
    assert result["holds"] == 1
    assert result["does_not_hold"] == ["late & slow"]
    numbers = json.loads((tmp_path / "new" / "folder" / "numbers.json").read_text())
    assert numbers["experiments"]["boxes"]["numbers"] == {"answer": 42}
    assert [claim["holds"] for claim in numbers["experiments"]["boxes"]["claims"]] == [True, False, None, None]
    assert result["cannot_be_judged"] == ["elsewhere: no recording"]
    assert count(CHAPTER.claims) == (1, 1, 1, 1)
    page = (tmp_path / "new" / "folder" / "report.html").read_text()
    assert "do not quote it" in page


def test_a_recording_of_ones_own_is_mapped_under_both_profiles(one_chapter, tmp_path):
    steps = []
    own = map_own(Simulation("sim:wall?image_width=212&frames=6"), lambda: steps.append(1))
    assert len(steps) == 6
    assert [row[:2] for row in own.sheets[0].rows] == [("chien2020", "6"), ("default", "6")]
    assert all(figures["occupied"] > 0 for figures in own.numbers.values())
    reproduce("chien2020", tmp_path, data="sim:wall?image_width=64&frames=3")
    chapter = (tmp_path / "report.html").read_text().partition("<h2>2. Your recording")[2]
    assert "<h3>Your recording, chien2020</h3>" in chapter
    assert "<h3>Your recording, default</h3>" in chapter
    assert "Fig 4.11" not in chapter
    assert "as published" not in chapter
    assert "holds?" not in chapter  # no table of no claims
    with pytest.raises(StereovoxError, match="nowhere"):
        reproduce("chien2020", tmp_path, data=tmp_path / "nowhere")


def test_mistakes_are_told_before_the_work(monkeypatch, tmp_path):
    done = []
    monkeypatch.setattr(chien2020, "experiments", lambda sizes, steps, camera: done.append(1) or [CHAPTER])
    nothing = Simulation("sim:wall?image_width=16&frames=3")
    monkeypatch.setattr(nothing, "frame", lambda i: replace(Simulation.frame(nothing, i), fault="no_pose"))
    monkeypatch.setattr(chien2020, "open_source", lambda where: nothing)
    with pytest.raises(StereovoxError, match="not one frame can be used"):
        reproduce("chien2020", tmp_path, data="mine")
    (tmp_path / "numbers.json").mkdir()
    with pytest.raises(StereovoxError, match="choose another --out"):
        reproduce("chien2020", tmp_path)
    assert done == []


def test_what_goes_wrong_is_one_line(one_chapter, tmp_path):
    with pytest.raises(StereovoxError, match=r"unknown paper 'ist'.*ist2019"):
        reproduce("ist", tmp_path)
    with pytest.raises(StereovoxError, match=r"unknown paper 'chien'.*chien2020"):
        reproduce("chien", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(StereovoxError, match="choose another --out"):
        reproduce("chien2020", tmp_path / "file")
    (tmp_path / "report.html").mkdir()
    with pytest.raises(StereovoxError, match=r"report\.html: cannot be written; choose another --out"):
        reproduce("chien2020", tmp_path)
    with pytest.raises(StereovoxError, match="choose another --out"):
        reproduce("chien2020", "a\0b")
    assert set(PAPERS) == {"chien2020", "valenti2018", "ist2019"}
