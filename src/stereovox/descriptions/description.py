# SPDX-License-Identifier: Apache-2.0
"""The description of a path, and the words, names and command lines in it."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereovox.files.safe_io import FLOOR_READABLE


@dataclass(frozen=True)
class Description:
    """The description of a path.

    Attributes:
        kind: `map`, `floor map`, `recording`, `bag`, `robot`, `cloud`, `settings`, `calibration`, `poses`, `depth
            image` or `picture`.
        lines: Text lines for people.
        facts: The same as numbers and strings, as `stereovox info --json` prints them.
        commands: Command lines that use it, the most likely first.
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


def many(number: int, thing: str) -> str:
    """Format a number of things: `1 pose`, `4,541 poses`."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def thousands(number: Any) -> str:
    """Format an integer with commas: 1,234,567."""
    return f"{number:,}"


def metres(numbers: Any) -> str:
    """Format lengths along axes: `1.9 x 0.6 x 1.0 m`, or `3 x 98 x 6 mm` if all are short."""
    if max(numbers) < 0.1:
        return " x ".join(f"{1000 * number:.0f}" for number in numbers) + " mm"
    return " x ".join(f"{number:.1f}" if number < 10 else f"{number:.0f}" for number in numbers) + " m"


def map_name(source: str, ending: str = ".svox") -> str:
    """Return the default name of a recording's map: `kitchen.svox`, and `room.svox` for `sim:room`."""
    place = source if os.path.exists(source) else source.partition("?")[0]
    kind, colon, rest = place.partition(":")
    if colon and not os.path.exists(place):
        return f"{rest or kind}{ending}"
    name = os.path.basename(os.path.realpath(place))  # tolerates loops of links
    packed = name.lower().endswith((".bz2", ".gz"))
    return f"{Path(Path(name).stem if packed else name).stem or 'map'}{ending}"


def picture_name(path: str) -> str:
    """Return the default name of a map's picture; the image of a floor's map may have the shorter name."""
    place = Path(os.path.realpath(path))
    return f"{place.stem}{'-picture' if place.suffix.lower() in FLOOR_READABLE else ''}.png"
