# SPDX-License-Identifier: Apache-2.0
"""Imports point one way, each heavy library has one home, each module says what it is."""

import ast
import re
from collections.abc import Iterator
from inspect import signature
from pathlib import Path
from time import monotonic, monotonic_ns

import pytest

from stereovox.mapper import GridMapper, Mapper
from stereovox.run import Checkpoints

SOURCE = Path(__file__).resolve().parents[1] / "src/stereovox"
LAYERS = (
    {
        "errors",
        "files",
        "untrusted",
        "registry",
        "frame",
        "geometry",
        "cameras",
        "wide",
        "lenses",
        "rigs",
        "planar",
        "config",
        "config_robot",
        "config_safety",
        "gate",
        "belief",
        "health",
        "camera_path",
        "history",
        "update_report",
        "_jit",
        "guarded",
        "shards",
    },
    {"sources", "depth", "sensors", "maps"},
    {"integrate", "products", "localize", "calibrate"},
    {"mapper", "intake", "pace", "ways", "comparing", "evaluate", "view", "run"},
    {"floor_run"},
    {"cli", "ros", "__main__"},
)
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
HOMES = {
    "builtin_interfaces": r"ros/.*",
    "cv2": r"(calibrate|depth|sources)/.*",
    "diagnostic_msgs": r"ros/.*",
    "embreex": r"sources/.*",
    "geometry_msgs": r"ros/.*",
    "gtsam": r"localize/.*",
    "matplotlib": r"(view|products)/.*",
    "nav_msgs": r"ros/.*",
    "numba": r"(.*/)?_[a-z]\w*\.py",
    "octomap": r"evaluate/.*",
    "octomap_msgs": r"ros/.*",
    "pydantic": r"config(_robot|_safety)?\.py",
    "pyoctomap": r"evaluate/.*",
    "pyrealsense2": r"sources/.*",
    "rcl_interfaces": r"ros/.*",
    "rclpy": r"ros/.*",
    "rerun": r"products/.*",
    "rich": r"cli/.*",
    "rosbags": r"sources/.*",
    "sensor_msgs": r"ros/.*",
    "skimage": r"products/.*",
    "small_gicp": r"calibrate/.*",
    "std_msgs": r"ros/.*",
    "std_srvs": r"ros/.*",
    "tf2_msgs": r"ros/.*",
    "trimesh": r"(products|sources)/.*",
    "typer": r"cli/.*",
    "viser": r"view/.*",
    "zarr": r"maps/.*",
}
NAMED_CLASS = re.compile(r"(stereovox(?:\.\w+)+):\w+")


def imported(tree: ast.Module, package: list[str]) -> Iterator[tuple[int, str]]:
    """Yield line and full name of all that a module of `package` imports, anywhere in it, also by registry text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            origin = ".".join([*base, *filter(None, [node.module])])
            yield from ((node.lineno, f"{origin}.{name.name}") for name in node.names)
        elif isinstance(node, ast.Constant) and (text := NAMED_CLASS.fullmatch(str(node.value))):
            yield node.lineno, text[1]


def is_kernel_file(file: str) -> bool:
    """Tell whether a file holds kernels: `_name.py`, but for slow twins."""
    return bool(re.fullmatch(r"(.*/)?_(?!.*reference)[a-z]\w*\.py", file))


def broken_rules(root: Path) -> list[str]:
    """Return one line for each rule that a file of the package at `root` breaks."""
    found = []
    for path in sorted(root.rglob("*.py")):
        file = path.relative_to(root).as_posix()
        text = path.read_text()
        tree = ast.parse(text)
        if not text.startswith("# SPDX-License-Identifier: Apache-2.0\n"):
            found.append(f"{file}:1 has no SPDX line")
        if not ast.get_docstring(tree):
            found.append(f"{file}:1 has no docstring")
        room = file.partition("/")[0].removesuffix(".py")
        if room not in {*LEVEL, "__init__"}:
            found.append(f"{file}:1 '{room}' belongs to no layer")
        for line, name in imported(tree, ["stereovox", *Path(file).parent.parts]):
            library, _, inner = name.partition(".")
            if not re.fullmatch(HOMES.get(library, ".*"), file):
                found.append(f"{file}:{line} {library} is not at home here")
            other = inner.partition(".")[0]
            if library == "stereovox" and is_kernel_file(file) and "._" not in f".{inner}":
                found.append(f"{file}:{line} machine code outlives a change of {inner}: only kernel files are hashed")
            upwards = library == "stereovox" and LEVEL.get(other, -1) > LEVEL.get(room, 99)
            if upwards or (room, library, other) == ("mapper", "stereovox", "sources"):
                found.append(f"{file}:{line} {room} must not import {other}")
    return found


def test_the_rules_hold():
    assert not broken_rules(SOURCE)


@pytest.mark.parametrize(
    ("file", "line", "complaint"),
    [
        ("maps/a.py", "from stereovox.view.picture import picture", "maps must not import view"),
        (
            "maps/_a.py",
            "from stereovox.maps.cell_format import State",
            "machine code outlives a change of maps.cell_format.State: only kernel files are hashed",
        ),
        ("maps/a.py", "from stereovox import geometry, mapper", "maps must not import mapper"),
        ("maps/a.py", "def f():\n    import stereovox.cli.map", "maps must not import cli"),
        ("maps/a.py", "if TYPE_CHECKING:\n    from ..integrate import ray", "maps must not import integrate"),
        ("maps/a.py", 'MAPS = {"ray": "stereovox.integrate.ray:Ray"}', "maps must not import integrate"),
        ("maps/__init__.py", "from .. import mapper", "maps must not import mapper"),
        ("frame.py", "from .sensors import model", "frame must not import sensors"),
        ("mapper.py", "from stereovox.sources import open_source", "mapper must not import sources"),
        ("maps/a.py", "def f():\n    import cv2", "cv2 is not at home here"),
        ("maps/cpu.py", "from numba.core import config", "numba is not at home here"),
        ("maps/__init__.py", "import numba", "numba is not at home here"),
        ("sources/a.py", "import zarr.storage", "zarr is not at home here"),
        ("attic/a.py", "", "'attic' belongs to no layer"),
    ],
)
def test_each_rule_can_fail(tmp_path, file, line, complaint):
    head = '# SPDX-License-Identifier: Apache-2.0\n"""What it is."""\n'
    good = {
        "__init__.py": "from stereovox.mapper import Mapper",
        "mapper.py": "from stereovox.integrate import ray",
        "view/a.py": "import matplotlib\nfrom stereovox import evaluate",
        "integrate/_cpu.py": "import numba\nfrom ..maps import _cpu\nfrom . import _cells",
    }
    for name, text in {**good, file: line}.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(head + text)
    assert [found.split(" ", 1)[1] for found in broken_rules(tmp_path)] == [complaint]


def test_bare_files_are_found(tmp_path):
    (tmp_path / "frame.py").write_text("import math\n")
    assert broken_rules(tmp_path) == ["frame.py:1 has no SPDX line", "frame.py:1 has no docstring"]


def test_nothing_goes_by_a_clock_that_is_set():
    """Checkpoints, ages and deadlines would come early, late or never when somebody sets the system's time."""
    for path in sorted(SOURCE.rglob("*.py")):
        names = {name for _, name in imported(ast.parse(path.read_text()), [])}
        assert not names & {"time", "time.time", "time.time_ns", "datetime", "datetime.datetime"}, path
    assert signature(Checkpoints).parameters["clock"].default is monotonic
    assert signature(Mapper).parameters["clock"].default is signature(GridMapper).parameters["clock"].default
    assert signature(Mapper).parameters["clock"].default is monotonic_ns
