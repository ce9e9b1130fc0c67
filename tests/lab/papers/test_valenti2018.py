# SPDX-License-Identifier: Apache-2.0
"""`stereovox reproduce valenti2018` on small recordings in KITTI's formats."""

from __future__ import annotations

import json
import re
import sys

import made_street
import pytest

from stereovox.cli import main
from stereovox.errors import SourceError
from stereovox_lab.papers import reproduce, valenti2018
from stereovox_lab.papers.valenti import chapters
from stereovox_lab.papers.valenti.mappers import DEFAULT, OCTOMAP, THESIS
from stereovox_lab.papers.valenti.recordings import find_drives
from stereovox_lab.papers.valenti2018 import TABLE, Extent, experiments


@pytest.fixture(autouse=True)
def _sharp(monkeypatch):
    made_street.sharpen(monkeypatch)


@pytest.fixture
def no_charts(monkeypatch):
    monkeypatch.setattr(chapters, "_shown", lambda maps: [])


def nothing(done, total, text):
    """Show no progress."""


def test_a_raw_drive_gives_a_page_and_all_numbers(tmp_path):
    pytest.importorskip("octomap", reason="pip install 'stereovox[bench]'")
    drive, done = made_street.raw(tmp_path, 3), []
    result = reproduce(
        "valenti2018", tmp_path / "out", data=drive, quick=True, progress=lambda *step: done.append(step[:2])
    )
    assert done[-1][0] == done[-1][1] == max(counted for counted, _ in done)
    numbers = json.loads((tmp_path / "out/numbers.json").read_text())
    table, one, speed = (numbers["experiments"][name] for name in ("table81", f"drive_{drive.name}", "speed"))
    assert len(table["numbers"]["thesis"]) == 10
    maps = one["numbers"]["maps"]
    assert [(m["mapper"], m["voxel_size"]) for m in maps] == [
        (name, size) for size in (0.5, 0.4) for name in (THESIS, DEFAULT, OCTOMAP)
    ]
    assert {m["frames"] for m in maps} == {3}
    for m in maps:
        assert set(m["truth"]) == {"view", "rays"} | ({"box"} if m["voxel_size"] == TABLE.voxel_size else set())
        for told in (*m["truth"].values(), *m["apart"].values()):
            names = {"threshold", "precision", "recall", "tolerance_precision", "tolerance_recall"}
            for point in ("strict", "at_least"):
                assert set(told[point]) == names
            assert {"error", "correlation", "ece", "brier", "coverage", "tp", "fp", "tn", "fn"} <= set(told)
            assert "correlation" in told["observed"]
            assert len(told["listed"]) == 7
        assert m["apart"]["view"]["balanced"] is None  # three metres of street, with one wall at the end
    ours = maps[1]["truth"]["rays"]
    lowest = ours["listed"][0]
    assert lowest["tolerance_recall"] > 0.3, lowest  # stereo does find the wall
    assert lowest["tolerance_precision"] > 0.5
    assert ours["at_least"]["recall"] >= ours["strict"]["recall"]
    letters = [claim["text"][:3] for chapter in (one, speed) for claim in chapter["claims"]]
    assert set(letters) == {f"({letter})" for letter in "abcdefg"} | {"Fig"}
    unjudged = {claim["text"][:3] for claim in one["claims"] if claim["unjudged"]}
    assert unjudged == {"(a)", "(b)", "(f)", "Fig"}
    of_box, in_view = (maps[0]["truth"][kind] for kind in ("box", "view"))
    assert of_box["cells"] > in_view["cells"]
    accuracy = next(claim for claim in table["claims"] if "valenti2018: accuracy" in claim["text"])
    assert accuracy["ours"] == f"{of_box['accuracy']:.3f}"
    likeness = next(claim for claim in table["claims"] if "valenti2018: correlation" in claim["text"])
    assert likeness["ours"] == f"{of_box['correlation_free']:.3f}"
    assert any("not among the drives" in text for text in result["cannot_be_judged"])
    claims = [claim for chapter in numbers["experiments"].values() for claim in chapter["claims"]]
    assert result["holds"] == sum(claim["holds"] is True for claim in claims)
    assert result["does_not_hold"] == [claim["text"] for claim in claims if claim["holds"] is False]
    assert {"read", "match", "prepare", "map"} == set(speed["numbers"]["speeds"][0]["ms"])
    page = (tmp_path / "out/report.html").read_text()
    for text in (
        "thesis, 0009",
        "<h3>Fig 8.4</h3>",
        "Frame by frame, default",
        "thesis gives neither the cell size",
        "do not quote it",
        "wanted",
        "Each printed figure, judged",
        "cannot be judged",
        "no threshold is chosen",
    ):
        assert text in page, text
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import""", page)


def test_every_tracking_sequence_below_a_folder_is_found_and_its_labels_are_used(tmp_path, no_charts):
    pytest.importorskip("octomap", reason="pip install 'stereovox[bench]'")
    for sequence in ("0000", "0003"):
        training = made_street.tracking(tmp_path / "kitti", 2, sequence)
    drives = find_drives(tmp_path)
    assert [drive.name for drive in drives] == ["kitti_tracking_0000", "kitti_tracking_0003"]
    assert [drive.name for drive in find_drives(training / "image_02/0003")] == ["kitti_tracking_0003"]
    found = experiments(drives, Extent((TABLE,), 2), nothing)
    assert [chapter.name for chapter in found] == [
        "table81", "drive_kitti_tracking_0000", "drive_kitti_tracking_0003", "speed"]  # fmt: skip
    assert found[1].numbers["lidar"]["0.5 m, to 20 m"]["view"]["in_boxes"] > 0
    rows = [row[0] for row in found[0].sheets[0].rows]
    assert all("thresholds are chosen on kitti_tracking_000" in chapter.method for chapter in found[1:3])
    judged = [claim.text for claim in found[1].claims if claim.text[:3] in ("(a)", "(b)", "(f)") and not claim.unjudged]
    assert len(judged) == 4
    own = [claim for claim in found[0].claims if claim.text.startswith("kitti_tracking_0003, valenti2018: recall")]
    assert [claim.thesis for claim in own] == ["0.590 (of 0003)"]
    assert rows[10:] == [
        f"{drive.name}, {name}, {cells}"
        for drive in drives for name in (THESIS, DEFAULT, OCTOMAP) for cells in ("whole box", "in view")
    ]  # fmt: skip


def test_without_octomap_there_is_a_row_that_says_so(tmp_path, monkeypatch, no_charts):
    monkeypatch.setitem(sys.modules, "octomap", None)
    found = experiments(find_drives(made_street.raw(tmp_path, 2)), Extent((TABLE,)), nothing)
    assert [m["mapper"] for m in found[1].numbers["maps"]] == [THESIS, DEFAULT]
    assert "pip install 'stereovox[bench]'" in found[1].sheets[0].rows[-1][2]
    unknown = [claim for claim in found[1].claims if "not installed" in claim.unjudged]
    assert [claim.text[:3] for claim in unknown] == ["(a)", "(f)"]
    assert all(claim.holds is None for claim in unknown)


@pytest.mark.parametrize("given", ["nowhere", "empty", "", "seen"])
def test_a_wrong_folder_ends_in_one_line(given, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "seen").mkdir()
    words = ["--data", str(tmp_path / given)] if given else []
    if given == "seen":
        drive = made_street.raw(tmp_path / "seen", 2)
        (drive / "velodyne_points").rename(tmp_path / "scans")
    assert main(["reproduce", "valenti2018", "--out", str(tmp_path / "out"), *words]) == 2
    said = {"nowhere": "no such folder", "empty": "holds no drive", "": "--data", "seen": "lidar"}
    error = capsys.readouterr().err
    assert said[given] in error
    assert error.count("\n") <= 2  # a word about compiling may stand before


def test_a_damaged_recording_is_named(tmp_path):
    drive = made_street.raw(tmp_path, 2)
    (drive / "image_00/timestamps.txt").unlink()
    with pytest.raises(SourceError, match=r"timestamps\.txt"):
        find_drives(tmp_path)


def test_the_quick_run_is_a_part_of_the_full_one():
    assert set(valenti2018.QUICK.settings) < set(valenti2018.FULL.settings)
    assert {(one.voxel_size, one.max_range) for one in valenti2018.FULL.settings} == {
        (size, reach) for size in (0.5, 0.4, 0.2) for reach in (20.0, 40.0)
    }
