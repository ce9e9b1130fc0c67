# SPDX-License-Identifier: Apache-2.0
"""What an integrator makes once for each camera: tables, and memory that stays from frame to frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from stereovox.rigs import VirtualCamera

MAX_CAMERAS, MAX_PIXELS = 16, 1 << 26
"""Cameras whose tools are kept, and pixels of all of them; where more come, as from a lens that zooms, all go."""

Camera = TypeVar("Camera", bound=VirtualCamera)
Tools = TypeVar("Tools")


class PerCamera(Generic[Camera, Tools]):
    """Makes the tools for a camera when it is first seen, and keeps them."""

    def __init__(self, make: Callable[[Camera], Tools]):
        self._make = make
        self._kept: dict[Camera, Tools] = {}

    def __getitem__(self, camera: Camera) -> Tools:
        tools = self._kept.get(camera)
        if tools is None:
            tools = self._make(camera)
            pixels = sum(kept.width * kept.height for kept in (*self._kept, camera))
            if len(self._kept) >= MAX_CAMERAS or pixels > MAX_PIXELS:
                self._kept.clear()
            self._kept[camera] = tools
        return tools
