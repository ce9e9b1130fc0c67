# SPDX-License-Identifier: Apache-2.0
"""Settings of a ground robot (scans, 2-D grids, localisation, SLAM), of trust in frames, and of deadlines."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from stereovox.config.maps import Section


class ScanConfig(Section):
    """How a depth image becomes a scan (IST 2019, III-C).

    method: `rows` takes the nearest of `rows` rows round the level row, for level cameras; `cloud` takes the
        nearest point between `heights`, for tilted ones.
    rows: 1 is the middle row alone (IST 2019). off_level_deg: largest angle between that row and the horizon.
    heights: lowest and highest metres above the floor that a robot occupies; anything between is an obstacle.
    floor: height of a level floor in metres along `up`, from the world's origin. Not set: in 3-D maps the floor
        is found at each place; for scans from depth images it is 0.
    angle_step_deg: width of a beam; not set: the width of a pixel in the middle of the image.
    """

    method: Literal["rows", "cloud"] = "cloud"
    rows: int = Field(1, ge=1, le=4096)
    heights: tuple[float, float] = (0.1, 1.8)
    floor: float | None = Field(None, ge=-1e5, le=1e5)
    off_level_deg: float = Field(2.0, gt=0, le=20)
    angle_step_deg: float | None = Field(None, ge=0.01, le=10)

    @model_validator(mode="after")
    def _ordered(self) -> ScanConfig:
        if self.heights[0] >= self.heights[1]:
            raise ValueError(f"heights {list(self.heights)} must rise: [lowest, highest]")
        return self


class GridConfig(Section):
    """How scans become a 2-D occupancy grid (IST 2019, II).

    traversal: cells of a beam: `bresenham`'s line, or `exact`: every cell that it touches; other packages can add more.
    update: a cell changes `once` a scan (a hit beats a miss), or with `every` beam that crosses it (IST 2019).
    thickness: metres behind the measured point that are occupied too (alpha of IST 2019, II-B); 0: only its cell.
    p_occupied, p_free: probability, from even odds, after one beam that ends in a cell, and one that passes it
        (OctoMap's values); see `prior`.
    prior: probability that a cell is occupied before any evidence.
    max_tilt_deg: scans of a sensor that leans more than this are refused, because its beams meet the floor.
    """

    traversal: str = "exact"
    update: Literal["once", "every"] = "once"
    thickness: float = Field(0.0, ge=0, le=5)
    p_occupied: float = Field(0.7, gt=0.5, lt=1)
    p_free: float = Field(0.4, gt=0, lt=0.5)
    prior: float = Field(0.5, gt=0, lt=1)
    max_tilt_deg: float = Field(5.0, ge=0, le=45)


class AmclConfig(Section):
    """Adaptive Monte Carlo localisation (Thrun, Burgard and Fox 2005, chapters 5, 6 and 8).

    particles_min, particles_max: smallest and largest number of particles.
    kld_error, kld_z: use enough particles that, up to the normal quantile `kld_z` (2.33: in 99 of 100 cases),
        they differ from the true distribution by at most `kld_error` (Fox 2003); kld_bin, kld_bin_deg: its bins, in
        metres and degrees, which also separate the clusters that the pose is taken from.
    alpha1 ... alpha4: noise of the odometry (table 5.6): variance of a turn by a turn, of a turn by a distance, of a
        distance by a distance, of a distance by a turn. 0.01 is a standard deviation of 10 %.
    update_min_d, update_min_a: update after moving this many metres or turning this many radians.
    resample_interval: updates between two resamplings.
    model: `field` compares beam ends with the nearest obstacle (table 6.3); `beam` compares ranges with
        those expected from the map (table 6.1), which is slower and suits maps of everything the lidar sees.
    max_beams: number of beams used per scan. max_range: metres beyond which a beam counts as no return; not set:
        the scan's own.
    trust: power of a scan's likelihood: 1 treats the beams as independent (as printed), 1 / max_beams as a single one.
    z_hit, z_short, z_max, z_rand: shares of beams that end at an obstacle of the map, before it, nowhere, and anywhere;
        only their proportions matter: `beam` divides them by their sum, which need not be 1 (it is not in ROS's amcl);
        `field` uses z_hit and z_rand only. sigma_hit: metres; lambda_short: 1 / metres.
    field_distance: metres from an obstacle beyond which all places are equal.
    beam_skip: once the particles agree, leave out beams that most of them place in the open: people, and moved
        objects.
    beam_skip_distance: a beam fits a particle if it ends within this many metres of an obstacle.
    beam_skip_share: a beam is left out if it fits a smaller share of the particles.
    beam_skip_most: all beams are used if a larger share of them would be left out.
    alpha_slow, alpha_fast: decay rates of the long and the short average of the likelihood (table 8.3); when the
        short one falls below the long one, random particles help to find the robot again. 0: never.
    recovery_least: a smaller share of random particles counts as chance, and none are drawn; 0: as printed.
    candidates: random poses tried for each random particle, of which the scan selects one; 1: no selection, as printed.
    start_std: standard deviation of a given first pose: metres, metres, radians.
    """

    particles_min: int = Field(500, ge=10)
    particles_max: int = Field(30000, ge=10, le=1_000_000)
    kld_error: float = Field(0.01, gt=0, lt=1)
    kld_z: float = Field(2.33, gt=0, le=6)
    kld_bin: float = Field(0.5, gt=0)
    kld_bin_deg: float = Field(10.0, gt=0, le=360)
    alpha1: float = Field(0.02, ge=0)
    alpha2: float = Field(0.02, ge=0)
    alpha3: float = Field(0.02, ge=0)
    alpha4: float = Field(0.02, ge=0)
    update_min_d: float = Field(0.2, ge=0)
    update_min_a: float = Field(0.5, ge=0)
    resample_interval: int = Field(1, ge=1)
    model: Literal["field", "beam"] = "field"
    max_beams: int = Field(60, ge=2)
    max_range: float | None = Field(None, gt=0)
    trust: float = Field(0.1, gt=0, le=1)
    z_hit: float = Field(0.75, gt=0, le=1)
    z_short: float = Field(0.05, ge=0, le=1)
    z_max: float = Field(0.05, ge=0, le=1)
    z_rand: float = Field(0.15, gt=0, le=1)
    sigma_hit: float = Field(0.1, gt=0)
    lambda_short: float = Field(0.1, gt=0)
    field_distance: float = Field(2.0, gt=0)
    beam_skip: bool = True
    beam_skip_distance: float = Field(0.5, gt=0)
    beam_skip_share: float = Field(0.3, ge=0, le=1)
    beam_skip_most: float = Field(0.9, ge=0, le=1)
    alpha_slow: float = Field(0.01, ge=0, le=1)
    alpha_fast: float = Field(0.3, ge=0, le=1)
    recovery_least: float = Field(0.1, ge=0, lt=1)
    candidates: int = Field(20, ge=1, le=1000)
    start_std: tuple[float, float, float] = (0.5, 0.5, 0.26)

    @model_validator(mode="after")
    def _ordered(self) -> AmclConfig:
        if self.particles_min > self.particles_max:
            raise ValueError(f"particles_min {self.particles_min} must be at most particles_max {self.particles_max}")
        if self.alpha_slow > self.alpha_fast:
            raise ValueError(f"alpha_slow {self.alpha_slow:g} must be at most alpha_fast {self.alpha_fast:g}")
        if min(self.start_std) < 0:
            raise ValueError(f"start_std {list(self.start_std)} must not be negative")
        return self


class SlamConfig(Section):
    """Simultaneous localisation and mapping from a 2-D lidar (`localize/slam/pipeline.py`).

    voxel_size: side in metres of a cell of the map, and of the grid used for scan matching.
    max_range: metres up to which hits are matched; farther ones are too sparse to form a line.
    sigma: metres that a hit may be off a wall; beyond, its weight falls (Geman and McClure).
    odometry: possible error of the odometry's step between two scans: metres (above 0), metres per metre, radians
        (above 0), radians per radian. The limits for turns are wide on purpose: odometry and lidar seldom share a
        clock,
        and matching is more accurate.
    keyframe_distance, keyframe_turn: metres and radians between the scans that make up the map.
    local_keyframes: a scan is matched with the map of this many recent keyframes.
    submap_keyframes: keyframes of a submap, the unit of loop closure.
    closure_path: shortest path in metres between two visits for a loop.
    drift, drift_turn: drift that the search for loops allows along that path: metres and radians per metre.
    closure_window, closure_window_turn: largest search window in metres and radians.
    closure_score: smallest mean likelihood of the points (0 to 1) for recognising a place.
    closure_rival: no loop is closed if another place reaches this share of the best score.
    closure_share: share of the points that must then lie on the earlier map's lines.
    refine_rounds: final rounds in which all keyframes are matched with all others that saw the same walls; 0 is
    fastest.
    refine_distance: largest distance in metres between keyframes that are matched with each other.
    clear_far: let a beam without a return clear the map up to `max_range`. Off, since many lidars report black and
        dazzling objects in the same way.
    """

    voxel_size: float = Field(0.05, ge=0.01, le=0.5)
    max_range: float = Field(30.0, gt=0, le=1000)
    sigma: float = Field(0.04, gt=0, le=1)
    odometry: tuple[float, float, float, float] = (0.02, 0.2, 0.07, 0.5)
    keyframe_distance: float = Field(0.25, gt=0, le=10)
    keyframe_turn: float = Field(0.2, gt=0, le=3.2)
    local_keyframes: int = Field(50, ge=1, le=1000)
    submap_keyframes: int = Field(24, ge=2, le=1000)
    closure_path: float = Field(12.0, gt=0)
    drift: float = Field(0.03, ge=0, le=1)
    drift_turn: float = Field(0.004, ge=0, le=1)
    closure_window: float = Field(6.0, gt=0, le=50)
    closure_window_turn: float = Field(0.5, gt=0, le=3.2)
    closure_score: float = Field(0.45, gt=0, lt=1)
    closure_rival: float = Field(0.9, gt=0, le=1)
    closure_share: float = Field(0.5, gt=0, lt=1)
    refine_rounds: int = Field(1, ge=0, le=20)
    refine_distance: float = Field(5.0, gt=0, le=100)
    clear_far: bool = False

    @model_validator(mode="after")
    def _possible(self) -> SlamConfig:
        if self.max_range > 2000 * self.voxel_size:
            raise ValueError(f"max_range {self.max_range:g} spans more than 2000 cells of {self.voxel_size:g}")
        base, per_metre, base_turn, per_radian = self.odometry
        if min(base, base_turn) <= 0 or min(per_metre, per_radian) < 0:
            raise ValueError(
                f"odometry {list(self.odometry)} must be [metres, metres per metre, radians, radians per radian]: "
                "the first and the third above 0, the others at least 0"
            )
        return self


class LoopsConfig(Section):
    """Loop closure in space (`loops/`).

    drift: share of the path length by which poses may be off, along each axis: it adds up over some metres, then grows
        with the square root of the length.
    drift_deg: degrees by which they may be turned after one metre; grows with the square root of the length.
    upright_deg: degrees by which the poses' up may be wrong; for poses levelled by gravity, as of a T265, a phone or a
        headset. Not set: up drifts like heading.
    odometry_drift, odometry_drift_deg: `drift` and `drift_deg` of a second odometry, such as wheel odometry.
    """

    drift: float = Field(0.015, gt=0, le=0.5)
    drift_deg: float = Field(0.15, gt=0, le=20)
    upright_deg: float | None = Field(None, gt=0, le=45)
    odometry_drift: float = Field(0.02, gt=0, le=0.5)
    odometry_drift_deg: float = Field(0.3, gt=0, le=20)


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
