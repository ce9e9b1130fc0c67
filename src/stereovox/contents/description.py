# SPDX-License-Identifier: Apache-2.0
"""The result of `describe`, and how its figures are written."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Description:
    """What a path holds.

    Attributes:
        kind: `map`, `floor map`, `recording`, `bag`, `robot`, `cloud`, `settings`, `calibration`, `poses`, `depth
            image` or `picture`.
        lines: Lines for people.
        facts: The same as numbers and texts, as `stereovox info --json` prints them.
        commands: Command lines that use it, the likely one first.
    """

    kind: str
    lines: list[str]
    facts: dict[str, Any]
    commands: list[str] = field(default_factory=list)


def command_line(*words: object) -> str:
    """Return a stereovox command quoted for a shell."""
    return shlex.join(["stereovox", *map(str, words)])


def size(number_of_bytes: float) -> str:
    """Format a number of bytes: `12.3 MB`."""
    for unit in ("bytes", "kB", "MB"):
        if number_of_bytes < 1000:
            return f"{number_of_bytes:.3g} {unit}"
        number_of_bytes /= 1000
    return f"{number_of_bytes:.3g} GB"


def thousands(number: Any) -> str:
    """Format a whole number with commas: 1,234,567."""
    return f"{number:,}"


def metres(numbers: Any) -> str:
    """Format lengths along axes: `1.9 x 0.6 x 1 m`."""
    return " x ".join(f"{number:.2g}" if number < 10 else f"{number:.0f}" for number in numbers) + " m"
