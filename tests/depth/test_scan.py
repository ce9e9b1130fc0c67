# SPDX-License-Identifier: Apache-2.0
"""Depth images as scans: against loops over single pixels, and the laws of what may be cleared."""

import math
from itertools import pairwise

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import load_config
from stereovox.depth.scan import scan_of
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import look_at, rotation_matrix

NONE = np.array([0, np.nan, -np.inf, np.inf, np.nan, np.nan], np.float32)
PINHOLE = PinholeCamera(64, 48, 60.0, 58.0, 30.7, 24.2)
CAMERAS = {
    "pinhole": PINHOLE,
    "spherical": SphericalCamera.from_field_of_view(60, 50, 150, 130, 0.15),
    "cylindrical": CylindricalCamera.from_field_of_view(60, 40, 110, 100, 0.15),
}
NEAR, FAR = 0.4, 6.0
CLOSE = 4e-4
"""Share of a beam by which float32 may be off."""


def settings(**scan):
    return load_config(min_range=NEAR, max_range=FAR, **{f"scan.{name}": value for name, value in scan.items()})


def pose(height=1.0, tilt=0.0, roll=0.0, yaw=0.4):
    """Tilt: degrees down; roll: degrees round the optical axis."""
    a, b = math.radians(yaw), math.radians(tilt)
    eye = np.array([1.5, -2.0, height])
    ahead = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), -math.sin(b)])
    T = look_at(eye, eye + ahead)
    T[:3, :3] = T[:3, :3] @ rotation_matrix([0, 0, math.radians(roll)])
    return T


def image_of(camera, T, seed=0, reasons=(0, 1, 2, 3, 4, 5)):
    """A random image in patches of all kinds, depths from 0.4 to 7 m."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = np.kron(random.uniform(0.5, 6.0, (13, 17)), np.ones((4, 4)))[: camera.height, : camera.width]
    depth = (depth * (1 + 0.05 * np.sin(u + v / 3))).clip(NEAR, FAR).astype(np.float32)
    shares = np.array([0.9, 0.03, 0.01, 0.04, 0.01, 0.01])[list(reasons)]
    patches = random.choice(reasons, (16, 20), p=shares / shares.sum())
    reason = np.kron(patches, np.ones((4, 4), int))[: camera.height, : camera.width].astype(np.uint8)
    return DepthImage(np.where(reason == 0, depth, NONE[reason]), reason, camera, T, 77)


def rays_in_scan(image):
    """Rays (height, width, 3) of pixels: forward, left, up of a level frame that looks where the camera does."""
    columns, rows = (np.asarray(part, float) for part in image.camera.rays())
    rays = np.stack(np.broadcast_arrays(columns[None], rows[:, :1], rows[:, 1:]), axis=-1)
    return level(image.T_world_sensor, rays)


def level(T, rays):
    forward = T[:2, 2] / np.linalg.norm(T[:2, 2])
    left = np.array([-forward[1], forward[0]])
    world = rays @ T[:3, :3].T
    return np.stack([world[..., :2] @ forward, world[..., :2] @ left, world[..., 2]], axis=-1)


def corners(image):
    """The same of the corners of all pixels, (height + 1, width + 1, 3); a border is halfway between two pixels."""
    columns, rows = (np.asarray(part, float) for part in image.camera.rays())
    columns, rows = halfway(columns), np.stack([halfway(rows[:, 0]), halfway(rows[:, 1])], axis=1)
    rays = np.stack(np.broadcast_arrays(columns[None], rows[:, :1], rows[:, 1:]), axis=-1)
    return level(image.T_world_sensor, rays)


def halfway(values):
    middle = [(a + b) / 2 for a, b in pairwise(values)]
    return np.array([2 * values[0] - middle[0], *middle, 2 * values[-1] - middle[-1]])


def floor_limit(image, low):
    """Depth up to which the floor may be too near: 1.25 times about the least that is measured."""
    depths = np.sort(image.depth_m[::4, ::4][image.reason[::4, ::4] == Reason.VALID])
    least = depths[len(depths) // 100] if len(depths) else 0.0
    return 1.25 * max(NEAR, least) if low > 0 else 0.0


def what_it_says(why, d, ray, height, heights, floor):
    """One ray, step by step: (hit or None, whether too near, from, to), along the floor."""
    low, high = heights
    way = math.hypot(ray[0], ray[1])
    nothing = why in (Reason.UNMATCHED, Reason.MASKED, Reason.UNKNOWN)
    if ray[0] <= 0 or abs(ray[2]) >= math.tan(math.radians(80)) * way or nothing:
        return None, False, 0.0, 0.0
    enter, leave = 0.0, math.inf  # depths at which the ray is between the heights
    for limit, inwards in ((low, ray[2] > 0), (high, ray[2] < 0)):
        at = (limit - height) / ray[2]
        enter, leave = (max(enter, at), leave) if inwards else (enter, min(leave, at))
    if why == Reason.TOO_NEAR:
        is_floor = ray[2] < 0 and height / -ray[2] < floor
        return None, enter <= leave and enter < NEAR and not is_floor, 0.0, 0.0
    d = FAR if why == Reason.TOO_FAR else float(d)
    hit = d * way if why == Reason.VALID and low <= height + d * ray[2] <= high and d * way <= FAR else None
    return hit, False, enter * way, min(min(d, leave) * way, FAR)


def beams_of_pixels(image, scan):
    """For each pixel the beams it belongs to, and those of which rounding may decide whether it does."""
    bearing = corners(image)
    place = (np.arctan2(bearing[..., 1], bearing[..., 0]) - scan.angle_min) / scan.angle_step
    of_pixel, doubtful = {}, {}
    for v in range(image.camera.height):
        for u in range(image.camera.width):
            four = place[v : v + 2, u : u + 2]
            low, high, middle = four.min(), four.max(), (four.min() + four.max()) / 2
            inside = range(math.ceil(low), math.floor(high) + 1)
            of_pixel[v, u] = inside if len(inside) else [round(middle)]
            edges = {round(edge) for edge in (low, high) if abs(edge - round(edge)) < CLOSE}
            if abs(middle % 1 - 0.5) < CLOSE or edges:
                edges |= {math.floor(middle), math.ceil(middle)}
            doubtful[v, u] = edges if edges & set(inside) or len(inside) < 2 else set()
    return of_pixel, doubtful


def slow(image, scan, config, rows=None):
    """Ranges, clear and clear_from by a loop over pixels; and which beams rounding may change."""
    n, height, rows_only = len(scan.ranges), image.T_world_sensor[2, 3], bool(rows)
    heights = (-math.inf, math.inf) if rows else config.scan.heights
    hits, near, start, end = np.full(n, np.inf), np.zeros(n, bool), np.zeros(n), np.zeros(n)
    unsure, floor = np.zeros(n, bool), floor_limit(image, heights[0])
    of_pixel, doubtful = beams_of_pixels(image, scan)
    rays = rays_in_scan(image)
    order = list(rows or range(image.camera.height))
    for v in reversed(order) if height > heights[1] else order:
        for u in range(image.camera.width):
            why, d = Reason(image.reason[v, u]), image.depth_m[v, u]
            hit, too_near, first, last = what_it_says(why, d, rays[v, u], height, heights, floor)
            level_at = height + (float(d) if why == Reason.VALID else 0) * rays[v, u, 2]
            edge = why == Reason.VALID and min(abs(level_at - limit) for limit in heights) < 1e-4
            for b in of_pixel[v, u]:
                if not 0 <= b < n:
                    continue
                hits[b] = min(hits[b], math.inf if hit is None else hit)
                near[b] |= too_near
                if last > first and (end[b] == 0 or (first <= end[b] and last >= start[b])):
                    start[b] = first if end[b] == 0 else min(start[b], first)
                    end[b] = max(end[b], last)
            if hit is not None or too_near or last > first or edge:
                for b in {*doubtful[v, u], *(of_pixel[v, u] if edge else ())}:
                    unsure[max(b, 0) : b + 1] = True
    clear = np.where(near, 0, np.minimum(end, hits))
    clear[clear <= start] = 0
    free = (clear >= FAR * 0.999) & (start == 0)
    ranges = np.where(near, -np.inf, np.where(np.isfinite(hits), hits, np.where(free, np.inf, np.nan)))
    closest = np.zeros(n) if rows_only else blind_lengths(image, rays, of_pixel, n, heights[0], floor)
    start = np.maximum(start, closest)
    unsure |= np.abs(clear - closest) < 0.1 * closest
    clear[clear <= start] = 0
    start[clear == 0] = 0
    return ranges, clear, start, unsure


def blind_lengths(image, rays, of_pixel, n, low, floor):
    """Metres of each beam in which a thing on the floor may stand below the view, or nearer than depths are known."""
    lowest, unmeasured, height = np.full(n, np.inf), np.zeros(n), image.T_world_sensor[2, 3]
    drop = height - low
    for (v, u), beams in of_pixel.items():
        forward, left, up = rays[v, u]
        way = math.hypot(forward, left)
        if forward <= 0 or abs(up) >= math.tan(math.radians(80)) * way:
            continue
        depth = NEAR
        if image.reason[v, u] == Reason.TOO_NEAR and up < 0 and height / -up < floor:
            depth = max(NEAR, height / -up)
        for b in beams:
            if 0 <= b < n:
                lowest[b], unmeasured[b] = min(lowest[b], up / way), max(unmeasured[b], depth * way)
    sunk = [(drop / -falls if falls < 0 else math.inf) if drop > 0 else 0.0 for falls in lowest]
    return np.maximum(sunk, unmeasured)


CASES = {
    "level": (pose(), {}),
    "down": (pose(tilt=20), {}),
    "down, turned and rolled": (pose(tilt=25, roll=7, yaw=160), {"heights": [0.2, 1.5]}),
    "up": (pose(0.3, tilt=-15), {}),
    "on its side": (pose(tilt=10, roll=90), {}),
    "above the heights": (pose(2.2, tilt=25), {"heights": [0.1, 1.2]}),
    "above, on its side": (pose(2.2, tilt=25, roll=-90), {"heights": [0.1, 1.2]}),
    "below the heights": (pose(0.1, tilt=-20), {"heights": [0.4, 1.2]}),
    "steep": (pose(1.5, tilt=60), {}),
    "fine": (pose(tilt=20), {"angle_step_deg": 0.3}),
    "coarse": (pose(tilt=20), {"angle_step_deg": 4.0}),
}


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("case", CASES)
def test_equals_the_slow_one(case, camera):
    T, scan_settings = CASES[case]
    config, image = settings(**scan_settings), image_of(CAMERAS[camera], T, seed=len(case))
    scan = scan_of(image, config)
    compare(scan, slow(image, scan, config))


@pytest.mark.parametrize("rows", [1, 2, 7])
def test_rows_equal_the_slow_ones(rows):
    config, image = settings(method="rows", rows=rows), image_of(PINHOLE, pose())
    scan = scan_of(image, config)
    first = 24 - (rows - 1) // 2  # cy is 24.2
    compare(scan, slow(image, scan, config, range(first, first + rows)))


def compare(scan, wanted):
    *wanted, unsure = wanted
    sure = ~unsure
    assert sure.sum() > 0.3 * len(sure)
    for name, right in zip(("ranges", "clear", "clear_from"), wanted, strict=True):
        found = getattr(scan, name)
        assert found.dtype == np.float32
        assert found.shape == unsure.shape
        close = 0.1 if name == "clear_from" else 3e-5  # a ray at the border of two beams may belong to either
        np.testing.assert_allclose(found[sure], right[sure], rtol=close, atol=3e-5, err_msg=name)


def test_beams_cover_the_field_of_view_in_equal_steps():
    camera = PinholeCamera.from_field_of_view(640, 480, 57)
    image = DepthImage(np.full((480, 640), 2, np.float32), np.zeros((480, 640), np.uint8), camera, pose(), 5)
    for method in ("rows", "cloud"):
        scan = scan_of(image, settings(method=method))
        assert scan.angle_step == pytest.approx(1 / camera.fx)
        borders = np.degrees([scan.angles[0] - scan.angle_step / 2, scan.angles[-1] + scan.angle_step / 2])
        assert borders == pytest.approx([-28.5, 28.5], abs=np.degrees(scan.angle_step))
        assert np.isfinite(scan.ranges[1:-1]).all()
        assert scan.ranges[1:-1] == pytest.approx(2 / np.cos(scan.angles[1:-1]), rel=2e-3)
        assert scan.stamp_ns == 5


def test_the_scan_stands_upright_in_the_camera():
    T = pose(1.3, tilt=20, roll=5, yaw=70)
    image = image_of(PINHOLE, T)
    scan, rays = scan_of(image, settings()), corners(image)
    assert scan.T_world_sensor[:3, 3] == pytest.approx(T[:3, 3])
    assert scan.T_world_sensor[:3, 0] == pytest.approx([np.cos(np.radians(70)), np.sin(np.radians(70)), 0])
    assert scan.T_world_sensor[:3, 2] == pytest.approx([0, 0, 1])
    flattest = (np.hypot(rays[..., 0], rays[..., 1]) / np.linalg.norm(rays, axis=-1)).min()
    assert flattest < 0.8  # nearer than that along the floor no ray of `min_range` of depth ends
    assert (scan.range_min, scan.range_max) == (pytest.approx(NEAR * flattest, rel=0.01), FAR)


@pytest.mark.parametrize("seed", range(12))
def test_nothing_is_cleared_beyond_an_obstacle_of_any_ray_of_the_beam(seed):
    random = np.random.default_rng(seed)
    T = pose(random.uniform(0.2, 2.0), random.uniform(-10, 40), random.uniform(-20, 20), random.uniform(-180, 180))
    image, low = image_of(PINHOLE, T, seed), random.uniform(0, 0.5)
    config = settings(heights=[low, low + 1.2], angle_step_deg=random.uniform(0.5, 2))
    scan, rays = scan_of(image, config), rays_in_scan(image)
    beam = np.rint((np.arctan2(rays[..., 1], rays[..., 0]) - scan.angle_min) / scan.angle_step).astype(int)
    assert (scan.clear <= np.where(np.isfinite(scan.ranges), scan.ranges, np.inf)).all()
    assert not scan.clear[scan.ranges == -np.inf].any()
    floor = floor_limit(image, low)
    obstacles, farthest = 0, np.zeros(len(scan.ranges))
    for (v, u), b in np.ndenumerate(beam):
        why = Reason(image.reason[v, u])
        hit, near, _, end = what_it_says(why, image.depth_m[v, u], rays[v, u], T[2, 3], config.scan.heights, floor)
        if near:
            assert scan.ranges[b] == -np.inf
        if hit is not None:
            obstacles += 1
            assert scan.ranges[b] <= hit + 1e-4
            assert scan.clear[b] <= hit + 1e-4
        farthest[max(b - 2, 0) : b + 3] = np.maximum(farthest[max(b - 2, 0) : b + 3], end)  # and pixels that overlap
    assert obstacles > 10
    assert (scan.clear <= farthest + 1e-4).all()
    assert (scan.clear[scan.clear > 0] > scan.clear_from[scan.clear > 0]).all()


def hall(tilt, height=1.0, reason=Reason.TOO_FAR):
    """An empty hall: the floor where a ray meets it, else nothing in reach."""
    T = pose(height, tilt, yaw=0)
    image = image_of(PINHOLE, T)
    rise = rays_in_scan(image)[..., 2]
    floor = np.where(rise < 0, -height / np.minimum(rise, -1e-9), np.inf).astype(np.float32)
    seen = floor <= FAR
    return DepthImage(
        np.where(seen, floor, NONE[reason]), np.where(seen, 0, reason).astype(np.uint8), PINHOLE, T
    )  # fmt: skip


def test_in_an_empty_hall_a_level_camera_sees_nothing_up_to_its_range():
    for method in ("rows", "cloud"):
        scan = scan_of(hall(0), settings(method=method))
        assert (scan.ranges[1:-1] == np.inf).all()
        assert scan.clear[1:-1] == pytest.approx(FAR, rel=1e-3)
        lowest = 0.9 / ((47 - 24.2) / 58)  # there the lowest ray of a level camera at 1 m is 0.1 m high
        middle = int(np.argmin(np.abs(scan.angles)))
        assert scan.clear_from[middle] == pytest.approx(0 if method == "rows" else lowest, rel=0.02)


def test_a_box_that_has_sunk_below_the_view_is_not_cleared():
    """Rays over a low box see far; the box, now nearer than the lowest ray comes down, must not be forgotten."""
    scan = scan_of(hall(0, height=0.6), settings())
    box = 0.7  # metres ahead, 0.2 m high: the camera, at 0.6 m, sees down to 0.32 m there
    assert (scan.clear[1:-1] > 5).all()
    assert (scan.clear_from[1:-1] > box).all()


def test_the_floor_right_before_the_camera_is_too_near_and_no_obstacle():
    image = hall(0, height=0.15)  # its lowest rows meet the floor at 0.38 m, nearer than `min_range`
    near = (image.reason == Reason.VALID) & (image.depth_m < NEAR)
    assert near.any()
    image.depth_m[near], image.reason[near] = -np.inf, Reason.TOO_NEAR
    scan = scan_of(image, settings())
    assert (scan.ranges[1:-1] == np.inf).all()
    assert (scan.clear_from[1:-1] >= NEAR).all()
    image.depth_m[20], image.reason[20] = -np.inf, Reason.TOO_NEAR  # a row that looks up
    assert (scan_of(image, settings()).ranges[1:-1] == -np.inf).all()


def test_a_camera_with_a_nearest_depth_of_its_own():
    """A Kinect measures from 0.8 m on, whatever `min_range` is: its own reasons say so, on the floor before it."""
    image = hall(0, height=0.3)  # its lowest rows meet the floor at 0.76 m
    own = (image.reason == Reason.VALID) & (image.depth_m < 0.8)
    assert own.any()
    image.depth_m[own], image.reason[own] = -np.inf, Reason.TOO_NEAR
    scan = scan_of(image, settings())
    assert (scan.ranges[1:-1] == np.inf).all()
    assert (scan.clear_from[1:-1] > 0.7).all()


def test_a_camera_that_looks_down_knows_no_more_than_it_sees():
    scan = scan_of(hall(35), settings(heights=[0.1, 1.8]))
    top = np.radians(35 - np.degrees(np.arctan(24.2 / 58)))  # how far the highest row looks down
    beam = len(scan.ranges) // 2
    assert np.isnan(scan.ranges).all()
    assert scan.clear[beam] == pytest.approx(0.9 / np.tan(top), rel=0.02)  # there its ray is 0.1 m high
    assert scan.clear.max() < FAR


def test_without_a_match_nothing_is_known():
    scan = scan_of(hall(0, reason=Reason.UNMATCHED), settings(method="rows"))
    assert np.isnan(scan.ranges).all()
    assert not scan.clear.any()
    scan = scan_of(hall(0, reason=Reason.MASKED), settings(heights=[0.2, 1.8]))
    assert np.isnan(scan.ranges).all()
    floor = scan.clear[len(scan.ranges) // 2]  # the floor in reach of 6 m is seen as before
    assert 4 < floor < FAR


def test_something_too_near_wins_over_all_else():
    image = hall(0)
    image.depth_m[20, 30], image.reason[20, 30] = -np.inf, Reason.TOO_NEAR
    image.depth_m[20:, 30], image.reason[20:, 30] = np.where(np.arange(28) > 2, 2.0, -np.inf), 2 * (np.arange(28) < 3)
    free, beam = scan_of(hall(0), settings()), None
    scan = scan_of(image, settings())
    beam = np.flatnonzero(scan.ranges == -np.inf)
    assert len(beam) in (1, 2)
    assert not scan.clear[beam].any()
    others = np.delete(np.arange(len(scan.ranges)), beam)
    np.testing.assert_array_equal(scan.clear[others], free.clear[others])


def test_what_is_too_near_over_the_heights_is_no_obstacle():
    image = hall(20, height=2.5)
    image.depth_m[:, 30], image.reason[:, 30] = -np.inf, Reason.TOO_NEAR
    scan = scan_of(image, settings(heights=[0.1, 1.5]))
    assert not (scan.ranges == -np.inf).any()


def test_a_camera_over_the_heights_knows_nothing_close_by():
    scan = scan_of(hall(20, height=2.0), settings(heights=[0.2, 1.0]))
    beam = int(np.argmin(np.abs(scan.angles)))
    lowest = np.radians(20) + np.arctan((47 - 24.2) / 58)
    assert scan.clear_from[beam] == pytest.approx(1.8 / np.tan(lowest), rel=0.02)  # there it is 0.2 m high
    assert scan.clear[beam] > 1.5 * scan.clear_from[beam]
    assert np.isnan(scan.ranges[beam])


def test_points_farther_than_the_range_along_the_floor_are_none():
    camera = PinholeCamera.from_field_of_view(64, 48, 90)
    image = DepthImage(np.full((48, 64), 5.0, np.float32), np.zeros((48, 64), np.uint8), camera, pose(), 0)
    scan = scan_of(image, settings(method="rows"))
    beyond = 5 / np.cos(scan.angles) > FAR * 1.01
    assert beyond.sum() > 10
    assert (scan.ranges[beyond][1:-1] == np.inf).all()
    assert np.isfinite(scan.ranges[5 / np.cos(scan.angles) < FAR * 0.99]).all()


@pytest.mark.parametrize(
    ("T", "scan", "word", "cure"),
    [
        (pose(tilt=30), {"method": "rows"}, "camera_tilted", "scan.method=cloud"),
        (pose(roll=10), {"method": "rows"}, "camera_tilted", "scan.method=cloud"),
        (pose(tilt=85), {}, "camera_vertical", "down"),
        (pose(tilt=-85), {"method": "rows"}, "camera_vertical", "up"),
        (pose(3.0), {"heights": [0.1, 0.2]}, "heights_not_seen", "scan.heights"),
        (pose(-2.0, tilt=30), {}, "heights_not_seen", "scan.heights"),
    ],
)
def test_views_that_make_no_scan(T, scan, word, cure):
    with pytest.raises(FrameRefused) as refused:
        scan_of(image_of(PINHOLE, T), settings(**scan))
    assert refused.value.reason == word
    assert cure in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_tilted_camera_has_a_level_row_too():
    image = hall(10)
    scan = scan_of(image, settings(method="rows"))
    row = 24.2 - 58 * np.tan(np.radians(10))
    image.reason[round(row)], image.depth_m[round(row)] = Reason.VALID, 2.0
    assert (scan.ranges[1:-1] == np.inf).all()
    found = scan_of(image, settings(method="rows")).ranges
    way = 2 / np.cos(np.radians(10)) / np.cos(scan.angles[1:-1])
    assert found[1:-1] == pytest.approx(way, rel=0.02)


def test_only_worlds_whose_z_is_up():
    with pytest.raises(ConfigError, match="up -y"):
        scan_of(image_of(PINHOLE, pose()), load_config(up="-y"))
    assert len(scan_of(image_of(PINHOLE, pose()), load_config(up="+z")).ranges)
