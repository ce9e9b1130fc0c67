# SPDX-License-Identifier: Apache-2.0
"""Every measure of an evaluation again, slow and obvious: dicts of cells and plain Python, no code shared."""

import itertools
import math


def probability(log_odds):
    return 1 / (1 + math.exp(-log_odds))


def mean(values):
    return sum(values) / len(values) if values else None


def neighbours(cell, tolerance):
    reach = range(-tolerance, tolerance + 1)
    return [tuple(a + b for a, b in zip(cell, step, strict=True)) for step in itertools.product(reach, reach, reach)]


def tally(cells, ours, truth, threshold, tolerance):
    """ours: {cell: log-odds of known cells}; truth: {cell: holds a surface}; cells: those of the truth that count."""

    def called(cell):
        return cell in ours and probability(ours[cell]) > threshold

    tp = sum(called(cell) and truth[cell] for cell in cells)
    fp = sum(called(cell) and not truth[cell] for cell in cells)
    fn = sum(not called(cell) and truth[cell] for cell in cells)
    tn = len(cells) - tp - fp - fn
    surface = [cell for cell in cells if truth[cell]]

    def share(part, whole):
        return part / whole if whole else None

    forgiven = [any(truth.get(near, False) for near in neighbours(cell, tolerance)) for cell in cells if called(cell)]
    found = [any(called(near) for near in neighbours(cell, tolerance)) for cell in surface]
    return {
        "cells": len(cells),
        "tp": tp,
        "fp": fp,
        "tn": tn,
        "fn": fn,
        "accuracy": share(tp + tn, len(cells)),
        "precision": share(tp, tp + fp),
        "recall": share(tp, tp + fn),
        "specificity": share(tn, tn + fp),
        "npv": share(tn, tn + fn),
        "tolerance_precision": mean(forgiven),
        "tolerance_recall": mean(found),
        "correlation": pearson([probability(ours.get(cell, 0.0)) for cell in cells], [truth[cell] for cell in cells]),
        "correlation_free": pearson(
            [probability(ours[cell]) if cell in ours else 0.0 for cell in cells], [truth[cell] for cell in cells]
        ),
        "iou": share(tp, tp + fp + fn),
        "average_precision": average_precision([(probability(ours.get(cell, 0.0)), truth[cell]) for cell in cells]),
        "auc": auc([(probability(ours.get(cell, 0.0)), truth[cell]) for cell in cells]),
    }


def scores(ours, truth, threshold, tolerance, bins):
    seen = [cell for cell in truth if cell in ours]
    pairs = [(probability(ours[cell]), truth[cell]) for cell in seen]
    error = mean([(probability(ours[cell]) - truth[cell]) ** 2 for cell in seen])
    return {
        **tally(list(truth), ours, truth, threshold, tolerance),
        "threshold": threshold,
        "tolerance_cells": tolerance,
        "coverage": len(seen) / len(truth),
        "error": error,
        "brier": error,
        "ece": ece(pairs, bins),
        "ece_likely": ece([(p, y) for p, y in pairs if p >= 0.3], bins),
        "ece_equal_mass": ece_equal_mass(pairs, bins),
        "f_score_1": f_score(ours, truth, threshold, 1),
        "f_score_2": f_score(ours, truth, threshold, 2),
        "balanced": balanced(ours, truth, tolerance),
        "observed": tally(seen, ours, truth, threshold, tolerance),
    }


def f_score(ours, truth, threshold, within):
    found = tally(list(truth), ours, truth, threshold, within)
    precision, recall = found["tolerance_precision"], found["tolerance_recall"]
    if not any(truth.values()):
        return None
    return 2 / (1 / precision + 1 / recall) if precision and recall else 0.0


def balanced(ours, truth, tolerance):
    names = ("precision", "recall", "tolerance_precision", "tolerance_recall")
    points = []
    for percent in range(1, 100):
        found = tally(list(truth), ours, truth, percent / 100, tolerance)
        points.append({"threshold": percent / 100, **{name: found[name] for name in names}})

    def lesser(point):
        return min(-1 if point[name] is None else point[name] for name in names[2:])

    return max(points, key=lesser)  # the first of equal ones


def pearson(x, y):
    if len(set(x)) < 2 or len(set(y)) < 2:
        return None
    mx, my = mean(x), mean(y)
    covariance = mean([(a - mx) * (b - my) for a, b in zip(x, y, strict=True)])
    return covariance / math.sqrt(mean([(a - mx) ** 2 for a in x]) * mean([(b - my) ** 2 for b in y]))


def auc(pairs):
    """How often an occupied cell beats a free one: every pair of them, one by one."""
    occupied, free = ([p for p, is_surface in pairs if is_surface == wanted] for wanted in (True, False))
    return mean([(a > b) + (a == b) / 2 for a in occupied for b in free])


def average_precision(pairs):
    surfaces = sum(is_surface for _, is_surface in pairs)
    if not 0 < surfaces < len(pairs):
        return None
    area, recall = 0.0, 0.0
    for threshold in sorted({p for p, _ in pairs}, reverse=True):
        called = [is_surface for p, is_surface in pairs if p >= threshold]
        area += (sum(called) / surfaces - recall) * sum(called) / len(called)
        recall = sum(called) / surfaces
    return area


def ece_equal_mass(pairs, bins):
    """Every cell by the share of cells below its p, half of those with the very same p counted."""
    groups = {}
    for p, y in pairs:
        below, same = sum(q < p for q, _ in pairs), sum(q == p for q, _ in pairs)
        groups.setdefault(math.floor((2 * below + same) * bins / (2 * len(pairs))), []).append((p, y))
    gaps = [abs(sum(p for p, _ in inside) - sum(y for _, y in inside)) for inside in groups.values()]
    return sum(gaps) / len(pairs) if pairs else None


def ece(pairs, bins):
    total = 0.0
    for i in range(bins):
        inside = [(p, y) for p, y in pairs if i / bins <= p < (i + 1) / bins or (i == bins - 1 and p == 1)]
        if inside:
            total += len(inside) * abs(mean([p for p, _ in inside]) - mean([y for _, y in inside]))
    return total / len(pairs) if pairs else None
