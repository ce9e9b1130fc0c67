# SPDX-License-Identifier: Apache-2.0
"""The result of `stereovox benchmark` as tables: for the terminal and on a page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from stereovox.view.report import page


class Column(NamedTuple):
    """A figure of the table. better: 1 if more is better, -1 if less is, 0 if neither. scale, digits: for display.

    meaning: for readers.
    """

    head: str
    better: int
    scale: float
    digits: int
    meaning: str


COLUMNS = {
    "auc": Column("AUC", 1, 1, 3, "How often a surface cell has a higher p than a free one; a cell never seen: 0.5."),
    "average_precision": Column("AP", 1, 1, 3, "Area under precision against recall, exact, over all thresholds."),
    "iou": Column("IoU", 1, 1, 3, "Exact cells that map and truth both call occupied, of those that either does."),
    "f_score_1": Column("F, 1 cell", 1, 1, 3, "Harmonic mean of precision and recall, within one cell."),
    "f_score_2": Column("F, 2 cells", 1, 1, 3, "The same within two cells."),
    "ece": Column("ECE", -1, 1, 3, "How far probabilities of cells seen lie from the true shares, 10 bins."),
    "ece_likely": Column("ECE p>=.3", -1, 1, 3, "The same without the many cells that are surely free: p >= 0.3."),
    "ece_equal_mass": Column("ECE mass", -1, 1, 3, "The same in 10 bins of equally many cells."),
    "brier": Column("Brier", -1, 1, 3, "Mean squared error of the probabilities of the cells seen."),
    "wrongly_free": Column("wrongly free %", -1, 100, 2, "Of the surface cells that the map knows, called free."),
    "wrongly_free_alone": Column("alone %", -1, 100, 2, "The same, nothing tentative or occupied within one cell."),
    "thin_lost": Column(
        "thin lost %", -1, 100, 1, "Of the surface cells of lines (one or two cells across in two directions: poles, "
        "wires, legs), without an occupied cell within one cell."),
    "coverage": Column("known", 1, 1, 3, "Share of the truth's cells that the map says anything about."),
    "ms": Column(
        "ms", -1, 1, 2, "Median processor time of a frame, of all threads: of stereovox all that it does with a depth "
        "image, of others their insertion alone. For time by the clock: stereovox bench."),
    "map_bytes": Column("MB", -1, 1e-6, 2, "Memory of the map as the library reports it."),
}  # fmt: skip
OF_PROBABILITIES = ("ece", "ece_likely", "ece_equal_mass", "brier", "ms", "map_bytes")
"""Shown in a second table on the page."""
TRUTHS = {
    "exact geometry": "Simulated: the cells that exact depth images of the same frames see; the "
    "scene's triangles decide what is in them.",
    "lidar": "The cells that lidar points fall into, and those that their rays cross, in view of a mapped frame.",
    "held-out frames": "Every tenth frame is not mapped. The cells in which its pixels end are occupied, those that "
    "they see through well before the end are free; what two such frames contradict each other about is left out. The "
    "noise of the camera is in the truth too.",
}
LEAD = (
    "Each library maps the same frames from the same poses into cells of the same size; each map is judged by the same "
    "truth, cell by cell, at the library's own thresholds. Means over the runs of a data set; * marks the best figures."
)


def rows_of(result: dict[str, Any], data: str, names: Iterable[str] = COLUMNS) -> list[tuple[str, ...]]:
    """Return the rows of one data set: a library and its figures `names`, the best of each column marked by `*`."""
    names, group = list(names), [mean for mean in result["means"] if mean["data"] == data]
    return [(mean["library"], *(_shown(name, mean, group) for name in names)) for mean in group]


def _shown(name: str, mean: dict[str, Any], group: Sequence[dict[str, Any]]) -> str:
    column, value = COLUMNS[name], mean[name]
    if value is None:
        return "-"
    text = f"{value * column.scale:.{column.digits}f}"
    others = [column.better * one[name] for one in group if one[name] is not None]
    return text + "*" * (len(group) > 1 and column.better * value >= max(others))


def heads(names: Iterable[str] = COLUMNS) -> tuple[str, ...]:
    """Return the heads above `rows_of`."""
    return ("library", *(COLUMNS[name].head for name in names))


def title_of(result: dict[str, Any], data: str) -> str:
    """Return a one-line description of a data set."""
    runs = [about for about in result["data"] if about["name"] == data]
    one = runs[0]
    number = f", {len(runs)} runs" if len(runs) > 1 else ""
    held = f" and {one['frames_held_out']} held out" if one["frames_held_out"] else ""
    cells = f"{one['surface_cells']:,} surface and {one['free_cells']:,} free cells"
    return (
        f"{data}: {one['frames']} frames{held}{number}, cells of {one['voxel_size']:g} m to {one['max_range']:g} m; "
        f"truth: {one['truth']}, {cells}"
    )


def write_benchmark(folder: Path, result: dict[str, Any]) -> dict[str, str]:
    """Write `benchmark.html` and `benchmark.json` into `folder`; return their paths. Raises StereovoxError."""
    contents = {
        "benchmark.html": benchmark_page(result).encode(),
        "benchmark.json": (json.dumps(result, indent=1, allow_nan=False) + "\n").encode(),
    }
    page.write_files(folder, contents)
    return {name.partition(".")[2]: str(folder / name) for name in contents}


def benchmark_page(result: dict[str, Any]) -> str:
    """Return the page as text."""
    names = dict.fromkeys(about["name"] for about in result["data"])
    libraries = ((one["name"], one["version"], one["settings"]) for one in result["libraries"])
    kinds = dict.fromkeys(about["truth"] for about in result["data"])
    runs = (
        (about["name"], about["run"] or "-", about["frames"], about["frames_held_out"], about["surface_cells"],
         about["free_cells"], about["contradictory_cells"], about["truth_sha256"][:12])
        for about in result["data"]
    )  # fmt: skip
    facts = ((key, str(value)) for key, value in result["machine"].items())
    return page.page(
        "How accurate are the maps?",
        LEAD,
        *(page.section(title_of(result, name), "", *_tables(result, name)) for name in names),
        page.section("What the figures mean", "", page.table(("figure", "what it says"), _meanings())),
        page.section("Where the truth is from", "", page.table(("truth", "how"), [(k, TRUTHS[k]) for k in kinds])),
        page.section("Libraries", "", page.table(("name", "version", "settings"), libraries)),
        page.section("Runs", "The checksum is the same where the truth is.", page.table(RUN_HEADS, runs)),
        page.section(
            f"Protocol {result['protocol']}", "The command that made this page:", page.code(result["command"])
        ),
        page.section("Machine", "", page.table(("what", "is"), facts)),
    )


def _tables(result: dict[str, Any], data: str) -> Iterator[str]:
    """Yield two tables, each as wide as a page: on geometry, and on probabilities and costs."""
    of_places = [name for name in COLUMNS if name not in OF_PROBABILITIES]
    for names in (of_places, OF_PROBABILITIES):
        yield page.table(heads(names), rows_of(result, data, names))
        yield "<p></p>"


RUN_HEADS = ("data", "run", "frames", "held out", "surface cells", "free cells", "contradictory", "truth")


def _meanings() -> list[tuple[str, str]]:
    return [(column.head, column.meaning) for column in COLUMNS.values()]
