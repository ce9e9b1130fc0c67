# SPDX-License-Identifier: Apache-2.0
"""`pip install .` and `.[test]` find wheels of everything on 64-bit ARM: pip is asked, told that it runs there.

Nothing is installed. Without an index in reach the tests are skipped; what runs on such a machine is not tried here.
"""

import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
MACHINE = "aarch64"
PIP_THERE = f"""
import platform, sys
platform.machine = lambda: {MACHINE!r}  # environment markers ask this; --platform only says which wheels fit
from pip._internal.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
WHEELS = ["--platform", "manylinux2014_aarch64", "--platform", "manylinux_2_28_aarch64", "--only-binary", ":all:"]
"""What pip takes on Debian 10, Ubuntu 20.04 and newer. Numba has had no wheels for older systems since 0.61."""
LOOK = [
    "install",
    "--dry-run",
    "--ignore-installed",
    "--disable-pip-version-check",
    "--retries",
    "1",
    "--timeout",
    "15",
    "-q",
]


def requirements(lines):
    """Return what `lines` come to on that machine, the extras of stereovox itself resolved."""
    found = []
    for wanted in map(Requirement, lines):
        if wanted.marker and not wanted.marker.evaluate({"platform_machine": MACHINE}):
            continue
        if wanted.name != PROJECT["name"]:
            wanted.marker = None
            found.append(str(wanted))
        for extra in sorted(wanted.extras) if wanted.name == PROJECT["name"] else ():
            found += requirements(PROJECT["optional-dependencies"][extra])
    return found


def pip_there(*words):
    command = [sys.executable, "-c", PIP_THERE, *LOOK, *WHEELS, "--target", "nowhere", *words]
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)


@cache
def reason_to_skip():
    """Return why pip cannot tell here, None if it can: NumPy has such wheels."""
    asked = pip_there("--no-deps", "numpy")
    return f"pip reaches no index with wheels for {MACHINE}: {asked.stderr.strip()[-90:]}" if asked.returncode else None


@pytest.mark.parametrize("extras", [[], ["test", "rerun"]], ids=str)
def test_there_are_wheels_of_all_requirements(extras):
    # Extras' own requirements only: with all that these require it takes pip half a minute.
    wanted = [line for extra in extras for line in requirements(PROJECT["optional-dependencies"][extra])]
    asked = pip_there(*(["--no-deps", *wanted] if extras else PROJECT["dependencies"]))
    if asked.returncode and (why := reason_to_skip()):
        pytest.skip(why)
    assert asked.returncode == 0, asked.stderr


def test_a_library_without_such_wheels_is_noticed():
    if why := reason_to_skip():
        pytest.skip(why)
    asked = pip_there("--no-deps", "embreex")
    assert "No matching distribution found for embreex" in asked.stderr


def test_extras_leave_out_what_has_no_such_wheels():
    there = {Requirement(line).name for line in requirements(PROJECT["optional-dependencies"]["test"])}
    assert {"pytest", "octomap-python", "gtsam"} <= there
    assert not there & {"pyoctomap", "pyrealsense2", "atheris", "ros-rclpy", "obstore"}
