# SPDX-License-Identifier: Apache-2.0
"""`stereovox map` and `picture` without an output name: the default one, which never replaces anything."""

import pytest

from stereovox import load_map
from stereovox.cli import main
from stereovox.descriptions.files import map_name, picture_name

COARSE = ("sim:room?image_width=160", "--voxel-size", "0.4", "--frames", ":2")


def test_a_map_and_its_picture_name_themselves(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["map", *COARSE]) == 0
    frames = load_map("room.svox").frames
    assert frames == 2
    assert main(["picture", "room.svox", "--dpi", "40"]) == 0
    assert (tmp_path / "room.png").stat().st_size > 1000
    before = (tmp_path / "room.png").read_bytes()
    capsys.readouterr()
    assert main(["map", *COARSE, "--set", "up=x"]) == 2
    assert "room.svox: already exists; replace it with --out room.svox" in capsys.readouterr().err
    assert load_map("room.svox").config.up == "z"
    assert main(["picture", "room.svox"]) == 2
    assert "replace it with: stereovox picture room.svox room.png" in capsys.readouterr().err
    assert (tmp_path / "room.png").read_bytes() == before
    assert main(["map", *COARSE[:-1], ":3", "--resume"]) == 0  # goes on with the map of that name
    assert load_map("room.svox").frames == 3


def test_the_map_of_a_floor_has_its_ending(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "floor.yaml").touch()
    assert main(["map", "sim:floor", "--profile", "ist2019"]) == 2
    assert "floor.yaml: already exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("recordings/kitchen/", "kitchen"),
        ("desk?depth_scale=1000&poses=a/b.txt", "desk"),
        ("walk.bag", "walk"),
        ("logs/fr079.clf.bz2", "fr079"),
        ("sim:box?size=small", "box"),
        ("realsense:?width=848", "realsense"),
    ],
)
def test_names_follow_the_recording(source, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert map_name(source) == f"{name}.svox"
    assert map_name(source, ".yaml") == f"{name}.yaml"


def test_the_picture_of_a_floor_spares_its_image():
    assert picture_name("maps/room.svox") == "room.png"
    assert picture_name("maps/floor.yaml") == "floor-picture.png"


def test_the_map_that_would_be_written_is_no_guess_at_what_was_meant(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["map", "nowhere"]) == 2
    assert "nowhere: no such folder or file; check the name" in capsys.readouterr().err
