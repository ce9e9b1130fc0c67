# SPDX-License-Identifier: Apache-2.0
"""Where a map is made: on the processor, or on a graphics card if there is one that can be used."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from stereovox.config import Config


def warn(line: str) -> None:
    """Issue a line as a warning to whoever made the mapper."""
    warnings.warn(line, RuntimeWarning, stacklevel=4)


def on_usable_device(config: Config, notify: Callable[[str], None] = warn) -> Config:
    """Return the settings with a device that can be used here; `notify` is told why that is another one."""
    reason = None if config.device == "cpu" else _no_card()
    if reason is None:
        return config
    notify(f'device "cuda": {reason}; this map is made on the processor (device "cpu")')
    return config.model_copy(update={"device": "cpu"})


def _no_card() -> str | None:
    """Return why no graphics card can be used; None where one can."""
    try:
        from stereovox._gpu import unusable
    except ImportError as error:
        return f"numba-cuda cannot be loaded ({error})"
    return unusable()
