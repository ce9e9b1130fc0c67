# SPDX-License-Identifier: Apache-2.0
"""What the papers say is true: their programs run, their commands and settings exist, CI runs the README's line."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import BaseModel

from stereovox.cli import COMMANDS
from stereovox.config import Config

ROOT = Path(__file__).resolve().parents[1]
PAPERS = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]
PROGRAMS = [
    pytest.param(text, id=f"{paper.name}-{number}")
    for paper in PAPERS
    for number, text in enumerate(re.findall(r"```python\n(.*?)```", paper.read_text(), re.DOTALL))
]


@pytest.mark.parametrize("text", PROGRAMS)
def test_programs_run(text, tmp_path):
    (tmp_path / "program.py").write_text(text)
    done = subprocess.run([sys.executable, "program.py"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("paper", PAPERS, ids=lambda paper: paper.name)
def test_links_lead_somewhere_and_commands_exist(paper):
    text = paper.read_text()
    for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (paper.parent / link).exists(), link
    for code in [*re.findall(r"```bash\n(.*?)```", text, re.DOTALL), *re.findall(r"`([^`\n]+)`", text)]:
        for command in re.findall(r"(?:^|[/\s])stereovox ([a-z]\w*)\b(?! =)", code):
            assert command in COMMANDS, code


def setting_names(model, prefix=""):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from setting_names(field.annotation, f"{name}.")
        else:
            yield prefix + name


def test_readme_names_every_setting():
    text = (ROOT / "README.md").read_text()
    missing = [name for name in setting_names(Config) if f"`{name}`" not in text]
    assert missing == ["profile"]  # not a setting to be set: the profile's own name


def test_ci_runs_the_line_that_the_papers_give():
    shown = subprocess.run([ROOT / ".ci/run", "--show"], cwd="/", capture_output=True, text=True, check=True).stdout
    assert shown.strip().endswith("pytest -n 2")
    for paper in ("README.md", "CONTRIBUTING.md"):
        assert f"```bash\n{shown}```" in (ROOT / paper).read_text()
