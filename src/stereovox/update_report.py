# SPDX-License-Identifier: Apache-2.0
"""What one frame did."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class UpdateReport:
    """What one frame did: milliseconds spent, cells whose value changed, and why it was refused, if it was.

    detail: why in a line, or that frames of its sensor are believed again.
    match_ms: rectify and match a stereo pair; depth_ms: prepare the depth image; integrate_ms: put it into the map.
    way: how thoroughly the frame was looked at: `full`, or what `pace` left of it.
    """

    depth_ms: float = 0.0
    integrate_ms: float = 0.0
    cells: int = 0
    refused: str | None = None
    detail: str = ""
    match_ms: float = 0.0
    way: str = "full"
