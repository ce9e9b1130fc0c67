# SPDX-License-Identifier: Apache-2.0
"""On a full disk commands say so, end with status 2, and keep older files: here no file may grow beyond a limit."""

from __future__ import annotations

from errno import ENOSPC
from shutil import rmtree

import numpy as np
import pytest
from full_disks import full_disk
from made_maps import random_map

from stereovox.cli import main

pytest.importorskip("resource", reason="this system limits no file sizes")

MOST = 1500
"""Bytes of the largest file that can be written."""
POINTS = np.random.default_rng(0).uniform(0, 4, (3000, 3))


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    for seed in (1, 2):
        random_map(seed).save(folder / f"{seed}.svox")
    np.savetxt(folder / "points.xyz", POINTS, "%.3f")
    return folder


def files_in(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("words", "out"),
    [
        ("import points.xyz OUT --voxel-size 0.1", "m.svox"),
        ("merge 1.svox 2.svox --out OUT", "m.svox"),
        ("export 1.svox OUT", "m.ply"),
        ("export 1.svox OUT", "m.npz"),
        ("export 1.svox OUT", "m.bt"),
        ("picture 1.svox OUT --view space", "m.png"),
        ("eval 1.svox 2.svox --report OUT", "page"),
        ("simulate sim:floor?plan=testbed&seconds=1&scan_hz=4&depth_hz=2&image_width=64 --out OUT", "m.mcap"),
    ],
)
def test_nothing_is_left_half_written(words, out, maps, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(maps)
    words = words.replace("OUT", str(tmp_path / out)).split()
    assert main(words) in (0, 3)  # compiles and saves kernels as well
    whole = files_in(tmp_path)
    assert whole
    with full_disk(MOST):
        main(words)
    assert files_in(tmp_path) == whole
    for path in tmp_path.iterdir():
        rmtree(path) if path.is_dir() else path.unlink()
    capsys.readouterr()
    with full_disk(MOST):
        assert main(words) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert str(tmp_path / out) in said
    assert "File too large" in said
    assert "free space" in said or "room" in said
    assert files_in(tmp_path) == {}


def test_what_no_command_foresaw_is_told_with_the_cure(monkeypatch, capsys):
    def full(arguments):
        raise OSError(ENOSPC, "No space left on device")

    monkeypatch.setattr("stereovox.cli.start.info.run", full)
    assert main(["info", "a.svox"]) == 2
    assert "the file being written is incomplete" in capsys.readouterr().err
