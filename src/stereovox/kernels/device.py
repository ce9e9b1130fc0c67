# SPDX-License-Identifier: Apache-2.0
"""The device that makes a map: the processor, or a graphics card if a usable one exists."""

from __future__ import annotations

import warnings
from collections.abc import Callable

from stereovox.config import Config
from stereovox.errors import ConfigError


def warn(line: str) -> None:
    """Issue a line as a warning at the caller that made the mapper."""
    warnings.warn(line, RuntimeWarning, stacklevel=4)


def on_usable_device(config: Config, notify: Callable[[str], None] = warn) -> Config:
    """Return the settings with a usable device; `notify` gets the reason if it is another one."""
    reason = None if config.device == "cpu" else _no_card()
    if reason is None:
        return config
    notify(f'device "cuda": {reason}; this map is made on the processor (device "cpu")')
    return config.model_copy(update={"device": "cpu"})


def check_device() -> None:
    """Raise ConfigError if no graphics card can be used; for work without a mapper."""
    reason = _no_card()
    if reason is not None:
        raise ConfigError(f'device "cuda": {reason}')


def check_on_processor(config: Config) -> None:
    """Raise ConfigError if the settings request a graphics card, which does not support maps of floors."""
    if config.device != "cpu":
        raise ConfigError(f'device "{config.device}": maps of floors are made on the processor only; leave it out')


def _no_card() -> str | None:
    """Return why no graphics card can be used; None if one can."""
    try:
        from stereovox.kernels._gpu import unusable
    except ImportError as error:
        return f"numba-cuda cannot be loaded ({error})"
    return unusable()
