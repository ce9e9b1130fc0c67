# SPDX-License-Identifier: Apache-2.0
"""Scans of simulated rooms against rays cast at every height: nothing is missed, nothing is cleared that nobody saw."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth.scan import scan_of
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import look_at
from stereovox.simulate.scene import Scene, box, cylinder

CAMERA = PinholeCamera.from_field_of_view(320, 240, 57)
LOW, HIGH = 0.1, 1.8
NEAR, FAR = 0.4, 6.0
ROOM = (
    box("room", "floor", (-1, -3, -0.1), (5, 3, 0)),
    box("room", "ceiling", (-1, -3, 2.5), (5, 3, 2.6)),
    box("room", "end", (4.5, -3, 0), (4.7, 3, 2.5)),
    box("room", "left", (-1, 1.6, 0), (5, 1.8, 2.5)),
    box("room", "right", (-1, -1.9, 0), (5, -1.7, 2.5)),
)
THINGS = (
    box("things", "crate", (2.0, -1.2, 0), (2.6, -0.7, 0.5)),
    box("things", "table", (2.4, 0.1, 0.70), (3.4, 1.0, 0.74)),
    cylinder("things", "pole", (1.8, 0.05, 0), (1.8, 0.05, 2.5), 0.03),
    box("things", "sill", (3.0, -0.6, 0), (3.2, -0.2, 0.06)),  # lower than the heights: no obstacle
    box("things", "lamp", (1.5, -0.4, 2.0), (1.8, -0.1, 2.4)),  # higher than the heights
)


def settings(**scan):
    return load_config(
        min_range=NEAR, max_range=FAR, **{"scan.heights": [LOW, HIGH], **{f"scan.{k}": v for k, v in scan.items()}}
    )


def pose(height, tilt_deg, x=0.0, y=0.0, yaw_deg=3.0):
    tilt, yaw = np.radians([tilt_deg, yaw_deg])
    ahead = np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), -np.sin(tilt)])
    return look_at((x, y, height), np.array([x, y, height]) + ahead)


def image_of(scene, T):
    """What a camera without noise sees: exact depth, with reasons."""
    columns, rows = CAMERA.rays()
    rays = np.stack(np.broadcast_arrays(columns[None], rows[:, :1], rows[:, 1:]), axis=-1).reshape(-1, 3)
    depth = scene.cast(T[:3, 3], rays @ T[:3, :3].T).reshape(CAMERA.height, CAMERA.width)
    reason = np.select([depth < NEAR, depth > FAR], [Reason.TOO_NEAR, Reason.TOO_FAR], 0).astype(np.uint8)
    none = np.array([0, np.nan, -np.inf, np.inf], np.float32)[reason]
    return DepthImage(np.where(reason == 0, depth, none), reason, CAMERA, T)


def seen_within(scene, scan, T, angles):
    """Cast a fan of rays at each angle, as the view reaches up and down: the nearest hit and the farthest sight.

    Both along the floor, of what is between the heights alone; (N,) each, inf and 0 for none.
    """
    height, rows = T[2, 3], np.linspace(-0.5, CAMERA.height - 0.5, 500)[1:-1]
    found, sight = np.full(len(angles), np.inf), np.zeros(len(angles))
    R = scan.T_world_sensor[:3, :3]
    tilt = np.arcsin(-T[2, 2])
    for i, angle in enumerate(angles):
        # the ray of row y of the image in the vertical plane at `angle`: forward and up are those of column 0
        y = (rows - CAMERA.cy) / CAMERA.fy
        forward, up = np.cos(tilt) - y * np.sin(tilt), -np.sin(tilt) - y * np.cos(tilt)
        directions = np.stack([forward, forward * np.tan(angle), up], axis=1)
        in_view = np.abs(directions[:, 1]) <= (CAMERA.width / 2) / CAMERA.fx
        directions = directions[in_view]
        directions /= np.hypot(directions[:, 0], directions[:, 1])[:, None]  # length: along the floor
        reach = scene.cast(T[:3, 3], directions @ R.T).astype(float)
        at = height + reach * directions[:, 2]
        hits = reach[(at >= LOW) & (at <= HIGH) & (reach <= FAR)]
        found[i] = hits.min(initial=np.inf)
        with np.errstate(divide="ignore"):
            leave = np.where(directions[:, 2] > 0, HIGH - height, LOW - height) / directions[:, 2]
        sight[i] = np.minimum(np.minimum(reach, leave), FAR).max(initial=0.0)
    return found, sight


@pytest.mark.parametrize(("height", "tilt"), [(1.0, 20.0), (0.5, 0.0), (1.4, 35.0), (0.3, -10.0)])
def test_a_furnished_room_as_rays_at_all_heights_see_it(height, tilt):
    scene, T = Scene([*ROOM, *THINGS]), pose(height, tilt)
    scan = scan_of(image_of(scene, T), settings())
    parts = np.linspace(-1.0, 1.0, 5)  # a beam and its pixels reach into the next ones
    casts = [seen_within(scene, scan, T, scan.angles + part * scan.angle_step) for part in parts]
    hits, sights = (np.array(kind) for kind in zip(*casts, strict=True))
    inner = slice(3, -3)
    nearest, farthest = hits.min(0)[inner], hits.max(0)[inner]
    ranges, clear = scan.ranges[inner], scan.clear[inner]
    hit = np.isfinite(ranges)
    assert (hit == np.isfinite(nearest))[np.isfinite(nearest) == np.isfinite(farthest)].all()
    slack = 0.05 * ranges[hit]  # between two rows the camera sees a slanting edge a bit later
    assert (ranges[hit] >= nearest[hit] - 1e-3).all()
    assert (ranges[hit] <= farthest[hit] + slack).all()
    plain = hit & (farthest < nearest + 0.02)
    assert plain.sum() > 60
    assert np.abs(ranges - nearest)[plain].max() < 0.03
    assert (clear <= sights.max(0)[inner] + 1e-3).all()
    assert (clear <= farthest + slack.max()).all()
    unhit = ~hit & (sights.max(0) - sights.min(0) < 0.05)[inner]
    assert np.abs(clear - sights.min(0)[inner])[unhit].max(initial=0) < 0.15
    assert np.mean(clear > 0) > 0.9


def test_the_scan_in_the_world_lies_on_the_walls():
    scene, T = Scene(ROOM), pose(1.0, 15, x=0.3, y=-0.2, yaw_deg=25)
    scan = scan_of(image_of(scene, T), settings())
    ways = np.stack([np.cos(scan.angles), np.sin(scan.angles)], axis=1) * scan.ranges[:, None]
    points = scan.T_world_sensor[:2, :2] @ ways[np.isfinite(scan.ranges)].T + scan.T_world_sensor[:2, 3:]
    off = np.minimum(np.abs(points[0] - 4.5), np.abs(points[1] - 1.6))
    assert len(off) > 300
    assert off.max() < 0.02


def test_a_pole_thinner_than_a_beam_ends_it():
    scene = Scene([*ROOM, cylinder("things", "pole", (3, 0, 0), (3, 0, 2.5), 0.04)])
    for method in ("rows", "cloud"):
        scan = scan_of(image_of(scene, pose(0.5, 0, yaw_deg=0)), settings(method=method, angle_step_deg=2.0))
        pole = np.flatnonzero(scan.ranges < 3.2)
        assert len(pole) in (1, 2)
        assert np.abs(scan.angles[pole]).max() < np.radians(2)
        assert scan.ranges[pole] == pytest.approx(2.98, abs=0.01)
        assert (scan.clear[pole] <= scan.ranges[pole]).all()


def test_a_table_edge_that_only_some_rows_see():
    scene = Scene([*ROOM, box("things", "table", (2.0, -0.5, 0.70), (2.8, 0.5, 0.74))])
    image = image_of(scene, pose(0.9, 0, yaw_deg=0))
    ahead = slice(150, 170)
    found = {
        name: scan_of(image, settings(**scan)).ranges[ahead]
        for name, scan in {
            "middle": {"method": "rows"},
            "few": {"method": "rows", "rows": 21},
            "many": {"method": "rows", "rows": 81},
            "cloud": {},
            "above it": {"heights": [0.8, HIGH]},
        }.items()
    }
    for name in ("middle", "few", "above it"):
        assert found[name] == pytest.approx(4.5, abs=0.05), name
    assert found["cloud"] == pytest.approx(2.0, abs=0.05)
    assert found["many"].max() < 3  # nearest wins


def test_before_a_wall_that_is_too_near_nothing_is_cleared():
    scene = Scene([*ROOM, box("things", "wall", (0.3, -3, 0), (0.35, 0, 2.5))])  # to the right of the camera's axis
    scan = scan_of(image_of(scene, pose(1.0, 20, yaw_deg=0)), settings())
    right, left = scan.angles < -0.02, scan.angles > 0.02
    assert (scan.ranges[right] == -np.inf).mean() > 0.8  # beams at the border see what might be the floor as well
    assert not (scan.ranges[right] > 0).any()
    assert not scan.clear[right].any()
    assert np.nanmin(scan.ranges[left]) > 1
    assert np.isfinite(scan.ranges[left]).mean() > 0.8  # its last beams see the floor alone, close by
    assert (scan.clear[left][:-1] > 1).all()


def test_a_hall_without_return():
    scene = Scene([box("hall", "floor", (-100, -100, -0.1), (100, 100, 0))])
    level = scan_of(image_of(scene, pose(0.5, 0)), settings())
    assert (level.ranges == np.inf).all()
    down = scan_of(image_of(scene, pose(1.0, 35)), settings())
    assert np.isnan(down.ranges).all()
    top = np.radians(35) - np.arctan(CAMERA.height / 2 / CAMERA.fy)
    assert down.clear[len(down.clear) // 2] == pytest.approx(0.9 / np.tan(top), rel=0.02)
