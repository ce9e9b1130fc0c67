# SPDX-License-Identifier: Apache-2.0
"""The page's section on formulas, and the audit: which claim falls when a formula or a setting is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

from stereovox_lab.papers.chapter import Chapter, Claim, Sheet
from stereovox_lab.papers.formulas.mutants import CHIEN, IST, MUTANTS, TABLE, VALENTI, Mutant, applied

TEXTS = {CHIEN: "chien", VALENTI: "valenti", IST: "ist"}
METHOD = (
    "Each formula, algorithm and setting of the text: what the profile makes of a small made-up scene, cell by cell, "
    "next to a slow twin that was written from the text and shares no code. Values that are tabulated or rounded may "
    "differ as the claim says."
)
AUDIT = (
    "The audit applies one fault at a time to stereovox and runs all these claims again. A fault that no claim "
    "notices, or the table of the profile's settings alone, is explained."
)
HEADS = ("fault", "claims that fall", "first of them", "must fall", "why no map shows it")


@dataclass(frozen=True)
class Outcome:
    """What a fault did: the claims that fell."""

    mutant: Mutant
    fallen: tuple[str, ...]

    @property
    def noticed(self) -> bool:
        """Whether the claim fell that must."""
        wanted = self.mutant.falls
        return any(_of_settings(one) if wanted == TABLE else one.startswith(wanted) for one in self.fallen)

    @property
    def as_expected(self) -> bool:
        """Whether it was noticed, or survived as explained."""
        return self.noticed if self.mutant.falls else not self.fallen

    @property
    def shown(self) -> tuple[str, ...]:
        """The claims that fell, those on maps before the table of settings."""
        return tuple(sorted(self.fallen, key=_of_settings))


def _of_settings(claim: str) -> bool:
    return claim.endswith("the profile's settings")


def claims(paper: str) -> list[Claim]:
    """Return all claims on the formulas of a paper; a group that ends in an error is a claim that does not hold."""
    found = []
    for check in import_module(f"stereovox_lab.papers.formulas.{TEXTS[paper]}").CHECKS:
        try:
            found += check()
        except Exception as error:
            found.append(Claim(f"{check.__name__}: {type(error).__name__}", "a result", str(error), False))
    return found


def outcome(mutant: Mutant) -> Outcome:
    """Return which claims of its paper fall under a fault."""
    with applied(mutant):
        return Outcome(mutant, tuple(claim.text for claim in claims(mutant.paper) if claim.holds is False))


def formulas(paper: str, audit: bool = False, step: Callable[[], None] = lambda: None) -> Chapter:
    """Return the section on a paper's formulas; with `audit` also the table of faults. step: called after each."""
    found, sheets, outcomes = claims(paper), [], list[Outcome]()
    step()
    for mutant in MUTANTS if audit else ():
        if mutant.paper == paper:
            outcomes.append(outcome(mutant))
            step()
    if audit:
        found += audit_claims(found, outcomes)
        sheets.append(Sheet("One fault at a time", HEADS, [_row(one) for one in outcomes]))
    numbers = {"faults": [{"fault": one.mutant.what, "falls": list(one.shown), "why": one.mutant.why}
                          for one in outcomes]}  # fmt: skip
    return Chapter(
        "formulas", "Formulas", f"{METHOD} {AUDIT}" if audit else METHOD, found, sheets=sheets, numbers=numbers
    )


def steps(paper: str) -> int:
    """Return how often `formulas` with `audit` calls its step."""
    return 1 + sum(mutant.paper == paper for mutant in MUTANTS)


def audit_claims(found: Sequence[Claim], outcomes: Sequence[Outcome]) -> list[Claim]:
    """Return the claims on the audit: no fault survives unexplained, and no claim withstands them all."""
    wrong = [one.mutant.what for one in outcomes if not one.as_expected]
    explained = sum(not one.mutant.falls for one in outcomes)
    fallen = {text for one in outcomes for text in one.fallen}
    firm = [claim.text for claim in found if claim.holds is not None and claim.text not in fallen]
    return [
        Claim("Audit: every fault makes the claim fall that must", f"{len(outcomes)}, {explained} survive as explained",
              "; ".join(wrong) or "all do", not wrong),
        Claim("Audit: every claim falls under some fault", f"{len(found)}", "; ".join(firm) or "all do", not firm),
    ]  # fmt: skip


def _row(one: Outcome) -> tuple[str, ...]:
    shown = one.shown[0] if one.fallen else "none"
    if one.fallen and all(map(_of_settings, one.fallen)):
        shown = "settings alone"
    return one.mutant.what, str(len(one.fallen)), shown, one.mutant.falls or "none", one.mutant.why
