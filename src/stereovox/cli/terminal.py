# SPDX-License-Identifier: Apache-2.0
"""Words and progress for the person at the terminal, all on stderr."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from stereovox.errors import one_line

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from stereovox.frame import UpdateReport

T = TypeVar("T")


def say(text: str = "") -> None:
    """Print a line on stderr, or several; names out of a recording cannot colour or move anything there."""
    print("\n".join(map(one_line, text.split("\n"))), file=sys.stderr, flush=True)


def say_about_compiling() -> None:
    """Tell the user why the first run on a machine takes its time."""
    from stereovox._jit import cache_folder

    folder = cache_folder()
    if folder is None:
        say("no folder for compiled kernels can be written: they are compiled in every run (set STEREOVOX_CACHE)")
    elif not any(folder.rglob("*.nbi")):
        say("compiling the kernels, once on this machine: about half a minute")


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Give a progress bar with rate and time left on stderr, if that is a terminal; it goes away at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
    )
    hidden = not console.is_terminal  # a log has no use for it
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True, disable=hidden) as bar:
        yield bar


def tracked(items: Iterable[T], total: int | None, text: str) -> Iterator[T]:
    """Yield `items` with a progress bar; `total` is None where nobody knows how many there are."""
    with progress_of(total, text) as bar:
        for item in items:
            yield item
            bar.advance()


@contextmanager
def progress_of_steps(text: str) -> Iterator[Callable[[int, int, str], None]]:
    """Give what draws a progress bar when it is called with steps done, steps in all, and what is being done."""
    with progress_bar() as bar:
        task = bar.add_task(text, note="")
        yield lambda done, total, doing: bar.update(task, completed=done, total=total, description=doing)


@contextmanager
def progress_of(total: int | None, text: str) -> Iterator[ProgressOfFrames]:
    """Give an observer that draws a progress bar; `total` is None where nobody knows how many frames there are."""
    with progress_bar() as bar:
        yield ProgressOfFrames(bar, bar.add_task(text, total=total, note=""))


class ProgressOfFrames:
    """Moves a progress bar on by each frame."""

    def __init__(self, bar: Progress, task: TaskID):
        self._bar, self._task = bar, task

    def after(self, frame: object, report: object) -> None:
        """Note a frame that was offered to the map."""
        self.advance()

    def advance(self) -> None:
        """Move on by one step."""
        speed = self._bar.tasks[0].finished_speed or self._bar.tasks[0].speed
        self._bar.update(self._task, advance=1, note=f"{speed:.0f} a second" if speed else "")


def command_line(*words: object) -> str:
    """Return a stereovox command that can be copied to a shell, whatever the file names hold."""
    return shlex.join(["stereovox", *map(str, words)])


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
    """Return a whole number with commas: 1,234,567."""
    return f"{number:,}"


def say_refusals(result: dict[str, Any], reports: Sequence[UpdateReport], what: str) -> None:
    """Say how many `what` (frames) were mapped, which were refused and why, and when they were believed again."""
    say(f"{result['frames']} {what} mapped, {result['frames_refused']} refused")
    for reason, number in result["refused"].items():
        example = next(report.detail for report in reports if report.refused == reason)
        say(f"  {number} x {reason}, first: {example}")
    for told, number in result["settled"].items():
        say(f"  {number} x {told}")


def cells_line(result: dict[str, Any]) -> str:
    """Return one line about the cells of a map and the memory they need."""
    occupied, free = thousands(result["occupied"]), thousands(result["free"])
    reserved = ", reserved for the window" if result.get("memory_reserved") else ""
    return f"{occupied} occupied and {free} free cells in {size(result['memory_bytes'])}{reserved}"
