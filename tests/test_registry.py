# SPDX-License-Identifier: Apache-2.0
"""Plug-ins of other packages are found, also those that are installed while a process runs."""

import os
import sys
from pathlib import Path

import pytest

from stereovox import cli, registry
from stereovox.errors import ConfigError


def test_a_package_is_found_once_it_is_installed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    assert registry.names("sensors", {"own": "a:B"}) == ["own"]
    with pytest.raises(ConfigError, match="unknown sensor 'other'"):
        registry.find("sensors", {}, "other")
    (tmp_path / "other-1.dist-info").mkdir()
    (tmp_path / "other-1.dist-info/METADATA").write_text("Name: other\nVersion: 1\n")
    (tmp_path / "other-1.dist-info/entry_points.txt").write_text("[stereovox.sensors]\nother = pathlib:Path\n")
    os.utime(tmp_path, ns=(1, 1))  # another time than before, whatever the clock's steps
    assert registry.names("sensors", {"own": "a:B"}) == ["other", "own"]
    assert registry.find("sensors", {}, "other") is sys.modules["pathlib"].Path


@pytest.mark.parametrize("order", [["bench", "explore", "own"], ["own", "explore", "bench"]])
def test_the_order_of_installed_files_changes_no_list(tmp_path, monkeypatch, order):
    """Installers write entry points in any order; help and reference pages stay the same."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "other-1.dist-info").mkdir()
    (tmp_path / "other-1.dist-info/METADATA").write_text("Name: other\nVersion: 1\n")
    for group in ("commands", "layouts"):
        lines = "\n".join(f"{name} = other:{name}" for name in order)
        with (tmp_path / "other-1.dist-info/entry_points.txt").open("a") as file:
            file.write(f"[stereovox.{group}]\n{lines}\n")
    os.utime(tmp_path, ns=(order.index("own"), 1))
    assert registry.names("layouts", {}) == ["bench", "explore", "own"]
    others = [name for name in cli.commands() if name not in cli.COMMANDS]
    assert others == sorted(others)
    assert "own" in others


def test_a_layout_that_has_the_name_of_one_of_ours_is_asked_first_and_ours_stays(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "other-1.dist-info").mkdir()
    (tmp_path / "other-1.dist-info/METADATA").write_text("Name: other\nVersion: 1\n")
    (tmp_path / "other-1.dist-info/entry_points.txt").write_text("[stereovox.sources]\nplain = pathlib:Path\n")
    os.utime(tmp_path, ns=(3, 3))
    assert list(registry.every("sources", {"tum": "os:PathLike", "plain": "os:stat"})) == [Path, os.PathLike, os.stat]
