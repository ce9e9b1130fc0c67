# SPDX-License-Identifier: Apache-2.0
"""What a path holds: a map, recording, bag, cloud, image, poses or calibration; and the commands that use it."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module

from stereovox.contents.description import Description as Description
from stereovox.errors import SourceError, shortened

KINDS = (
    "stereovox.contents.maps:describe_map",
    "stereovox.contents.maps:describe_floor",
    "stereovox.contents.recordings:describe_recording",
    "stereovox.contents.files:describe_cloud",
    "stereovox.contents.files:describe_settings",
    "stereovox.contents.files:describe_calibration",
    "stereovox.contents.files:describe_poses",
    "stereovox.contents.files:describe_image",
    "stereovox.contents.files:describe_points",
)
"""Asked in this order; each returns None for what is not of its kind."""
UNKNOWN = "is of no known kind, by name or content; what can be read: docs/recordings.md and docs/formats.md"


def describe(path: str | os.PathLike[str]) -> Description:
    """Find out what a path holds and what to do with it; a recording is looked at, not read whole.

    Args:
        path: A folder or file, also with options behind a `?`, or a simulation (`sim:room`).

    Returns:
        What it holds.

    Raises:
        StereovoxError: There is nothing, or nothing that any command uses: one line that says what it seems to be, what
            is missing, and the cure.
    """
    from stereovox.opening import file_cure, open_source

    text = os.fspath(path)
    for name in KINDS:
        module, _, function = name.partition(":")
        known: Callable[[str], Description | None] = getattr(import_module(module), function)
        found = known(text)
        if found is not None:
            return found
    if os.path.isfile(text):
        raise SourceError(f"{shortened(text)}: {file_cure(text) or UNKNOWN}")
    open_source(text)  # which says what is missing
    raise AssertionError(f"{text}: a recording that is not described")
