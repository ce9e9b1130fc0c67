# SPDX-License-Identifier: Apache-2.0
"""Good inputs of each kind, and for each check of `mapping.entrance` a bad one that must be refused for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from made_clouds import pose, room_points

import stereovox as sv
from stereovox.cameras.rigs import StereoPair
from stereovox.frame import Reason, Scan, StereoFrame
from stereovox.geometry import se2
from stereovox.geometry.se3 import look_at, rotation_matrix
from stereovox.mapper import GridMapper
from stereovox.mapping.entrance import CLOUD, FLOOR_RANGE, IMAGE, IMAGE_SCAN, PAIR, PAIR_SCAN, RANGE, SCAN
from stereovox.maps.record.history import DisagreementSpell

CAMERA = sv.PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5, 0.1)
WALL_M = 1.0
SETTINGS: dict[str, Any] = {"voxel_size": 0.1, "max_range": 5.0, "stereo.disparities": 16}
GRIDS = SCAN, IMAGE_SCAN, PAIR_SCAN, FLOOR_RANGE
RANGES = RANGE, FLOOR_RANGE
MEASURED = {
    IMAGE: "depth",
    PAIR: "left",
    CLOUD: "points",
    SCAN: "ranges",
    IMAGE_SCAN: "depth",
    PAIR_SCAN: "left",
    RANGE: "distance",
    FLOOR_RANGE: "distance",
}
LOOSE = {
    **{f"stereo.{name}": 0 for name in ("p1", "uniqueness", "speckle_size", "min_confidence", "texture", "left_right")},
    "stereo.p2": 0.01,
    "stereo.block_size": 1,
}
"""Settings with which noise has matches."""


@dataclass
class Case:
    """What is offered: `before` must be taken, `bad` must be refused.

    reason: the word it must be refused by, "" for the check's own. arrange: called with the mapper before `bad`.
    patch: values of names of modules.
    """

    bad: Any
    before: Sequence[Any] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    reason: str = ""
    arrange: Callable[[Any], None] = lambda mapper: None
    mapper: type | None = None
    patch: dict[str, Any] = field(default_factory=dict)


def good(kind: str, n: int = 0, **changes: Any) -> Any:
    """Return the n-th good input of a kind, with changed fields."""
    made = {
        IMAGE: _image,
        PAIR: _pair,
        CLOUD: _cloud,
        SCAN: _scan,
        IMAGE_SCAN: _image,
        PAIR_SCAN: _pair,
        RANGE: _range,
        FLOOR_RANGE: _range,
    }[kind](n)
    return replace(made, **changes)


def mapper_of(kind: str, settings: dict[str, Any]) -> sv.Mapper | GridMapper:
    """Return a new mapper for a kind."""
    return (GridMapper if kind in GRIDS else sv.Mapper)(**{**SETTINGS, **settings})


def _camera_pose(n: int) -> np.ndarray:
    return look_at([0.002 * n, 0, 1], [5, 0, 1])


def _image(n: int) -> sv.Frame:
    depth = WALL_M + np.random.default_rng(n).normal(0, 0.003, (48, 64))
    return sv.Frame(depth.astype(np.float32), CAMERA, _camera_pose(n), 10**8 * n)


def _pair(n: int, disparity: int = 4) -> StereoFrame:
    texture = np.random.default_rng(n).integers(10, 245, (48, 64), np.uint8)
    return StereoFrame(texture, np.roll(texture, -disparity, axis=1), StereoPair(CAMERA), _camera_pose(n), 10**8 * n)


def _cloud(n: int) -> sv.Cloud:
    azimuth, height = np.meshgrid(np.linspace(-3.14, 3.13, 240), np.linspace(-0.4, 0.4, 16))
    directions = np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], -1)
    T = pose(0.002 * n)
    points = room_points(T, directions.reshape(-1, 3)) + np.random.default_rng(n).normal(0, 0.003, (3840, 3))
    return sv.Cloud(points.astype(np.float32), T, 10**8 * n)


def _scan(n: int) -> Scan:
    angles = -np.pi + np.arange(720) * np.pi / 360
    walls = np.min(2.0 / np.maximum(np.abs([np.cos(angles), np.sin(angles)]), 1e-9), axis=0)
    ranges = walls + np.random.default_rng(n).normal(0, 0.003, 720)
    T = se2.lifted([0.002 * n, 0, 0])
    return Scan(ranges.astype(np.float32), -np.pi, np.pi / 360, 0.1, 10.0, T, stamp_ns=10**8 * n)


def _range(n: int) -> sv.Range:
    beam = sv.RangeSensor(beam=np.radians(20))
    return sv.Range(0.95 + 0.001 * n, pose(0.002 * n), 10**8 * n, beam)


def cases(reason: str, number: int, kind: str) -> list[Case]:
    """Return bad inputs of a kind for the check that is the `number`-th of this reason."""
    return RECIPES[reason, number](kind)


def _changed(**changes: Any) -> Callable[[str], list[Case]]:
    return lambda kind: [Case(good(kind, **changes))]


def _values(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable[[str], list[Case]]:
    """Return a recipe that changes what was measured."""

    def recipe(kind: str) -> list[Case]:
        name = MEASURED[kind]
        return [Case(good(kind, **{name: change(getattr(good(kind), name), np.random.default_rng(1))}))]

    return recipe


def _by_kind(**recipes: Callable[[str], list[Case]]) -> Callable[[str], list[Case]]:
    """Return a recipe by what is measured: depth, left, points or ranges."""
    return lambda kind: recipes[MEASURED[kind]](kind)


def _posed(
    change: Callable[[np.ndarray], Any], name: str = "T_world_sensor", **settings: Any
) -> Callable[[str], list[Case]]:
    """Return a recipe that changes the pose."""
    return lambda kind: [Case(good(kind, **{name: change(getattr(good(kind), name).copy())}), settings=settings)]


def _after(change: Callable[[Any], Any], n: int = 100, frames: int = 1) -> Callable[[str], list[Case]]:
    """Return a recipe that changes the frame that follows good ones."""
    return lambda kind: [Case(change(good(kind, n + frames)), [good(kind, n + k) for k in range(frames)])]


def _seen_from_elsewhere(kind: str) -> list[Case]:
    """A view of things at several depths, and again with other noise although the sensor has moved."""

    def view(seed: int) -> Any:
        if kind == IMAGE:
            blocks = np.random.default_rng(0).uniform(1, 2, (6, 8)).repeat(8, 0).repeat(8, 1)
            noise = np.random.default_rng(seed).normal(0, 0.003, (48, 64))
            return good(kind, 0, depth=(blocks + noise).astype(np.float32))
        if kind == PAIR:
            bands = [_pair(seed, disparity) for disparity in (3, 8, 4)]
            left, right = (np.concatenate([getattr(one, eye)[16 * n : 16 * n + 16] for n, one in enumerate(bands)])
                           for eye in ("left", "right"))  # fmt: skip
            return good(kind, 0, left=left, right=right)
        return good(kind, 0, points=good(kind, seed).points)

    T = _moved(good(kind).T_world_sensor, 0.25)
    return [Case(replace(view(2), stamp_ns=10**8, T_world_sensor=T), [view(0)])]


def _moved(T: np.ndarray, metres: float) -> np.ndarray:
    T = T.copy()
    T[0, 3] += metres
    return T


def _at(T: np.ndarray, row: int, column: int, value: float) -> np.ndarray:
    T[row, column] = value
    return T


def _turned(T: np.ndarray, degrees: float, axis: int) -> np.ndarray:
    T[:3, :3] = T[:3, :3] @ rotation_matrix(np.radians(degrees) * np.eye(3)[axis])
    return T


def _scaled(T: np.ndarray) -> np.ndarray:
    T[:3, :3] *= 2
    return T


def _not_frames(kind: str) -> list[Case]:
    made, name = good(kind), MEASURED[kind]
    masked = replace(made, **{name: np.ma.masked_array(getattr(made, name))})
    if kind in RANGES:
        masked = replace(made, pose_sigma=(0.0, np.nan))
    more = [] if kind == SCAN else [Case(replace(made, pose_sigma=(-1.0, 0.0)))]
    return [Case("no frame"), Case(None), Case(masked), *more]


def _wrong_mapper(kind: str) -> list[Case]:
    mapper = GridMapper if kind == CLOUD else sv.Mapper
    return [Case(made, mapper=mapper) for made in (good(kind), good(kind, name=np.zeros(0)))]


def _one_sensor_more(kind: str) -> list[Case]:
    def fill(mapper: Any) -> None:
        trusted = mapper.map.history.trusted
        trusted.update({f"s{k}": trusted["first"] for k in range(63)})

    return [Case(good(kind, 1, sensor="last"), [good(kind, 0, sensor="first")], arrange=fill)]


def _wrong_shape(kind: str) -> list[Case]:
    made = getattr(good(kind), MEASURED[kind])
    return [Case(good(kind, **{MEASURED[kind]: made[:, :2] if kind == CLOUD else made[None]}))]


def _wrong_type(kind: str) -> list[Case]:
    made = getattr(good(kind), MEASURED[kind])
    return [Case(good(kind, **{MEASURED[kind]: made.astype(np.int32)}))]


def _no_scale(kind: str) -> list[Case]:
    millimetres = np.full((48, 64), 1500, np.uint16)
    scales = (np.nan, 0.0, -1.0, np.inf)
    return [Case(good(kind, depth=millimetres, depth_scale=scale)) for scale in scales]


def _huge_view(kind: str) -> list[Case]:
    views = "stereovox.integrate.views"  # a view that is really so large would take minutes where it is let through
    return [Case(good(kind), patch={f"{views}.MIN_BLOCKS": 0, f"{views}.BLOCKS_PER_PIXEL": 0})]


def _too_large(kind: str) -> list[Case]:
    if kind in (CLOUD, RANGE):
        return [Case(good(kind), patch={"stereovox.integrate._cells.WIDE": 4})]
    far = _pair(0, 1) if kind == PAIR else good(kind, depth=np.full((48, 64), 4.0, np.float32))
    fine = {"voxel_size": 0.01, "depth.denoise": False}
    return [Case(far, settings=fine, patch={"stereovox.integrate.views.MAX_BLOCKS": 1})]


def _units_of_a_pair(kind: str) -> list[Case]:
    millimetres = replace(CAMERA, baseline=100.0)
    return [Case(good(kind, pair=StereoPair(millimetres)))]


def _unit(kind: str) -> list[Case]:
    if MEASURED[kind] == "left":
        return _units_of_a_pair(kind)
    name = MEASURED[kind]
    limits = {"range_max": 10_000.0} if kind == SCAN else {}
    return [
        Case(good(kind, **limits, **{name: getattr(good(kind), name) * np.float32(unit)})) for unit in (1000, 0.0005)
    ]


def _nothing_left(kind: str) -> list[Case]:
    if kind in RANGES:
        return [Case(good(kind, distance=value)) for value in (np.nan, -np.inf, np.inf, 0.1, 4.1, 1500.0, -1.0)]
    if MEASURED[kind] == "left":
        return [Case(good(kind, left=np.full((48, 64), 128, np.uint8), right=np.full((48, 64), 128, np.uint8)))]
    made = getattr(good(kind), MEASURED[kind])
    values = (np.nan, -np.inf) if kind == SCAN else (np.nan, 0.0)
    return [Case(good(kind, **{MEASURED[kind]: np.full_like(made, value)})) for value in values]


def _few_left(kind: str) -> list[Case]:
    if MEASURED[kind] == "left":
        return [Case(_with_patch(kind, np.full((48, 64), 128, np.uint8)), settings={"trust.min_valid_share": 0.3})]
    made = getattr(good(kind), MEASURED[kind]).copy()
    kept = made[20, 20:22].copy() if made.shape == (48, 64) else made[:2].copy()
    made[:] = np.nan
    if made.shape == (48, 64):
        made[20, 20:22] = kept
    else:
        made[: 2 + 10 * (kind == CLOUD)] = kept[0]
    return [Case(good(kind, **{MEASURED[kind]: made}))]


def _with_patch(kind: str, flat: np.ndarray) -> Any:
    made = good(kind)
    left, right = flat.copy(), flat.copy()
    left[20:28, 30:36], right[20:28, 26:32] = made.left[20:28, 30:36], made.left[20:28, 30:36]
    return replace(made, left=left, right=right)


def _random(kind: str) -> list[Case]:
    rng = np.random.default_rng(3)
    if MEASURED[kind] == "left":
        noise = rng.integers(0, 256, (2, 48, 64), np.uint8)
        return [Case(good(kind, left=noise[0], right=noise[1]), settings=LOOSE)]
    if kind == CLOUD:
        made = good(kind).points
        ranges = rng.uniform(0.6, 8, (len(made), 1))
        return [
            Case(good(kind, points=rng.uniform(-5, 5, made.shape).astype(np.float32))),
            Case(good(kind, points=made / np.linalg.norm(made, axis=1)[:, None] * ranges)),
        ]
    made = getattr(good(kind), MEASURED[kind])
    return [Case(good(kind, **{MEASURED[kind]: rng.uniform(0.3, 4.5, made.shape).astype(np.float32)}))]


def _lit(value: int) -> Callable[[str], list[Case]]:
    return lambda kind: [Case(good(kind, **{eye: np.full((48, 64), value, np.uint8)})) for eye in ("left", "right")]


def _contradicting(kind: str) -> list[Case]:
    """The wall or the room is half as far as it was."""
    before = [good(kind, n) for n in range(5, 12)]
    pair = kind in (PAIR, PAIR_SCAN)
    halved = {} if pair else {MEASURED[kind]: getattr(good(kind, 12), MEASURED[kind]) * np.float32(0.5)}
    bad = _pair(12, 8) if pair else good(kind, 12, **halved)
    return [Case(bad, before, {"voxel_size": 0.03, "stereo.subpixel": 0.05, "scan.method": "rows"})]


def _doubted(fits: int) -> Callable[[str], list[Case]]:
    """Return a recipe of a frame that comes after 2 s of others in doubt, of which so many in 60 fit elsewhere."""

    def judged(mapper: Any) -> None:
        sensor = next(iter(mapper.map.history.trusted))
        mapper.map.history.doubts[sensor] = DisagreementSpell(-8 * 10**8, 11 * 10**8, 60, fits)

    return lambda kind: [replace(case, arrange=judged) for case in _contradicting(kind)]


def _no_room(kind: str) -> list[Case]:
    return [Case(good(kind), settings={"max_memory": 10_000, "voxel_size": 0.02})]


def _no_time_left(kind: str) -> list[Case]:
    def skip(mapper: Any) -> None:
        mapper._deadline._scheduler.skips = lambda: True

    return [Case(good(kind), settings={"deadline_ms": 50.0}, arrange=skip)]


def _on_a_card(kind: str) -> list[Case]:
    def pretend(mapper: Any) -> None:
        integration = mapper._deadline._levels[0].integrator
        integration._config = integration._config.model_copy(update={"device": "cuda"})

    return [Case(good(kind), arrange=pretend)]


def _down(kind: str) -> list[Case]:
    T = look_at([0, 0, 1], [1e-3, 0, 0])
    return [Case(good(kind, T_world_sensor=T)), Case(good(kind, T_world_sensor=look_at([0, 0, 1], [1e-3, 0, 2])))]


RECIPES: dict[tuple[str, int], Callable[[str], list[Case]]] = {
    ("bad_form", 0): _changed(name=5),
    ("bad_form", 1): _not_frames,
    ("bad_form", 2): _wrong_mapper,
    ("bad_stamp", 0): _changed(stamp_ns=0.5),
    ("bad_sensor", 0): _changed(sensor=5),
    ("bad_sensor", 1): lambda kind: [Case(good(kind, sensor=name)) for name in ("two\nlines", "x" * 300)],
    ("bad_sensor", 2): _one_sensor_more,
    ("(its own)", 0): lambda kind: [Case(good(kind, fault=word), reason=word) for word in ("unreadable", "no_pose")],
    ("bad_dtype", 0): _wrong_type,
    ("bad_shape", 0): _wrong_shape,
    ("bad_scale", 0): _no_scale,
    ("bad_reason", 0): _changed(reason=np.full((48, 64), len(Reason), np.uint8)),
    ("bad_camera", 0): _huge_view,
    ("view_too_large", 0): _too_large,
    ("too_many_points", 0): lambda kind: [Case(good(kind), patch={"stereovox.depth.cloud.MAX_POINTS": 3839})],
    ("too_many_beams", 0): lambda kind: [Case(good(kind), patch={"stereovox.integrate.beams.MAX_BEAMS": 719})],
    ("bad_scan", 0): lambda kind: [Case(good(kind, **bad)) for bad in ({"angle_step": 0.0}, {"range_max": 0.05})],
    ("bad_clear", 0): lambda kind: [Case(good(kind, **{n: np.zeros(3, np.float32)})) for n in ("clear", "clear_from")],
    ("no_pose", 0): _changed(T_world_sensor=None),
    ("pose_not_finite", 0): lambda kind: [
        *_posed(lambda T: _at(T, 0, 3, np.nan))(kind), *_posed(lambda T: _at(T, 1, 1, np.inf))(kind)
    ],
    ("pose_too_far", 0): _posed(lambda T: _at(T, 1, 3, -1e6)),
    ("pose_too_far", 1): _posed(lambda T: _at(T, 1, 3, 9e5), voxel_size=0.0005, max_range=0.2),
    ("pose_not_rigid", 0): _posed(_scaled),
    ("mount_not_rigid", 0): _posed(_scaled, "T_base_sensor"),
    ("mount_too_far", 0): _posed(lambda T: _at(T, 0, 3, 2e6), "T_base_sensor"),
    ("pose_extrapolated", 0): _changed(pose_off_ns=10**9),
    ("stamp_backwards", 0): _after(lambda frame: replace(frame, stamp_ns=99 * 10**8)),
    ("clock_reset", 0): lambda kind: [
        *_after(lambda frame: replace(frame, stamp_ns=10**8))(kind),
        *_after(lambda frame: replace(frame, stamp_ns=frame.stamp_ns + 3601 * 10**9))(kind),
    ],
    ("pose_jump", 0): _after(lambda frame: replace(frame, T_world_sensor=_moved(frame.T_world_sensor, 50))),
    ("frozen_image", 0): lambda kind: [
        Case(good(kind, 0, stamp_ns=10**8, T_world_sensor=_moved(good(kind).T_world_sensor, 0.1)), [good(kind, 0)])
    ],
    ("frozen_image", 1): _seen_from_elsewhere,
    ("bad_units", 0): _unit,
    ("no_valid_depth", 0): _nothing_left,
    ("no_valid_point", 0): _nothing_left,
    ("no_valid_range", 0): _nothing_left,
    ("too_few_values", 0): _few_left,
    ("no_surfaces", 0): _random,
    ("too_dark", 0): _lit(0),
    ("overexposed", 0): _lit(255),
    ("tilted", 0): lambda kind: _posed(lambda T: _turned(T, 20, int(kind == FLOOR_RANGE)))(kind),
    ("camera_tilted", 0): _posed(lambda T: _turned(T, 20, 2), **{"scan.method": "rows"}),
    ("camera_vertical", 0): _down,
    ("below_floor", 0): _posed(lambda T: T, **{"scan.floor": 50.0}),
    ("heights_not_seen", 0): _posed(lambda T: _at(T, 2, 3, 100)),
    ("disagrees_with_map", 0): _contradicting,
    ("contradicts_map", 0): _doubted(0),
    ("camera_moved", 0): _doubted(60),
    ("memory_full", 0): _no_room,
    ("no_time", 0): _no_time_left,
    ("no_clouds", 0): _on_a_card,
}  # fmt: skip
