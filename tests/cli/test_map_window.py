# SPDX-License-Identifier: Apache-2.0
"""`map` with a window that moves with the camera."""

import json

import numpy as np

from stereovox.cli import main
from stereovox.maps import load_map

SOURCE = "sim:flight?length=120&speed=10&frames=60"
COARSE = ["--voxel-size", "0.4", "--max-range", "4"]
WINDOW = ["--set", "window.size=[14, 14, 12]"]


def mapped(out, *options):
    assert main(["map", SOURCE, "--out", str(out), *COARSE, "--json", *options]) == 0
    return load_map(out)


def test_tiles_are_in_the_saved_map_and_gone_from_the_disk(tmp_path, capsys):
    kept = mapped(tmp_path / "kept", *WINDOW, "--set", "window.outside=keep")
    memory = json.loads(capsys.readouterr().out)["memory_bytes"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept"]
    whole = mapped(tmp_path / "whole")
    np.testing.assert_array_equal(kept.blocks()[0], whole.blocks()[0])
    np.testing.assert_array_equal(kept.blocks()[1], whole.blocks()[1])
    dropped = mapped(tmp_path / "dropped", *WINDOW)
    assert len(dropped.blocks()[0]) < 0.6 * len(kept.blocks()[0])
    assert memory < 10e6


def test_a_resumed_flight_ends_like_an_uninterrupted_one(tmp_path):
    options = [*WINDOW, "--set", "window.outside=keep", "--set", "window.lead_s=0.3"]
    whole = mapped(tmp_path / "whole", *options)
    mapped(tmp_path / "half", *options, "--frames", ":25")
    half = mapped(tmp_path / "half", *options, "--resume")
    np.testing.assert_array_equal(half.blocks()[1], whole.blocks()[1])
    assert half.frames == whole.frames


def test_a_window_too_small_for_its_trigger_is_refused(tmp_path, capsys):
    assert main(["map", SOURCE, "--out", str(tmp_path / "map"), "--set", "window.size=[1, 1, 1]"]) == 2
    assert "trigger 1.0 must be less than half" in capsys.readouterr().err


def test_a_window_too_large_for_any_memory_is_refused(tmp_path, capsys):
    assert main(["map", SOURCE, "--out", str(tmp_path / "map"), "--set", "window.size=[900, 900, 900]"]) == 2
    assert "needs 12 TB of memory" in capsys.readouterr().err
