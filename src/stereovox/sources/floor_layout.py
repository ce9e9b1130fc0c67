# SPDX-License-Identifier: Apache-2.0
"""What a simulated floor consists of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereovox.sources.floor_drive import Stop
from stereovox.sources.floor_plan import FloorPlan, Rectangle, Thing

SHIFT = (0.0137, 0.0219)
"""Metres by which all of a floor is moved, so that no wall lies exactly on a cell's face for any round cell size."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A floor, the way of a robot through it, and the rectangle that a shut door closes off (None: no such door)."""

    plan: FloorPlan
    stops: Sequence[Stop]
    behind_door: Rectangle | None = None

    def moved(self, x: float, y: float) -> Layout:
        """Return the same floor somewhere else."""

        def rectangle(one: Rectangle) -> Rectangle:
            return one[0] + x, one[1] + y, one[2] + x, one[3] + y

        def thing(one: Thing) -> Thing:
            return replace(one, corners=one.corners + np.array([x, y]))

        plan = FloorPlan([rectangle(one) for one in self.plan.free], [thing(one) for one in self.plan.things])
        stops = [Stop(stop.x + x, stop.y + y, stop.spin_deg) for stop in self.stops]
        return Layout(plan, stops, None if self.behind_door is None else rectangle(self.behind_door))
