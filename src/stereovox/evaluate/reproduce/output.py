# SPDX-License-Identifier: Apache-2.0
"""What all reproductions end in: two files, and a progress bar on the way there."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.evaluate.out_folder import out_folder
from stereovox.evaluate.reproduce.chapter import Chapter, Progress
from stereovox.evaluate.reproduce.page import HEADS, report
from stereovox.files import replacing


class Steps:
    """Counts what is done over all experiments."""

    def __init__(self, progress: Progress, total: int):
        self._progress, self._total, self._done = progress, total, 0

    def of(self, text: str) -> Callable[[], None]:
        """Return a function to call after each step of one experiment."""

        def step() -> None:
            self._done += 1
            self._progress(min(self._done, self._total), self._total, text)

        self._progress(self._done, self._total, text)
        return step


def output_files(out: Path) -> dict[str, Path]:
    """Return the files to be written; raises StereovoxError now, not after minutes, where they cannot be."""
    out_folder(out)
    files = {"report": out / "report.html", "numbers": out / "numbers.json"}
    for path in files.values():
        if path.is_dir() or not os.access(path if path.exists() else out, os.W_OK):
            raise StereovoxError(f"{path}: cannot be written; choose another --out")
    return files


def write_result(
    files: dict[str, Path],
    found: Sequence[Chapter],
    seconds: float,
    *,
    paper: str,
    title: str,
    lead: str,
    quick: bool,
    heads: Sequence[str] = HEADS,
) -> dict[str, Any]:
    """Write the page and the numbers of all chapters; return the result of the command.

    lead: what the page begins with; heads: of the four columns of claims.
    Raises StereovoxError where a file cannot be written.
    """
    claims = [claim for chapter in found for claim in chapter.claims]
    result = {
        "paper": paper,
        "quick": quick,
        "holds": sum(claim.holds is True for claim in claims),
        "does_not_hold": [claim.text for claim in claims if claim.holds is False],
        "seconds": round(seconds, 1),
        "files": {name: str(path) for name, path in files.items()},
    }
    numbers = {chapter.name: chapter.summary() for chapter in found}
    _write(files["numbers"], json.dumps({**result, "experiments": numbers}, indent=1, allow_nan=False) + "\n")
    lead += " A quick run with few frames: do not quote it." if quick else ""
    _write(files["report"], report(title, lead, _facts(found, seconds), found, heads))
    return result


def _facts(found: Sequence[Chapter], seconds: float) -> list[tuple[str, str]]:
    verdicts = [claim.holds for chapter in found for claim in chapter.claims]
    return [
        (f"{verdicts.count(True)}", "claims hold"),
        (f"{verdicts.count(False)}", "claims do not"),
        (f"{verdicts.count(None)}", "figures without a claim"),
        (f"{seconds / 60:.1f} min", "for everything"),
    ]


def _write(path: Path, text: str) -> None:
    with replacing(path, StereovoxError) as file:
        file.write(text.encode())
