"""Scans and depth images become a floor's map; what cannot be trusted changes nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.errors import ConfigError
from stereovox.geometry import se2
from stereovox.geometry.se3 import from_quaternion
from stereovox.mapper import GridMapper
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid

ROOM = 2.0
STRANGE = [0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e30, 0.05, 7.0]


def made_scan(pose=(0.0, 0.0, 0.0), **changes):
    """A full turn in the middle of a square room of 4 m, sensor 0.2 m above and ahead of the robot's middle."""
    T_base_sensor = se2.lifted([0.2, 0, 0])
    T_base_sensor[2, 3] = 0.2
    T = se2.lifted(pose) @ T_base_sensor
    angles = -np.pi + np.arange(720) * np.pi / 360
    yaw = se2.flattened(T)[2]
    directions = np.column_stack([np.cos(angles + yaw), np.sin(angles + yaw)])
    with np.errstate(divide="ignore"):
        ranges = np.where(directions > 0, (ROOM - T[:2, 3]) / directions, (-ROOM - T[:2, 3]) / directions).min(axis=1)
    scan = sv.Scan(ranges.astype(np.float32), -np.pi, np.pi / 360, 0.1, 5.6, T, T_base_sensor, stamp_ns=7)
    return replace(scan, **changes)


def leaning(degrees):
    a = np.radians(degrees)
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
    return made_scan().T_world_sensor @ T


@pytest.mark.parametrize("profile", ["default", "ist2019"])
def test_a_room_is_mapped_from_several_places(profile):
    mapper = GridMapper(profile, voxel_size=0.05, **{"grid.prior": 0.5, "min_range": 0.1})
    for pose in [(0, 0, 0), (0.5, -0.5, 1), (-1, 0.7, 2), (1, 1, -2), (0.3, -1.2, 3), (0, 0, -1)] * 2:
        report = mapper.add(made_scan(pose))
        assert report.refused is None
    assert mapper.map.frames == 12
    inside = np.random.default_rng(0).uniform(-1.8, 1.8, (500, 2))
    assert (mapper.map.state(inside) == State.FREE).all()
    walls = mapper.map.occupied()
    assert len(walls) > 250
    assert np.abs(np.abs(walls).max(axis=1) - ROOM).max() < 0.16
    assert (mapper.map.state([[2.5, 0], [0, -2.5], [30, 30]]) == State.UNKNOWN).all()
    grid = mapper.occupancy()
    assert np.abs(np.array(grid.cells.shape) - 82).max() <= 6
    assert grid.states[tuple(grid.indices([[0.3, 0.3]])[0])] == State.FREE


def test_a_report_tells_what_a_scan_did():
    mapper = GridMapper(voxel_size=0.05)
    first = mapper.add(made_scan())
    assert first.cells == len(mapper.map.cells()[0]) > 5000
    assert first.integrate_ms > 0
    assert mapper.add(made_scan()).cells > 5000


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"fault": "no_pose", "fault_detail": "no pose at 7"}, "no_pose"),
        ({"ranges": np.empty(0, np.float32)}, "bad_shape"),
        ({"ranges": np.ones((2, 3), np.float32)}, "bad_shape"),
        ({"ranges": np.array(["a"])}, "bad_dtype"),
        ({"angle_step": 0.0}, "bad_scan"),
        ({"angle_min": np.nan}, "bad_scan"),
        ({"angle_step": 1e308}, "bad_scan"),
        ({"range_min": np.nan}, "bad_scan"),
        ({"range_max": 0.1}, "bad_scan"),
        ({"range_max": np.nan}, "bad_scan"),
        ({"clear": np.zeros(3, np.float32)}, "bad_clear"),
        ({"ranges": np.ones(65537, np.float32)}, "too_many_beams"),
        ({"ranges": np.full(9, np.nan, np.float32)}, "no_valid_range"),
        ({"T_world_sensor": np.full((4, 4), np.nan)}, "pose_not_finite"),
        ({"T_world_sensor": se2.lifted([1e7, 0, 0])}, "pose_too_far"),
        ({"T_world_sensor": np.diag([1.0, -1, 1, 1])}, "pose_not_rigid"),
        ({"T_world_sensor": 2 * np.eye(4)}, "pose_not_rigid"),
        ({"T_world_sensor": np.eye(3)}, "pose_not_rigid"),
        ({"T_world_sensor": None}, "no_pose"),
        ({"T_world_sensor": leaning(6)}, "tilted"),
    ],
)
def test_what_cannot_be_trusted_is_refused_and_counted(changes, reason):
    mapper = GridMapper(voxel_size=0.05)
    mapper.add(made_scan())
    before = mapper.map.storage.tiles()
    report = mapper.add(replace(made_scan(), **changes))
    assert report.refused == reason
    assert report.detail
    assert "\n" not in report.detail
    assert all((a == b).all() for a, b in zip(before, mapper.map.storage.tiles(), strict=True))
    assert (mapper.map.frames, mapper.map.frames_refused) == (1, 1)


def test_a_little_tilt_and_a_sensor_upside_down_are_fine():
    mapper = GridMapper(voxel_size=0.05)
    for degrees in (4, -4, 176, 180):
        assert mapper.add(replace(made_scan(), T_world_sensor=leaning(degrees))).refused is None
    mapper = GridMapper(voxel_size=0.05, **{"grid.max_tilt_deg": 20})
    assert mapper.add(replace(made_scan(), T_world_sensor=leaning(19))).refused is None


def wall_frame(distance=2.0):
    camera = sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.075)
    pose = np.array([[0, 0, 1, 0.03], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])  # looks along world x
    depth = np.minimum(distance, 0.3 / np.maximum((np.arange(60) - 29.5) / 60, 1e-3))  # its floor is at 0
    return sv.Frame(np.repeat(depth[:, None], 80, axis=1).astype(np.float32), camera, pose)


@pytest.mark.parametrize("method", ["rows", "cloud"])
def test_depth_images_are_mapped_too(method):
    mapper = GridMapper(voxel_size=0.1, **{"scan.method": method, "grid.prior": 0.5})
    for _ in range(8):
        assert mapper.add(wall_frame()).refused is None
    assert mapper.map.state([[x, 0.05] for x in (0.55, 1.05, 1.55, 2.05, 2.35, 3.0)]).tolist() == [1, 1, 1, 3, 0, 0]
    bad = mapper.add(replace(wall_frame(), depth=np.zeros((3, 3), np.uint16)))
    assert bad.refused == "bad_shape"
    assert (mapper.map.frames, mapper.map.frames_refused) == (8, 1)


@pytest.mark.parametrize(("height", "floor", "refused"), [
    (1.2, None, None), (0.0, None, "below_floor"), (0.4, None, "below_floor"), (0.0, -1.2, None),
    (1.2, 1.2, "below_floor"),
])  # fmt: skip
def test_a_world_that_begins_at_the_camera_has_its_floor_elsewhere(height, floor, refused):
    """The camera looks at a floor 1.2 m below it, a wall 4 m ahead."""
    mapper = GridMapper(voxel_size=0.1, **{"scan.floor": floor})
    camera = sv.PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5)
    down = (np.arange(48) - 23.5) / 40
    depth = np.minimum(4.0, 1.2 / np.maximum(down, 1e-3))[:, None] * np.ones(64)
    T = np.array([[0, 0, 1.0, 0], [-1, 0, 0, 0], [0, -1, 0, height], [0, 0, 0, 1]])
    report = mapper.add(sv.Frame(depth.astype(np.float32), camera, T))
    assert report.refused == refused
    assert refused is None or "scan.floor" in report.detail


@pytest.mark.parametrize("as_picture", [True, False])
def test_going_on_with_a_map_keeps_its_frame(as_picture):
    settings = {"voxel_size": 0.05, "grid.prior": 0.5}
    first = GridMapper(**settings)
    for _ in range(6):
        first.add(made_scan())
    grid = first.occupancy()
    turned = OccupancyGrid(grid.cells, grid.resolution, tuple(se2.compose([0.4, 0.2, 0.5], grid.origin)))
    second = GridMapper(**settings, resume=turned if as_picture else first.map)
    pose = se2.compose([0.4, 0.2, 0.5], [0, 0, 0]) if as_picture else (0, 0, 0)
    moved = made_scan()
    report = second.add(replace(moved, T_world_sensor=se2.lifted(pose) @ moved.T_world_sensor))
    assert report.refused is None
    known = (grid.cells >= 0).sum()
    assert abs(len(second.map.cells()[0]) - known) < 0.02 * known
    with pytest.raises(ConfigError, match="set voxel_size to"):
        GridMapper(voxel_size=0.1, resume=turned)


@st.composite
def scans(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    beams = draw(st.integers(0, 50))
    ranges = rng.uniform(0, 8, beams)
    strange = rng.random(beams) < draw(st.sampled_from([0.0, 0.3, 1.0]))
    ranges[strange] = rng.choice(STRANGE, strange.sum())
    lean = draw(st.sampled_from([0, 0, 0.02, 1]))
    turn = rng.normal(size=4) * [lean, lean, 1, 1]
    pose = from_quaternion(rng.normal(size=3) * draw(st.sampled_from([0, 1, 1e4, 4e5, 1e7])), turn)
    if draw(st.integers(0, 9)) == 0:
        pose[draw(st.integers(0, 3)), draw(st.integers(0, 3))] = draw(st.sampled_from([*STRANGE]))
    clear = rng.choice([*STRANGE, 2.0], beams).astype(np.float32) if draw(st.booleans()) else None
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = ranges.astype(draw(st.sampled_from([np.float32, np.float64, np.float32, np.int64, np.float16])))
    limits = draw(st.sampled_from([(0.1, 5.6), (0.0, np.inf), (0.0, 1e-9), (3.0, 3.0), (np.nan, 5.0), (0.1, np.nan)]))
    step = draw(st.sampled_from([0.1, -0.1, 1e-12, 1e6, 0.0, np.inf]))
    return sv.Scan(ranges, draw(st.sampled_from([-2.0, 1e9, np.nan])), step, *limits, pose, clear=clear)


@pytest.mark.parametrize(
    "grid", [{"traversal": "exact", "update": "once"}, {"traversal": "bresenham", "update": "every"}]
)
@settings(max_examples=100, deadline=None)
@given(sequence=st.lists(scans(), min_size=1, max_size=4))
def test_any_scan(grid, sequence):
    mapper = GridMapper(voxel_size=0.25, max_range=4.0, grid={**grid, "thickness": 0.3})
    for scan in sequence:
        before = mapper.map.storage.tiles()
        report = mapper.add(scan)
        if report.refused:
            assert all((a == b).all() for a, b in zip(before, mapper.map.storage.tiles(), strict=True))
            assert report.detail
            assert "\n" not in report.detail
    _, values = mapper.map.storage.tiles()
    assert values.min(initial=0) >= -4000
    assert values.max(initial=0) <= 3500
    assert mapper.map.frames + mapper.map.frames_refused == len(sequence)
    sensors = np.array([scan.T_world_sensor[:2, 3] for scan in sequence])
    spots = (mapper.map.cells()[0] + 0.5) * 0.25
    if len(spots) and np.isfinite(sensors).all():  # nothing is said farther away than a beam reaches
        distance = np.linalg.norm(spots[:, None] - sensors[None], axis=-1).min(axis=1)
        assert distance.max() < 4.0 + 0.3 + 0.36
