# SPDX-License-Identifier: Apache-2.0
"""Notebooks run from top to bottom, without data, and end with a picture."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "examples/notebooks").glob("*.ipynb"))
RUN = """
import ast, json, sys
import matplotlib.pyplot as plt

for blocked in sys.argv[2:]:
    sys.modules[blocked] = None
names = {"__name__": "__main__"}
for number, source in enumerate(json.load(open(sys.argv[1]))):
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


def run(notebook, folder, *blocked):
    """Run a notebook in a process of its own, where the modules `blocked` are not installed."""
    (folder / "cells.json").write_text(json.dumps(code(notebook)))
    command = [sys.executable, "-c", RUN, "cells.json", *blocked]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("STEREOVOX_KITTI")}
    environment.pop("STEREOVOX_BAG", None)
    done = subprocess.run(
        command, cwd=folder, env={**environment, "MPLBACKEND": "Agg"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{notebook.name}\n{done.stderr[-3000:]}"
    return done.stdout


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 5


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_runs_and_ends_with_a_picture(notebook, tmp_path):
    if "rosbags" in notebook.read_text():
        pytest.importorskip("rosbags", reason="needs pip install '.[bags]'")
    assert run(notebook, tmp_path).endswith("last: picture\n")


def test_without_octomap_the_comparison_is_left_out(tmp_path):
    (notebook,) = (path for path in NOTEBOOKS if "octomap" in path.name)
    said = run(notebook, tmp_path, "octomap")
    assert "pip install octomap-python" in said
    assert "agrees" not in said
    assert said.endswith("last: picture\n")


def test_a_cell_that_fails_is_seen(tmp_path):
    broken = tmp_path / "broken.ipynb"
    broken.write_text(json.dumps({"cells": [{"cell_type": "code", "source": ["x = 1\n", "1 / 0"]}]}))
    with pytest.raises(AssertionError, match="code cell 0"):
        run(broken, tmp_path)


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
