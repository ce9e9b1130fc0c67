# SPDX-License-Identifier: Apache-2.0
"""The files by which others join: workflows, templates, the citation. They parse, and what they name exists."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted(ROOT.glob(".github/workflows/*.yml"))


def steps(workflow):
    return [step for job in yaml.safe_load(workflow.read_text())["jobs"].values() for step in job["steps"]]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_name_files_and_extras_that_exist(workflow):
    commands = "\n".join(step.get("run", "") for step in steps(workflow))
    for path in re.findall(r"(?<![\w/])(?:\.ci|tests)/[\w./]+", commands):
        assert (ROOT / path).exists(), path
    for extra in re.findall(r"'\.\[(\w+)\]'", commands):
        assert extra in PROJECT["optional-dependencies"], extra
    assert all("uses" in step or "run" in step for step in steps(workflow))


def test_the_tested_pythons_are_those_that_the_package_names():
    jobs = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text())["jobs"]
    tested = set(jobs["readme"]["strategy"]["matrix"]["python"])
    named = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if "Python :: 3." in line}
    assert tested == named
    assert PROJECT["requires-python"] == f">={min(named, key=lambda one: int(one[2:]))}"


def test_the_version_stands_in_one_place():
    assert "version" in PROJECT["dynamic"]
    assert "version:" not in (ROOT / "CITATION.cff").read_text().replace("cff-version:", "")


@pytest.mark.parametrize(
    "file", ["CITATION.cff", ".pre-commit-config.yaml", *map(str, ROOT.glob(".github/ISSUE_TEMPLATE/*"))]
)
def test_other_files_parse(file):
    assert isinstance(yaml.safe_load((ROOT / file).read_text()), dict)
