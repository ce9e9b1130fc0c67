# SPDX-License-Identifier: Apache-2.0
"""Many recordings scored at once: each as by `map`, `truth` and `eval`, once only, with all of them added up."""

import csv
import json
from functools import partial
from pathlib import Path

import made_street
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.errors import MapFileError, StereovoxError
from stereovox.evaluate.lidar_truth import lidar_truth
from stereovox.evaluate.scores import score
from stereovox.fleet import ScoreOptions, score_fleet, scores

distributed = pytest.importorskip("distributed")
SETTINGS = {"voxel_size": 0.5, "max_range": 20.0}
PROFILES = ["default", "valenti2018"]
OPTIONS = ScoreOptions(threshold=0.35)  # three frames of a wall 15 m away are not enough for more


@pytest.fixture(scope="module")
def sequences(tmp_path_factory):
    """Return two sequences of KITTI tracking with lidar."""
    folder = tmp_path_factory.mktemp("kitti")
    with pytest.MonkeyPatch.context() as monkeypatch:
        made_street.sharpen(monkeypatch)
        for number in ("0000", "0001"):
            training = made_street.tracking(folder, 3, number)
    return [str(training / "image_02" / number) for number in ("0000", "0001")]


@pytest.fixture(scope="module")
def scheduler():
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def made(sequences, scheduler, tmp_path_factory):
    out = tmp_path_factory.mktemp("made") / "scores"
    return score_fleet(sequences, out, PROFILES, options=OPTIONS, scheduler=scheduler, **SETTINGS)


def test_each_is_scored_as_one_by_one(sequences, made, tmp_path):
    assert [(one.recording, one.profile) for one in made.scored] == [(s, p) for s in sequences for p in PROFILES]
    for number, one in enumerate(made.scored):
        mapped = sv.map_recording(
            one.recording, tmp_path / str(number), profile=one.profile, poses="given", **SETTINGS
        ).map
        truth, _ = lidar_truth(sv.open_source(one.recording), 0.5, 20.0)
        assert one.scores == score(mapped, truth, 0.35).as_dict()
        assert one.frames == mapped.frames > 0
        assert one.scores["tp"] > 0


def test_without_a_profile_cells_are_those_of_a_map_of_the_first_recording(sequences, scheduler, tmp_path):
    said, given = [], {"options": ScoreOptions(frames=":1", threshold=0.35), "max_range": 40.0}
    found = score_fleet(sequences[:1], tmp_path / "s", scheduler=scheduler, notify=said.append, **given)
    mapped = sv.map_recording(sequences[0], tmp_path / "m.svox", poses="given", frames=":1", max_range=40.0).map
    assert mapped.config.voxel_size == 0.2
    assert any("cells of 0.2 m" in line for line in said)
    truth, _ = lidar_truth(sv.open_source(sequences[0]), 0.2, 40.0, "view", ":1")
    assert found.scored[0].scores == score(mapped, truth, 0.35).as_dict()


def test_the_table_is_kept_and_adds_up(made):
    with open(f"{made.out}/scores.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["recording"] for row in rows] == [one.recording for one in made.scored] + ["all", "all"]
    for profile in PROFILES:
        *parts, total = [row for row in rows if row["profile"] == profile]
        for name in ("frames", "tp", "fp", "tn", "fn"):
            assert int(total[name]) == sum(int(row[name]) for row in parts)
        right, called = int(total["tp"]), int(total["tp"]) + int(total["fp"])
        assert float(total["precision"]) == pytest.approx(right / called)
        seen = [one.scores["observed"]["cells"] for one in made.scored if one.profile == profile]
        errors = [float(row["error"]) * n for row, n in zip(parts, seen, strict=True)]
        assert float(total["error"]) == pytest.approx(sum(errors) / sum(seen))
    kept = json.loads(Path(made.out, "scores.json").read_text())
    assert [one["scores"] for one in kept] == [json.loads(json.dumps(one.scores)) for one in made.scored]


def test_what_was_scored_is_not_scored_again(sequences, made, scheduler, monkeypatch):
    with pytest.raises(MapFileError, match="there are already scores"):
        score_fleet(sequences, made.out, PROFILES, scheduler=scheduler, **SETTINGS)
    monkeypatch.setattr(scores, "score_recording", None)  # no task is left that would need it
    again = score_fleet(sequences, made.out, PROFILES, options=OPTIONS, scheduler=scheduler, resume=True, **SETTINGS)
    assert again.scored == made.scored
    fewer = score_fleet(
        sequences[1:], made.out, PROFILES, options=OPTIONS, scheduler=scheduler, resume=True, **SETTINGS
    )
    assert fewer.scored == made.scored[2:]


def test_of_several_profiles_only_those_that_failed_are_scored_again(sequences, scheduler, tmp_path, monkeypatch):
    asked, scored = [], scores._scored

    def failing(where, folder, config, *words):
        asked.append(config.profile)
        if asked == ["default"]:
            raise ValueError("odd")
        return scored(where, folder, config, *words)

    monkeypatch.setattr(scores, "_scored", failing)
    run = partial(score_fleet, sequences[:1], tmp_path / "s", PROFILES, options=OPTIONS, scheduler=scheduler)
    first = run(**SETTINGS)
    assert [bool(one.error) for one in first.scored] == [True, False]
    assert "ValueError: odd" in first.scored[0].error
    again = run(**SETTINGS, resume=True)
    assert asked == ["default", "valenti2018", "default"]
    assert [one.profile for one in again.scored] == PROFILES
    assert not any(one.error for one in again.scored)


def test_other_settings_and_other_truths_are_scored_anew(sequences, scheduler, where):
    judged = {}
    for free in ("view", "rays"):
        found = score_fleet(
            sequences[:1], where, options=ScoreOptions(free, "1:"), scheduler=scheduler, resume=True, **SETTINGS
        )
        assert found.scored[0].frames == 2
        judged[free] = found.scored[0].scores["cells"]
    assert judged["view"] > judged["rays"] > 0


def test_what_cannot_be_scored_is_told_and_left_out(sequences, tmp_path, capsys):
    out = tmp_path / "scores"
    words = [sequences[0], "sim:box?image_width=64", "--out", str(out), "--voxel-size", "0.5", "--workers", "1"]
    assert main(["score", *words, "--json"]) == 3
    said = capsys.readouterr()
    assert "skipped: sim:box?image_width=64: " in said.out + said.err
    table = json.loads(said.out.splitlines()[-1])["table"]
    assert [row["recording"] for row in table] == [sequences[0], "all"]
    assert "0000  " in said.err + said.out  # names are short where that tells them apart


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"options": ScoreOptions("nowhere")}, "free 'nowhere' is not known"),
        ({"options": ScoreOptions(threshold=2)}, "threshold"),
        ({"options": ScoreOptions(tolerance=-1)}, "tolerance -1"),
        ({"profiles": []}, "no profile"),
        ({"voxel_size": -1}, "voxel_size"),
    ],
)
def test_wrong_values_are_told_before_any_work(sequences, tmp_path, given, why):
    with pytest.raises(StereovoxError, match=why):
        score_fleet(sequences, tmp_path / "scores", scheduler="tcp://nowhere.invalid:1", **given)
    assert not (tmp_path / "scores").exists()


def test_scores_do_not_take_the_place_of_a_map(sequences, tmp_path):
    sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0]).save(tmp_path / "map")
    with pytest.raises(MapFileError, match="is a map"):
        score_fleet(sequences, tmp_path / "map", resume=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.jpg").write_text("")
    with pytest.raises(MapFileError, match="other things"):
        score_fleet(sequences, tmp_path / "photos", resume=True)
