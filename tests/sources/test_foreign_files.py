# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import shlex

import pytest

from stereovox.descriptions import describe
from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.foreign_files import CURES, POINTER, cure_of

CLOUDS = ".ply", ".pcd", ".las", ".bt", ".e57", ".svox"


@pytest.mark.parametrize("ending", [*CURES, *CLOUDS])
def test_each_kind_of_file_names_its_cure_in_one_short_line(tmp_path, ending):
    file = tmp_path / f"walk 1{ending}"
    file.write_bytes(b"?")
    with pytest.raises(SourceError) as caught:
        open_source(file)
    said = str(caught.value)
    assert said.startswith(f"{file}: ")
    assert "that is known" not in said
    assert len(said.replace(str(tmp_path), "")) <= 300


def test_commands_quote_the_name(tmp_path):
    assert shlex.quote("my walk.svo") in cure_of("my walk.svo")
    assert len(cure_of("x" * 500 + ".svo")) <= 200


def test_clouds_are_imported(tmp_path):
    file = tmp_path / "room.PLY"
    file.write_bytes(b"ply\n")
    with pytest.raises(SourceError, match=r"stereovox import \S*room\.PLY map\.svox"):
        open_source(file)


def test_others_have_none():
    assert cure_of("notes.txt") == ""


def test_pointers_of_git_lfs_name_the_command(tmp_path):
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    for ending in (".bag", ".mcap", ".db3", ".mkv", ".ply"):
        (tmp_path / f"walk{ending}").write_text(text)
        with pytest.raises(SourceError, match=r"is a git-lfs pointer.*: git lfs pull$"):
            open_source(tmp_path / f"walk{ending}")
    (tmp_path / "scan/depth").mkdir(parents=True)
    (tmp_path / "scan/depth/0.png").write_text(text)
    (tmp_path / "scan/poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match="git lfs pull"):
        open_source(tmp_path / "scan")


@pytest.mark.parametrize("name", ["a.npz", "a.sens", "a.klg", "poses.txt", "a.db3", "a.json"])
def test_a_pointer_is_named_whatever_the_ending(tmp_path, name):
    (tmp_path / name).write_bytes(POINTER + b".github.com/spec/v1\noid sha256:4d\nsize 12345\n")
    for open_it in (describe, open_source):
        with pytest.raises(SourceError, match="git lfs pull"):
            open_it(str(tmp_path / name))


def test_a_rosbag2_folder_without_its_list_names_its_file(tmp_path):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk/all.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(SourceError, match=r"metadata\.yaml is missing\); did you mean .*all.db3\?"):
        open_source(tmp_path / "walk")
