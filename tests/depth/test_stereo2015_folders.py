# SPDX-License-Identifier: Apache-2.0
"""The benchmark on street scenes finds them in the folder that holds `training` and in `training` itself."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / "benchmarks/stereo2015.py"


def test_both_folders_hold_the_scenes(tmp_path):
    spec = importlib.util.spec_from_file_location("stereo2015", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with pytest.raises(SystemExit, match="no image_2"):
        module.scenes(tmp_path)
    images = tmp_path / "training/image_2"
    images.mkdir(parents=True)
    for name in ("000001_10.png", "000000_10.png", "000000_11.png"):
        (images / name).touch()
    wanted = [images / "000000_10.png", images / "000001_10.png"]
    assert module.scenes(tmp_path) == module.scenes(tmp_path / "training") == wanted
