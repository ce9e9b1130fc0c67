# SPDX-License-Identifier: Apache-2.0
"""Remarks on times: of a warm run, or of a run that compiles."""

from types import SimpleNamespace

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.cli.map.slam import _print_result
from stereovox.cli.terminal import say_about_compiling
from stereovox.kernels import _jit


@pytest.mark.parametrize("frames", [1, 2])
def test_times_of_a_single_frame_say_what_they_include(frames, tmp_path, capsys):
    command = ["map", "sim:room?image_width=160", "--out", str(tmp_path / "a.svox"), "--voxel-size", "0.2"]
    assert main([*command, "--frames", f":{frames}"]) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("per frame"))
    assert ("including loading or compiling the kernels" in line) == (frames == 1)


def test_the_first_run_on_a_machine_is_recognised(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(_jit, "cache_folder", lambda: tmp_path)
    assert say_about_compiling()
    assert "compiling the kernels, once" in capsys.readouterr().err
    (tmp_path / "one.nbi").touch()
    assert not say_about_compiling()
    monkeypatch.setattr(_jit, "cache_folder", lambda: None)
    assert say_about_compiling()


@pytest.mark.parametrize(
    ("seconds", "compiling", "words"),
    [
        (0.5, False, "(200 times as fast as recorded)"),
        (250.0, True, "(0.4 times as fast as recorded, compiling included)"),
    ],
)
def test_slam_says_whether_it_compiled(seconds, compiling, words, monkeypatch, capsys):
    monkeypatch.setattr("stereovox.cli.map.slam.print_trajectory_error", lambda *_: {})
    track = SimpleNamespace(stamps_ns=np.array([0, 100_000_000_000]))
    _print_result(None, SimpleNamespace(track=track, closures=3, refused={}, doubts=[]), seconds, compiling)
    assert words in capsys.readouterr().err
