# SPDX-License-Identifier: Apache-2.0
"""Messages and progress bars for the terminal, all on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from stereovox.descriptions.files import command_line as command_line
from stereovox.descriptions.files import size as size
from stereovox.descriptions.files import thousands as thousands
from stereovox.errors import one_line

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from stereovox.frame import UpdateReport
    from stereovox.track.stream import TrackingGap

MAX_SPANS = 10
"""Most spans of lost frames that are printed."""
T = TypeVar("T")


def say(text: str = "") -> None:
    """Print one or more lines on stderr; control characters, from names in recordings, are escaped."""
    print("\n".join(map(one_line, text.split("\n"))), file=sys.stderr, flush=True)


def say_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table and a blank line: columns of numbers right-aligned, others left-aligned."""
    columns = []
    for head, *texts in zip(heads, *rows, strict=True):
        width = max(map(len, (head, *texts)))
        numbers = all(text[:1].isdigit() for text in texts if text.strip("-"))
        columns.append([text.rjust(width) if numbers else text.ljust(width) for text in (head, *texts)])
    for line in zip(*columns, strict=True):
        say("  ".join(line).rstrip())
    say()


def say_about_compiling() -> bool:
    """Explain why the first run on a machine takes longer; return whether this is one."""
    from stereovox.kernels._jit import cache_folder

    folder = cache_folder()
    if folder is None:
        say("no folder for compiled kernels is writable, so every run compiles them (set STEREOVOX_CACHE)")
    elif not any(folder.rglob("*.nbi")):
        say("compiling the kernels, once on this machine: 20 to 40 seconds")
    else:
        return False
    return True


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a progress bar with rate and remaining time, shown only on a terminal; it disappears at the end."""
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
    """Yield `items` with a progress bar; `total` is None if their number is unknown."""
    with progress_of(total, text) as bar:
        for item in items:
            yield item
            bar.advance()


@contextmanager
def progress_of_steps(text: str) -> Iterator[Callable[[int, int, str], None]]:
    """Yield a function that updates a progress bar, called with steps done, their total, and the current step."""
    with progress_bar() as bar:
        task = bar.add_task(text, note="")
        yield lambda done, total, doing: bar.update(task, completed=done, total=total, description=doing)


@contextmanager
def progress_of(total: int | None, text: str) -> Iterator[FrameProgress]:
    """Yield an observer that draws a progress bar; `total` is None if the number of frames is unknown."""
    with progress_bar() as bar:
        yield FrameProgress(bar, bar.add_task(text, total=total, note=""))


class FrameProgress:
    """Observer that advances a progress bar by each frame."""

    def __init__(self, bar: Progress, task: TaskID):
        self._bar, self._task = bar, task

    def after(self, frame: object, report: object) -> None:
        """Advance by the frame that was offered to the map."""
        self.advance()

    def step(self, done: int, total: int, doing: str) -> None:
        """Show a step of the work that is not a frame."""
        self._bar.update(self._task, completed=done, total=total, description=doing, note="")

    def advance(self) -> None:
        """Advance by one step."""
        speed = self._bar.tasks[0].finished_speed or self._bar.tasks[0].speed
        self._bar.update(self._task, advance=1, note=f"{speed:.0f} per second" if speed else "")


def first_included(result: dict[str, Any]) -> str:
    """Return a remark on times in a summary if they are from a single frame, the first; else nothing."""
    return " (a single frame, including loading or compiling the kernels)" if result["frames"] == 1 else ""


def milliseconds(figures: dict[str, float]) -> str:
    """Format figures: `median 1.2, 90 % 1.5, 99 % 1.9, longest 2.3 ms`."""
    return "median {median:.2f}, 90 % {p90:.2f}, 99 % {p99:.2f}, longest {max:.2f} ms".format(**figures)


def but_few(result: dict[str, Any]) -> str:
    """Return `, but only ...` for the last line of a command that lost most of its input; else nothing."""
    lost = [doubt for doubt in result.get("doubts", ()) if isinstance(doubt, dict) and doubt["kind"] == "mostly_lost"]
    return "".join(f", but {doubt['text']}" for doubt in lost)


def say_refusals(result: dict[str, Any], reports: Sequence[UpdateReport], what: str) -> None:
    """Print how many `what` (frames) were mapped, which were refused and why, and how often accepted again."""
    say(f"{result['frames']} {what} mapped, {result['frames_refused']} refused")
    for doubt in result.get("doubts", ()):
        if doubt.get("kind") == "mostly_lost":
            say(f"warning: {doubt['text']}; the reasons:")
    for reason, number in result["refused"].items():
        example = next((f", first: {report.detail}" for report in reports if report.refused == reason), "")
        say(f"  {number} x {reason}{example}")
    for reason, number in result["settled"].items():
        say(f"  {number} x {reason}")


def say_lost(spans: Sequence[TrackingGap]) -> None:
    """Print the gaps in tracking: the longest ones, in order."""
    shown = sorted(sorted(spans, key=len)[-MAX_SPANS:], key=lambda span: span.first)
    for span in shown:
        say(f"  {span.line()}")
    if len(spans) > len(shown):
        say(f"  and {len(spans) - len(shown)} shorter ones (all with --json)")


def cells_line(result: dict[str, Any], voxel_size: float | None = None) -> str:
    """Format one line about the cells of a map, with their side in metres if given, and their memory."""
    occupied, free = thousands(result["occupied"]), thousands(result["free"])
    reserved = ", reserved for the window" if result.get("memory_reserved") else ""
    side = "" if voxel_size is None else f" of {voxel_size:g} m"
    return f"{occupied} occupied and {free} free cells{side} in {size(result['memory_bytes'])}{reserved}"
