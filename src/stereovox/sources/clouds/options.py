# SPDX-License-Identifier: Apache-2.0
"""Options common to recordings with clouds."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, fields, replace
from math import inf
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from stereovox.cameras.lidar import Lidar
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.frame import FORWARD, Cloud, Range
from stereovox.sources import parameters
from stereovox.sources.base import Source

OptionsT = TypeVar("OptionsT", bound="LidarOptions")


@dataclass(frozen=True)
class LidarOptions:
    """Options after the name of any recording with clouds, as in `scans?range_max=80&sigma=0.03`.

    sigma: standard deviation of a range in metres (0: 0.02). range_min: metres below which points are left out, such
    as points on the vehicle (-1: 0.5). range_max: metres beyond which a point is no surface (0: no limit).
    """

    sigma: float = 0.0
    range_min: float = -1.0
    range_max: float = 0.0

    @property
    def lidar(self) -> Lidar:
        """Return the lidar; raises SourceError for numbers out of range."""
        usual = Lidar()
        try:
            return Lidar(
                self.sigma or usual.sigma,
                usual.range_min if self.range_min == -1 else self.range_min,
                self.range_max or inf,
            )
        except StereovoxError as error:
            raise SourceError(str(error)) from None


def options_of(where: str, start: int, kind: type[OptionsT]) -> tuple[OptionsT, dict[str, str]]:
    """Return the options of a class found in `where` from `start` on, and all others unparsed.

    Raises SourceError for bad ones.
    """
    known = {field.name: field.default for field in fields(kind)}
    try:
        _, given = parameters.split(f"name{where[start:]}")
        ours = {key: text for key, text in given.items() if key in known}
        options = kind(**parameters.typed(ours, known))
        options.lidar  # noqa: B018 - this checks its numbers
        return options, {key: text for key, text in given.items() if key not in known}
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None


def no_others(where: str, others: dict[str, str], kind: type[LidarOptions]) -> None:
    """Raise SourceError if there are options unknown to a class."""
    try:
        parameters.typed(others, {field.name: field.default for field in fields(kind)})
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None


class CloudSource(Source):
    """A recording of clouds.

    Attributes:
        lidar: Range limits and noise.
        camera: A camera that points forward, for pictures.
    """

    lidar: Lidar
    camera: Any = FORWARD

    @abstractmethod
    def cloud(self, i: int) -> Cloud | Range:
        """Return cloud number `i`, from 0; raises FrameRefused if it cannot be used."""
        ...

    @abstractmethod
    def stamp_ns(self, i: int) -> int:
        """Return its time in nanoseconds."""
        ...

    @abstractmethod
    def file(self, i: int) -> str | Path:
        """Return its origin, for messages."""
        ...

    def frame(self, i: int) -> Cloud | Range:
        """Return cloud `i`; if it has a `fault`, it has no points and a pose of NaN."""
        i = range(len(self))[i]
        try:
            return self.cloud(i)
        except FrameRefused as refused:
            told = {"fault": refused.reason, "fault_detail": str(refused)}
            return replace(self.blank(), stamp_ns=self.stamp_ns(i), name=str(self.file(i)), **told)

    def blank(self) -> Cloud | Range:
        """Return a cloud without points and pose."""
        return Cloud(np.empty((0, 3), np.float32), np.full((4, 4), np.nan), lidar=self.lidar)
