# SPDX-License-Identifier: Apache-2.0
"""Notebooks run from top to bottom, without data, and end with a picture."""

import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "examples/notebooks").glob("*.ipynb"))
RUN = """
import ast, json, os, sys

for name in [*os.environ]:
    if name.startswith("STEREOVOX_KITTI") or name == "STEREOVOX_BAG":
        del os.environ[name]
os.environ["MPLBACKEND"] = "Agg"
import matplotlib.pyplot as plt

cells, blocked = json.load(open("cells.json"))
for name in blocked:
    sys.modules[name] = None
names = {"__name__": "__main__"}
for number, source in enumerate(cells):
    plt.close("all")
    tree, shown = ast.parse(source, f"code cell {number}"), None
    silent = source.rstrip().endswith(";")
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, f"code cell {number}", "exec"), names)
    if last is not None:
        shown = eval(compile(ast.Expression(last.value), f"code cell {number}", "eval"), names)
    html = shown._repr_html_() if not silent and hasattr(shown, "_repr_html_") else ""
    for figure in map(plt.figure, plt.get_fignums()):
        figure.canvas.draw()
print("last:", "picture" if "<img" in html or plt.get_fignums() else "none")
"""
"""What Jupyter does with the cells of a notebook, as far as these need it."""


def cells(notebook):
    return json.loads(notebook.read_text())["cells"]


def code(notebook):
    return ["".join(cell["source"]) for cell in cells(notebook) if cell["cell_type"] == "code"]


@pytest.fixture
def run(run_script, tmp_path):
    """Runs a notebook in a process of its own, where the modules `blocked` are not installed; returns what it said."""

    def run(notebook, *blocked):
        (tmp_path / "cells.json").write_text(json.dumps([code(notebook), blocked]))
        (tmp_path / "notebook.py").write_text(RUN)
        status, said = run_script(tmp_path / "notebook.py")
        assert status == 0, f"{notebook.name}\n{said[-3000:]}"
        return said

    return run


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 5


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_runs_and_ends_with_a_picture(notebook, run):
    if "rosbags" in notebook.read_text():
        pytest.importorskip("rosbags", reason="needs pip install '.[bags]'")
    assert run(notebook).endswith("last: picture\n")


def test_without_octomap_the_comparison_is_left_out(run):
    (notebook,) = (path for path in NOTEBOOKS if "octomap" in path.name)
    said = run(notebook, "octomap")
    assert "pip install octomap-python" in said
    assert "agrees" not in said
    assert said.endswith("last: picture\n")


def test_a_cell_that_fails_is_seen(run, tmp_path):
    broken = tmp_path / "broken.ipynb"
    broken.write_text(json.dumps({"cells": [{"cell_type": "code", "source": ["x = 1\n", "1 / 0"]}]}))
    with pytest.raises(AssertionError, match="code cell 0"):
        run(broken)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_is_clean_and_has_a_page(notebook):
    """No outputs, which only grow and age; what Jupyter needs to open it; a line on the page that lists them."""
    whole = json.loads(notebook.read_text())
    assert (whole["nbformat"], whole["metadata"]["kernelspec"]["language"]) == (4, "python")
    assert len({cell["id"] for cell in whole["cells"]}) == len(whole["cells"])
    for cell in whole["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
    assert cells(notebook)[0]["source"][0].startswith("# ")
    assert f"examples/notebooks/{notebook.name}" in (ROOT / "docs/notebooks.md").read_text()
