# SPDX-License-Identifier: Apache-2.0
"""Examples run as they are printed, command lines are accepted, links lead somewhere, the site builds."""

import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import stereovox
from stereovox.cli import _parse

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^(?:\[(examples/\w+\.py)\]\([^)]+\)[^\n]*:\n\n)?```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
"""A block of Python; where its file is named in the line above, that is what it shows."""
SHELL = re.compile(r"^```bash\n(.*?)^```", re.DOTALL | re.MULTILINE)
OUTSIDE = re.compile(r"<(?:script|link|img|iframe|source)[^>]*https?://[^>]*>|url\(['\"]?https?:[^)]*")


def line_of(page, place):
    return f"{page.name}:{page.read_text()[:place].count(chr(10)) + 1}"


BLOCKS = [(page, found) for page in PAGES for found in BLOCK.finditer(page.read_text())]
SHOWN = {line_of(page, found.start()): (found[1], found[2]) for page, found in BLOCKS if found[1]}
FILES = sorted((ROOT / "examples").glob("*.py"))
EXAMPLES = {line_of(page, found.start()): found[2] for page, found in BLOCKS if not found[1]}
EXAMPLES |= {f"examples/{path.name}": path.read_text() for path in FILES if "sys.argv" not in path.read_text()}


@pytest.mark.parametrize("where", EXAMPLES)
def test_example_runs(where, tmp_path, run_script):
    script = tmp_path / "example.py"
    script.write_text(EXAMPLES[where])
    status, told = run_script(script)
    assert status == 0, told


@pytest.mark.parametrize("where", SHOWN)
def test_pages_show_examples_as_they_are(where):
    name, code = SHOWN[where]
    assert (ROOT / name).read_text().endswith(f'"""\n\n{code}')


def test_examples_were_found():
    assert len(EXAMPLES) >= 20
    assert len(SHOWN) >= 6
    named = "".join(page.read_text() for page in PAGES)
    assert not [path.name for path in FILES if f"examples/{path.name}" not in named]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_command_lines_are_accepted(page):
    """Not run, but each option and command is there."""
    text = "".join(SHELL.findall(page.read_text())).replace("\\\n", " ")
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["stereovox"] and "..." not in words:
            _parse(words[1:])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_reference_pages_are_up_to_date():
    """The settings' page fails to be made where a setting has no description."""
    for name, text in runpy.run_path(str(ROOT / "docs/make_reference.py"))["pages"]().items():
        assert (ROOT / "docs/reference" / name).read_text() == text, f"{name}: run python docs/make_reference.py"


def test_the_api_page_names_everything_public():
    named = re.findall(r"^::: stereovox\.(\w+)$", (ROOT / "docs/reference/api.md").read_text(), re.MULTILINE)
    assert sorted([*named, "__version__"]) == sorted(stereovox.__all__)


def test_lines_that_describe_fields_become_lists():
    pytest.importorskip("griffe", reason="needs pip install '.[docs]'")
    titled = runpy.run_path(str(ROOT / "docs/docstring_fields.py"))["titled"]
    house = "A box: small.\n\nlow, high: corners. side: metres,\n    along x.\n\nMore."
    google = (
        "A box: small.\n\nAttributes:\n    low: corners.\n    high: See `low`.\n    side: metres, along x.\n\nMore."
    )
    assert titled(house, ["low", "high", "side"], "Attributes") == google
    assert titled(google, ["low", "high", "side"], "Attributes") == google


def test_the_menu_of_the_site_names_every_page_once():
    pages = re.findall(r"\S+\.md$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert len(pages) == len(set(pages)), pages


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_asks_no_other_host(tmp_path):
    pytest.importorskip("material", reason="needs pip install '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "contains a link" not in done.stderr, done.stderr  # to what is left out of the site: mkdocs only mentions it
    pages = [*(tmp_path / "site").rglob("*.html")]
    assert {page.with_suffix(".html").name for page in PAGES[1:]} <= {page.name for page in pages}
    api = (tmp_path / "site/reference/api.html").read_text()
    assert not [name for name in stereovox.__all__ if name != "__version__" and f">{name}</span>" not in api]
    assert (tmp_path / "site/examples/first_map.py").is_file()
    for page in [*pages, *(tmp_path / "site").rglob("*.css")]:
        assert not OUTSIDE.findall(page.read_text()), page.name
