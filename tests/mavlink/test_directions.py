"""Places in 3-D against all cells looked at one by one."""

import numpy as np
import pytest
from made_halls import CELL, hall, looking

from stereovox import State, StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mavlink.sectors import DirectionRules, nearest_places

POST = ((2, -0.1, -0.3), (2.2, 0.1, 0.3))


def face(place):
    """Layer and sector of a place in front, right, down, as AP_Proximity_Boundary_3D.h numbers them."""
    front, right, down = place
    yaw, pitch = np.degrees(np.arctan2(right, front)) % 360, np.degrees(np.arctan2(-down, np.hypot(front, right)))
    layers = [-60, -30, 0, 30, 60]
    return int(np.argmin(np.abs(np.array(layers) - pitch))), round(yaw / 45) % 8


@pytest.mark.parametrize("seed", range(4))
def test_each_direction_has_its_nearest(seed):
    random = np.random.default_rng(seed)
    low = random.uniform(-2, 2, (12, 3)) * [1, 1, 0.6]
    boxes = [(a, a + random.uniform(0.1, 0.6, 3)) for a in low]
    voxel_map = hall(boxes[:6], boxes[6:], height=3.0, size=3.5)
    T = looking(0)
    T[:3, :3] = T[:3, :3] @ rotation_matrix(random.uniform(-0.4, 0.4, 3))
    T[:3, 3] = random.uniform(-0.3, 0.3, 3)
    rules = DirectionRules(max_distance=2.0, own_radius=0)
    expected = {}
    cells = np.indices((50, 50, 50)).reshape(3, -1).T - 25
    for cell in cells[voxel_map.state((cells + 0.5) * CELL) != State.FREE]:
        nearest = np.clip(T[:3, 3], cell * CELL, (cell + 1) * CELL)
        x, y, z = T[:3, :3].T @ (nearest - T[:3, 3])
        away = np.sqrt(x * x + y * y + z * z)
        if away <= 2.0:
            expected[face((z, x, y))] = min(expected.get(face((z, x, y)), np.inf), away)
    found = {face(place): np.linalg.norm(place) for place in nearest_places(voxel_map, T, rules)}
    assert len(found) > 5
    assert found == pytest.approx(expected, abs=1e-6)


def test_axes_are_front_right_down():
    rules = DirectionRules(max_distance=2.5, own_radius=0)
    voxel_map = hall([POST], height=3.0)
    assert nearest_places(voxel_map, looking(0), rules).tolist() == [pytest.approx([2.0, 0, 0], abs=1e-9)]
    assert nearest_places(voxel_map, looking(90), rules).tolist() == [pytest.approx([0, 2.0, 0], abs=1e-9)]
    beam = ((-0.3, -0.3, 1.5), (0.3, 0.3, 2.0))
    above = nearest_places(hall([beam], height=3.0), looking(0), rules)
    assert above[np.argmin(np.linalg.norm(above, axis=1))] == pytest.approx([0, 0, -1.5])
    assert above[:, 2] == pytest.approx(np.full(len(above), -1.5))


def test_unknown_is_an_obstacle_unless_told():
    voxel_map = hall(unknown=[POST], height=3.0)
    assert len(nearest_places(voxel_map, looking(0), DirectionRules(max_distance=2.5)))
    assert not len(nearest_places(voxel_map, looking(0), DirectionRules(max_distance=2.5, unknown=False)))
    around = hall(unknown=[((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))], height=3.0)
    assert not len(nearest_places(around, looking(0), DirectionRules(max_distance=2.5, own_radius=0.5)))


def test_what_touches_the_vehicle_is_not_at_its_origin():
    """ArduPilot passes over a place at zero."""
    voxel_map = hall(occupied=[((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))], height=3.0)
    places = nearest_places(voxel_map, looking(0, (0.01, 0.02, 0.03)), DirectionRules(max_distance=2.5))
    assert (np.linalg.norm(places, axis=1) >= 0.01 - 1e-9).all()


def test_bad_rules_and_poses_are_refused():
    with pytest.raises(StereovoxError, match="max_distance"):
        DirectionRules(max_distance=0)
    with pytest.raises(StereovoxError, match="oldest_s"):
        DirectionRules(oldest_s=-1)
    with pytest.raises(StereovoxError, match="no rigid motion"):
        nearest_places(hall(), 2 * np.eye(4))
