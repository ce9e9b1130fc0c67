# SPDX-License-Identifier: Apache-2.0
"""Small files of strangers: bombs, nesting, pipes and what a terminal would obey."""

import os
import time
from pathlib import Path

import pytest

from stereovox.cli.terminal import say
from stereovox.config import load_config
from stereovox.errors import DISK_FULL, ConfigError, FrameRefused, MissingExtra, SourceError, StereovoxError
from stereovox.files.safe_io import (
    check_file,
    json_value,
    read_bounded,
    read_text,
    replacing,
    shown,
    toml_table,
    yaml_value,
)
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.calibration.camera_file import read_camera
from stereovox.sources.poses.tracker import read_tracker
from stereovox.view.report.page import out_folder, write_page

LEVELS = 40
REPEATED = "a0: &a0 [1, 2]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, LEVELS))
MERGED = "a0: &a0 {k: 1}\n" + "".join(f"a{k}: &a{k}\n  <<: [*a{k - 1}, *a{k - 1}]\n" for k in range(1, LEVELS))
MARK = "/tmp/stereovox-was-here"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (REPEATED, "expand to too many"),
        (MERGED, "expand to too many"),
        ("a: &a [*a]", "contain themselves"),
        ("a: &a {b: *a}", "contain themselves"),
        ("[" * 3000, "nested too deeply"),
        ("a: " + "{a: [" * 3000, "nested too deeply"),
        ("- " * 3000, "nested too deeply"),
        (b"a: \xff\xfe", "invalid start byte"),
        (f"!!python/object/apply:os.system ['touch {MARK}']", "could not determine a constructor"),
        (f"a: !!python/object/new:os.system ['touch {MARK}']", "could not determine a constructor"),
        ("a: [1\n  b: 2", "while parsing"),
        ("a: 2001-99-99", "month must be in 1..12"),
        ("? [1]\n: 2", "unhashable key"),
        (f"a: {'9' * 5000}", "limit"),
    ],
)
def test_yaml_that_is_refused(text, said):
    start = time.process_time()
    with pytest.raises(ValueError, match=said) as caught:
        yaml_value(text)
    assert "\n" not in str(caught.value)
    assert time.process_time() - start < 1
    assert not os.path.exists(MARK)


def test_yaml_with_some_aliases():
    assert yaml_value("a: &a {x: 1}\nb: {<<: *a, y: [*a, *a]}")["b"] == {"x": 1, "y": [{"x": 1}, {"x": 1}]}
    assert yaml_value("") is None


@pytest.mark.parametrize(
    "text", ["a" + ".a" * 20_000 + " = 1", "a = {" + "a." * 20_000 + "a = 1}", "a = " + "[" * 60_000]
)
def test_toml_that_would_take_long_is_refused(text):
    start = time.process_time()
    with pytest.raises(ValueError, match=r"more than 200 dots|nested too deeply"):
        toml_table(text)
    assert time.process_time() - start < 1


def test_json_that_nests_deeply():
    with pytest.raises(ValueError, match="nested too deeply"):
        json_value('{"a":' * 100_000)


def test_pipes_devices_and_folders_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, said in ((tmp_path / "pipe", "not a file"), (tmp_path, "directory"), (tmp_path / "none", "No such")):
        with pytest.raises(OSError, match=said):
            read_bounded(path)
    with pytest.raises(SourceError, match="pipe: not a file; give a readable TOML file"):
        read_camera(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a file"):
        read_bounded("/dev/zero")


def test_files_are_bounded(tmp_path):
    (tmp_path / "a").write_bytes(b"x" * 100)
    assert read_text(tmp_path / "a", 100) == "x" * 100
    with pytest.raises(OSError, match="holds more than 99 bytes") as refused:
        read_bounded(tmp_path / "a", 99)
    assert refused.value.errno not in DISK_FULL  # a command would advise to make room


def test_values_are_shown_short():
    assert shown([1, "two", 3.5, {"a": None}]) == "[1, 'two', 3.5, {'a': None}]"
    assert shown(10**5000).startswith("0x") and len(shown(10**5000)) < 70  # noqa: PT018
    assert len(shown(["x" * 10_000] * 10_000)) < 2000
    assert len(shown([10**400, [[[[[[1]]]]]]])) < 200


@pytest.mark.parametrize("error", [StereovoxError, SourceError, lambda text: FrameRefused("unreadable", text)])
def test_a_message_is_one_line_whatever_stands_in_it(error):
    said = str(error("a\nb\x1b[31mc\u2028d\u202ee\r" + "x" * 100_000 + " end"))
    assert said.startswith("a\\nb\\x1b[31mc\\u2028d\\u202ee\\r")
    assert said.isprintable()
    assert said.endswith("x end")
    assert len(said) < 10_100


def test_other_messages_stay_as_they_are():
    assert str(StereovoxError("a.toml: fx = -1 must be positive (café)")) == "a.toml: fx = -1 must be positive (café)"
    assert "pip install 'stereovox[bags]'" in str(MissingExtra("rosbags", "bags"))


def test_keys_of_a_profile_cannot_write_to_the_terminal(tmp_path):
    (tmp_path / "a.toml").write_text('"a\\nb\\u001b[2J" = 1\n')
    with pytest.raises(ConfigError, match=r"unknown setting 'a\\nb\\x1b\[2J'"):
        load_config(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text(f"voxel_size = 0x{'f' * 9000}\n")
    with pytest.raises(ConfigError, match=r"voxel_size"):
        load_config(tmp_path / "b.toml")
    (tmp_path / "c.toml").write_text("a = " + "[" * 60_000)
    with pytest.raises(ConfigError, match="nested too deeply"):
        load_config(tmp_path / "c.toml")


def test_a_sphere_of_absurdly_many_cells_is_refused():
    with pytest.raises(ConfigError, match=r"sphere.step_deg 1e-320: .*greater than or equal to 0.05"):
        load_config(**{"sphere.step_deg": 1e-320})


@pytest.mark.parametrize("stamp", ["1e999999999", "-1e999999999", "nan", "snan", "1e-999999999"])
def test_times_beyond_all_bounds(tmp_path, stamp):
    (tmp_path / "a.txt").write_text(f"{stamp} 0 0 0 0 0 0 1\n")
    if stamp == "1e-999999999":
        assert read_tracker(tmp_path / "a.txt").stamps_ns.tolist() == [0]
        return
    with pytest.raises(SourceError, match="is not a time in seconds"):
        read_tracker(tmp_path / "a.txt")


def test_notes_cannot_write_to_the_terminal(capsys):
    say("note: a topic /a\x1b[2J\x07b\nsecond line é")
    assert capsys.readouterr().err == "note: a topic /a\\x1b[2J\\x07b\nsecond line é\n"


def test_a_url_is_no_name_of_a_single_file(tmp_path, monkeypatch):
    """Also as a path, which has one slash where the URL has two, and where a folder of this name is there."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s3:/bucket").mkdir(parents=True)
    for name in ("s3://bucket/p.png", Path("s3://bucket/p.png")):
        with pytest.raises(StereovoxError, match=r"^s3://bucket/p\.png: only maps in boxes"):
            check_file(name, [".png"])
        with pytest.raises(SourceError, match=r"^s3://bucket/p\.png: only maps in boxes"), replacing(name, SourceError):
            pass
    for folder in (out_folder, lambda name: write_page(name, "page.html", "")):
        with pytest.raises(StereovoxError, match=r"^s3://bucket/new: only maps in boxes"):
            folder("s3://bucket/new")
    with pytest.raises(SourceError, match=r"^s3://bucket/a\.bag: only maps in boxes"):
        BagWriter(Path("s3://bucket/a.bag"))
    assert not list((tmp_path / "s3:/bucket").iterdir())
