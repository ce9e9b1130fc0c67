# SPDX-License-Identifier: Apache-2.0
"""Write benchmark results: `bench.json`, `bench.md`, `bench.png`, and text for the terminal."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.files.safe_io import replacing
from stereovox.view.figures import GREY, INK, LINE, blank, labels, png_of
from stereovox_lab.bench.machine import machine_line
from stereovox_lab.bench.more import MEASUREMENTS
from stereovox_lab.bench.results import Table, comparison_table, is_ours, rows_by_size

DPI = 130
SIZE = 13.0, 6.4
"""Inches."""
OURS = "#d1402f"
FURTHER = ("#e8963d", "#b56576")
"""Colours of our further integrators."""
OTHERS = ("#23618c", "#5b8c5a", "#a07cc0", "#6b7280", "#4aa3a2", "#94793f")
DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (4, 2, 1, 2)))
MARKERS = "osD^vP"
CAMERA_MS = 1000 / 30
"""Time per image of a camera at 30 images per second."""


def speed_png(result: dict[str, Any]) -> bytes:
    """Return a PNG of the result of `bench`: milliseconds per frame, and the map's megabytes, by voxel size."""
    figure = blank(*SIZE)
    left, right = figure.subplots(1, 2)
    lines = _lines(result)
    _panel(left, lines, "integrate_ms_median", 1.0)
    _panel(right, {name: rows for name, rows in lines.items() if not _again(rows[0], result)}, "map_bytes", 1e-6)
    if left.get_ylim()[0] < CAMERA_MS < left.get_ylim()[1]:
        left.axhline(CAMERA_MS, color=GREY, linewidth=1, zorder=0)
        place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "center"}
        left.annotate("30 frames a second", (0.5, CAMERA_MS), (0, 3), fontsize=9, color=GREY, **place)
    _label_axes(left, "Time to take in a frame", "median milliseconds (lower is better)")
    _label_axes(right, "Memory of the finished map", "megabytes (lower is better)")
    handles, names = left.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 5), frameon=False, fontsize=10.5)
    frames = f"{result['frames']} frames of {result['image']}, depth up to {result['max_range']:g} m"
    figure.suptitle(f"{_plain(result['source'])}: {frames}\n", fontsize=14, color=INK, weight="bold")
    figure.text(0.5, 0.925, machine_line(result["machine"]), ha="center", fontsize=9.5, color=GREY)
    return png_of(figure, DPI)


def _lines(result: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each library by its name in the legend, ours first."""
    found: dict[str, list[dict[str, Any]]] = {}
    for rows in rows_by_size(result).values():
        for row in rows:
            threads = f", {row['threads']} thread{'s' * (row['threads'] != 1)}" if is_ours(row) else ""
            found.setdefault(f"{_plain(row['library'])}{threads}", []).append(row)
    return {name: sorted(rows, key=lambda row: row["voxel_size"]) for name, rows in found.items()}


def _again(row: dict[str, Any], result: dict[str, Any]) -> bool:
    """Return whether a row is ours with more threads, which makes the same map."""
    return is_ours(row) and row["threads"] != result["rows"][0]["threads"]


def _panel(axis: Any, lines: Mapping[str, Sequence[dict[str, Any]]], key: str, factor: float) -> None:
    ours = list(dict.fromkeys(rows[0]["library"] for rows in lines.values() if is_ours(rows[0])))
    threads = list(dict.fromkeys(rows[0]["threads"] for rows in lines.values() if is_ours(rows[0])))
    others = [name for name, rows in lines.items() if not is_ours(rows[0])]
    first = next(iter(lines))
    for name, rows in lines.items():
        if is_ours(rows[0]):
            colour = (OURS, *FURTHER)[ours.index(rows[0]["library"]) % 3]
            dash = DASHES[threads.index(rows[0]["threads"]) % len(DASHES)]
            look: dict[str, Any] = {
                "linewidth": 2.8,
                "markersize": 7,
                "zorder": 5 if name == next(iter(lines)) else 4,
                "marker": "o",
            }
        else:
            number = others.index(name)
            colour, dash = OTHERS[number % len(OTHERS)], DASHES[number % len(DASHES)]
            look = {"linewidth": 1.6, "markersize": 6, "zorder": 3, "marker": MARKERS[1 + number % 5]}
        sizes, values = [row["voxel_size"] for row in rows], [factor * row[key] for row in rows]
        axis.plot(sizes, values, linestyle=dash, color=colour, label=name, **look)
        if name == first:
            _numbers(axis, sizes, values)
    axis.set(xscale="log", yscale="log")
    seen = [row for rows in lines.values() for row in rows]
    _ticks(axis, sorted({row["voxel_size"] for row in seen}), [factor * row[key] for row in seen])


def _numbers(axis: Any, sizes: Sequence[float], values: Sequence[float]) -> None:
    """Write the figures of our first line below its dots."""
    for size, value in zip(sizes, values, strict=True):
        axis.annotate(
            f"{value:.2g}", (size, value), (0, -16), textcoords="offset points", ha="center", color=OURS, fontsize=10
        )


def _ticks(axis: Any, sizes: Sequence[float], values: Sequence[float]) -> None:
    """Label the measured voxel sizes with plain numbers; span at least two powers of ten."""
    from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

    axis.set_xticks(sizes, [f"{size:g}" for size in sizes])
    axis.set_xlim(sizes[0] / 1.2, 1.2 * sizes[-1])
    axis.xaxis.set_minor_locator(NullLocator())
    low, high = min(values) / 2, 1.6 * max(values)
    middle = np.sqrt(low * high)
    axis.set_ylim(min(low, middle / 10), max(high, 10 * middle))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())
    axis.grid(True, color=LINE, linewidth=0.5, alpha=0.7)
    axis.set_axisbelow(True)


def _label_axes(axis: Any, title: str, unit: str) -> None:
    axis.set_title(title, loc="left", fontsize=12.5, color=INK)
    labels(axis, "size of a cell, metres", unit, 10.5)


def _plain(text: str) -> str:
    """Escape text so that matplotlib does not read it as a formula."""
    return text.replace("$", r"\$")


def tables(result: dict[str, Any]) -> list[Table]:
    """Return all tables of a result: the comparison, and the ones under `more`."""
    compared = [comparison_table(found) for found in (result, result.get("clearing", {})) if found.get("rows")]
    return compared + [MEASUREMENTS[name].table(found) for name, found in result.get("more", {}).items()]


def text(result: dict[str, Any]) -> str:
    """Return all tables as plain text."""
    return "\n\n\n".join(table.text() for table in tables(result))


def write(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write `bench.json` and `bench.md` into `folder`; atomically. Return the paths."""
    pages = [f"# stereovox benchmark\n\n{machine_line(result['machine'])}.\n"] if "machine" in result else []
    pages += [table.markdown() for table in tables(result)]
    contents = {"bench.json": json.dumps(result, indent=1), "bench.md": "\n".join(pages)}
    for name, content in contents.items():
        with replacing(folder / name) as file:
            file.write(f"{content.rstrip()}\n".encode())
    return [folder / name for name in contents]


def write_picture(result: dict[str, Any], folder: Path) -> Path:
    """Draw the comparison into `bench.png` in `folder`."""
    path = folder / "bench.png"
    with replacing(path) as file:
        file.write(speed_png(result))
    return path
