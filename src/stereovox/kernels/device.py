# SPDX-License-Identifier: Apache-2.0
"""Where a map is made: on the processor, or on a graphics card if there is one that can be used."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from stereovox.config import Config
from stereovox.errors import ConfigError


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


def check_device() -> None:
    """Raise ConfigError if no graphics card can be used; for what is made without a mapper."""
    reason = _no_card()
    if reason is not None:
        raise ConfigError(f'device "cuda": {reason}')


def check_on_processor(config: Config) -> None:
    """Raise ConfigError if the settings are those of a graphics card, on which there are no maps of floors."""
    if config.device != "cpu":
        raise ConfigError(f'device "{config.device}": maps of floors are made on the processor only; leave it out')


def _no_card() -> str | None:
    """Return why no graphics card can be used; None if one can."""
    try:
        from stereovox.kernels._gpu import unusable
    except ImportError as error:
        return f"numba-cuda cannot be loaded ({error})"
    return unusable()
