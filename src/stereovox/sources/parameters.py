# SPDX-License-Identifier: Apache-2.0
"""Names with parameters in the style of a URL: `sim:box?size=small&distance=2`."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import SourceError, did_you_mean
from stereovox.geometry.se3 import Transform, rotation_matrix

SWITCHES = {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}
LARGEST = 2**63
"""Largest integer: larger ones are useless, and may not fit into a float for an error message."""


def split(location: str) -> tuple[str, dict[str, str]]:
    """Return the name before `?` and the parameters `key=value` behind it, separated by `&`.

    Raises SourceError for a parameter without a value and for a repeated one.
    """
    name, _, query = location.partition("?")
    texts: dict[str, str] = {}
    for text in filter(None, query.split("&")):
        key, equals, value = text.partition("=")
        if not (key and equals and value):
            raise SourceError(f"'{text}' is not a parameter; write key=value")
        if key in texts:
            raise SourceError(f"'{key}' is given twice; give it once")
        texts[key] = value
    return name, texts


def file_of(text: str, folder: Path) -> Path:
    """Return the file or folder that a parameter names: as given, else inside `folder`; raises SourceError."""
    found = next((path for path in (Path(text), folder / text) if os.path.exists(path)), None)
    if found is None:
        raise SourceError(f"{text}: no such file, nor in {folder}; check the name")
    return found


def defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the parameters of `function` with their default values."""
    return {name: parameter.default for name, parameter in inspect.signature(function).parameters.items()}


def typed(texts: Mapping[str, str], known: Mapping[str, Any]) -> dict[str, Any]:
    """Convert parameters to the types of the defaults in `known`: bool, int, float or str.

    Raises SourceError for an unknown parameter, with a suggestion, and for unreadable values.
    """
    return {key: _value(key, text, known) for key, text in texts.items()}


def _value(key: str, text: str, known: Mapping[str, Any]) -> Any:
    if key not in known:
        raise SourceError(f"unknown parameter '{key}'{did_you_mean(key, known)}")
    kind = type(known[key])
    if kind is bool and text.lower() not in SWITCHES:
        raise SourceError(f"{key}={text} must be 1 or 0")
    try:
        value = SWITCHES[text.lower()] if kind is bool else kind(text)
    except ValueError:
        raise SourceError(f"{key}={text} must be a {'whole ' if kind is int else ''}number") from None
    if kind is float and not math.isfinite(value):
        raise SourceError(f"{key}={text} must be a finite number")
    if kind is int and abs(value) > LARGEST:
        raise SourceError(f"{key}={text} is too large")
    return value


def mounted(key: str, text: str) -> Transform | None:
    """Parse `x,y,z,yaw,pitch,roll` as T_body_sensor (4, 4), None for ""; raises SourceError for anything else."""
    if not text:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not (3 <= len(numbers) <= 6 and np.isfinite(numbers).all()):
        raise SourceError(f"{key}={text} must be x,y,z,yaw in metres and radians; pitch and roll may follow")
    yaw, pitch, roll = (*numbers[3:], 0.0, 0.0, 0.0)[:3]
    T = np.eye(4)
    T[:3, :3] = rotation_matrix([0, 0, yaw]) @ rotation_matrix([0, pitch, 0]) @ rotation_matrix([roll, 0, 0])
    T[:3, 3] = numbers[:3]
    return T
