# SPDX-License-Identifier: Apache-2.0
"""stereovox track, and map with the poses it finds."""

import json

import pytest
from made_unposed import ROOM, unposed

from stereovox.cli import main


def run(capsys, *words):
    status = main([*map(str, words)])
    said = capsys.readouterr()
    return status, said.out, said.err


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_track_writes_poses_and_says_how_it_went(here, capsys):
    unposed(here / "desk", 6)
    status, out, err = run(capsys, "track", "desk", "--out", "way.tum", "--json")
    found = json.loads(out.splitlines()[-1])
    assert (status, found["frames"], found["tracked"], found["lost"]) == (0, 6, 6, [])
    assert set(found["frame_ms"]) == {"median", "p90", "p99", "max"}
    assert "6 of 6 frames tracked over 0.2" in err
    assert "saved in way.tum; make a map with these poses: stereovox map desk --poses track" in err
    assert len((here / "way.tum").read_text().splitlines()) == 7


def test_where_the_camera_was_lost_is_said_and_is_the_exit_status(here, capsys):
    unposed(here / "desk", 6, covered=[3])
    status, out, err = run(capsys, "track", "desk", "--out", "way.tum", "--json")
    found = json.loads(out.splitlines()[-1])
    assert (status, found["tracked"], found["lost"][0]["first"], found["lost"][0]["last"]) == (3, 3, 3, 5)
    assert "3 of 6 frames tracked" in err
    assert "  lost from frame 3 to 5 (0.1 s): " in err


def test_poses_of_the_recording_are_compared_with(here, capsys):
    status, out, err = run(capsys, "track", ROOM, "--out", "way.tum", "--frames", ":6", "--json")
    assert status == 0
    assert "aligned with the recording's own poses, positions are off by 0." in err
    assert json.loads(out.splitlines()[-1])["score"]["poses"] == 6


def test_the_next_line_to_type_has_the_options_of_this_one(here, capsys):
    unposed(here / "desk", 6)
    options = ["--profile", "default", "--max-range", "4.0", "--frames", ":5", "--set", "noise.s0=0.002"]
    _, _, err = run(capsys, "track", "desk", "--out", "way.tum", *options)
    line = err.splitlines()[-1].partition("poses: stereovox ")[2]
    assert line == f"map desk --poses track {' '.join(options)}"
    status, _, err = run(capsys, *line.split())
    assert (status, "poses: tracked, 5 of 5 frames" in err) == (0, True)


def test_pictures_with_and_without_poses_to_compare_with(here, capsys):
    unposed(here / "desk", 8, covered=[1, 6])
    for words, picture in (((ROOM, "--frames", ":6"), "room.png"), (("desk",), "desk.png")):
        _, _, err = run(capsys, "track", *words, "--out", "way.tum", "--picture", picture)
        assert f"saved {picture}" in err
        assert (here / picture).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nowhere", "--out", "way.tum"), "no such folder"),
        ((ROOM, "--out", "way.svox"), "way.svox"),
        ((ROOM, "--out", "way.tum", "--picture", "way.gif"), "--picture way.gif: end the file's name with .png"),
        ((ROOM, "--out", "way.tum", "--picture", "nowhere/way.png"), "nowhere/way.png: there is no folder"),
        ((ROOM, "--out", "way.tum", "--set", "max_rnge=3"), "max_range"),
        (("dark", "--out", "way.tum"), "not one frame could be tracked"),
    ],
)
def test_mistakes_are_one_line(here, capsys, words, said):
    unposed(here / "dark", 3, covered=range(3))
    status, _, err = run(capsys, "track", *words)
    assert status == 2
    assert said in err.splitlines()[-1]
    assert not (here / "way.tum").exists()


def test_map_says_which_poses_it_uses(here, capsys):
    unposed(here / "desk", 6, covered=[4])
    status, out, err = run(capsys, "map", "desk", "--json")
    found = json.loads(out.splitlines()[-1])
    assert (status, found["poses"], found["frames"], found["refused"]) == (0, "track", 4, {"tracking_lost": 2})
    assert "note: the camera is tracked by visual odometry, since poses are missing (desk: has depth images (6)" in err
    assert "poses: tracked, 4 of 6 frames\n  lost from frame 4 to 5 (0.0 s): " in err
    unposed(here / "posed", 6, poses=True)
    status, out, err = run(capsys, "map", "posed", "--json")
    found = json.loads(out.splitlines()[-1])
    assert (status, found["poses"], "lost" in found) == (0, "given", False)
    assert "poses: from the recording" in err
    status, _, err = run(capsys, "map", "posed", "--out", "again.svox", "--poses", "track")
    assert (status, "poses: tracked, 6 of 6 frames" in err) == (0, True)


def test_given_poses_that_are_not_there_are_a_mistake(here, capsys):
    unposed(here / "desk", 3)
    status, _, err = run(capsys, "map", "desk", "--poses", "given")
    assert (status, "no poses; write poses.txt" in err, (here / "desk.svox").exists()) == (2, True, False)


def test_info_says_that_the_camera_is_tracked(here, capsys):
    unposed(here / "desk", 3)
    status, _, err = run(capsys, "info", "desk")
    assert (status, "map tracks the camera by visual odometry" in err) == (0, True)
    assert "stereovox map desk --out desk.svox" in err


def test_a_tracked_map_is_not_shown_with_other_poses(here, capsys):
    unposed(here / "desk", 3, poses=True)
    assert run(capsys, "map", "desk", "--poses", "track")[0] == 0
    status, _, err = run(capsys, "view", "desk.svox", "--recording", "desk", "--port", "0")
    assert (status, "the map was made of 'desk, tracked'" in err) == (2, True)
