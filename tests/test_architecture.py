# SPDX-License-Identifier: Apache-2.0
"""Imports point one way, each heavy library has one home, each module says what it is."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from inspect import signature
from pathlib import Path
from time import monotonic, monotonic_ns

import pytest
from house import circles_of, import_graphs, modules_of

import stereovox
from stereovox.mapper import GridMapper, Mapper
from stereovox.runs.engine import Checkpoints

SOURCE = Path(__file__).resolve().parents[1] / "src/stereovox"
LABORATORY = SOURCE.with_name("stereovox_lab")
LAYERS = (
    {"errors"},
    {"files", "geometry", "registry"},
    {"cameras", "config"},
    {"kernels", "sensors"},
    {"frame"},
    {"depth", "maps"},
    {"integrate", "products", "sources"},
    {"formats", "localize", "mapping", "simulate", "track"},
    {"mapper", "opening"},
    {"calibrate", "correct", "evaluate", "mavlink"},
    {"view"},
    {"runs", "viewer"},
    {"descriptions", "fleet", "live", "ros"},
    {"cli"},
    {"__main__"},
)
"""Floors of the house, from the ground up: a room imports from the floors below its own, and from no other room."""
LEVEL = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
HOMES = {
    "builtin_interfaces": r"ros/.*",
    "stereovox_lab": "nowhere in stereovox",
    "cv2": r"(calibrate|depth|simulate|sources|track)/.*",
    "diagnostic_msgs": r"ros/.*",
    "geometry_msgs": r"ros/.*",
    "dask": r"fleet/.*",
    "distributed": r"fleet/.*",
    "gtsam": r"geometry/pose_graph\.py",
    "matplotlib": r"(view|viewer)/.*",
    "nav_msgs": r"ros/.*",
    "numba": r"(.*/)?_[a-z]\w*\.py",
    "numcodecs": r"maps/.*",
    "obstore": r"files/places\.py",
    "octomap": "only in stereovox_lab",
    "octomap_msgs": r"ros/.*",
    "pydantic": r"config/.*",
    "pyoctomap": "only in stereovox_lab",
    "pymavlink": r"mavlink/.*",
    "pyrealsense2": r"sources/.*",
    "rcl_interfaces": r"ros/.*",
    "rclpy": r"ros/.*",
    "rerun": r"formats/.*",
    "rich": r"cli/.*",
    "rosbags": r"sources/.*",
    "sensor_msgs": r"ros/.*",
    "serial": r"mavlink/.*",
    "skimage": r"formats/.*",
    "small_gicp": r"calibrate/.*",
    "std_msgs": r"ros/.*",
    "std_srvs": r"ros/.*",
    "tf2_msgs": r"ros/.*",
    "laspy": r"formats/.*",
    "trimesh": r"(formats|simulate)/.*",
    "viser": r"viewer/.*",
    "zarr": r"maps/.*",
}
MOST_FILES = 20
"""In one folder."""
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
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from ((node.lineno, text[1]) for text in NAMED_CLASS.finditer(node.value) if text[0] == node.value)


def is_kernel_file(file: str) -> bool:
    """Return whether a file holds kernels: `_name.py`."""
    return bool(re.fullmatch(r"(.*/)?_[a-z]\w*\.py", file))


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
            upwards = library == "stereovox" and other != room and LEVEL.get(other, -1) >= LEVEL.get(room, 99)
            if upwards or ((room, library) == ("mapper", "stereovox") and other in ("opening", "sources")):
                found.append(f"{file}:{line} {room} must not import {other}")
    return found


def circles(root: Path) -> list[list[str]]:
    """Return the sets of files of the package at `root` that import each other in a circle, wherever in them."""
    real, typed = import_graphs(modules_of(root))
    return circles_of({name: real[name] | typed[name] for name in real})


def test_the_rules_hold():
    assert not broken_rules(SOURCE)


def test_the_root_is_small_and_no_folder_is_crowded():
    assert len(list(SOURCE.glob("*.py"))) <= 7
    folders = Counter(path.parent for root in (SOURCE, LABORATORY) for path in root.rglob("*.py"))
    assert not {str(folder): count for folder, count in folders.items() if count > MOST_FILES}


def test_circles_are_found(tmp_path):
    for name, text in {
        "__init__": "from stereovox.a import f",
        "a": "def f():\n    from stereovox import b",
        "b": "from stereovox.c import g",
        "c": "if TYPE_CHECKING:\n    from stereovox.a import f",
        "d": 'KINDS = {"a": "stereovox.a:f"}',
    }.items():
        (tmp_path / f"{name}.py").write_text(text + "\n")
    assert circles(tmp_path) == [["a", "b", "c"]]


def test_the_drawing_in_contributing_is_this_house():
    page = (SOURCE.parents[1] / "CONTRIBUTING.md").read_text()
    drawn = re.findall(r"^ *(\d+)  +([\w /]+?)(?:  .*)?$", page.partition("## Layers")[2], re.MULTILINE)
    assert [set(rooms.replace("/", "").split()) for _, rooms in drawn] == [set(rooms) for rooms in LAYERS[::-1]]


@pytest.mark.parametrize(
    ("file", "line", "complaint"),
    [
        ("maps/a.py", "from stereovox.view.picture import picture", "maps must not import view"),
        (
            "maps/_a.py",
            "from stereovox.maps.cells.cell_format import State",
            "machine code outlives a change of maps.cells.cell_format.State: only kernel files are hashed",
        ),
        ("maps/a.py", "from stereovox import geometry, mapper", "maps must not import mapper"),
        ("maps/a.py", "def f():\n    import stereovox.cli.map.map", "maps must not import cli"),
        ("maps/a.py", "if TYPE_CHECKING:\n    from ..integrate import ray", "maps must not import integrate"),
        ("maps/a.py", 'MAPS = {"ray": "stereovox.integrate.ray:Ray"}', "maps must not import integrate"),
        ("maps/__init__.py", "from .. import mapper", "maps must not import mapper"),
        ("frame/a.py", "from ..depth import scan", "frame must not import depth"),
        ("depth/a.py", "from stereovox.maps import VoxelMap", "depth must not import maps"),
        ("mapper.py", "from stereovox.opening import open_source", "mapper must not import opening"),
        ("maps/a.py", "def f():\n    from stereovox_lab import explore", "stereovox_lab is not at home here"),
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
    (tmp_path / "errors.py").write_text("import math\n")
    assert broken_rules(tmp_path) == ["errors.py:1 has no SPDX line", "errors.py:1 has no docstring"]


def test_nothing_goes_by_a_clock_that_is_set():
    """Checkpoints, ages and deadlines would come early, late or never when somebody sets the system's time."""
    measured = SOURCE / "frame/stamp_clock.py"  # ages of images by their own stamps
    for path in sorted({*SOURCE.rglob("*.py"), *LABORATORY.rglob("*.py")} - {measured}):
        text = path.read_text()
        suspect = re.search(r"^\s*(?:import|from)\b.*time", text, re.MULTILINE)  # most are not, and need no parsing
        names = {name for _, name in imported(ast.parse(text), [])} if suspect else set()
        assert not names & {"time", "time.time", "time.time_ns", "datetime", "datetime.datetime"}, path
    assert signature(Checkpoints).parameters["clock"].default is monotonic
    assert signature(Mapper).parameters["clock"].default is signature(GridMapper).parameters["clock"].default
    assert signature(Mapper).parameters["clock"].default is monotonic_ns


def test_no_public_name_is_hidden_by_a_module():
    """Once such a module is imported, `stereovox.name` is the module."""
    assert not {path.stem for path in SOURCE.iterdir()} & set(stereovox.__all__)
