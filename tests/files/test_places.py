# SPDX-License-Identifier: Apache-2.0
"""Files in folders and in object stores are written whole or not at all, alike in both."""

import pickle
from pathlib import Path

import pytest

from stereovox.errors import MapFileError, MissingExtra
from stereovox.files.places import Folder, Place, is_url


def test_files_are_written_found_listed_and_removed(where):
    place = Place.of(where)
    assert place.find("a") is None
    assert place.names() == []
    place.write("b/c", b"one")
    place.write_all({"b/d": b"two", "a": b""})
    assert place.sizes() == {"a": 0, "b/c": 3, "b/d": 3}
    assert place.names("b/") == ["b/c", "b/d"]
    assert place.names("b/c") == ["b/c"]
    assert (place / "b").read("c") == b"one"
    place.write("b/c", b"three")
    assert pickle.loads(pickle.dumps(place)).read("b/c") == b"three"
    place.remove(["b/c", "b/c", "none"])
    assert place.names() == ["a", "b/d"]
    with pytest.raises(MapFileError, match="b/c: is missing"):
        place.read("b/c")
    with pytest.raises(MapFileError, match=r"3 bytes|more than 2 bytes"):
        place.find("b/d", 2)


def test_one_of_two_creates_a_file(where):
    place = Place.of(where)
    assert place.create("lock", b"first")
    assert not place.create("lock", b"second")
    assert place.read("lock") == b"first"
    place.remove(["lock"])
    assert place.create("lock", b"third")


@pytest.mark.parametrize("name", ["", "../a", "a/../b", "/a", "a//b", ".", "a\0b", "a\\b"])
def test_names_stay_inside(where, name):
    with pytest.raises(MapFileError, match="not a valid file name"):
        Place.of(where).write(name, b"")


def test_a_write_that_fails_leaves_the_older_file(tmp_path, monkeypatch):
    place = Folder(tmp_path / "m")
    place.write("a", b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stereovox.files.places.os.fsync", fail)
    with pytest.raises(MapFileError, match=r"cannot be written \(No space left"):
        place.write("a", b"new")
    assert place.read("a") == b"old"
    assert place.names() == ["a"]


def test_what_a_killed_writer_left_is_not_listed_and_swept(tmp_path):
    place = Folder(tmp_path / "m")
    place.write("b/a", b"whole")
    (tmp_path / "m/b/.unfinished-0123").write_bytes(b"ha")
    assert place.names() == ["b/a"]
    place.tidy()
    assert [path.name for path in (tmp_path / "m/b").iterdir()] == ["a"]


def test_links_are_not_followed(tmp_path):
    (tmp_path / "m").mkdir()
    (tmp_path / "m/a").symlink_to("/etc/hostname")
    with pytest.raises(MapFileError, match="is a link"):
        Folder(tmp_path / "m").find("a")


def test_a_bucket_that_is_not_there(s3):
    with pytest.raises(MapFileError, match="no such bucket"):
        Place.of("s3://elsewhere/m").write("a", b"")


def test_without_obstore_a_url_names_the_install_line(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "obstore", None)
    with pytest.raises(MissingExtra, match=r"stereovox\[fleet\]"):
        Place.of("s3://bucket/m")
    assert isinstance(Place.of(Path("m")), Folder)


@pytest.mark.parametrize(("name", "url"), [("s3://b/m", True), ("gs://b/m", True), ("a/s3:/m", False), ("s3:", False)])
def test_urls(name, url):
    assert is_url(name) == url
