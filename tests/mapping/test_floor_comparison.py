# SPDX-License-Identifier: Apache-2.0
"""Scans are compared with the grid: beams against plain Python, bad scans, and floors that change."""

from dataclasses import replace
from math import floor, inf, isnan

import numpy as np
import pytest
from bad_scans import FAULTS as BAD
from bad_scans import Ground, changed, scans_of

import stereovox as sv
from stereovox.config import load_config
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.mapping.floor_comparison import FAULTS as FLAT_FAULTS
from stereovox.mapping.floor_comparison import Plane
from stereovox.maps import State, grid_map
from stereovox.maps.cells.evidence import GridEvidence
from stereovox.maps.grid_map import DEEP_CELLS, GridMap, load_grid
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.record.glance import AGAINST_BEAMS, FEW_BEAMS, BeamAgreement
from stereovox.opening import open_robot
from stereovox.simulate.floors.plan import block
from stereovox.simulate.floors.view import cast

SIDE = 0.1
ODDS = (-9, -3.1, -1.5, -0.4, 0.4, 1.2, 2.6, 9)


def made(cell="int16", seed=0, size=60):
    """A map whose cells are walls of all kinds in free and unknown ground, and the same as a table."""
    random = np.random.default_rng(seed)
    made_map = GridMap(load_config(voxel_size=SIDE, **{"map.cell": cell}), (0.7, -1.3, 0.6))
    odds = np.where(random.random((size, size)) < 0.1, random.choice(ODDS, (size, size)), random.choice([-9, -3.1]))
    odds[random.random((size, size)) < 0.3] = np.nan
    stored = made_map.storage.cell_format.stored(np.nan_to_num(odds))
    stored = np.where(np.isnan(odds), made_map.storage.cell_format.unknown, stored)
    picture = np.full((128, 128), made_map.storage.cell_format.unknown)
    picture[64 - size // 2 : 64 + size // 2, 64 - size // 2 : 64 + size // 2] = stored
    tiles = picture.reshape(2, 64, 2, 64).swapaxes(1, 2).reshape(4, 4096)
    coords = np.array([[-1, -1, 0], [0, -1, 0], [-1, 0, 0], [0, 0, 0]], np.int32)
    made_map.storage.insert(coords, tiles)
    table = {
        tuple(c): round(float(o), 6) for c, o in zip(made_map.cells()[0].tolist(), made_map.cells()[1], strict=True)
    }
    return made_map, table


class Slow:
    """The result of the kernels, cell by cell, from the log-odds and the settings alone."""

    def __init__(self, made_map, table):
        self.table = table
        rules, self.form = made_map.storage.rules, made_map.storage.cell_format
        self.prior = max(0.0, float(self.form.log_odds(np.array([rules.prior]))[0]))
        self.free = float(self.form.log_odds(np.array([rules.thresholds.free_most]))[0])
        self.occupied = float(self.form.log_odds(np.array([rules.thresholds.occupied_least]))[0])
        sure = self.form.log_odds(np.array([rules.sure[0], rules.sure[2]]))
        self.sure_free, self.sure_occupied = map(float, sure)

    def surface(self, cell):
        return self.table.get(cell, -inf) > max(self.prior, self.free) + 1e-5

    def near(self, cell, around):
        x, y = cell
        steps = range(-around, around + 1)
        return any(self.surface((x + dx, y + dy)) for dx in steps for dy in steps)

    def seen_at(self, cell, around, free):
        if self.near(cell, around):
            return State.OCCUPIED
        return State.FREE if self.table.get(cell, inf) <= free + 1e-5 else State.UNKNOWN

    def way(self, x, y, u, v, least):
        steps = int(max(abs(u - x), abs(v - y)) / 0.7) + 1
        for k in range(steps + 1):
            at = k / steps
            if self.table.get((floor(x + at * (u - x)), floor(y + at * (v - y))), -inf) >= least - 1e-5:
                return at
        return inf

    def weigh(self, ends, around, step):
        agree = into = through = every = 0
        for x, y, u, v, p, q in ends[::step].tolist():
            every += not (isnan(p) and isnan(u))
            met = State.UNKNOWN
            if not isnan(p):
                met = self.seen_at((floor(p), floor(q)), around, self.sure_free)
            agree, into = agree + (met == State.OCCUPIED), into + (met == State.FREE)
            length = np.hypot(u - x, v - y)
            if met == State.UNKNOWN and length > DEEP_CELLS:
                part = 1 - DEEP_CELLS / length
                through += self.way(x, y, x + part * (u - x), y + part * (v - y), self.sure_occupied) < inf
        return agree, into, through, every


def beams(random, count=300):
    ends = random.uniform(-35, 35, (count, 6))
    ends[:, 4:] = np.where(random.random((count, 1)) < 0.5, ends[:, 2:4], ends[:, 4:])
    ends[random.random(count) < 0.2, 4:] = np.nan
    ends[random.random(count) < 0.2, :4] = np.nan
    return ends


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
@pytest.mark.parametrize("around", [1, 3])
def test_beams_are_counted_as_by_plain_python(cell, around, monkeypatch):
    made_map, table = made(cell)
    ends, slow = beams(np.random.default_rng(1)), Slow(made_map, table)
    evidence = GridEvidence(np.empty((0, 3), np.int32), np.empty((0, 4096), np.int16), ends)
    for most, step in ((300, 1), (299, 2), (100, 3)):
        monkeypatch.setattr(grid_map, "BEAMS", most)
        found = made_map.storage.agreement(evidence, around)
        assert tuple(found) == slow.weigh(ends, around, step)
        assert min(found) > 0
    assert made_map.storage.agreement(GridEvidence.nothing(), around).against is None


@pytest.mark.parametrize("cell", ["int16", "uint8"])
def test_places_and_rays_are_those_of_plain_python(cell):
    made_map, table = made(cell)
    random, slow, storage = np.random.default_rng(2), Slow(made_map, table), made_map.storage
    cells = random.integers(-40, 40, (400, 2))
    for around in (1, 2):
        expected = [slow.seen_at(tuple(one), around, slow.free) for one in cells.tolist()]
        assert storage.seen_at(cells, around).tolist() == expected
        assert {int(one) for one in expected} == {State.UNKNOWN, State.FREE, State.OCCUPIED}
    lines = random.uniform(-50, 50, (200, 4))
    np.testing.assert_allclose(storage.cast(lines), [slow.way(*one, slow.occupied) for one in lines.tolist()])
    left, bottom = -33, -20
    window = [[slow.surface((left + i, bottom + j)) for i in range(50)] for j in range(40)]
    np.testing.assert_array_equal(storage.surfaces(left, bottom, 40, 50), window)


def test_points_are_looked_up_in_the_maps_frame():
    made_map, _ = made()
    plane, random = Plane(made_map, 1), np.random.default_rng(3)
    cells = random.integers(-30, 30, (100, 2))
    points = np.column_stack([se2.transform(made_map.origin, (cells + 0.5) * SIDE), random.uniform(-1, 1, 100)])
    assert plane.state(points).tolist() == made_map.storage.seen_at(cells, 1).tolist()
    start = np.array([*se2.transform(made_map.origin, [[0.05, 0.05]])[0], 0.3])
    ways = points - start
    ways[:, 2] = 0
    found = plane.cast_rays(np.broadcast_to(start, ways.shape), 2 * ways, 4.0).distance
    far = 4.0 / np.linalg.norm(ways, axis=1, keepdims=True)
    ends = cells * far + 0.5 * (1 + 0 * far)
    lines = np.column_stack([np.full((100, 2), 0.5), ends])
    np.testing.assert_allclose(found, 4.0 * made_map.storage.cast(lines), rtol=1e-4)


def test_few_beams_prove_nothing():
    assert BeamAgreement(FEW_BEAMS - 2, 0, 1, 20).against is None
    assert BeamAgreement(FEW_BEAMS - 1, 0, 1, 20).against == pytest.approx(1 / FEW_BEAMS)
    assert BeamAgreement(25, 2, 2, 100).against is None  # little of it is known
    assert BeamAgreement(26, 2, 2, 100).against == pytest.approx(4 / 30)
    assert BeamAgreement(10, AGAINST_BEAMS - 1, 1, 100).against == pytest.approx(AGAINST_BEAMS / 18)


ROOM = "sim:floor?plan=testbed&seed=5&speed=0.8&seconds=60&scan_hz=5"
SETTINGS = {"voxel_size": 0.05, "max_range": 5.6}
REFUSED = (
    "millimetres", "x 0.5", "x 1.2", "x 2", "mirrored", "turned by 8 deg", "turned by 90 deg", "ring at 1 m",
    "of another place", "random", "random, changing", "pose 2 m off", "range + 0.3 m",
)  # fmt: skip


@pytest.fixture(scope="module")
def ground():
    return Ground(scans_of(ROOM, None), **SETTINGS)


def test_no_good_scan_is_refused(ground):
    assert len(ground.scans) > 250
    assert ground.refused() == {}
    assert ground.mapper.map.history.usual["scan"].mean < 0.1


@pytest.mark.parametrize("kind", REFUSED)
def test_bad_scans_free_no_wall_for_three_seconds(ground, kind):
    found = ground.fault(kind, 175, [3], None)
    assert found["bad"] == 15
    assert found["walls"] > 300
    assert found["freed"] == [0]
    assert found["accepted"][0] <= 1
    assert found["late"] == 0
    if kind.startswith("turned by 8"):
        assert found["reasons"]["camera_moved"] > 5


@pytest.mark.parametrize(("kind", "reason"), [("pose 0.3 m off", "camera_moved"), ("mirrored", "contradicts_map")])
def test_the_reason_tells_a_sensor_that_moved(ground, kind, reason):
    held = ground.fault(kind, 100, [3], None)
    assert held["accepted"] == [0]
    assert held["reasons"][reason] >= 8


@pytest.mark.parametrize("kind", ["furniture moved", "boxes came", "walls open"])
def test_a_floor_that_has_changed_is_accepted(ground, kind):
    later = changed(ROOM, kind, 3)
    mapper = sv.GridMapper(**SETTINGS, resume=ground.grid(None))
    control = sv.GridMapper(**SETTINGS, resume=ground.grid(None), **{"trust.max_disagreement": 1})
    refused = [mapper.add(scan).refused for scan in later]
    assert [control.add(scan).refused for scan in later] == [None] * len(later)
    assert "".join("x" if why else "." for why in refused).count("x" * 16) == 0  # no more than 3 s in a row
    points = control.map.occupied()
    assert (mapper.map.state(points) == State.OCCUPIED).mean() > 0.97


def hall(people=()):
    """A hall of 8 x 6 m with two cupboards, as lines."""
    solids = [block("", "", where, (0, 2)) for where in ((-0.1, -0.1, 0, 6.1), (8, -0.1, 8.1, 6.1), (0, -0.1, 8, 0))]
    solids += [block("", "", where, (0, 2)) for where in ((0, 6, 8, 6.1), (1, 4.8, 2.5, 5.4), (6, 0.6, 6.5, 2.6))]
    return np.concatenate([one.outline for one in [*solids, *people]])


def scan_at(n, outline, x, y, yaw, sensor=""):
    """The n-th scan, 10 per second: 360 beams around a lidar."""
    angles = np.radians(np.arange(360.0))
    ranges = cast(outline, (x, y), yaw + angles) + np.random.default_rng(n).normal(0, 0.01, 360)
    T = se2.lifted([x, y, yaw])
    return Scan(ranges.astype(np.float32), 0.0, np.pi / 180, 0.05, 20.0, T, stamp_ns=10**8 * n, sensor=sensor)


def drive(outline, numbers, speed=0.05):
    return [scan_at(n, outline, 1.5 + speed * n, 3.0 + 0.2 * np.sin(n / 9), 0.3 * np.sin(n / 7)) for n in numbers]


WALLED = [block("", "", (4.0, 1.5, 4.2, 4.5), (0, 2))]
"""A wall that comes, so near that it is most of what is seen."""


def test_a_robot_that_stands_does_not_believe_a_new_wall_and_one_that_moves_does():
    found = {}
    for speed in (0.0, 0.06):
        mapper = sv.GridMapper(voxel_size=0.05, max_range=20.0)
        assert {mapper.add(scan).refused for scan in drive(hall(), range(100), 0.02)} == {None}
        came = [scan_at(100 + n, hall(WALLED), 2.5 + speed * n, 3.0, 0.0) for n in range(20)]
        found[speed] = [mapper.add(scan).refused for scan in came]
    assert set(found[0.0][11:]) == {"contradicts_map"}
    assert found[0.06][0] == "disagrees_with_map"
    assert found[0.06][-1] is None


def test_the_report_and_the_health_say_so(ground):
    clock = [0]
    mapper = sv.GridMapper(**SETTINGS, resume=ground.grid(None), clock=lambda: clock[0], stamp_clock="replay")
    for i, scan in enumerate(ground.scans[150:190]):
        clock[0] = scan.stamp_ns
        seen = replace(scan, ranges=1.3 * scan.ranges) if i >= 10 else scan
        report = mapper.add(seen)
    assert report.refused == "contradicts_map"
    assert "x 1.3" in report.detail
    assert "contradicts_map" in mapper.health().text
    assert mapper.health().state in ("stale", "lost")


def test_a_run_that_is_saved_in_between_refuses_the_same(ground, tmp_path):
    whole, parts = (sv.GridMapper(**SETTINGS) for _ in range(2))
    for i, scan in enumerate(ground.scans[:200]):
        seen = replace(scan, ranges=scan.ranges[::-1].copy()) if i >= 160 else scan
        assert parts.add(seen).refused == whole.add(seen).refused
        if i % 20 == 15:
            parts.save(tmp_path / "grid.npz")
            parts = sv.GridMapper(**SETTINGS, resume=load_grid(tmp_path / "grid.npz"))
    assert whole.map.history.refused["contradicts_map"] > 20
    assert parts.map.history.refused == whole.map.history.refused
    np.testing.assert_array_equal(parts.map.cells()[1], whole.map.cells()[1])


@pytest.mark.parametrize(("settings", "refused"), [({}, True), ({"trust.max_disagreement": 1}, False)])
def test_the_comparison_can_be_switched_off(settings, refused):
    mapper = sv.GridMapper(voxel_size=0.05, max_range=20.0, **settings)
    for scan in drive(hall(), range(60)):
        mapper.add(scan)
    half = drive(hall(), [60])[0]
    assert (mapper.add(replace(half, ranges=half.ranges / 2)).refused is not None) == refused


def test_sensors_at_different_heights_see_different_obstacles():
    for height, refused in ((0.01, "disagrees_with_map"), (0.1, None)):
        mapper = sv.GridMapper(voxel_size=0.05, max_range=20.0)
        for scan in drive(hall(), range(60)):
            mapper.add(scan)
        other = scan_at(60, hall(WALLED), 2.5, 3.0, 0.0, sensor="high")
        other.T_world_sensor[2, 3] = height
        assert mapper.add(replace(other, ranges=other.ranges / 2)).refused == refused


def test_what_drew_a_picture_is_not_known(ground):
    """Images see tables that the lidar of a map server's picture missed; a lidar is compared with it."""
    image = next(iter(open_robot("sim:floor?plan=testbed&seconds=2&image_width=160").frames))
    cells = np.where(np.random.default_rng(0).random((400, 400)) < 0.001, 100, 0).astype(np.int8)
    full = OccupancyGrid(cells, 0.05, (-10.0, -10.0, 0.0))
    assert sv.GridMapper(**SETTINGS, resume=full).add(image).refused is None
    assert sv.GridMapper(**SETTINGS, resume=full).add(ground.scans[0]).refused == "disagrees_with_map"


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (3.0, -2.0, 0.8)])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.35, -0.25, 0.0), (0.0, 0.0, 0.17), (-0.3, 0.2, -0.12)])
def test_a_knocked_lidar_is_found(origin, off):
    empty = GridMap(load_config(voxel_size=0.05, max_range=20.0), origin)
    mapper = sv.GridMapper(voxel_size=0.05, max_range=20.0, resume=empty)
    for scan in drive(hall(), range(60)):
        mapper.add(scan)
    scan = drive(hall(), [20])[0]
    angles = scan.angles
    points = np.column_stack([scan.ranges * np.cos(angles), scan.ranges * np.sin(angles), 0 * angles])
    truth = scan.T_world_sensor
    T = truth @ se2.lifted([0, 0, off[2]])
    T[:2, 3] += off[:2]
    found = Plane(mapper.map, 1).pose_on_surfaces(T, points)
    if not any(off):
        assert found is None or np.abs(found - T).max() < 0.11
        return
    assert np.abs(found[:2, 3] - truth[:2, 3]).max() < 0.11
    assert np.abs(found[:2, :2] - truth[:2, :2]).max() < 0.03


def test_the_faults_of_a_plane_leave_points_in_it():
    assert len(FLAT_FAULTS) > 100
    for name, matrix in FLAT_FAULTS.items():
        np.testing.assert_allclose(matrix @ [0, 0, 1], [0, 0, 1], err_msg=name)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)


OFF = ["x 0.8", "x 1.2", "turned by 30 deg", "pose 0.3 m off", "range + 0.3 m", "of another place"]


@pytest.mark.parametrize("kind", OFF)
def test_a_bad_first_scan_is_taken_out_by_the_second(ground, kind):
    start = len(ground.scans) // 4
    good = ground.scans[start + 1 : start + 4]
    mapper = sv.GridMapper(**SETTINGS)
    assert mapper.add(BAD[kind](ground.scans, start, start, np.random.default_rng(1))).refused is None
    assert mapper.health().state == "waiting"
    reports = [mapper.add(scan) for scan in good]
    assert [report.taken_out for report in reports] == [1, 0, 0]
    assert mapper.health().state == "current"
    fresh = sv.GridMapper(**SETTINGS)
    for scan in good:
        fresh.add(scan)
    for mine, theirs in zip(mapper.map.storage.tiles(), fresh.map.storage.tiles(), strict=True):
        assert np.array_equal(mine, theirs)
    assert (mapper.map.history.frames, dict(mapper.map.history.refused)) == (3, {"unconfirmed": 1})


def test_good_first_scans_are_confirmed_by_the_second(ground):
    for start in range(0, len(ground.scans) - 1, 40):
        mapper = sv.GridMapper(**SETTINGS)
        reports = [mapper.add(scan) for scan in ground.scans[start : start + 2]]
        assert [report.taken_out for report in reports] == [0, 0]
        assert mapper.health().state == "current"


def test_without_a_comparison_a_first_scan_counts(ground):
    mapper = sv.GridMapper(**SETTINGS, **{"trust.max_disagreement": 1})
    mapper.add(ground.scans[0])
    assert mapper.health().state == "current"
