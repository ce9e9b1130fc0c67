# SPDX-License-Identifier: Apache-2.0
"""Words and progress for the person at the terminal, all on stderr."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress

T = TypeVar("T")


def say(text: str = "") -> None:
    """Print a line on stderr."""
    print(text, file=sys.stderr, flush=True)


def say_about_compiling() -> None:
    """Tell the user why the first run on a machine takes its time."""
    from stereovox._jit import cache_folder

    folder = cache_folder()
    if folder is None:
        say("no folder for compiled kernels can be written: they are compiled in every run (set STEREOVOX_CACHE)")
    elif not any(folder.rglob("*.nbi")):
        say("compiling the kernels, once on this machine: about 20 seconds")


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a progress bar with rate and time left that lives on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        yield bar


def tracked(items: Iterable[T], total: int, text: str) -> Iterator[T]:
    """Yield `items` with a progress bar."""
    with progress_bar() as bar:
        task = bar.add_task(text, total=total, note="")
        for item in items:
            yield item
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
            bar.update(task, advance=1, note=f"{speed:.0f} a second" if speed else "")


def milliseconds(figures: dict[str, float]) -> str:
    """Return `median 1.2, 90 % 1.5, 99 % 1.9, longest 2.3 ms`."""
    return "median {median:.2f}, 90 % {p90:.2f}, 99 % {p99:.2f}, longest {max:.2f} ms".format(**figures)


def size(number_of_bytes: float) -> str:
    """Return a number of bytes as a person reads it."""
    for unit in ("bytes", "kB", "MB"):
        if number_of_bytes < 1000:
            return f"{number_of_bytes:.3g} {unit}"
        number_of_bytes /= 1000
    return f"{number_of_bytes:.3g} GB"


def thousands(number: Any) -> str:
    """Return a whole number with thin marks: 1,234,567."""
    return f"{number:,}"


def cells_line(result: dict[str, Any]) -> str:
    """Return one line about the cells of a map and the memory they need."""
    occupied, free = thousands(result["occupied"]), thousands(result["free"])
    return f"{occupied} occupied and {free} free cells in {size(result['memory_bytes'])}"
