# SPDX-License-Identifier: Apache-2.0
"""What a map of a real drive must show, and whether it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from stereovox.evaluate.curves import PrecisionRecall
from stereovox.evaluate.reproduce.chapter import Claim
from stereovox.evaluate.reproduce.valenti.figures import AT_LEAST, EXACT, STRICT, TOLERANT, at, best
from stereovox.evaluate.reproduce.valenti.judge import Judged
from stereovox.evaluate.reproduce.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox.evaluate.reproduce.valenti.speed import Speed
from stereovox.evaluate.scores import Scores


class Target(NamedTuple):
    """Least precision and recall within one cell, at one threshold, and least correlation, for one cell size."""

    precision: float
    recall: float
    correlation: float


TARGETS = {0.5: Target(0.92, 0.95, 0.72), 0.4: Target(0.90, 0.94, 0.70), 0.2: Target(0.85, 0.92, 0.62)}
"""By cell size in metres, for a range of TARGET_RANGE metres."""
TARGET_RANGE = 20.0
ERROR, ECE, HERTZ = 0.10, 0.05, 20.0
"""Most mean squared error, most calibration error, and least frames a second."""
NOT_THERE = "octomap-python is not installed"
KINDS = {"view": "free: all in view", "rays": "free: what the lidar looked into"}
"""Kinds of truth, the one that is claimed first."""
Found = Mapping[tuple[Setting, str], Judged]
"""All maps of a drive by setting and mapper."""


def claims_of(judged: Sequence[Judged]) -> list[Claim]:
    """Return the claims about one drive, (a) to (f); those without a target carry the figure and no verdict."""
    found = {(one.setting, one.mapper): one for one in judged}
    settings = list(dict.fromkeys(one.setting for one in judged))
    told = [claim for setting in settings if setting.voxel_size in TARGETS for claim in _of_setting(found, setting)]
    return [*told, *(_wins(found, setting, rival) for setting in settings for rival in (THESIS, OCTOMAP))]


def speed_claim(speed: Speed) -> Claim:
    """Return claim (g); a verdict for `default` only."""
    parts = ", ".join(f"{name} {times['median']:.1f}" for name, times in speed.ms.items())
    text = f"(g) {speed.profile}, {speed.setting}: stereo pair {speed.image} to updated map on 2 cores"
    ours = f"{speed.hertz:.1f} Hz on {speed.cores} core{'s' * (speed.cores != 1)} (median ms: {parts})"
    return Claim(text, f"at least {HERTZ:g} Hz", ours, speed.hertz >= HERTZ if speed.profile == DEFAULT else None)


def meets(scores: Scores, octomap: Scores | None, size: float) -> dict[str, bool | None]:
    """Return by letter which targets a map meets; None: nothing to compare with."""
    target = TARGETS[size]
    rival = None if octomap is None else _better_of(octomap.curve)
    return {
        "a": None if rival is None else _reached(scores.curve, EXACT, rival),
        "b": _reached(scores.curve, TOLERANT, target[:2]),
        "c": _most(scores.error, ERROR),
        "d": _least(scores.observed.correlation, target.correlation),
        "e": _most(scores.ece, ECE),
    }


def _of_setting(found: Found, setting: Setting) -> list[Claim]:
    claims = []
    for kind in KINDS:
        ours, octomap = found[setting, DEFAULT].scores[kind], found.get((setting, OCTOMAP))
        told = _told(ours, octomap.scores[kind] if octomap else None, setting, kind)
        claimed = kind == "view" and setting.max_range == TARGET_RANGE
        claims += told if claimed else [Claim(one.text, one.thesis, one.ours, None) for one in told]
    return claims


def _told(ours: Scores, octomap: Scores | None, setting: Setting, kind: str) -> list[Claim]:
    target, head = TARGETS[setting.voxel_size], f"{setting}; {KINDS[kind]}"
    met = meets(ours, octomap, setting.voxel_size)
    exact = "exact precision and recall at one threshold: OctoMap's better precision and its better recall at once"
    wanted, shown = NOT_THERE, best(ours.curve, EXACT)
    if octomap is not None:
        rival = _better_of(octomap.curve)
        wanted, shown = "{:.3f} and {:.3f}".format(*rival), best(ours.curve, EXACT, rival)
    within = best(ours.curve, TOLERANT, target[:2])
    observed, everywhere = ours.observed.correlation, ours.correlation
    return [
        Claim(f"(a) {head}: {exact}", wanted, _pair(shown, EXACT), met["a"]),
        Claim(f"(b) {head}: precision and recall within one cell, at one threshold",
              f"at least {target.precision:.2f} and {target.recall:.2f}", _pair(within, TOLERANT), met["b"]),
        Claim(f"(c) {head}: error (MSE, observed cells)", f"at most {ERROR:.2f} (thesis 0.074 to 0.089)",
              _number(ours.error), met["c"]),
        Claim(f"(d) {head}: correlation, observed cells", f"at least {target.correlation:.2f} (thesis 0.49 to 0.63)",
              _number(observed), met["d"]),
        Claim(f"(d) {head}: correlation, all cells of the truth", f"at least {target.correlation:.2f}",
              _number(everywhere), _least(everywhere, target.correlation)),
        Claim(f"(e) {head}: expected calibration error", f"at most {ECE:.2f}", _number(ours.ece), met["e"]),
    ]  # fmt: skip


def _wins(found: Found, setting: Setting, rival: str) -> Claim:
    """Return claim (f): better in each measure, each map at the threshold that suits it best."""
    text = f"(f) {setting}: default is better than {rival} in every measure"
    if (setting, rival) not in found:
        return Claim(text, "better in each", NOT_THERE, None)
    ours, theirs = (_measures(found[setting, name].scores["view"]) for name in (DEFAULT, rival))
    better = {name: ours[name] > theirs[name] for name in ours}
    told = [f"{name} {abs(ours[name]):.3f} against {abs(theirs[name]):.3f}" for name in ours]
    told = [one if better[name] else f"{one} (worse)" for name, one in zip(ours, told, strict=True)]
    return Claim(text, "better in each", "; ".join(told), all(better.values()))


def _measures(scores: Scores) -> dict[str, float]:
    """Return what is compared; more is better, so errors are negative."""
    exact, within = best(scores.curve, EXACT), best(scores.curve, TOLERANT)
    return {
        "lesser of exact precision and recall": min(exact[name] or 0.0 for name in EXACT),
        "the same within one cell": min(within[name] or 0.0 for name in TOLERANT),
        "error": -_or(scores.error, 1.0),
        "correlation of observed cells": _or(scores.observed.correlation, -1.0),
        "correlation of all cells": _or(scores.correlation, -1.0),
        "calibration error": -_or(scores.ece, 1.0),
    }


def _better_of(curve: PrecisionRecall) -> tuple[float, float]:
    """Return OctoMap's better precision and its better recall, of p > 0.7 and p >= 0.7."""
    points = [at(curve, threshold) for threshold in (STRICT, AT_LEAST)]
    precision, recall = (max(point[name] or 0.0 for point in points) for name in EXACT)
    return precision, recall


def _reached(curve: PrecisionRecall, names: tuple[str, str], wanted: tuple[float, float]) -> bool:
    point = best(curve, names, wanted)
    return all((point[name] or 0.0) >= goal for name, goal in zip(names, wanted, strict=True))


def _least(value: float | None, goal: float) -> bool:
    return value is not None and value >= goal


def _most(value: float | None, goal: float) -> bool:
    return value is not None and value <= goal


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _pair(point: Mapping[str, float | None], names: tuple[str, str]) -> str:
    precision, recall = (_number(point[name]) for name in names)
    return f"{precision} and {recall} at p > {point['threshold']:.4g}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
