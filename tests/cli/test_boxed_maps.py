# SPDX-License-Identifier: Apache-2.0
"""Commands give the same answers for maps in boxes, in folders and in object stores, as for a map in one piece."""

import json
import warnings

import pytest

import stereovox as sv
from stereovox.cli import main


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the folder of a map in one piece."""
    folder = tmp_path_factory.mktemp("map") / "whole.svox"
    mapper = sv.Mapper(voxel_size=0.2)
    for frame in sv.open_source("sim:apartment?image_width=80", frames="::48"):
        mapper.add(frame)
    mapper.save(folder)
    return folder


@pytest.fixture
def big(whole, where):
    sv.save_boxed(sv.load_map(whole), where, 3.2)
    return where


def said(capsys, *words):
    """Return what a command prints for programs."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main([*map(str, words), "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out.splitlines()[-1])


BOX = "--box=0.5,0.5,0,3,2.5,1.5"


def work_on(one, folder, name):
    """Write what four commands make of a map into a folder."""
    commands = (
        ("crop", one, folder / f"{name}.svox", BOX), ("export", one, folder / f"{name}.ply"),
        ("coarsen", one, folder / f"{name}-coarse.svox", "--factor", 2), ("distance", one, folder / f"{name}.npz", BOX),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for words in commands:
            assert main([*map(str, words), "--json"]) == 0


@pytest.fixture(scope="module")
def from_whole(whole, tmp_path_factory):
    """Return the folder of what they make of the map in one piece."""
    folder = tmp_path_factory.mktemp("made")
    work_on(whole, folder, "b")
    return folder


def test_commands_on_a_map_in_boxes(whole, from_whole, big, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    counts = ("free_cells", "occupied_cells", "tentative_cells", "frames")
    ours, theirs = (said(capsys, "info", one) for one in (big, whole))
    assert [ours.get(name) for name in counts] == [theirs.get(name) for name in counts]
    work_on(big, tmp_path, "a")
    said(capsys, "picture", big, "a.png")
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert (tmp_path / "a.ply").read_bytes() == (from_whole / "b.ply").read_bytes()
    for a, b in (("a.svox", from_whole / "b.svox"), ("a-coarse.svox", from_whole / "b-coarse.svox"), (big, whole)):
        changes = said(capsys, "diff", a, b)
        assert changes["appeared"] == changes["vanished"] == changes["became_known"] == changes["became_unknown"] == 0
    assert said(capsys, "eval", big, whole)["decisions"]["surface_occupied"] == 1.0


def test_a_map_in_boxes_is_not_gone_on_with(big, tmp_path, capsys):
    assert main(["map", "sim:room", "--frames", ":2", "--out", big, "--resume"]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in error if line.startswith("stereovox:")]) == 1
