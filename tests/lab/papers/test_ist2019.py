# SPDX-License-Identifier: Apache-2.0
"""`stereovox reproduce ist2019` on short drives."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from made_pages import Balanced

from stereovox.cli import main
from stereovox.formats.map_server import read_map_server
from stereovox.localize.slam.graph import MapDoubt
from stereovox.simulate.floors.floor import Floor, write_bag
from stereovox_lab.papers import ist2019, reproduce
from stereovox_lab.papers.ist.claims import claims_of, fan_claims, numbers_of
from stereovox_lab.papers.ist.drives import PLACES, Drive, Extent, record
from stereovox_lab.papers.ist.fans import DISTANCE, FEW, MANY, simulate
from stereovox_lab.papers.ist.publish import time_publishing
from stereovox_lab.papers.ist.survey import _judge, survey
from stereovox_lab.papers.ist.variants import MIDDLE, OURS, THEIRS, VARIANTS
from stereovox_lab.papers.ist2019 import QUICK, Sizes

pytest.importorskip("rosbags", reason="needs the extra 'bags'")
pytest.importorskip("gtsam", reason="needs the extra 'slam'")
SHORT = "image_width=128&scan_hz=5"
TINY = Sizes(Extent(f"depth_hz=5&seconds=9&{SHORT}", f"seconds=20&{SHORT}"), VARIANTS[:3], 64)


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setattr(ist2019, "QUICK", TINY)


def no_outside_link(page: str) -> bool:
    return not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import""", page)


def test_both_floors_give_a_page_maps_and_all_numbers(tmp_path):
    done = []
    result = reproduce("ist2019", tmp_path, quick=True, progress=lambda *step: done.append(step[:2]))
    assert done[-1][0] == done[-1][1] == max(counted for counted, _ in done)
    numbers = json.loads((tmp_path / "numbers.json").read_text())["experiments"]
    assert list(numbers) == ["simulation", "corridors", "testbed", "table1", "formulas"]
    for name in ("corridors", "testbed"):
        told = numbers[name]["numbers"]
        assert (told["scans"], told["frames"]) == (45, 45)
        assert list(told["maps"]) == [THEIRS, OURS, MIDDLE]
        assert told["slam_way"]["position_rms_m"] < 0.1
        assert told["amcl_way"]["position_median_m"] < 0.2
        ours, theirs = told["maps"][MIDDLE], told["maps"][THEIRS]
        assert ours["figures"]["frames"] > 35  # an image whose middle row shows nothing is refused
        assert theirs["scores"]["occupied_iou_tolerant"] > 0.3
        assert theirs["scores"]["distance_m"]["to_reference"]["median"] < 0.1
        assert set(theirs["of_building"]) == {"lidar", "band", "above"}
        saved = [read_map_server(tmp_path / f"{name}_{kind}.yaml") for kind in ("reference", "ist2019", "default")]
        assert {grid.resolution for grid in saved} == {0.02}
        assert all((grid.cells == 100).sum() > 50 for grid in saved)
    assert numbers["corridors"]["numbers"]["excluded"]
    assert not numbers["testbed"]["numbers"]["excluded"]
    assert numbers["corridors"]["numbers"]["first_scans"] == 100
    claims = [claim for chapter in numbers.values() for claim in chapter["claims"]]
    assert result["holds"] == sum(claim["holds"] is True for claim in claims)
    page = (tmp_path / "report.html").read_text()
    for text in ("Fig 3", "Fig 4", "Fig 6", "Fig 9", "26.2 %", "30.42 %", "Table I", "0.320", "do not quote it"):
        assert text in page, text
    assert page.count("data:image/png") == 1 + 2 * 6
    assert no_outside_link(page)
    checker = Balanced()
    checker.feed(page)
    assert checker.open == []
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".html", ".json"] + [".pgm"] * 8 + [".yaml"] * 8


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    bag = tmp_path_factory.mktemp("own") / "mine.bag"
    write_bag(Floor(f"sim:floor?plan=testbed&seconds=9&{SHORT}"), bag)
    return bag


def test_a_bag_of_ones_own_needs_no_truth(mine, tmp_path, capsys):
    words = ["reproduce", "ist2019", "--data", str(mine), "--out", str(tmp_path / "out"), "--quick"]
    assert main(words) == 0
    numbers = json.loads((tmp_path / "out/numbers.json").read_text())["experiments"]
    assert list(numbers) == ["simulation", "own", "table1", "formulas"]
    told = numbers["own"]["numbers"]
    assert told["slam_way"] is None
    assert told["reference_of_building"] is None
    assert told["maps"][THEIRS]["scores"]["eq7_percent"] > 0
    assert {claim["holds"] for claim in numbers["own"]["claims"]} == {None}
    page = (tmp_path / "out/report.html").read_text()
    assert "Your recording: mine" in page
    assert "2 claims do not" not in page
    own = page.partition("<h2>2. Your recording: mine")[2]
    assert own
    assert "as published" not in own
    assert capsys.readouterr().err


@pytest.mark.parametrize("given", ["nowhere.bag", "no_depth.bag", "no_scans.bag"])
def test_a_bag_that_will_not_do_ends_in_one_line(given, tmp_path, capsys):
    hz = {"no_depth.bag": "depth_hz=0", "no_scans.bag": "scan_hz=0&image_width=32"}.get(given)
    if hz:
        write_bag(Floor(f"sim:floor?seconds=1&{hz}"), tmp_path / given)
    assert main(["reproduce", "ist2019", "--data", str(tmp_path / given), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    said = {"nowhere.bag": "no such file", "no_depth.bag": "no depth images", "no_scans.bag": "no lidar scans"}[given]
    assert said in error
    assert error.count("\n") <= 2  # a word about compiling may stand before


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory):
    drive, folder = (
        Drive.through(PLACES[1], Extent("speed=1.5&scan_hz=3&depth_hz=2&image_width=160")),
        tmp_path_factory.mktemp("testbed"),
    )
    return survey(record(drive, folder), (*VARIANTS[:3], VARIANTS[4]), folder, lambda: None)


def test_the_whole_chain_reaches_its_target(surveyed):
    found = surveyed
    theirs, ours = (found.judged[name].scores for name in (THEIRS, MIDDLE))
    assert max(theirs.eq7_percent, ours.eq7_percent) < 10
    assert found.reference.way_error.position_rms_m < 0.1
    assert found.way_error.position_rms_m < 0.1
    assert theirs.free_iou > 0.9
    assert theirs.occupied.tolerance_recall > 0.9
    assert ours.occupied.tolerance_precision > 0.7


def test_claims_on_a_doubted_reference_do_not_hold(surveyed):
    good = claims_of(surveyed, PLACES[1])
    doubt = MapDoubt("unseen", 3.0, 9.0, 0.5)
    slam = replace(surveyed.reference.slam, doubts=[doubt])
    doubted = replace(surveyed, reference=replace(surveyed.reference, slam=slam))
    bad = claims_of(doubted, PLACES[1])
    assert good[0].holds is True
    assert (bad[0].holds, bad[0].ours) == (False, doubt.line())
    of_reference = [(a, b) for a, b in zip(good[1:], bad[1:], strict=True) if a != b]
    assert len(of_reference) >= 4
    assert all(b.holds is False and b.ours.endswith("the reference is doubted") for _, b in of_reference)
    alone = [a.text for a, b in zip(good, bad, strict=True) if a == b and a.holds is not None]
    assert alone
    assert all("way" in text or "building" in text or "which sees one height only" in text for text in alone)
    assert numbers_of(doubted)["doubts"] == [{**doubt.as_dict(), "text": doubt.line()}]
    assert {one.holds for one in claims_of(doubted, None)} == {None}


def test_doubts_of_a_reference_are_printed_and_end_in_status_3(mine, surveyed, tmp_path, capsys, monkeypatch):
    doubt = MapDoubt("unseen", 3.0, 9.0, 0.5)
    slam = replace(surveyed.reference.slam, doubts=[doubt])
    doubted = replace(surveyed, reference=replace(surveyed.reference, slam=slam))
    monkeypatch.setattr(ist2019, "survey", lambda recording, *_: replace(doubted, recording=recording))
    words = ["reproduce", "ist2019", "--data", str(mine), "--out", str(tmp_path / "out"), "--quick"]
    assert main([*words, "--json"]) == 3
    said = capsys.readouterr()
    told = {"experiment": "own", **doubt.as_dict(), "text": doubt.line()}
    assert json.loads(said.out)["doubts"] == [told]
    assert f"warning: the reference map of own may be wrong: {doubt.line()}" in said.err.replace("\n", " ")
    assert doubt.line() in (tmp_path / "out/report.html").read_text()


def unseen(cells):
    return np.full_like(cells, -1)


def without_walls(cells):
    return np.where(cells > 50, 0, cells).astype(np.int8)


def opposite(cells):
    return np.where(cells < 0, cells, 100 - cells).astype(np.int8)


def aside(cells):
    return np.roll(cells, 15, axis=1)


def test_every_claim_about_a_floor_fails_with_some_broken_map_or_way(surveyed):
    """No claim may hold whatever the code does: each one breaks with at least one map, or way, that is wrong."""
    place = PLACES[1]
    left = {claim.text for claim in claims_of(surveyed, place) if claim.holds is not None}
    assert len(left) > 8
    off = replace(surveyed.way_error, position_rms_m=0.2)
    ways = replace(surveyed, way_error=off, reference=replace(surveyed.reference, way_error=off))
    slam = replace(surveyed.reference.slam, doubts=[MapDoubt("unseen", 3.0, 9.0, 0.5)])
    doubted = replace(surveyed, reference=replace(surveyed.reference, slam=slam))
    left -= {one.text for one in [*claims_of(ways, place), claims_of(doubted, place)[0]] if one.holds is False}
    for broken, (name, one) in product((without_walls, aside, opposite, unseen), surveyed.judged.items()):
        if left:
            made = replace(one.made, grid=replace(one.made.grid, cells=broken(one.made.grid.cells)))
            bad = _judge(made, surveyed.reference, surveyed.excluded, surveyed.recording)
            claims = claims_of(replace(surveyed, judged={**surveyed.judged, name: bad}), place)
            left -= {claim.text for claim in claims if claim.holds is False}
    assert not left


def test_a_region_that_no_door_hides_is_told_from_one_that_a_door_does(surveyed):
    (x0, y0), resolution = surveyed.reference.grid.origin[:2], surveyed.reference.grid.resolution
    rows, columns = np.nonzero(surveyed.reference.grid.cells == 0)
    middle = (float(np.median(columns)) * resolution + x0, float(np.median(rows)) * resolution + y0)
    seen = [(middle[0] - 1, middle[1] - 1, middle[0] + 1, middle[1] + 1)]
    good = surveyed.judged[THEIRS].made
    cells = good.grid.cells.copy()
    x, y = (good.grid.centres(*np.indices(cells.shape)[:, :, :].reshape(2, -1))).T
    cells.ravel()[(np.abs(x - middle[0]) < 1.1) & (np.abs(y - middle[1]) < 1.1)] = -1
    for grid, holds in ((good.grid, False), (replace(good.grid, cells=cells), True)):
        judged = _judge(replace(good, grid=grid), surveyed.reference, seen, surveyed.recording)
        found = replace(surveyed, judged={**surveyed.judged, THEIRS: judged}, excluded=seen)
        (claim,) = [claim for claim in claims_of(found, PLACES[1]) if "door" in claim.text]
        assert claim.holds is holds, claim.ours


def test_synthetic_beams_mark_what_the_report_says():
    steps = []
    many, few = simulate([DISTANCE] * MANY, lambda: steps.append(1)), simulate(FEW, lambda: steps.append(1))
    assert len(steps) == 2
    assert (len(many.scan.ranges), len(few.scan.ranges)) == (700, 10)
    assert [claim.holds for claim in fan_claims(many, few)] == [True] * 3
    # counted once more: middles of cells inside the sector
    y, x = np.mgrid[-200:200, 0:200] * 0.02 + 0.01
    inside = (np.hypot(x, y) < DISTANCE) & (np.abs(np.degrees(np.arctan2(y, x))) < 57 / 2)
    assert many.free == pytest.approx(inside.sum(), rel=0.03)
    assert few.expected_free is None
    assert few.free == pytest.approx(sum(FEW) / 0.02, rel=0.15)
    wrong = (replace(many, free=many.free * 2), replace(few, right=0.5))
    assert [claim.holds for claim in fan_claims(*wrong)] == [False, True, False]
    assert not fan_claims(replace(many, beyond=1), few)[1].holds


def test_what_a_shut_door_closes_off_is_seen_from_the_start_of_the_first_drive():
    corridors, testbed = (Drive.through(place, Extent("seconds=2", "seconds=2")) for place in PLACES)
    (x0, y0, x1, y1), start = corridors.floor.behind_door, corridors.first.start
    assert start[2] == 0
    (seen,) = corridors.closed_off
    assert seen == pytest.approx([x0 - start[0], y0 - start[1], x1 - start[0], y1 - start[1]])
    assert (corridors.floor.options.shut, corridors.first.options.shut) == (True, False)
    assert testbed.closed_off == []
    assert testbed.first is testbed.floor


def test_publishing_is_timed_and_the_quick_run_is_smaller():
    published = time_publishing(40)
    assert published.side == 40
    assert published.picture > 0
    assert published.message > 0
    names = [{one.name for one in sizes.variants} for sizes in (QUICK, Sizes())]
    assert {THEIRS, OURS, MIDDLE} < names[0] < names[1]
    assert [(place.error_percent, place.update_s) for place in PLACES] == [(26.2, 0.21), (30.42, 0.32)]
