# SPDX-License-Identifier: Apache-2.0
"""What an integrator makes once for each camera: tables, and memory that stays from frame to frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

Camera = TypeVar("Camera")
Tools = TypeVar("Tools")

MOST = 16
"""Cameras whose tools are kept; where more come, as from a lens that zooms, all are forgotten."""


class PerCamera(Generic[Camera, Tools]):
    """Makes the tools for a camera when it is first seen, and keeps them."""

    def __init__(self, make: Callable[[Camera], Tools]):
        self._make = make
        self._kept: dict[Camera, Tools] = {}

    def __getitem__(self, camera: Camera) -> Tools:
        tools = self._kept.get(camera)
        if tools is None:
            if len(self._kept) >= MOST:
                self._kept.clear()
            tools = self._kept[camera] = self._make(camera)
        return tools
