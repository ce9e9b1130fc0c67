# SPDX-License-Identifier: Apache-2.0
"""Lint, format and types are clean, as by the three commands a contributor runs by hand; the house stays small."""

import ast
import importlib.util
import io
import re
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest
from house import house

from stereovox.sources.base import MEMBERS

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = {
    "lint": ["ruff", "check", "--no-cache"],
    "format": ["ruff", "format", "--no-cache", "--check"],
    "types": ["pyrefly", "check", "--python-interpreter-path", sys.executable],
}

MOST = {
    "modules": 485,
    "lines": 93_130,
    "loose modules at the root": 7,
    "rooms": 34,
    "floors": 15,
    "modules of the laboratory": 86,
    "lines of the laboratory": 12_810,
    "words of README and docs": 37_950,
}
"""Budgets. Raising one needs a reason in CHANGELOG.md."""
HABITS = {
    "way, for path or manner": (r"\bways?\b", 0.38),
    "tell, for report": (r"\b(?:tells?|told|telling)\b", 0.24),
    "beside, for next to": (r"\bbeside\b", 0.02),
    "believe, for accept": (r"\bbeliev(?:e[sd]?|ing)\b", 0.05),
    "is none, for is missing": (r"\b(?:is|are) none\b|\bnone where\b", 0.57),
    "where, for if": (r"\bwhere\b", 2.56),
}
"""Words of translated English, and how often they may occur in a thousand words of source and docs."""


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_house_rule(name):
    command = [sys.executable, "-m", *COMMANDS[name]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command[2:])}\n{done.stdout[-4000:]}{done.stderr[-2000:]}"


@pytest.mark.parametrize("script", sorted(ROOT.glob("benchmarks/*.py")), ids=lambda script: script.stem)
def test_benchmarks_find_what_they_measure(script):
    """Nobody runs them between two changes, so names that moved away would show only when a figure is wanted."""
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stereovox"):
            module = importlib.import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}"), name.name


@pytest.fixture(scope="module")
def figures():
    return house(ROOT)


@pytest.mark.parametrize("name", MOST)
def test_the_house_stays_small(figures, name):
    assert figures[name] <= MOST[name]


def test_no_files_import_each_other_in_a_circle(figures):
    """Wherever in them; tests/test_architecture.py shows that circles are found."""
    assert not figures["circles with TYPE_CHECKING"]


def prose(path):
    """Return the text of a page without its code, or the comments and sentences of a module."""
    text = path.read_text()
    if path.suffix == ".md":
        return re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return "\n".join(token.string for token in tokens if token.type in kinds and " " in token.string)


@pytest.fixture(scope="module")
def sentences():
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    return "\n".join(prose(path) for path in sorted([*(ROOT / "src").rglob("*.py"), *pages]))


@pytest.mark.parametrize("habit", HABITS)
def test_translated_english_does_not_grow_back(sentences, habit):
    pattern, most = HABITS[habit]
    assert 1000 * len(re.findall(pattern, sentences, re.IGNORECASE)) / len(sentences.split()) <= most


def test_a_habit_is_found(tmp_path):
    page, module = tmp_path / "a.md", tmp_path / "a.py"
    page.write_text("It tells the way.\n```\ntold\n```\n")
    module.write_text('"""What is beside it."""\nbeside = 1  # a way\n')
    assert re.findall("tells|told", prose(page)) == ["tells"]
    assert re.findall("beside|way", prose(module)) == ["beside", "way"]


def probes_of_sources(text):
    """Yield the lines of a module that ask whether a source has something: `stream_of` has settled that on opening."""
    for node in ast.walk(ast.parse(text)) if "attr(" in text else ():
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("getattr", "hasattr"):
            asked = node.args[1].value if len(node.args) > 1 and isinstance(node.args[1], ast.Constant) else None
            if asked in MEMBERS - OF_OTHERS:
                yield node.lineno


OF_OTHERS = {"name", "camera"}
"""What frames and photos have, too."""


def test_nobody_asks_what_a_source_has():
    """Its members are normalised once, in `sources/base.py`."""
    base = ROOT / "src/stereovox/sources/base.py"
    paths = set((ROOT / "src").rglob("*.py")) - {base}
    assert not {str(path): lines for path in sorted(paths) if (lines := list(probes_of_sources(path.read_text())))}
    assert list(probes_of_sources(base.read_text()))


def test_a_probe_of_a_source_is_found():
    assert list(probes_of_sources('a = getattr(source, "notes", ())\nb = hasattr(source, "frame")\n')) == [1, 2]
    assert not list(probes_of_sources('a = getattr(frame, "name", "")\nb = getattr(source, what)\n'))
