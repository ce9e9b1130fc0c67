# SPDX-License-Identifier: Apache-2.0
"""The code base in figures: modules, lines, folders, and circular imports.

    python benchmarks/house.py [ROOT] [--json]

ROOT: the folder of a checkout; by default this one. Imports count wherever they are in a file, including those by name
in a registry (`"stereovox.x:Name"`); those for type checkers alone (`if TYPE_CHECKING`) are counted separately. The
package's own `__init__.py` is left out of circles: it loads names on demand.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parents[1]
NAMED = re.compile(r"(stereovox(?:\.\w+)+):\w+")
PACKAGE, LABORATORY = "stereovox", "stereovox_lab"
SMALL = 60
"""Lines below which a module that one other imports is a fragment."""

Graph = Mapping[str, set[str]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", nargs="?", type=Path, default=HERE)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = house(arguments.root)
    print(json.dumps(found) if arguments.json else "\n".join(f"{name:34} {_shown(found[name])}" for name in found))


def house(root: Path) -> dict[str, Any]:
    """Return the figures of the checkout at `root`."""
    modules = modules_of(root / "src" / PACKAGE)
    read = {name: _read(name, path, modules) for name, path in modules.items()}
    lines = {name: found.lines for name, found in read.items()}
    real, typed = ({name: getattr(found, kind) for name, found in read.items()} for kind in ("real", "typed"))
    together = {name: real[name] | typed[name] for name in modules}
    users = Counter(other for name in modules if name != PACKAGE for other in together[name])
    alone = [name for name, count in users.items() if count == 1]
    flat = Counter(str(path.parent.relative_to(root / "src")) for path in modules.values())
    rooms = Counter()
    for name, path in modules.items():
        rooms[path.relative_to(root / "src" / PACKAGE).parts[0].removesuffix(".py")] += lines[name]
    (folder, files), (room, most) = flat.most_common(1)[0], rooms.most_common(1)[0]
    circles, typed_circles = (circles_of(graph) for graph in (real, together))
    between = between_rooms(real)
    laboratory = [path.read_text() for path in (root / "src" / LABORATORY).rglob("*.py")]
    pages = [root / "README.md", *(root / "docs").glob("*.md")]
    return {
        "modules": len(modules),
        "lines": sum(lines.values()),
        "lines of code": sum(found.code for found in read.values()),
        "modules of the laboratory": len(laboratory),
        "lines of the laboratory": sum(text.count("\n") for text in laboratory),
        "folders": len(flat),
        "rooms": len(between),
        "floors": 1 + max(floors_of(between).values()),
        "words of README and docs": sum(len(page.read_text().split()) for page in pages),
        "loose modules at the root": flat[PACKAGE],
        "biggest folder, files in it": f"{folder}: {files}",
        "biggest room, share of the lines": f"{room}: {most / sum(lines.values()):.1%}",
        "circles": circles,
        "circles with TYPE_CHECKING": typed_circles,
        "circles between rooms": circles_of(between),
        "modules with one importer": len(alone),
        f"of these under {SMALL} lines": sum(lines[name] < SMALL for name in alone),
    }


def modules_of(package: Path) -> dict[str, Path]:
    """Return all modules by their full names."""
    named = {
        ".".join([PACKAGE, *path.relative_to(package).with_suffix("").parts]): path for path in package.rglob("*.py")
    }
    return {name.removesuffix(".__init__"): named[name] for name in sorted(named)}


def import_graphs(modules: Mapping[str, Path]) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Return each module's imports of the others: at run time, and for type checkers alone."""
    read = {name: _read(name, path, modules) for name, path in modules.items()}
    return {name: found.real for name, found in read.items()}, {name: found.typed for name, found in read.items()}


class Read(NamedTuple):
    """A module: its imports of others at run time and for type checkers alone, its lines, and those of code."""

    real: set[str]
    typed: set[str]
    lines: int
    code: int


def _read(name: str, path: Path, modules: Mapping[str, Path]) -> Read:
    text, package = path.read_text(), name if path.name == "__init__.py" else name.rpartition(".")[0]
    real, typed, texts = set[str](), set[str](), set[int]()
    ahead: list[tuple[ast.AST, set[str]]] = [(ast.parse(text), real)]
    while ahead:
        node, into = ahead.pop()
        if isinstance(node, ast.If) and _is_for_types(node):
            into = typed
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            texts.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        elif isinstance(node, ast.Import | ast.ImportFrom | ast.Constant):
            into.update(_imported(node, package, modules))
        ahead.extend((inner, into) for inner in ast.iter_child_nodes(node))
    bare = [line.strip() for number, line in enumerate(text.splitlines(), 1) if number not in texts]
    code = sum(bool(line) and not line.startswith("#") for line in bare)
    return Read(real - {name}, typed - {name}, text.count("\n"), code)


def _is_for_types(node: ast.If) -> bool:
    return any("TYPE_CHECKING" in (getattr(one, "id", ""), getattr(one, "attr", "")) for one in ast.walk(node.test))


def _imported(node: ast.AST, package: str, modules: Mapping[str, Path]) -> Iterator[str]:
    """Yield the modules that one node imports, except the package's own `__init__.py`."""
    names: list[str] = []
    if isinstance(node, ast.Import):
        names = [name.name for name in node.names]
    elif isinstance(node, ast.ImportFrom):
        base = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
        origin = ".".join([*base, *filter(None, [node.module])])
        inner = [f"{origin}.{name.name}" for name in node.names]
        names = [name if name in modules else origin for name in inner]
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and (text := NAMED.fullmatch(node.value)):
        names = [text[1]]
    yield from (name for name in names if name in modules and name != PACKAGE)


def floors_of(rooms: Graph) -> dict[str, int]:
    """Return the number of layers below each room; 0 in a circle, which has no floor."""
    found: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in found:
            found[room] = 0
            found[room] = max((1 + floor(other) for other in rooms[room]), default=0)
        return found[room]

    return {room: floor(room) for room in rooms}


def circles_of(graph: Graph) -> list[list[str]]:
    """Return the strongly connected components of more than one node (Tarjan 1972, here by reachability)."""
    nodes = [name for name in graph if name != PACKAGE]
    reached = {name: _reached(name, graph) for name in nodes}
    found, done = [], set()
    for name in nodes:
        if name in reached[name] and name not in done:
            circle = sorted(other for other in reached[name] if name in reached.get(other, ()))
            done.update(circle)
            found.append([other.removeprefix(f"{PACKAGE}.") for other in circle])
    return found


def _reached(start: str, graph: Graph) -> set[str]:
    found, ahead = set[str](), [start]
    while ahead:
        for other in graph[ahead.pop()] - found:
            found.add(other)
            ahead.append(other)
    return found


def between_rooms(graph: Graph) -> dict[str, set[str]]:
    """Return the imports between rooms: folders and loose modules at the root."""
    rooms = defaultdict[str, set[str]](set)
    for name, others in graph.items():
        if name != PACKAGE:
            rooms[_room(name)] |= {_room(other) for other in others} - {_room(name)}
    return {room: rooms[room] for room in sorted({*rooms, *(other for others in rooms.values() for other in others)})}


def _room(name: str) -> str:
    return name.split(".")[1]


def _shown(value: Any) -> str:
    if not isinstance(value, list):
        return str(value)
    return "\n".join([str(len(value)), *("    " + _row(row) for row in value)])


def _row(row: str | Iterable[str]) -> str:
    return row if isinstance(row, str) else " ".join(row)


if __name__ == "__main__":
    main()
