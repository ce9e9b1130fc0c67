# SPDX-License-Identifier: Apache-2.0
"""stereovox's laboratory: papers reproduced, benchmarks, missions and checks. The product does not need it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stereovox_lab.flights.campaign import explore as explore
    from stereovox_lab.flights.explore import Cruise as Cruise

_HOMES = {"explore": "campaign", "Cruise": "explore"}
__all__ = ["Cruise", "explore"]


def __getattr__(name: str) -> Any:
    """Import public names on first use, so that commands stay fast."""
    if name in _HOMES:
        return getattr(import_module(f"stereovox_lab.flights.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'stereovox_lab' has no attribute '{name}'")
