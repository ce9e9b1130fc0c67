# SPDX-License-Identifier: Apache-2.0
"""TOML next to a recording: what TOML allows and Python's floats or stack do not."""

from __future__ import annotations

import tomllib

import pytest

from stereovox.errors import SourceError
from stereovox.files.safe_io import is_number, toml_text
from stereovox.sources.calibration.camera_file import read_camera
from stereovox.sources.rigs.pair_file import read_pair

HUGE = "9" * 400
CAMERA = "width=8\nheight=6\nfy=9\ncx=4\ncy=3\n"


@pytest.mark.parametrize(
    ("read", "text", "said"),
    [
        (read_camera, f"{CAMERA}fx={HUGE}", "fx = 999"),
        (read_camera, f"{CAMERA}fx=9\n[correction]\nmodel='scale'\ncoefficients=[{HUGE}]", "correction.coefficients"),
        (read_pair, f"depth_scale = {HUGE}", "depth_scale = 999"),
        (read_pair, f"T_tracker_camera = [[{HUGE}, 0, 0, 0]]", "T_tracker_camera must be"),
        (read_camera, "a = " + "[" * 60_000, "nested too deeply"),
        (read_pair, "a = " + "[" * 60_000, "nested too deeply"),
        (read_camera, "#" * 100_000, "holds more than 65536 bytes"),
        (read_pair, ".".join(["a"] * 20_000) + " = 1", "a line with more than 200 dots"),
        (read_pair, f"baseline = 0x{'f' * 9000}", "baseline = 0xfff"),
    ],
)
def test_numbers_without_end_and_deep_nesting_are_one_line(tmp_path, read, text, said):
    path = tmp_path / "file.toml"
    path.write_text(text)
    with pytest.raises(SourceError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: {said}")
    assert "\n" not in str(caught.value)


def test_what_is_written_reads_back():
    for value in ('tab\tquote" back\\slash\x7f é', 7, -1.5e-300, [0.1, 2, "x"], ["a", ["b"]]):
        assert tomllib.loads(f"value = {toml_text(value)}")["value"] == value


def test_numbers():
    assert all(map(is_number, (0, -3, 1.5, 10**299)))
    assert not any(map(is_number, (True, "1", float("nan"), float("inf"), -float("inf"), 10**400, None)))
