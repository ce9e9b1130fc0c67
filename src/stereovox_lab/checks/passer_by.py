# SPDX-License-Identifier: Apache-2.0
"""A person crosses the view of a camera at rest and leaves; a thin pole stands next to the path."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Frame, Reason
from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.stage import one_of
from stereovox.sources.base import DepthSource

HZ = 30
BACKGROUNDS = ("near", "far", "silent")
MISSES = ("background", "unmatched")
HEIGHT = 1.2
"""Height of the camera above the floor."""
WALK_X, WALK_FROM, SPEED_MPS = 2.5, 3.2, 1.5
"""The person's path: distance from the camera, and extent to the left and right."""
WIDE, TALL = 0.45, 1.75
"""Width and height of the person."""
WALL = 4.0
POLE = (1.5, -0.47)
BEFORE, AFTER = 30, 45
"""Frames without the person, at the beginning and at the end."""


class PasserBy(DepthSource):
    """Frames of a simulated D435, 30 a second: empty, a person walking from left to right, empty. World: z up, metres.

    background: `near`, a wall within range; `far`: nothing behind the person but the floor, and the camera reports it
    as too far away; `silent`: the same, but without a reason for the missing value. pole_m: thickness of the pole.
    pole_every: it is measured in one frame of this many; `missed`: how the others miss it: its pixels show the
    background (`background`) or have no value (`unmatched`). Raises SourceError for unknown words.
    """

    layout = "a person who crosses the view (for `stereovox_lab.checks.ghosts`)"

    def __init__(
        self,
        background: str = "near",
        *,
        pole_m: float = 0.03,
        pole_every: int = 3,
        missed: str = "background",
        seed: int = 0,
        image_width: int = 424,
    ):
        one_of("background", background, BACKGROUNDS)
        one_of("missed", missed, MISSES)
        self.name = f"passing, background {background}"
        self.background, self.pole_m, self.pole_every, self.missed, self.seed = (
            background, pole_m, pole_every, missed, seed,
        )  # fmt: skip
        self.camera = depth_camera(image_width)
        self.T_world_camera: Transform = look_at((0, 0, HEIGHT), (1, 0, HEIGHT))
        self._device = replace(D435(), camera=self.camera)
        self._walk = round(2 * WALK_FROM / SPEED_MPS * HZ)

    def __len__(self) -> int:
        return BEFORE + self._walk + AFTER

    @cached_property
    def static(self) -> Scene:
        """The static parts: floor, pole, and the wall if there is one."""
        return Scene([*self._surroundings, self.pole])

    @cached_property
    def pole(self) -> Solid:
        """The thin pole that is often missed."""
        return cylinder("pole", "pole", (*POLE, 0.0), (*POLE, 3.0), self.pole_m, sections=12)

    def person(self, i: int) -> Solid | None:
        """Return the person in frame `i`, None if absent."""
        step = i - BEFORE
        if not 0 <= step < self._walk:
            return None
        y = WALK_FROM - SPEED_MPS * step / HZ
        return cylinder("person", "person", (WALK_X, y, 0.0), (WALK_X, y, TALL), WIDE, sections=16)

    @lru_cache(maxsize=1)  # noqa: B019 - one image, asked for again at once
    def true_depth(self, i: int) -> NDArray[np.float32]:
        """Return the exact depth (height, width) in metres of frame `i`, inf if there is nothing."""
        return self._cast(self.person(i), pole=True)

    def shows_person(self, i: int) -> bool:
        """Return whether a pixel of frame `i` shows the person."""
        return self.person(i) is not None and bool((self.true_depth(i) < self._cast(None, pole=True)).any())

    def frame(self, i: int) -> Frame:
        """Return frame `i`; raises IndexError if it does not exist."""
        i = range(len(self))[i]
        shown = i % self.pole_every == 0
        truth = self._cast(self.person(i), pole=shown or self.missed == "unmatched")
        depth, reason = self._device.measure(truth, [self.seed, i])
        if not shown and self.missed == "unmatched":
            lost = truth < self._cast(self.person(i), pole=False)
            depth[lost], reason[lost] = 0, Reason.UNMATCHED
        if self.background == "silent":
            reason[reason == Reason.TOO_FAR] = Reason.UNKNOWN
        stamp_ns = round(i * 1e9 / HZ)
        return Frame(depth, self.camera, self.T_world_camera, stamp_ns, 0.001, reason, f"{self.name} frame {i}")

    @property
    def _surroundings(self) -> list[Solid]:
        solids = [box("floor", "floor", (-1, -30, -0.2), (30, 30, 0))]
        return (
            [*solids, box("wall", "wall", (WALL, -8, 0), (WALL + 0.2, 8, 8))] if self.background == "near" else solids
        )

    def _cast(self, person: Solid | None, *, pole: bool) -> NDArray[np.float32]:
        if person is None:
            return self._empty(pole)
        return self._rendered([*self._surroundings, *([self.pole] if pole else []), person])

    @lru_cache(maxsize=2)  # noqa: B019 - both views of nobody live as long as the source
    def _empty(self, pole: bool) -> NDArray[np.float32]:
        return self._rendered([*self._surroundings, *([self.pole] if pole else [])])

    def _rendered(self, solids: list[Solid]) -> NDArray[np.float32]:
        x, y = self.camera.ray_slopes()
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
        T = self.T_world_camera
        depth = Scene(solids).cast(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32))
        return depth.reshape(self.camera.height, self.camera.width)
