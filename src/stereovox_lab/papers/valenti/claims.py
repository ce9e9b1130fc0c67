# SPDX-License-Identifier: Apache-2.0
"""Claims about maps of real drives, and whether they hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from stereovox.evaluate.curves import EXACT, TOLERANT, PrecisionRecall
from stereovox.evaluate.scores import Scores
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.valenti.apart import NOT_APART, Apart
from stereovox_lab.papers.valenti.figures import AT_LEAST, STRICT, at
from stereovox_lab.papers.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox_lab.papers.valenti.printed import BEST
from stereovox_lab.papers.valenti.speed import Speed

TARGET_RANGE = 20.0
ERROR, ECE, HERTZ = 0.10, 0.05, 20.0
"""Largest mean squared error, largest calibration error, and least frames a second."""
NOT_INSTALLED = "octomap-python is not installed"
KINDS = {"view": "free: all in view", "rays": "free: what the lidar looked into"}
"""Kinds of truth."""
CLAIMED = "view"
Found = Mapping[tuple[Setting, str], Apart]
"""All maps of a drive by setting and mapper."""
Point = Mapping[str, float | None] | None
"""Threshold, precision and recall, exact and within one cell; None if no threshold could be chosen apart."""
LESS_IS_BETTER = {"error", "calibration error"}


class Target(NamedTuple):
    """Least precision and recall within one cell, at one threshold, and least correlation, for one cell size."""

    precision: float
    recall: float
    correlation: float


TARGETS = {0.5: Target(0.92, 0.95, 0.72), 0.4: Target(0.90, 0.94, 0.70), 0.2: Target(0.85, 0.92, 0.62)}
"""By cell size in metres, for a range of TARGET_RANGE metres."""


class Result(NamedTuple):
    """One target, and a map's figure for it; holds: None if it cannot be judged; unjudged: why not."""

    letter: str
    text: str
    wanted: str
    ours: str
    holds: bool | None
    unjudged: str = ""

    def claim(self, setting: Setting) -> Claim:
        """Return it as a claim about a map at this setting."""
        return Claim(f"({self.letter}) {setting}: {self.text}", self.wanted, self.ours, self.holds, self.unjudged)


def claims_of(maps: Sequence[Apart]) -> list[Claim]:
    """Return the claims about one drive: (a) to (e) of `default` up to TARGET_RANGE, (f) at every setting."""
    found = {(one.judged.setting, one.judged.mapper): one for one in maps}
    settings = list(dict.fromkeys(setting for setting, _ in found))
    claimed = [one for one in settings if one.voxel_size in TARGETS and one.max_range == TARGET_RANGE]
    told = [one.claim(setting) for setting in claimed for one in results(found, setting, DEFAULT, CLAIMED)]
    return [*told, *(_wins(found, setting, rival) for setting in settings for rival in (THESIS, OCTOMAP))]


def speed_claim(speed: Speed) -> Claim:
    """Return (g), a figure without a verdict: it depends on the machine and on what else that does."""
    parts = ", ".join(f"{name} {times['median']:.1f}" for name, times in speed.ms.items())
    text = f"(g) {speed.profile}, {speed.setting}: stereo pair {speed.image} to updated map on 2 cores"
    ours = f"{speed.hertz:.1f} Hz on {speed.cores} core{'s' * (speed.cores != 1)} (median ms: {parts})"
    return Claim(text, f"at least {HERTZ:g} Hz on an idle machine", ours, None)


def results(found: Found, setting: Setting, mapper: str, kind: str) -> list[Result]:
    """Return one map's results on the targets for its cell size, (a) to (e), against one kind of truth.

    Thresholds are chosen and scored on different parts, see `Apart`.
    """
    ours, target = found[setting, mapper], TARGETS[setting.voxel_size]
    scores, (precision, recall, correlation) = ours.scored[kind], target
    return [
        _against_octomap(ours, found.get((setting, OCTOMAP)), kind),
        _pair("b", "precision and recall within one cell, at one threshold", ours.point(kind, TOLERANT, target[:2]),
              TOLERANT, (precision, recall)),
        _at_most("c", "error (MSE)", scores.error, ERROR, f" (thesis {BEST['error']:.3f} to 0.089)"),
        _at_least("d", "correlation, observed cells", scores.observed.correlation, correlation),
        _at_least("d", "correlation, all cells, unobserved ones at 0.5", scores.correlation, BEST["correlation"],
                  ", the thesis's best"),
        _at_most("e", "expected calibration error", scores.ece, ECE),
    ]  # fmt: skip


def _at_most(letter: str, text: str, value: float | None, goal: float, why: str = "") -> Result:
    return Result(letter, text, f"at most {goal:.2f}{why}", _number(value), value is not None and value <= goal)


def _at_least(letter: str, text: str, value: float | None, goal: float, why: str = "") -> Result:
    return Result(letter, text, f"at least {goal:.2f}{why}", _number(value), value is not None and value >= goal)


def _against_octomap(ours: Apart, octomap: Apart | None, kind: str) -> Result:
    """Return (a): both OctoMap's better precision and its better recall, of p > 0.7 and p >= 0.7."""
    text = "exact precision and recall, at one threshold"
    if octomap is None:
        return Result("a", text, "OctoMap's", "-", None, NOT_INSTALLED)
    theirs = _fixed(octomap.chosen[kind]) if octomap.chosen else (0.0, 0.0)
    point = ours.point(kind, EXACT, theirs)
    return _pair("a", text, point, EXACT, _fixed(octomap.scored[kind].curve), " (OctoMap's better ones)")


def _fixed(curve: PrecisionRecall) -> tuple[float, float]:
    """Return the better exact precision and the better recall of p > 0.7 and p >= 0.7."""
    points = [at(curve, threshold) for threshold in (STRICT, AT_LEAST)]
    precision, recall = (max(point[name] or 0.0 for point in points) for name in EXACT)
    return precision, recall


def _pair(
    letter: str, text: str, point: Point, names: tuple[str, str], wanted: tuple[float, float], why: str = ""
) -> Result:
    goal = "at least {:.3f} and {:.3f}".format(*wanted) + why
    if point is None:
        return Result(letter, text, goal, "-", None, NOT_APART)
    holds = all((point[name] or 0.0) >= least for name, least in zip(names, wanted, strict=True))
    return Result(letter, text, goal, _format_point(point, names), holds)


def _wins(found: Found, setting: Setting, rival: str) -> Claim:
    """Return claim (f): better in each measure that has a target, each map at the threshold chosen for it apart."""
    text, wanted = f"(f) {setting}: default is better than {rival} in every measure", "better in each"
    if (setting, rival) not in found:
        return Claim(text, wanted, "-", None, NOT_INSTALLED)
    ours, theirs = (found[setting, name] for name in (DEFAULT, rival))
    if ours.chosen is None or theirs.chosen is None:
        return Claim(text, wanted, "-", None, NOT_APART)
    pairs = {name: (measure(ours), measure(theirs)) for name, measure in MEASURES.items()}
    better = {name: a < b if name in LESS_IS_BETTER else a > b for name, (a, b) in pairs.items()}
    told = [f"{name} {a:.3f} against {b:.3f}{'' if better[name] else ' (worse)'}" for name, (a, b) in pairs.items()]
    return Claim(text, wanted, "; ".join(told), all(better.values()))


def _lesser(names: tuple[str, str]) -> Callable[[Apart], float]:
    """Return a function for the lesser of precision and recall at the threshold that balances them elsewhere."""

    def measure(one: Apart) -> float:
        point = one.point(CLAIMED, names) or {}
        return min(point.get(name) or 0.0 for name in names)

    return measure


def _score(tell: Callable[[Scores], float | None], otherwise: float) -> Callable[[Apart], float]:
    """Return a function for a threshold-free measure; otherwise: its default if there is no value."""

    def measure(one: Apart) -> float:
        value = tell(one.scored[CLAIMED])
        return otherwise if value is None else value

    return measure


MEASURES: dict[str, Callable[[Apart], float]] = {
    "precision and recall, exact": _lesser(EXACT),
    "within one cell": _lesser(TOLERANT),
    "error": _score(lambda scores: scores.error, 1.0),
    "correlation, observed": _score(lambda scores: scores.observed.correlation, -1.0),
    "correlation, all cells": _score(lambda scores: scores.correlation, -1.0),
    "calibration error": _score(lambda scores: scores.ece, 1.0),
}
"""Measures compared in (f)."""


def _format_point(point: Mapping[str, float | None], names: tuple[str, str]) -> str:
    precision, recall = (_number(point[name]) for name in names)
    return f"{precision} and {recall} at p > {point['threshold']:.4g}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
