# SPDX-License-Identifier: Apache-2.0
"""Plug-in registry: look up a class in a `name -> "module:Class"` dict, and import it only when it is used."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib import import_module, metadata
from typing import Any

from stereovox.errors import ConfigError, did_you_mean


def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group; all packages are read once, and again when one is installed."""
    return _entry_points(tuple((folder, _changed_ns(folder)) for folder in sys.path)).select(group=group)


@lru_cache(maxsize=1)
def _entry_points(folders: tuple[tuple[str, int], ...]) -> Any:
    return metadata.entry_points()  # of another type in Python 3.11


def _changed_ns(folder: str) -> int:
    try:
        return os.stat(folder or ".").st_mtime_ns
    except (OSError, ValueError):
        return 0


def find(room: str, builtin: Mapping[str, str], name: str) -> Any:
    """Return the object registered as `name` in `room` (`sensors`, `integrators`, ...).

    Other packages register theirs as entry points in the group `stereovox.<room>`.
    Raises ConfigError that suggests or lists the known names.
    """
    if name in builtin:
        return _load(builtin[name])
    others = {entry.name: entry for entry in entry_points(group=f"stereovox.{room}")}
    if name in others:
        return others[name].load()
    raise ConfigError(f"unknown {room.removesuffix('s')} '{name}'{did_you_mean(name, [*builtin, *others])}")


def names(room: str, builtin: Mapping[str, str]) -> list[str]:
    """Return all names registered in `room`, other packages' first."""
    return list(dict.fromkeys([*sorted(entry.name for entry in entry_points(group=f"stereovox.{room}")), *builtin]))


def every(room: str, builtin: Mapping[str, str]) -> Iterator[Any]:
    """Yield all objects registered in `room`, other packages' first, whatever their names; each is imported then."""
    for entry in sorted(entry_points(group=f"stereovox.{room}"), key=lambda entry: entry.name):
        yield entry.load()
    yield from map(_load, builtin.values())


def _load(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return getattr(import_module(module), attribute)
