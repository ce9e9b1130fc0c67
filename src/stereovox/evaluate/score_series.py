# SPDX-License-Identifier: Apache-2.0
"""Scores after every frame, for charts of how a map becomes better (Valenti 2018, Fig 8.4)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.scores import QuickScores, score_reading
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.maps import VoxelMap


@dataclass
class ScoreSeries:
    """Scores a map after each frame against one truth, the same for all frames.

    truth: the truth, made ready once. threshold: as in `score`. frames, scores: what was added so far.
    """

    truth: TruthCells
    threshold: float = 0.7
    frames: list[int] = field(default_factory=list)
    scores: list[QuickScores] = field(default_factory=list)

    def add(self, frame: int, voxel_map: VoxelMap) -> QuickScores:
        """Score `voxel_map` as it is after frame number `frame`, and remember it."""
        result = score_reading(self.truth.read(voxel_map), self.truth, self.threshold)
        self.frames.append(frame)
        self.scores.append(result)
        return result

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return `frame` (F,) int64 and each measure by name (F,) float64, NaN where it has no value.

        Those over observed cells alone begin with `observed_`.
        """
        rows = [_flat(score) for score in self.scores]
        columns = {name: np.array([row[name] for row in rows], float) for name in (rows[0] if rows else ())}
        return {"frame": np.array(self.frames, np.int64), **columns}


def _flat(score: QuickScores) -> dict[str, float | None]:
    numbers = score.as_dict()
    observed = numbers.pop("observed")
    return {**numbers, **{f"observed_{name}": value for name, value in observed.items()}}
