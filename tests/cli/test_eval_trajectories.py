# SPDX-License-Identifier: Apache-2.0
"""`stereovox eval` of two files of poses: what it prints and writes, and what it says about wrong use."""

import json

import numpy as np
import pytest
from made_trajectories import flight, moved, shaken, timed, write_kitti, write_tum

import stereovox as sv
from stereovox.cli import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_tum(tmp_path / "ours.tum", timed(shaken(moved() @ flight(), 1)[:200]))
    write_tum(tmp_path / "truth.tum", timed(flight()))
    write_tum(tmp_path / "later.tum", timed(flight(), np.arange(300) * 10**8 + 10**15))
    write_tum(tmp_path / "still.tum", timed(np.repeat(flight(1), 50, axis=0)))
    write_kitti(tmp_path / "kitti.txt", flight())
    (tmp_path / "words.txt").write_text("no poses\nat all\n")
    sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0]).save(tmp_path / "map.svox")
    return tmp_path


def run(capsys, *words):
    status = main(["eval", *words])
    captured = capsys.readouterr()
    return status, captured.out, captured.err.splitlines()


@pytest.mark.usefixtures("folder")
def test_a_table_is_printed_and_one_object_of_json(capsys):
    status, out, err = run(capsys, "ours.tum", "truth.tum", "--json")
    found, score = json.loads(out), sv.score_trajectory("ours.tum", "truth.tum")
    assert status == 0
    assert found == json.loads(json.dumps(score.as_dict()))
    assert err[0].startswith("200 of 200 poses have one of the truth's 300, along ")
    assert err[0].endswith("in 19.90 s; they cover 66.6% of the truth. Aligned rigidly first.")
    table = {tuple(line.split()[:2]): line.split() for line in err}
    assert table["position", "(ATE)"][2:5] == ["200", f"{score.position_m.rmse:.4f}", f"{score.position_m.mean:.4f}"]
    assert table["motion", "per"][4:6] == ["190", f"{score.per_second.translation_m.rmse:.4f}"]
    assert table["10", "m"][2:] == [str(score.segments[3].segments), f"{score.segments[3].translation_percent:.3f}",
                                    "%", f"{score.segments[3].rotation_deg_per_m:.5f}", "deg/m"]  # fmt: skip
    assert any(line.startswith("drift: ") and f"{score.drift_percent:.3f} %" in line for line in err)
    assert not any("note" in line for line in err)


@pytest.mark.usefixtures("folder")
def test_options_are_used(capsys):
    words = ("ours.tum", "truth.tum", "--json", "--max-difference", "0.001", "--segment", "3", "--segment", "4.5")
    found = json.loads(run(capsys, *words, "--scale")[1])
    assert [one["length_m"] for one in found["segments"]] == [3, 4.5]
    assert found["scale"] != 1
    assert json.loads(run(capsys, *words, "--no-align")[1])["position_m"]["rmse"] > 10


@pytest.mark.parametrize("align", [True, False])
def test_what_all_rotations_have_in_common_is_explained(folder, capsys, align):
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    write_tum(folder / "axes.tum", timed(flight() @ turned))
    _, _, err = run(capsys, "axes.tum", "truth.tum", *([] if align else ["--no-align"]))
    note = next(line for line in err if line.startswith("note: 90.0 degrees"))
    assert ("too straight" in note) is align
    assert ("leave --no-align out" in note) is not align


def test_a_page_and_a_picture_are_written(folder, capsys):
    status, out, err = run(capsys, "kitti.txt", "kitti.txt", "--report", "report", "--json")
    page = (folder / "report/evaluation.html").read_text()
    assert (status, json.loads(out)["report"], err[-1]) == (
        0,
        "report/evaluation.html",
        "report: report/evaluation.html",
    )
    assert (folder / "report/trajectory.png").read_bytes()[:4] == b"\x89PNG"
    assert "kitti.txt compared with kitti.txt: 300 of 300 poses" in page
    assert "position (ATE)" in page
    assert "data:image/png" in page


def test_a_picture_alone_is_written(folder, capsys):
    status, _, err = run(capsys, "kitti.txt", "kitti.txt", "--picture", "way.png")
    assert (status, err[-1]) == (0, "saved way.png")
    assert (folder / "way.png").read_bytes()[:4] == b"\x89PNG"


WRONG = {
    ("later.tum", "truth.tum"): "later.tum: 0 poses have one of truth.tum no more than 0.02 s apart",
    ("still.tum", "truth.tum"): "still.tum: stands still",
    ("kitti.txt", "truth.tum"): "kitti.txt: has no times",
    ("words.txt", "truth.tum"): "words.txt",
    ("none.tum", "truth.tum"): "none.tum: No such file",
    ("map.svox", "truth.tum"): "truth.tum: a file of poses, but the other is not",
    ("ours.tum", "truth.tum", "--threshold", "0.5"): "--threshold: only for maps",
    ("ours.tum", "truth.tum", "--tolerance", "3"): "--tolerance: only for maps",
    ("ours.tum", "truth.tum", "--tolerance", "0"): "--tolerance: only for maps",
    ("map.svox", "map.svox", "--scale"): "--scale: only for trajectories",
    ("map.svox", "map.svox", "--picture", "way.png"): "--picture: only for trajectories",
    ("ours.tum", "truth.tum", "--picture", "way.jpg"): "--picture way.jpg: end the file's name with .png",
    ("map.svox", "map.svox", "--max-difference", "0"): "--max-difference: only for trajectories",
    ("map.svox", "map.svox", "--no-align"): "--no-align: only for floor maps (.yaml) and trajectories",
    ("kitti.txt", "kitti.txt", "--max-difference", "0.1"): "kitti.txt: has no times, poses pair by number or line",
    ("ours.tum", "truth.tum", "--no-align", "--scale"): "scale",
    ("ours.tum", "truth.tum", "--segment", "0"): "give lengths in metres above 0",
    ("ours.tum", "truth.tum", "--max-difference", "-1"): "give seconds above 0",
}


@pytest.mark.parametrize("words", WRONG, ids=" ".join)
@pytest.mark.usefixtures("folder")
def test_wrong_use_is_one_line(capsys, words):
    status, out, err = run(capsys, *words)
    assert (status, out, len(err)) == (2, "", 1)
    assert WRONG[words] in err[0]
