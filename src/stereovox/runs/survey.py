# SPDX-License-Identifier: Apache-2.0
"""A quick survey of a recording before it is mapped: its contents, its up direction, and settings that suit it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config
from stereovox.frame import AnyFrame, Cloud, Frame, Range, Rays, StereoFrame
from stereovox.geometry.se3 import Transform, inverse, rigidity_error, rotation_vector
from stereovox.products.floor_axes import nearest_axis, up_of, upright_axes
from stereovox.products.moved import level_transform
from stereovox.sources.base import Source, Stream
from stereovox.track.tracker import LEVEL as AHEAD

KINDS = {StereoFrame: "stereo", Frame: "depth", Cloud: "cloud", Range: "range"}
"""Kind of a recording, by the type of its frames."""
RIGID = 0.05
"""Largest entry of abs(R^T R - I) for a pose that is used here."""
FRAMES = 16
"""Frames that are read, spread over the recording."""
USUAL_RANGE_M, USUAL_CELL_M = 5.0, 0.05
"""Values of `default`, kept unless a recording gives a reason to change them."""
RANGES_M = (5.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0)
CELLS_M = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
FAR_SHARE = 0.1
"""Share of the depths that must be beyond the usual range to make it longer."""
NEAR_M = 1.2
"""A recording whose farthest depths are nearer gets smaller cells."""
DISPARITY_ERROR_PX, DEPTH_ERROR = 0.5, 0.05
"""Standard deviation of a disparity, and the largest relative one for a depth to be worth mapping."""
MAX_CELLS_DEEP = 400
"""Most cells along the longest suggested depth, if the user chose their size."""
LEVEL_ENOUGH = np.radians(5.0)
"""Largest angle between up and the nearest axis at which that axis counts as up."""
PICTURES_UPRIGHT = "pictures are turned upright"
TILTED, LEVELLED = f"{PICTURES_UPRIGHT}, with --level the map is too", "the map is turned upright"
"""How a world that is not level is handled, in words: for a fleet, for a map, and with --level."""
LEVEL, UPRIGHT = np.radians(15.0), np.radians(40.0)
"""A surface counts as horizontal within the first angle; an axis points up within the second."""
STEADY = 0.75
"""Least length of the mean of the cameras' own up directions; less means that the camera was turned over."""
TURNED, UPRIGHT_SHARE = 0.5, 0.4
"""Radians that a camera must turn for its turns to be evidence, and the least share then about the vertical."""
FIRST = 10
"""Frames at the start among which a first depth image must be, to find the up direction."""
HORIZONTAL_SHARE = 0.06
"""Share of the surface that must be horizontal (floor, tables, ceiling) to confirm the up direction."""

HANGING = "-z"
"""The own up direction of a sensor that is mounted upside down, in the worlds of robots and motion capture."""


class UpEstimate(NamedTuple):
    """The up direction in the world of a recording.

    axis: the nearest axis of the world, `z`, `-y` and so on. direction: (3,) unit vector. off: angle between both in
    radians. sure: whether there is enough evidence to use it. why: the evidence in words.
    """

    axis: str
    direction: NDArray[np.float64]
    off: float
    sure: bool
    why: str

    @property
    def words(self) -> str:
        """The direction in words: `up is -y`, or `up is 27 degrees from -y`."""
        return f"up is {'' if self.off < LEVEL_ENOUGH else f'{np.degrees(self.off):.0f} degrees from '}{self.axis}"


class Suggestion(NamedTuple):
    """Suggested value of a setting, and why, in words."""

    value: float
    why: str


@dataclass(frozen=True, eq=False)
class Survey:
    """The findings of a quick survey of a recording.

    Attributes:
        name: Name of the recording.
        kind: `depth`, `stereo`, `cloud` or `range`.
        frames: Number of frames.
        seconds: Time from the first to the last frame; 0 if the recording has no times.
        camera: Camera of all frames.
        read: Number of frames that were read for the figures below.
        faults: How many of these cannot be used, by reason.
        posed: Number of frames read that have a pose.
        extent_m: (3,) metres along the world's axes between the camera's extreme positions; None without poses.
        depth_m: (3,) metres: 5th, 50th and 95th percentile of the depths; None for stereo pairs.
        without_value: Share of pixels without depth; None for stereo pairs.
        depths_m: (N,) metres, a sample of all depths; empty for stereo pairs.
        unit: Unit of the depth images in words; None if it is unknown.
        unit_m: The same in metres.
        unit_sure: Whether the images themselves confirm it.
        unit_why: The evidence for the unit.
        up: The up direction; None without poses.
        max_range: Suggested longest depth in metres.
        voxel_size: Suggested side of a cell in metres.
        notes: The recording's own notes: assumptions, omitted files.
    """

    name: str
    kind: str
    frames: int
    seconds: float
    camera: PinholeCamera
    read: int
    faults: Counter[str]
    posed: int
    extent_m: NDArray[np.float64] | None
    depth_m: NDArray[np.float64] | None
    without_value: float | None
    depths_m: NDArray[np.float64]
    unit: str | None
    unit_m: float | None
    unit_sure: bool
    unit_why: str
    up: UpEstimate | None
    max_range: Suggestion
    voxel_size: Suggestion
    notes: tuple[str, ...]

    def settings(self, given: Mapping[str, Any], tilted: str = TILTED) -> tuple[dict[str, Any], list[str]]:
        """Choose the settings that the recording itself suggests.

        Args:
            given: Settings that the user chose, which are kept.
            tilted: Words for how a world that is not level is handled.

        Returns:
            Settings by name, and lines that give their values, the reasons, and the override.
        """
        chosen, lines = self._size_settings(given)
        up, said = self.up_settings(given, tilted)
        return {**chosen, **up}, [*lines, *said]

    def _size_settings(self, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
        chosen: dict[str, Any] = {}
        if "max_range" not in given and self.max_range.value != USUAL_RANGE_M:
            most = MAX_CELLS_DEEP * given.get("voxel_size", np.inf)
            chosen["max_range"] = max(
                (m for m in RANGES_M if m <= min(self.max_range.value, most)), default=RANGES_M[0]
            )
        cell = self.voxel_size if "max_range" not in given else suggest_cell(self.depths_m, given["max_range"])
        if not {"voxel_size", "steps"} & set(given) and cell.value != USUAL_CELL_M:
            chosen["voxel_size"] = cell.value
        if not chosen:
            return {}, []
        words = {"max_range": "depth up to {:g} m", "voxel_size": "cells of {:g} m"}
        options = {"max_range": "--max-range", "voxel_size": "--voxel-size"}
        what = ", ".join(words[name].format(value) for name, value in chosen.items())
        why = self.max_range.why if "max_range" in chosen else cell.why
        return chosen, [f"{what} ({why}); else give {' or '.join(options[name] for name in chosen)}"]

    def up_settings(self, given: Mapping[str, Any], tilted: str = TILTED) -> tuple[dict[str, Any], list[str]]:
        """Choose the up direction.

        Args:
            given: Settings that the user chose, which are kept.
            tilted: As for `settings`.

        Returns:
            As `settings`, for up alone.
        """
        if self.up is None or {"up", "up_direction"} & set(given):
            return {}, []
        if not self.up.sure:
            likely = f", perhaps {self.up.axis}" if self.up.axis != "z" else ""
            return {}, [f"the up direction is uncertain{likely} ({self.up.why}); z is assumed, else give --set up=AXIS"]
        if self.up.off < LEVEL_ENOUGH:
            level, chosen = "", {"up": self.up.axis}
        else:
            level = f"{tilted}; "
            direction = tuple(round(float(part), 4) for part in self.up.direction)
            chosen = {"up": self.up.axis, "up_direction": direction}
        if chosen == {"up": "z"}:
            return {}, []
        return chosen, [f"{self.up.words} ({self.up.why}); {level}else give --set up=AXIS"]

    @property
    def rate_hz(self) -> float | None:
        """Frames per second; None if the recording has no times."""
        return (self.frames - 1) / self.seconds if self.seconds > 0 else None


def survey(source: Source, frames: int = FRAMES) -> Survey:
    """Survey a recording.

    Args:
        source: The recording, from `open_source`.
        frames: Number of frames to read.

    Returns:
        The findings; an unreadable frame only counts in `faults`.
    """
    numbers = np.unique(np.linspace(0, len(source) - 1, min(frames, len(source))).astype(int)).tolist()
    read = [source.frame(i) for i in numbers]
    posed = [frame for frame in read if _has_pose(frame)]
    held: list[AnyFrame] = [frame for frame in posed if not isinstance(frame, Range)]  # a sonar may look anywhere
    images = [frame for frame in read if isinstance(frame, Frame) and frame.depth.size]
    depths = [_depth_m(frame) for frame in images] + [_ranges(frame) for frame in read if isinstance(frame, Rays)]
    valid = np.concatenate([np.empty(0), *(depth[np.isfinite(depth)] for depth in depths)])
    pixels = sum(depth.size for depth in depths)
    max_range = suggest_range(valid, source.camera, stereo=isinstance(read[0], StereoFrame))
    positions = np.array([frame.T_world_sensor[:3, 3] for frame in posed])
    unit = source.unit
    return Survey(
        name=source.name,
        kind=KINDS[type(next((frame for frame in read if not frame.fault), read[0]))],
        frames=len(source),
        seconds=(read[-1].stamp_ns - read[0].stamp_ns) / 1e9,
        camera=source.camera,
        read=len(read),
        faults=Counter(frame.fault for frame in read if frame.fault),
        posed=len(posed),
        extent_m=np.ptp(positions, axis=0) if len(posed) else None,
        depth_m=np.percentile(valid, [5, 50, 95]) if valid.size else None,
        without_value=1 - valid.size / pixels if pixels else None,
        depths_m=valid,
        unit=None if unit is None else unit.words,
        unit_m=None if unit is None else unit.scale,
        unit_sure=unit is not None and unit.sure,
        unit_why="" if unit is None else unit.why,
        up=find_up(source, held) if held else None,
        max_range=max_range,
        voxel_size=suggest_cell(valid, max_range.value),
        notes=tuple(source.notes),
    )


def find_up(source: Source, frames: list[AnyFrame]) -> UpEstimate:
    """Find the up direction: as the layout defines it (`source.up`), by an accelerometer, or else by the images.

    Args:
        source: The recording.
        frames: Some of its frames, with poses.

    Returns:
        The direction; not `sure` if the camera was turned over or saw no horizontal surface.
    """
    if source.up:
        return UpEstimate(source.up, upright_axes(source.up)[2], 0.0, True, "as this kind of recording defines it")
    gravity = source.gravity()
    if gravity is not None:
        axis, off = _axis_near(gravity)
        return UpEstimate(axis, gravity, off, True, "by the accelerometer")
    return _seen_up(frames)


def _seen_up(frames: Sequence[AnyFrame]) -> UpEstimate:
    """Find the up direction from posed frames.

    A camera is mostly held upright, so the mean up direction of the images is near the world's; horizontal surfaces
    close to that, such as floors and tables, then refine and confirm it.
    """
    mean = np.mean([_own_up(frame) for frame in frames], axis=0)
    steady = float(np.linalg.norm(mean))
    if steady < STEADY:
        axis = nearest_axis(mean) if steady > 0 else "z"
        return UpEstimate(axis, mean, float("nan"), False, "the camera was turned over along its path")
    normals = [_normals(frame) for frame in frames if isinstance(frame, Frame) and frame.depth.size]
    normals = np.concatenate([np.empty((0, 3)), *normals])
    direction, share = _level_direction(mean / steady, normals)
    axis, off = _axis_near(direction)
    if axis == HANGING:
        return UpEstimate(axis, direction, off, False, "the sensor hangs upside down, or the world's z points down")
    if _turns_level(frames, direction):
        return UpEstimate(axis, direction, off, False, "the camera hardly turned about the up direction of its images")
    if not len(normals):  # the mean attitude alone suffices for the axis, not for the angle
        return UpEstimate(axis, upright_axes(axis)[2], 0.0, bool(off < UPRIGHT), "by how the camera was held")
    sure = bool(share >= HORIZONTAL_SHARE and off < UPRIGHT)
    why = f"by how the camera was held; {100 * share:.0f} % of what it saw is level"
    return UpEstimate(axis, direction, off, sure, why)


def _axis_near(direction: NDArray[np.float64]) -> tuple[str, float]:
    """Return the axis nearest to a unit vector (3,), and the angle between both in radians."""
    axis = nearest_axis(direction)
    return axis, float(np.arccos(np.clip(direction @ upright_axes(axis)[2], -1, 1)))


def _turns_level(frames: Sequence[AnyFrame], up: NDArray[np.float64]) -> bool:
    """Return whether a camera turned mostly about axes that are level if `up` (3,) is right.

    People and robots turn about the vertical, so then the camera was held on its side.
    """
    R = [frame.T_world_sensor[:3, :3] for frame in frames]
    turns = np.array([before @ rotation_vector(before.T @ after) for before, after in pairwise(R)]).reshape(-1, 3)
    whole = float(np.linalg.norm(turns, axis=1).sum())
    return whole > TURNED and float(np.abs(turns @ up).sum()) < UPRIGHT_SHARE * whole


def level_start(source: Stream, config: Config) -> Transform:
    """Return the pose (4, 4) of the first image of a tracked camera, in the world of its map.

    The camera is at the origin. The up direction follows from floors, tables and ceilings in the first image, if their
    normals are near its vertical; else the camera is assumed to be level.
    """
    return level_pose(next(_first_images(source), None), config)


def level_pose(first: Frame | None, config: Config) -> Transform:
    """Return that pose (4, 4) for a first image, level for None."""
    found = None if first is None else _seen_up([replace(first, T_world_sensor=AHEAD, fault=None)])
    tilt = level_transform(found.direction) if found is not None and found.sure else np.eye(4)
    return level_world(config) @ tilt @ AHEAD


def level_world(config: Config) -> Transform:
    """Return the motion (4, 4) from a world with z up into one with the up direction of the settings."""
    return inverse(level_transform(up_of(config)))


def _first_images(source: Stream) -> Iterator[Frame]:
    """Yield depth images at the start of a recording."""
    if not isinstance(source, Source):
        return
    for i in range(min(FIRST, len(source))):
        frame = source.frame(i)
        if isinstance(frame, Frame) and frame.depth.size:
            yield frame


def suggest_range(depths: NDArray[np.float64], camera: PinholeCamera, stereo: bool) -> Suggestion:
    """Suggest the longest depth that is worth mapping.

    depths: (N,) metres of a sample of pixels; empty for stereo pairs, which are not matched here.
    """
    baseline = camera.baseline
    precise = DEPTH_ERROR * camera.fx * baseline / DISPARITY_ERROR_PX if baseline else np.inf
    if stereo:
        value = max((m for m in RANGES_M if m <= 1.1 * precise), default=RANGES_M[0])
        error = f"{100 * DEPTH_ERROR:.0f} % depth error at {precise:.0f} m"
        return Suggestion(value, f"a baseline of {baseline or 0:.2g} m gives {error}")
    far = float(np.mean(depths > USUAL_RANGE_M)) if depths.size else 0.0
    if far < FAR_SHARE:
        return Suggestion(
            USUAL_RANGE_M, f"{100 * far:.0f} % of the depths are beyond" if far >= 0.005 else "no depth is beyond"
        )
    needed = float(np.percentile(depths, 95))
    fitting = [m for m in RANGES_M if m <= 1.1 * precise]
    value = next((m for m in fitting if m >= 0.95 * needed), max(fitting, default=USUAL_RANGE_M))
    limit = f", the baseline is good to {precise:.1f} m" if value < 0.95 * needed else ""
    return Suggestion(value, f"{100 * far:.0f} % of the depths are beyond {USUAL_RANGE_M:g} m{limit}")


def suggest_cell(depths: NDArray[np.float64], max_range: float) -> Suggestion:
    """Suggest the side of a cell from the depths (N,) in metres of a sample of pixels, and the mapped range."""
    if max_range > USUAL_RANGE_M:
        value = next((side for side in CELLS_M if side >= max_range / 200), CELLS_M[-1])
        return Suggestion(max(value, USUAL_CELL_M), f"a range of {max_range:g} m")
    farthest = float(np.percentile(depths, 95)) if depths.size else USUAL_RANGE_M
    if farthest < NEAR_M:
        return Suggestion(max(side for side in CELLS_M if side <= max(farthest / 100, CELLS_M[0])), "a near scene")
    return Suggestion(USUAL_CELL_M, "the usual size")


def _has_pose(frame: AnyFrame) -> bool:
    return not frame.fault and rigidity_error(frame.T_world_sensor) < RIGID


def _own_up(frame: AnyFrame) -> NDArray[np.float64]:
    """Return the direction (3,) in the world that is up if the sensor is upright; lidars have other axes."""
    return frame.T_world_sensor[:3, 2] if isinstance(frame, Cloud) else -frame.T_world_sensor[:3, 1]


def _ranges(cloud: Rays) -> NDArray[np.float64]:
    """Return a sample of a cloud's ranges in metres, NaN for rays without a range; of a range, itself."""
    if isinstance(cloud, Range):
        return np.where(np.isfinite([cloud.distance]), [cloud.distance], np.nan)
    ranges = np.linalg.norm(cloud.points[:: max(1, len(cloud.points) // 10_000)].astype(float), axis=1)
    return np.where(ranges > cloud.lidar.range_min, ranges, np.nan)


def _depth_m(frame: Frame) -> NDArray[np.float64]:
    """Return a sample of an image's depths in metres, NaN for pixels without depth."""
    step = max(1, frame.depth.shape[1] // 160)
    depth = frame.depth[::step, ::step].astype(np.float64)
    depth[~(depth > 0) | ~np.isfinite(depth)] = np.nan
    if frame.depth.dtype == np.uint16:
        depth[depth == 65535] = np.nan
    return depth * frame.depth_scale


def _normals(frame: Frame) -> NDArray[np.float64]:
    """Return unit normals (N, 3) of surfaces in the world frame, towards the camera."""
    camera = frame.camera
    if not isinstance(camera, PinholeCamera):
        return np.empty((0, 3))
    step = max(1, frame.depth.shape[1] // 160)
    depth = _depth_m(frame)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] * step
    points = np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=-1)
    beside = 2
    across = points[beside:-beside, 2 * beside :] - points[beside:-beside, : -2 * beside]
    down = points[2 * beside :, beside:-beside] - points[: -2 * beside, beside:-beside]
    here = points[beside:-beside, beside:-beside]
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=-1)
    jump = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1)) > 0.3 * here[..., 2]
    usable = np.isfinite(length) & (length > 0) & ~jump
    normals = normals[usable] / length[usable][:, None]
    normals *= -np.sign((normals * here[usable]).sum(axis=1))[:, None]
    return normals @ frame.T_world_sensor[:3, :3].T


def _level_direction(start: NDArray[np.float64], normals: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the normal of horizontal surfaces near `start` (3,), and the share of all normals that agree with it.

    Ceilings count too, flipped. Mean shift, from a wide angle to a narrow one.
    """
    direction = start
    for angle in np.linspace(np.radians(40), LEVEL, 6):
        along = normals @ direction
        near = np.abs(along) > np.cos(angle)
        if near.sum() < max(30, 0.02 * len(normals)):
            return start, 0.0
        mean = (normals[near] * np.sign(along[near])[:, None]).mean(axis=0)
        direction = mean / np.linalg.norm(mean)
    if start @ direction < np.cos(np.radians(45)):
        return start, 0.0
    return direction, float(np.mean(np.abs(normals @ direction) > np.cos(LEVEL)))
