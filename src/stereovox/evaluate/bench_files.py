# SPDX-License-Identifier: Apache-2.0
"""A benchmark's results as files: `bench.json`, `bench.md`; and as text. Written anew whenever something is done."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stereovox.evaluate.bench_machine import machine_line
from stereovox.evaluate.bench_more import MEASUREMENTS
from stereovox.evaluate.bench_table import Table, comparison_table
from stereovox.files import replacing


def tables(result: dict[str, Any]) -> list[Table]:
    """Return the tables of all that is in a result: the comparison, and what stands under `more`."""
    compared = [comparison_table(result)] if result.get("rows") else []
    return compared + [MEASUREMENTS[name].table(found) for name, found in result.get("more", {}).items()]


def text(result: dict[str, Any]) -> str:
    """Return all tables as plain text."""
    return "\n\n\n".join(table.text() for table in tables(result))


def write(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write `bench.json` and `bench.md` into `folder`; older ones stay whole until then. Return the paths."""
    pages = [f"# stereovox benchmark\n\n{machine_line(result['machine'])}.\n"] if "machine" in result else []
    pages += [table.markdown() for table in tables(result)]
    contents = {"bench.json": json.dumps(result, indent=1), "bench.md": "\n".join(pages)}
    for name, content in contents.items():
        with replacing(folder / name) as file:
            file.write(f"{content.rstrip()}\n".encode())
    return [folder / name for name in contents]


def write_picture(result: dict[str, Any], folder: Path) -> Path:
    """Draw the comparison into `bench.png` in `folder`."""
    from stereovox.view.speed import speed_png

    path = folder / "bench.png"
    with replacing(path) as file:
        file.write(speed_png(result))
    return path
