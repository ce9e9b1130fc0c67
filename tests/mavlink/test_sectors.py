"""Sectors of a map against rays sampled in small steps, and what autopilots read in them."""

import numpy as np
import pytest
from made_halls import CELL, hall, looking

from stereovox import StereovoxError, VoxelMap, load_config
from stereovox.maps import State
from stereovox.mavlink.sectors import UNKNOWN, SectorRules, obstacle_sectors

EXACT = SectorRules(max_distance=4.0, half_height=0.25, overlap_deg=0, own_radius=0)


def sampled(voxel_map, T_world_body, rules, kinds, wider_deg):
    """Nearest place in each kind of states on dense rays in each sector, made wider by so much: the obvious way."""
    half = 2.5 + rules.overlap_deg + wider_deg
    forward, down = T_world_body[:3, 2].copy(), np.array([0.0, 0, -1])
    forward[2] = 0
    forward /= np.linalg.norm(forward)
    right = np.cross(down, forward)
    away = np.arange(0.0, rules.max_distance, 0.02)
    heights = np.linspace(-rules.half_height, rules.half_height, 7)[:, None, None, None] * [0, 0, 1]
    found = np.full((len(kinds), 72), np.inf)
    for i in range(72):
        angles = np.radians(5 * i + np.linspace(-half, half, 16))[:, None, None]  # 6 cm apart
        points = T_world_body[:3, 3] + away[:, None] * (np.cos(angles) * forward + np.sin(angles) * right)
        seen = voxel_map.state((points + heights).reshape(-1, 3)).reshape(7 * 16, -1)
        for n, states in enumerate(kinds):
            hit = np.flatnonzero(np.isin(seen, states).any(axis=0))
            if len(hit):
                found[n, i] = away[hit[0]]
    return found


@pytest.mark.parametrize("seed", range(6))
def test_sectors_are_what_dense_rays_find(seed):
    random = np.random.default_rng(seed)
    low = random.uniform(-2.5, 2.5, (30, 3)) * [1, 1, 0.2]
    boxes = [(a, a + random.uniform(0.05, 0.8, 3)) for a in low]
    voxel_map = hall(boxes[:10], boxes[10:20], boxes[20:], size=4.0, height=0.8)
    at = random.uniform(-0.6, 0.6, 3) * [1, 1, 0.3]
    T = looking(random.uniform(-180, 180), at)
    overlap = [0, 5][seed % 2]
    rules = SectorRules(max_distance=3.0, half_height=0.25, overlap_deg=overlap, own_radius=0)
    found = obstacle_sectors(voxel_map, T, rules)
    kinds = [[State.OCCUPIED, State.TENTATIVE], [State.UNKNOWN]]
    narrower, wider = (sampled(voxel_map, T, rules, kinds, wider_deg) for wider_deg in (0, 0.5))
    for ours, narrow, wide in zip((found.obstacle_m, found.unknown_m), narrower, wider, strict=True):
        assert np.isfinite(ours).sum() > 10
        assert (ours <= narrow + 1e-9).all()  # never farther than anything that is there
        assert (ours >= np.where(np.isinf(wide), rules.max_distance, wide) - np.hypot(CELL, CELL) - 0.02).all()


@pytest.mark.parametrize(("yaw_deg", "sector"), [(0, 0), (90, 18), (-90, 54), (180, 36), (45, 9), (10, 2)])
def test_sectors_run_clockwise_from_the_front(yaw_deg, sector):
    """A post in the direction of x: who looks `yaw_deg` to its left has it as far to the right."""
    voxel_map = hall(occupied=[((2, -0.1, -1), (2.2, 0.1, 1))])
    found = obstacle_sectors(voxel_map, looking(yaw_deg), EXACT)
    assert np.flatnonzero(np.isfinite(found.obstacle_m)).tolist() == sorted({(sector + k) % 72 for k in (-1, 0, 1)})
    assert found.obstacle_m[sector] == pytest.approx(2.0, abs=1e-9)


def test_height_band_is_level_whatever_roll_and_pitch():
    voxel_map = hall(occupied=[((2, -0.1, 0.6), (2.2, 0.1, 1)), ((-2.2, -0.1, -0.2), (-2, 0.1, -0.1))])
    T = looking(0)
    tilt = np.radians(20)
    T[:3, :3] = T[:3, :3] @ [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    found = obstacle_sectors(voxel_map, T, EXACT)
    assert np.isinf(found.obstacle_m[0])
    assert found.obstacle_m[36] == pytest.approx(2.0)


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_any_axis_may_point_up(up):
    """Right of a body that looks along the floor's x is minus its y, wherever up is."""
    from stereovox.products.floor_axes import upright_axes

    x, y, upwards = upright_axes(up)
    post = np.sort(np.stack([2 * x - 1.5 * y - 0.1, 2 * x - 1.5 * y + 0.1]), axis=0)
    voxel_map = hall(occupied=[tuple(post)], up=up)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([-y, -upwards, x])
    found = obstacle_sectors(voxel_map, T, EXACT)
    assert found.obstacle_m[7] < 2.6  # atan2(1.5, 2) = 36.9 degrees
    assert np.isinf(found.obstacle_m[65])


def test_all_free_is_no_obstacle_and_one_unknown_cell_is_not():
    rules = SectorRules(max_distance=4.0, half_height=0.25)
    assert (obstacle_sectors(hall(), looking(20), rules).centimetres(rules) == 401).all()
    voxel_map = hall(unknown=[((3, 0, 0), (3.1, 0.1, 0.1))])
    blocked = obstacle_sectors(voxel_map, looking(0), rules)
    assert blocked.centimetres(rules)[0] == 300
    strict = SectorRules(max_distance=4.0, half_height=0.25, unknown="unmeasured")
    said = blocked.centimetres(strict)
    assert said[0] == UNKNOWN
    assert (np.delete(said, [70, 71, 0, 1, 2]) == 401).all()


def test_unknown_behind_an_obstacle_is_no_matter_and_before_it_is():
    rules = SectorRules(max_distance=4.0, unknown="unmeasured", overlap_deg=0)
    wall = ((2, -4, -1), (2.1, 4, 1))
    assert obstacle_sectors(hall([wall], [((2.5, -4, -1), (3, 4, 1))]), looking(0), rules).centimetres(rules)[0] == 200
    assert (
        obstacle_sectors(hall([wall], [((1.5, -4, -1), (1.8, 4, 1))]), looking(0), rules).centimetres(rules)[0]
        == UNKNOWN
    )


def test_tentative_is_an_obstacle():
    found = obstacle_sectors(hall(tentative=[((2, -0.1, -1), (2.2, 0.1, 1))]), looking(0), EXACT)
    assert found.obstacle_m[0] == pytest.approx(2.0)


def test_a_tentative_cell_no_likelier_than_before_is_no_obstacle_but_space_that_is_not_free_yet():
    voxel_map = hall(tentative=[((2, -0.1, -1), (2.2, 0.1, 1))], doubt=-2.4)
    assert voxel_map.state([[2.05, 0.05, 0.05]]) == State.TENTATIVE
    found = obstacle_sectors(voxel_map, looking(0), EXACT)
    assert found.unknown_m[0] == pytest.approx(2.0)
    assert np.isinf(found.obstacle_m[0])


def test_own_place_hides_unknown_cells_but_no_obstacles():
    around = ((-0.4, -0.4, -1), (0.4, 0.4, 1))
    rules = SectorRules(max_distance=3.0, own_radius=0.6, half_height=0.2)
    assert np.isinf(obstacle_sectors(hall(unknown=[around]), looking(0), rules).free_m).all()
    assert np.isinf(obstacle_sectors(hall(tentative=[around]), looking(0), rules).free_m).all()
    touching = obstacle_sectors(hall(occupied=[around]), looking(0), rules)
    assert (touching.centimetres(rules) == 1).all()  # 0 would be passed over by PX4 and ArduPilot


def test_empty_map_is_unknown_all_round():
    rules = SectorRules(own_radius=0, unknown="unmeasured")
    empty = VoxelMap(load_config(voxel_size=0.1))
    assert (obstacle_sectors(empty, looking(0), rules).centimetres(rules) == UNKNOWN).all()
    shown = SectorRules(own_radius=0.5)
    cm = obstacle_sectors(empty, looking(0), shown).centimetres(shown)
    assert (cm >= 30).all()
    assert (cm <= 60).all()


def test_old_evidence_counts_as_unknown():
    from stereovox import Mapper, open_source

    mapper = Mapper("default", voxel_size=0.1, **{"map.keep_times": True})
    for frame in open_source("sim:room?image_width=160", frames=":40:4"):
        mapper.add(frame)
    pose, fresh = frame.T_world_sensor, SectorRules(own_radius=0)
    aged = obstacle_sectors(mapper.map, pose, SectorRules(own_radius=0, oldest_s=0.2))
    assert (aged.unknown_m <= obstacle_sectors(mapper.map, pose, fresh).unknown_m).all()
    assert (aged.unknown_m < obstacle_sectors(mapper.map, pose, fresh).unknown_m).any()


def test_what_px4_reads_leaves_no_gap():
    """PX4 1.14 takes every second element for 10 degrees; a thin post anywhere must show in the right ones."""
    rules = SectorRules(max_distance=4.0)
    for bearing in np.arange(0.0, 360, 8.3):
        x, y = 3 * np.cos(np.radians(bearing)), -3 * np.sin(np.radians(bearing))
        low = np.floor(np.array([x, y, -2]) / CELL) * CELL
        post = (low, low + np.array([CELL, CELL, 4]))
        seen = hall(occupied=[post], size=4.5, height=0.8)
        cm = obstacle_sectors(seen, looking(0), rules).centimetres(rules)
        true_cm = 100 * np.hypot(*np.maximum(np.abs(low[:2] + CELL / 2) - CELL / 2, 0))
        read = [cm[2 * (int(bearing // 10) + k) % 72] for k in (0, 1)]
        assert min(read) <= true_cm + 0.5
        assert min(read) >= true_cm - 100 * CELL


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"max_distance": 0}, "max_distance"),
        ({"max_distance": 700}, "max_distance"),
        ({"half_height": -1}, "half_height"),
        ({"overlap_deg": 50}, "overlap_deg"),
        ({"own_radius": 9}, "own_radius"),
        ({"oldest_s": np.nan}, "oldest_s"),
        ({"unknown": "free"}, "obstacle or unmeasured"),
    ],
)
def test_rules_out_of_range_are_refused(bad, words):
    with pytest.raises(StereovoxError, match=words):
        SectorRules(**bad)


def test_poses_that_make_no_sense_are_refused():
    up = np.eye(4)
    with pytest.raises(StereovoxError, match="straight up or down"):
        obstacle_sectors(hall(), up)
    with pytest.raises(StereovoxError, match="no rigid motion"):
        obstacle_sectors(hall(), np.full((4, 4), np.nan))
    with pytest.raises(StereovoxError, match="cells for one message"):
        obstacle_sectors(
            VoxelMap(load_config(voxel_size=0.01)), looking(0), SectorRules(max_distance=100.0, half_height=10.0)
        )


def test_tilted_worlds_are_refused():
    config = load_config(voxel_size=0.1, up_direction=[0.3, 0.0, 0.95])
    with pytest.raises(StereovoxError, match="--level"):
        obstacle_sectors(VoxelMap(config), looking(0))
