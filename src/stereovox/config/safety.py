# SPDX-License-Identifier: Apache-2.0
"""Settings of trust and deadline: which frames may change a map, and what is left out when time is short."""

from __future__ import annotations

from pydantic import Field, model_validator

from stereovox.config.base import Section


class TrustConfig(Section):
    """Which frames may change the map, and for how long it then counts as current (docs/safety.md).

    ordered: the stamps of each sensor must not go back; `false` for runs that repeat or reverse a recording.
    clock_reset_s: a stamp more than this many seconds back counts as a clock reset.
    max_gap_s: a stamp more than this many seconds ahead counts as a clock reset, too.
    max_speed_mps, max_turn_dps: metres and degrees a second beyond which a pose has jumped.
    max_pose_off_s: seconds that a pose may be extrapolated.
    settle_s: after a jump or a reset, frames that agree with each other for this long are accepted again; 0: at once.
    stale_s, lost_s: seconds without a trusted frame until the map is `stale` and until it is `lost`.
    min_valid_share: share of the pixels that must have a depth or be too far; 0: one pixel is enough.
    min_surface_share: share of the depths that must lie on surfaces; 0: not checked.
    max_unexposed_share: share of the pixels of a stereo image that may be black or saturated; 1: all.
    frozen: refuse an image that repeats what was seen from elsewhere, exactly or with new noise.
    max_disagreement: share of a frame's evidence on certain cells that may contradict the map, beyond what is usual for
        its sensor; 1: not checked.
    pose_error_m: occasional pose error in metres; a frame may disagree by this, relative to the size of a cell.
    changed_s: shortest time in seconds for which frames must disagree with the map before a changed world is accepted,
        if they show one; time alone is no evidence.
    moved_s: seconds after which frames are accepted that would agree with the map from another pose; not set: never.
    """

    ordered: bool = True
    clock_reset_s: float = Field(1.0, gt=0, le=1e9)
    max_gap_s: float = Field(3600.0, gt=0, le=1e9)
    max_speed_mps: float = Field(40.0, gt=0)
    max_turn_dps: float = Field(1500.0, gt=0)
    max_pose_off_s: float = Field(0.05, ge=0, le=1e9)
    settle_s: float = Field(1.0, ge=0, le=1e9)
    stale_s: float = Field(0.5, gt=0)
    lost_s: float = Field(5.0, gt=0)
    min_valid_share: float = Field(0.005, ge=0, le=1)
    min_surface_share: float = Field(0.5, ge=0, le=1)
    max_unexposed_share: float = Field(0.9, gt=0, le=1)
    frozen: bool = True
    max_disagreement: float = Field(0.15, gt=0, le=1)
    pose_error_m: float = Field(0.0075, ge=0)
    changed_s: float = Field(1.0, ge=0, le=1e9)
    moved_s: float | None = Field(None, ge=0, le=1e9)

    @model_validator(mode="after")
    def _ordered(self) -> TrustConfig:
        if self.stale_s >= self.lost_s:
            raise ValueError(f"stale_s {self.stale_s:g} must be smaller than lost_s {self.lost_s:g}")
        return self


class PaceConfig(Section):
    """Quality levels for frames that take longer than `deadline_ms` (docs/safety.md).

    near_share: share of the maximum range that the first level keeps. stride: pixels along each side that the second
        level merges into one, on top of `depth.downsample`. The third level skips the frame.
    """

    near_share: float = Field(0.5, gt=0, le=1)
    stride: int = Field(2, ge=1, le=16)
