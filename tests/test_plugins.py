# SPDX-License-Identifier: Apache-2.0
"""Packages that extend stereovox are installed by pip and found; rooms that not all users need may be missing."""

import base64
import hashlib
import json
import os
import subprocess
import sys
import zipfile

import pytest

import stereovox as sv

MODULE = """
from dataclasses import dataclass

import numpy as np

import stereovox as sv
from stereovox.opening import Source

EXAMPLES = "stereovox greet"
GROUP = "Ask"


class Own(Source):
    layout = "a folder that is ours"

    def __init__(self, where):
        self.name = "own"
        self.camera = sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, baseline=0.05)

    @classmethod
    def recognises(cls, where):
        return (cls._path(where) / "own.txt").is_file()

    @staticmethod
    def _path(where):
        from pathlib import Path
        return Path(where)

    def __len__(self):
        return 3

    def frame(self, i):
        depth = np.full((60, 80), 2.0 + 0.001 * i, np.float32)
        return sv.Frame(depth, self.camera, np.eye(4), stamp_ns=i * 33_333_333)


@dataclass(frozen=True)
class Careful:
    p_hit: float = 0.65
    p_free: float = 0.45
    p_unknown: float = 0.5

    def probability(self, z, z_measured, sigma):
        clear = np.where(z < z_measured - 2 * sigma, self.p_free, self.p_unknown)
        return np.where(z == z_measured, self.p_hit, clear)


def export(voxel_map, path):
    path.write_text(f"{len(voxel_map.occupied())} occupied")


def add_arguments(parser):
    parser.add_argument("name")


def run(arguments):
    \"\"\"Greet somebody.\"\"\"
    return {"greeted": arguments.name}
"""
ENTRIES = """[stereovox.sources]
own = own_package:Own
[stereovox.sensors]
careful = own_package:Careful
[stereovox.export]
.count = own_package:export
[stereovox.commands]
greet = own_package
broken = no_such_module
"""
HIDDEN = """
import importlib, pkgutil, sys

hidden = {rooms!r}

class Missing:
    def find_spec(self, name, path=None, target=None):
        if any(name == room or name.startswith(room + ".") for room in hidden):
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Missing())
import stereovox

def walk(package):
    for module in pkgutil.iter_modules(package.__path__, package.__name__ + "."):
        if module.name not in (*hidden, "stereovox.__main__", "stereovox.ros.share"):
            found = importlib.import_module(module.name)
            if module.ispkg:
                walk(found)

walk(stereovox)
from stereovox.cli import main
sys.exit(main({words!r}))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder into which pip has installed a package that adds a layout, a sensor model, an export and commands."""
    folder = tmp_path_factory.mktemp("plugin")
    wheel = folder / "own_package-1.0-py3-none-any.whl"
    files = {
        "own_package.py": '"""Greet somebody."""\n' + MODULE,
        "own_package-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: own-package\nVersion: 1.0\n",
        "own_package-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\n"
        "Tag: py3-none-any\n",
        "own_package-1.0.dist-info/entry_points.txt": ENTRIES,
    }
    record = "own_package-1.0.dist-info/RECORD"
    lines = []
    with zipfile.ZipFile(wheel, "w") as file:
        for name, text in files.items():
            file.writestr(name, text)
            digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).rstrip(b"=").decode()
            lines.append(f"{name},sha256={digest},{len(text.encode())}")
        file.writestr(record, "\n".join([*lines, f"{record},,"]) + "\n")
    target = folder / "site"
    words = ["install", "-q", "--no-index", "--no-deps", "--disable-pip-version-check", "--target"]
    subprocess.run([sys.executable, "-m", "pip", *words, str(target), str(wheel)], check=True)
    return target


def stereovox(installed, *words):
    where = os.pathsep.join(filter(None, [str(installed), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-m", "stereovox", *words]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": where}, check=False)


def test_a_package_adds_a_layout_a_sensor_model_an_export_and_a_command(installed, tmp_path):
    recording, out, count = tmp_path / "recording", tmp_path / "own.svox", tmp_path / "own.count"
    (recording / "depth").mkdir(parents=True)  # what `plain`, asked last, takes for its own
    (recording / "own.txt").write_text("ours")
    done = stereovox(installed, "map", str(recording), "--out", str(out), "--set", "sensor.model=careful", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["frames"] == 3
    assert sv.load_map(out).config.sensor.model == "careful"
    done = stereovox(installed, "export", str(out), str(count))
    assert done.returncode == 0, done.stderr
    assert count.read_text() == f"{len(sv.load_map(out).occupied())} occupied"
    done = stereovox(installed, "greet", "world", "--json")
    assert json.loads(done.stdout.splitlines()[-1]) == {"greeted": "world"}, done.stderr


def test_help_lists_commands_of_packages_and_survives_a_broken_one(installed):
    done = stereovox(installed, "--help")
    assert done.returncode == 0, done.stderr
    asked = done.stdout.partition("  Ask\n")[2].partition("  Correct\n")[0]
    assert "greet" in asked
    assert "broken" not in done.stdout
    assert "note: the command broken of another package cannot be imported" in done.stderr
    alone = stereovox(installed, "broken")
    assert alone.returncode == 2
    assert alone.stderr.count("\n") == 1


def test_the_rest_works_without_optional_rooms(tmp_path):
    """All other modules can be imported, and a recording can be mapped."""
    rooms = ["stereovox_lab", *(f"stereovox.{room}" for room in ("ros", "mavlink", "fleet", "viewer", "live"))]
    words = ["map", "sim:room?image_width=32", "--frames", ":2", "--voxel-size", "0.2", "--out", str(tmp_path / "m")]
    script = HIDDEN.format(rooms=rooms, words=words)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
