# SPDX-License-Identifier: Apache-2.0
"""Results of benchmarks as tables, for the terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stereovox_lab.bench.machine import machine_line

LIBRARY = "stereovox"
QUIET = 0.9
"""Least share of a processor that a thread gets on a quiet machine."""


@dataclass(frozen=True)
class Table:
    """A title, a head, rows in groups, and lines below; the first `words` columns are flush left."""

    title: str
    head: tuple[str, ...]
    groups: Sequence[Sequence[tuple[str, ...]]]
    notes: Sequence[str] = ()
    words: int = 1

    def text(self) -> str:
        """Return the table as plain text."""
        lines = [self.head, *(row for group in self.groups for row in group)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        text = [self.title, "", self._aligned(self.head, widths)]
        for group in self.groups:
            text += ["", *(self._aligned(row, widths) for row in group)]
        return "\n".join([*text, *([""] if self.notes else []), *self.notes])

    def markdown(self, level: int = 2) -> str:
        """Return the table in Markdown under a heading of this level."""
        sides = [":--" if i < self.words else "--:" for i in range(len(self.head))]
        rows = [self.head, sides, *(row for group in self.groups for row in group)]
        lines = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in rows]
        return "\n".join([f"{'#' * level} {self.title}", "", *lines, "", *(f"- {note}" for note in self.notes), ""])

    def _aligned(self, row: tuple[str, ...], widths: Sequence[int]) -> str:
        cells = [
            cell.ljust(w) if i < self.words else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()


def format_table(result: dict[str, Any]) -> str:
    """Return the result of `bench` as plain text: a block of lines for each voxel size, stereovox first."""
    return comparison_table(result).text()


def comparison_table(result: dict[str, Any]) -> Table:
    """Return the result of `bench` as a table: a group for each voxel size, first the row peers are compared with."""
    compared = ("stereovox is",) if any(result["ratio"].values()) else ()
    whole = ("whole",) if any("add_ms_median" in row for row in result["rows"]) else ()
    times = ("ms/frame", "p90", "p99", *whole)
    head = ("voxel", "library", "threads", "frames", *times, *compared, "occupied", "free", "map MB")
    groups = [
        [_cells(row, i == 0, result["ratio"][size] if compared else None, bool(whole)) for i, row in enumerate(rows)]
        for size, rows in rows_by_size(result).items()
    ]
    return Table(_title(result), head, groups, _notes(result), words=2)


def is_ours(row: dict[str, Any]) -> bool:
    """Return whether a row is one of stereovox, not of a peer."""
    return "integrator" in row


def rows_by_size(result: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return all rows of a result by the voxel size as `ratio` names it: the one that peers are compared with, then
    our other ones, then peers.
    """
    ours = [row for row in result["rows"] if is_ours(row)]
    peers = [row for row in result["rows"] if not is_ours(row)]
    rows = [*ours, *result.get("variants", ()), *peers]
    sizes = dict.fromkeys(row["voxel_size"] for row in rows)
    return {str(size): [row for row in rows if row["voxel_size"] == size] for size in sizes}


def _title(result: dict[str, Any]) -> str:
    up_to = f"depth up to {result['max_range']:g} m{', free where beyond' if result.get('far_share') else ''}"
    return f"{result['source']}: {result['frames']} frames of {result['image']}, {up_to}"


def _cells(row: dict[str, Any], first: bool, ratio: dict[str, float] | None, whole: bool) -> tuple[str, ...]:
    """Return the cells of a line; `ratio` is None if there are no peers, and then has no column."""
    faster = () if ratio is None else (_faster(ratio.get(row["library"])),)
    add = (f"{row['add_ms_median']:.2f}" if "add_ms_median" in row else "",) if whole else ()
    return (
        f"{row['voxel_size']:g} m" if first else "",
        row["library"],
        str(row["threads"]),
        str(row["frames"]),
        *(f"{row[f'integrate_ms_{name}']:.2f}" for name in ("median", "p90", "p99")),
        *add,
        *faster,
        f"{row['occupied']:,}",
        f"{row['free']:,}",
        f"{row['map_bytes'] / 1e6:.1f}",
    )


def _faster(times: float | None) -> str:
    """Format a ratio in words, from our side; empty for our own rows."""
    if times is None:
        return ""
    if times < 1:
        return f"{1 / max(times, 1e-3):.1f} x slower"
    return f"{times:.0f} x faster" if times >= 10 else f"{times:.1f} x faster"


def _notes(result: dict[str, Any]) -> list[str]:
    notes = [
        "ms/frame: median time of the call that takes a frame in; making depth images or points is not part of it.",
        "Cells as each library defines them: stereovox by its own thresholds, others parted at 0.5.",
    ]
    prepared = [row["depth_ms_median"] for row in result["rows"] if "depth_ms_median" in row]
    if prepared:
        notes.append(f"stereovox makes its depth image in {_span(prepared)} ms more, which peers have done for them;")
        notes.append("whole: the median of its whole call, Mapper.add.")
    if result.get("far_share"):
        share, reach = result["far_share"], result["max_range"]
        notes.append(f"{share:.1%} of the pixels are beyond {reach:g} m and clear space up to there, for all.")
    notes += [f"{name} cannot clear along such pixels and is left out." for name in result.get("not_clearing", ())]
    if result["frames_refused"]:
        notes.append(f"{result['frames_refused']} frames were refused, first: {result['first_refusal']}")
    for row in result["rows"]:
        if row["frames"] < result["frames"]:
            done = f"{row['frames']} of {result['frames']} frames"
            which = f"{row['library']} at {row['voxel_size']:g} m"
            notes.append(f"{which} stopped at its time limit after {done}: do not compare its cells and MB.")
    notes += _busy([*result["rows"], *result.get("variants", ())])
    notes += [f"without {line}" for line in result.get("not_installed", ())]
    if "machine" in result:
        notes.append(f"On {machine_line(result['machine'])}.")
    return notes


def _busy(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a note if other programs slowed the benchmark down."""
    alone = [row for row in rows if row["threads"] == 1 and "cpu_share" in row]
    short = [row for row in alone if row["cpu_share"] < QUIET]
    if not short:
        return []
    worst = min(short, key=lambda row: row["cpu_share"])
    which = f"{worst['library']} at {worst['voxel_size']:g} m got {worst['cpu_share']:.0%} of a processor"
    rows_of = f"{len(short)} of {len(alone)} rows of one thread"
    return [f"Other programs were in the way of {rows_of}; the worst: {which}. Measure again."]


def _span(values: Sequence[float]) -> str:
    low, high = f"{min(values):.2f}", f"{max(values):.2f}"
    return low if low == high else f"{low} to {high}"
