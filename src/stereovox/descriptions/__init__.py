# SPDX-License-Identifier: Apache-2.0
"""The contents of a path: a map, recording, bag, cloud, image, poses or calibration; and the commands that use it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from importlib import import_module

from stereovox.descriptions.files import Description as Description
from stereovox.errors import SourceError, shortened
from stereovox.sources.foreign_files import POINTS, is_pointer

KINDS = (
    "stereovox.descriptions.maps:describe_map",
    "stereovox.descriptions.maps:describe_floor",
    "stereovox.descriptions.recordings:describe_recording",
    "stereovox.descriptions.files:describe_cloud",
    "stereovox.descriptions.files:describe_settings",
    "stereovox.descriptions.files:describe_calibration",
    "stereovox.descriptions.files:describe_poses",
    "stereovox.descriptions.files:describe_image",
    "stereovox.descriptions.files:describe_points",
)
"""Tried in this order; each returns None for paths of another kind."""
BY_THEMSELVES, MOST_FILES = 4, 50
"""How many of the first kinds are single files; and how many files of a folder are checked."""
UNKNOWN = "is of no known kind, by name or content; what can be read: docs/recordings.md and docs/formats.md"


def describe(path: str | os.PathLike[str]) -> Description:
    """Find out what a path contains and how to use it; a recording is sampled, not read whole.

    Args:
        path: A folder or file, optionally with options behind a `?`, or a simulation (`sim:room`).

    Returns:
        Its description.

    Raises:
        StereovoxError: The path is missing, or no command can use it: one line with its apparent kind, the missing
            part, and the cure.
    """
    from stereovox.opening import file_cure, open_source

    text = os.fspath(path)
    if is_pointer(text):
        raise SourceError(f"{shortened(text)}: {POINTS}")
    found = _known(text, KINDS)
    if found is not None:
        return found
    if os.path.isfile(text):
        raise SourceError(f"{shortened(text)}: {file_cure(text) or UNKNOWN}")
    try:
        open_source(text)  # its error names the missing part
    except SourceError:
        found = _within(text)
        if found is None:
            raise
        return found
    raise AssertionError(f"{text}: a recording that is not described")


def _known(text: str, kinds: Sequence[str]) -> Description | None:
    """Describe a path if it is of one of these kinds."""
    for name in kinds:
        module, _, function = name.partition(":")
        known: Callable[[str], Description | None] = getattr(import_module(module), function)
        found = known(text)
        if found is not None:
            return found
    return None


def _within(folder: str) -> Description | None:
    """Describe the single file of a folder that commands can use by itself; raises SourceError for several."""
    if not os.path.isdir(folder) or any(entry.is_dir() for entry in os.scandir(folder)):
        return None
    files = sorted(entry.path for entry in os.scandir(folder) if entry.is_file() and not _is_image(entry.name))
    found = {file: one for file in files[:MOST_FILES] if (one := _known(file, KINDS[:BY_THEMSELVES])) is not None}
    if len(found) > 1:
        see = f"stereovox info {shlex.quote(next(iter(found)))}"
        raise SourceError(f"{shortened(folder)}: not a recording, but {len(found)} files; see each: {see}")
    return next(iter(found.values()), None)


def _is_image(name: str) -> bool:
    """Return whether a file may be the image of a floor's map, which is described by its .yaml."""
    return name.lower().endswith((".pgm", ".png", ".bmp"))
