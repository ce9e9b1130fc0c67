# SPDX-License-Identifier: Apache-2.0
"""The formulas of the three texts hold in the maps, and claims on them fall when something is wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox_lab.papers import reproduce
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.formulas import audit, same, same_cells
from stereovox_lab.papers.formulas.audit import Outcome, audit_claims, claims, outcome
from stereovox_lab.papers.formulas.mutants import CHIEN, IST, MUTANTS, REFUSED, TABLE, VALENTI, Mutant, applied

SAMPLE = [one for one in MUTANTS if one.falls not in (TABLE, "")][::7]
"""The whole table takes some minutes: `stereovox reproduce PAPER --audit`."""


@pytest.mark.parametrize("paper", [CHIEN, VALENTI, IST])
def test_the_formulas_hold_in_the_maps(paper):
    found = claims(paper)
    assert len({claim.text for claim in found}) == len(found) >= 8
    assert not [claim for claim in found if claim.holds is False]


@pytest.mark.slow
@pytest.mark.parametrize("mutant", SAMPLE, ids=lambda mutant: f"{mutant.paper}: {mutant.what}")
def test_a_fault_makes_its_claim_fall(mutant):
    found = outcome(mutant)
    assert found.as_expected, found.fallen
    assert any(not audit._of_settings(claim) for claim in found.fallen)


def test_explained_faults_survive():
    for mutant in MUTANTS:
        if not mutant.falls:
            assert outcome(mutant).fallen == ()
        assert bool(mutant.why) == (mutant.falls in (TABLE, ""))


def test_faults_are_in_place_only_while_they_are_applied():
    for mutant in (MUTANTS[0], *(one for one in MUTANTS if ":" in one.where)):
        with applied(mutant):
            assert (load_config(CHIEN).integrator == "ray") == (mutant is MUTANTS[0])
    assert load_config(CHIEN).integrator == "line"
    assert len({(one.paper, one.what) for one in MUTANTS}) == len(MUTANTS) >= 60


def test_a_fault_that_no_claim_notices_is_reported():
    harmless = Mutant(IST, "threads = 2", "threads", 2, "II-B")
    found = outcome(harmless)
    assert not found.as_expected
    firm = Claim("firm", "-", "-", True)
    verdicts = audit_claims([firm, Claim("figure", "-", "-", None)], [found])
    assert [claim.holds for claim in verdicts] == [False, False]
    assert "threads = 2" in verdicts[0].ours
    assert verdicts[1].ours == "firm"
    explained = Outcome(replace(harmless, falls="", why="maps do not depend on it"), ())
    other = Outcome(replace(harmless, falls=REFUSED), (f"{REFUSED}: StereovoxError", "firm"))
    assert [claim.holds for claim in audit_claims([firm], [explained, other])] == [True, True]
    assert not Outcome(explained.mutant, ("firm",)).as_expected


def test_comparisons_fall():
    assert same("x", [1.0, float("nan")], [1.0, float("nan")]).holds
    assert not same("x", [1.0, 2.0], [1.0, 2.1], 0.05).holds
    assert same("x", [1.0, 2.0], [1.0, 2.1], 0.05, 0.5).holds
    assert not same("x", [1.0], [1.0, 2.0]).holds
    assert not same("x", [], []).holds
    here, there = np.array([True, True, False]), np.array([True, False, False])
    assert same_cells("x", here, here).holds
    assert not same_cells("x", here, there).holds
    assert same_cells("x", here, there, 0.5).holds
    assert not same_cells("x", here & False, here & False).holds


def test_the_audit_writes_a_page(tmp_path, monkeypatch):
    few = [next(one for one in MUTANTS if one.paper == IST and one.where == where)
           for where in ("grid.traversal", "noise.subpixel")]  # fmt: skip
    monkeypatch.setattr(audit, "MUTANTS", few)
    steps = []
    result = reproduce(IST, tmp_path, audit=True, progress=lambda done, total, text: steps.append((done, total)))
    assert steps[-1] == (3, 3)
    assert [text[:5] for text in result["does_not_hold"]] == ["Audit"]  # two faults do not reach every claim
    numbers = json.loads((tmp_path / "numbers.json").read_text())["experiments"]["formulas"]["numbers"]
    assert [fault["fault"] for fault in numbers["faults"]] == ["grid.traversal = exact", "noise.subpixel = 0.25"]
    page = (tmp_path / "report.html").read_text()
    assert "settings alone" in page
    assert "Bresenham" in page
