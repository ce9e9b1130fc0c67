# SPDX-License-Identifier: Apache-2.0
"""Claims about maps of real drives, and whether they hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from stereovox.evaluate.curves import EXACT, TOLERANT, PrecisionRecall
from stereovox.evaluate.scores import Scores
from stereovox.lab.papers.chapter import Claim
from stereovox.lab.papers.valenti.figures import AT_LEAST, STRICT, at
from stereovox.lab.papers.valenti.judge import Judged
from stereovox.lab.papers.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox.lab.papers.valenti.speed import Speed

TARGET_RANGE = 20.0
ERROR, ECE, HERTZ = 0.10, 0.05, 20.0
"""Most mean squared error, most calibration error, and least frames a second."""
NOT_INSTALLED = "octomap-python is not installed"
KINDS = {"view": "free: all in view", "rays": "free: what the lidar looked into"}
"""Kinds of truth."""
CLAIMED = "view"
Found = Mapping[tuple[Setting, str], Judged]
"""All maps of a drive by setting and mapper."""
LESS_IS_BETTER = {"error", "calibration error"}


class Target(NamedTuple):
    """Least precision and recall within one cell, at one threshold, and least correlation, for one cell size."""

    precision: float
    recall: float
    correlation: float


TARGETS = {0.5: Target(0.92, 0.95, 0.72), 0.4: Target(0.90, 0.94, 0.70), 0.2: Target(0.85, 0.92, 0.62)}
"""By cell size in metres, for a range of TARGET_RANGE metres."""


class Result(NamedTuple):
    """One target, and what a map reached of it; holds: None where there is nothing to compare with."""

    letter: str
    text: str
    wanted: str
    ours: str
    holds: bool | None


def claims_of(judged: Sequence[Judged]) -> list[Claim]:
    """Return the claims about one drive: (a) to (e) of `default` up to TARGET_RANGE, (f) at every setting."""
    found = {(one.setting, one.mapper): one for one in judged}
    settings = list(dict.fromkeys(one.setting for one in judged))
    claimed = [one for one in settings if one.voxel_size in TARGETS and one.max_range == TARGET_RANGE]
    told = [Claim(f"({one.letter}) {setting}: {one.text}", one.wanted, one.ours, one.holds)
            for setting in claimed for one in results(found, setting, DEFAULT, CLAIMED)]  # fmt: skip
    return [*told, *(_wins(found, setting, rival) for setting in settings for rival in (THESIS, OCTOMAP))]


def speed_claim(speed: Speed) -> Claim:
    """Return claim (g); a verdict for `default` only."""
    parts = ", ".join(f"{name} {times['median']:.1f}" for name, times in speed.ms.items())
    text = f"(g) {speed.profile}, {speed.setting}: stereo pair {speed.image} to updated map on 2 cores"
    ours = f"{speed.hertz:.1f} Hz on {speed.cores} core{'s' * (speed.cores != 1)} (median ms: {parts})"
    return Claim(text, f"at least {HERTZ:g} Hz", ours, speed.hertz >= HERTZ if speed.profile == DEFAULT else None)


def results(found: Found, setting: Setting, mapper: str, kind: str) -> list[Result]:
    """Return what one map reaches of the targets for its cell size, (a) to (e), against one kind of truth."""
    ours, target = found[setting, mapper].scores[kind], TARGETS[setting.voxel_size]
    octomap = found.get((setting, OCTOMAP))
    correlation, goal = ours.observed.correlation, target.correlation
    return [
        _against_octomap(ours.curve, octomap.scores[kind].curve if octomap else None),
        _pair("b", "precision and recall within one cell, at one threshold", ours.curve, TOLERANT, target[:2], ""),
        Result("c", "error (MSE)", f"at most {ERROR:.2f} (thesis 0.074 to 0.089)", _number(ours.error),
               ours.error is not None and ours.error <= ERROR),
        Result("d", "correlation, observed cells", f"at least {goal:.2f}", _number(correlation),
               correlation is not None and correlation >= goal),
        Result("d", "correlation, all cells", "no target (thesis 0.49 to 0.63)", _number(ours.correlation), None),
        Result("e", "expected calibration error", f"at most {ECE:.2f}", _number(ours.ece),
               ours.ece is not None and ours.ece <= ECE),
    ]  # fmt: skip


def _against_octomap(curve: PrecisionRecall, octomap: PrecisionRecall | None) -> Result:
    """Return (a): OctoMap's better precision and its better recall, of p > 0.7 and p >= 0.7, at once."""
    text = "exact precision and recall, at one threshold"
    if octomap is None:
        return Result("a", text, NOT_INSTALLED, _format_point(curve.best(EXACT), EXACT), None)
    points = [at(octomap, threshold) for threshold in (STRICT, AT_LEAST)]
    precision, recall = (max(point[name] or 0.0 for point in points) for name in EXACT)
    return _pair("a", text, curve, EXACT, (precision, recall), " (OctoMap's better ones)")


def _pair(
    letter: str, text: str, curve: PrecisionRecall, names: tuple[str, str], wanted: tuple[float, float], why: str
) -> Result:
    point = curve.best(names, wanted)
    holds = all((point[name] or 0.0) >= goal for name, goal in zip(names, wanted, strict=True))
    goal = "at least {:.3f} and {:.3f}".format(*wanted)
    return Result(letter, text, f"{goal}{why}", _format_point(point, names), holds)


def _wins(found: Found, setting: Setting, rival: str) -> Claim:
    """Return claim (f): better in each measure that has a target, each map at the threshold that suits it best."""
    text = f"(f) {setting}: default is better than {rival} in every measure"
    if (setting, rival) not in found:
        return Claim(text, "better in each", NOT_INSTALLED, None)
    ours, theirs = (found[setting, name].scores[CLAIMED] for name in (DEFAULT, rival))
    pairs = {name: (measure(ours), measure(theirs)) for name, measure in MEASURES.items()}
    better = {name: a < b if name in LESS_IS_BETTER else a > b for name, (a, b) in pairs.items()}
    told = [f"{name} {a:.3f} against {b:.3f}{'' if better[name] else ' (worse)'}" for name, (a, b) in pairs.items()]
    beside = f"not counted: correlation, all cells {_number(ours.correlation)} against {_number(theirs.correlation)}"
    return Claim(text, "better in each", "; ".join([*told, beside]), all(better.values()))


def _lesser(names: tuple[str, str]) -> Callable[[Scores], float]:
    """Return a function that tells the lesser of precision and recall where that is largest."""

    def measure(scores: Scores) -> float:
        point = scores.curve.best(names)
        return min(point[name] or 0.0 for name in names)

    return measure


MEASURES: dict[str, Callable[[Scores], float]] = {
    "precision and recall, exact": _lesser(EXACT),
    "within one cell": _lesser(TOLERANT),
    "error": lambda scores: _or(scores.error, 1.0),
    "correlation, observed": lambda scores: _or(scores.observed.correlation, -1.0),
    "calibration error": lambda scores: _or(scores.ece, 1.0),
}
"""What is compared in (f)."""


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _format_point(point: Mapping[str, float | None], names: tuple[str, str]) -> str:
    precision, recall = (_number(point[name]) for name in names)
    return f"{precision} and {recall} at p > {point['threshold']:.4g}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
