# SPDX-License-Identifier: Apache-2.0
"""Plug-ins of other packages are found, also those that are installed while a process runs."""

import os
import sys

import pytest

from stereovox import registry
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
