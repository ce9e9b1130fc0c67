# SPDX-License-Identifier: Apache-2.0
"""The truth of small recordings of which every occupied cell is known."""

from __future__ import annotations

import itertools

import made_kitti as made
import numpy as np
import pytest

from stereovox.errors import SourceError, StereovoxError
from stereovox.evaluate.lidar_truth import lidar_truth
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.maps import State
from stereovox.opening import open_source

SIZE = 0.4
RANGE = 20.0


def cells_of(points: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(int(c) for c in cell) for cell in np.floor(points / SIZE)}


def seen_by(n: int, points: np.ndarray, offset: float = 0.0) -> np.ndarray:
    """Which points of the world the left camera of frame `n` has in its image and range, one by one."""
    found = []
    for x, y, z in transform_points(inverse(made.cam0_pose(n)), points):
        u, v = made.F * (x + offset) / z + made.CX, made.F * y / z + made.CY
        inside = -0.5 <= u < made.SIZE[0] - 0.5 and -0.5 <= v < made.SIZE[1] - 0.5
        found.append(inside and 0 < z <= RANGE)
    return np.array(found)


def occupied(voxel_map) -> set[tuple[int, ...]]:
    return cells_of(voxel_map.occupied())


def test_occupied_are_the_cells_with_a_point_in_view(tmp_path):
    source = open_source(made.raw(tmp_path))
    voxel_map, counts = lidar_truth(source, SIZE, RANGE)
    wall = made.wall()
    seen = [seen_by(n, wall) for n in range(4)]
    assert occupied(voxel_map) == set().union(*(cells_of(wall[some]) for some in seen))
    assert counts.used == sum(some.sum() for some in seen) + 4
    assert counts.points == 4 * (len(wall) + 3)
    assert counts.out_of_range == 4  # the point 90 m ahead, in a cell that no frame has within its range
    assert counts.outside_view == counts.points - counts.used
    assert (counts.frames, counts.in_boxes, counts.moving) == (4, 0, 0)
    assert (voxel_map.config.voxel_size, voxel_map.config.max_range) == (SIZE, RANGE)
    assert (voxel_map.frames, voxel_map.recording) == (4, source.name)


def test_free_are_all_other_cells_in_view_of_any_frame(tmp_path):
    voxel_map, counts = lidar_truth(open_source(made.raw(tmp_path)), SIZE, RANGE)
    box = itertools.product(range(-3, 61, 2), range(-35, 50, 2), range(-14, 15, 2))
    centres = (np.array(list(box)) + 0.5) * SIZE
    in_view = np.any([seen_by(n, centres) for n in range(4)], axis=0)
    hits = occupied(voxel_map)
    held = np.array([tuple(int(c) for c in cell) in hits for cell in np.floor(centres / SIZE)])
    expected = np.where(held, State.OCCUPIED, np.where(in_view, State.FREE, State.UNKNOWN))
    np.testing.assert_array_equal(voxel_map.state(centres), expected)
    assert counts.free == voxel_map.counts()["free"]
    assert counts.occupied == len(hits)


def test_with_rays_free_are_only_cells_on_the_way_to_a_point(tmp_path):
    source = open_source(made.raw(tmp_path))
    by_view, by_rays = (lidar_truth(source, SIZE, RANGE, free)[0] for free in ("view", "rays"))
    assert occupied(by_view) == occupied(by_rays)
    free = by_rays.free()
    assert 0 < len(free) < 0.5 * len(by_view.free())
    assert cells_of(free) < cells_of(by_view.free())
    behind = free[free[:, 0] > 15.07 + SIZE]  # nothing behind the wall but on the way to the point 90 m ahead
    ends = [transform_points(made.cam0_pose(n), np.array([[3.0, 0.1, 90.0]]))[0] for n in range(4)]
    starts = [source.scan(n).T_world_lidar[:3, 3] for n in range(4)]
    ways = [a + np.linspace(0, 1, 2000)[:, None] * (b - a) for a, b in zip(starts, ends, strict=True)]
    nearest = np.min([np.abs(behind[:, None] - way[None]).max(axis=2).min(axis=1) for way in ways], axis=0)
    assert len(behind) > 0
    assert nearest.max() < 0.6 * SIZE
    scan = source.scan(0)
    start, end = scan.T_world_lidar[:3, 3], made.wall()[len(made.wall()) // 2 + 3]
    way = start + np.linspace(0, 1, 500)[:, None] * (end - start)
    on_way = way[seen_by(0, (np.floor(way / SIZE) + 0.5) * SIZE)]  # of cells out of view nothing is said
    assert len(on_way) > 300
    assert set(by_rays.state(on_way)) <= {State.FREE, State.OCCUPIED}


def test_with_box_free_are_all_other_cells_round_those_in_view(tmp_path):
    source = open_source(made.raw(tmp_path))
    by_view, (by_box, counts) = lidar_truth(source, SIZE, RANGE)[0], lidar_truth(source, SIZE, RANGE, "box")
    known = by_view.cells()[0]
    low, high = known.min(axis=0), known.max(axis=0) + 1
    assert counts.free + counts.occupied == np.prod(high - low)
    inside = np.stack(np.meshgrid(*map(np.arange, low - 1, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    held = ((inside >= low) & (inside < high)).all(axis=1)
    states = by_box.state((inside + 0.5) * SIZE)
    assert set(states[held]) == {State.FREE, State.OCCUPIED}
    assert set(states[~held]) == {State.UNKNOWN}
    assert occupied(by_view) <= occupied(by_box)
    for cell in occupied(by_box) - occupied(by_view):  # of points beyond the range of all frames
        assert by_view.state([(np.array(cell) + 0.5) * SIZE])[0] == State.UNKNOWN


def test_a_box_of_too_many_cells_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("stereovox.evaluate.lidar_truth.MAX_BOX", 100)
    with pytest.raises(StereovoxError, match="use larger ones"):
        lidar_truth(open_source(made.raw(tmp_path)), SIZE, RANGE, "box")


def test_points_in_annotated_boxes_are_dropped(tmp_path):
    training = made.tracking(tmp_path)
    with_labels, counts = lidar_truth(open_source(training), SIZE, RANGE)
    wall = made.wall()
    seen = set().union(*(cells_of(wall[seen_by(n, wall, made.OFFSETS[2])]) for n in range(4)))
    assert occupied(with_labels) == seen
    assert counts.in_boxes == 4 * 9**3
    (training / "label_02/0000.txt").unlink()
    without, counts = lidar_truth(open_source(training), SIZE, RANGE)
    assert occupied(without) > seen
    assert counts.in_boxes == 0


def test_boxes_grow_by_the_margin(tmp_path):
    training = made.tracking(tmp_path, 1)
    above = made.car_corner(0) + [[0, -1.5 - up, 0] for up in (0.05, 0.15)]
    points = transform_points(inverse(made.T_CAM0_VELO), above)
    made.write_scan(training / "velodyne/0000/000000.bin", points)
    source = open_source(training)
    dropped = [lidar_truth(source, SIZE, RANGE, box_margin=margin)[1].in_boxes for margin in (0.0, 0.1, 0.2)]
    assert dropped == [0, 1, 2]


def test_points_on_moving_pixels_are_dropped(tmp_path):
    source = open_source(made.stereo2015(tmp_path, (2,)))
    voxel_map, counts = lidar_truth(source, SIZE, RANGE)
    wall = made.wall()
    kept = wall[seen_by(0, wall, made.OFFSETS[2])]
    x, _, z = transform_points(inverse(made.cam0_pose(0)), kept).T
    column = np.floor(made.F * (x + made.OFFSETS[2]) / z + made.CX + 0.5)
    moves = (column >= 20) & (column < 30)
    assert counts.moving == moves.sum() > 50
    assert occupied(voxel_map) == cells_of(kept[~moves])


def test_a_pixel_reaches_half_way_to_its_neighbours(tmp_path):
    training = made.stereo2015(tmp_path, (2,))
    moving = np.zeros((made.SIZE[1], made.SIZE[0]), np.uint8)
    moving[12, 31] = 1
    made.write_picture(training / "obj_map/000002_10.png", moving)
    pixels = [(30.6, 12), (31.4, 11.6), (31.0, 12.4), (30.6, 11.6), (30.4, 12), (31.6, 12), (31, 11.4), (31, 12.6)]
    points = [[(u - made.CX) / made.F * 10 - made.OFFSETS[2], (v - made.CY) / made.F * 10, 10] for u, v in pixels]
    made.write_scan(training / "velodyne/000002.bin", transform_points(inverse(made.T_CAM0_VELO), points))
    _, counts = lidar_truth(open_source(training), SIZE, RANGE)
    assert (counts.moving, counts.used) == (4, 4)


@pytest.mark.parametrize(("frames", "count"), [("1:3", 2), ([0, 3], 2), ([-1], 1), (None, 4)])
def test_frames_are_picked(tmp_path, frames, count):
    source = open_source(made.raw(tmp_path))
    assert lidar_truth(source, SIZE, RANGE, frames=frames)[1].frames == count


def test_a_scan_that_cannot_be_used_is_counted(tmp_path):
    drive = made.raw(tmp_path)
    (drive / "velodyne_points/data/0000000001.bin").write_bytes(b"1234")
    (drive / "oxts/data/0000000002.txt").write_text("49")
    voxel_map, counts = lidar_truth(open_source(drive), SIZE, RANGE)
    assert counts.frames == voxel_map.frames == 2
    assert counts.refused == {"unreadable": 1, "bad_pose_file": 1}
    assert "0000000001.bin" in counts.first_refusal
    with pytest.raises(SourceError, match=r"not one lidar scan can be used .*0000000001\.bin"):
        lidar_truth(open_source(drive), SIZE, RANGE, frames=[1])


def test_a_map_of_the_truth_can_be_saved(tmp_path):
    from stereovox.maps import load_map

    voxel_map, _ = lidar_truth(open_source(made.raw(tmp_path)), SIZE, RANGE)
    voxel_map.save(tmp_path / "truth.svox")
    assert load_map(tmp_path / "truth.svox").counts() == voxel_map.counts()


def test_bad_values_are_one_line(tmp_path):
    source = open_source(made.raw(tmp_path))
    for settings, says in [
        ({"free": "nothing"}, "free 'nothing'"),
        ({"box_margin": -1.0}, "box margin"),
        ({"frames": "9:"}, "selects none of the 4"),
    ]:
        with pytest.raises(StereovoxError, match=says):
            lidar_truth(source, SIZE, RANGE, **settings)
    with pytest.raises(StereovoxError, match="voxel_size"):
        lidar_truth(source, 0.0, RANGE)
    with pytest.raises(SourceError, match="has no lidar"):
        lidar_truth(open_source("sim:room"), SIZE, RANGE)


def test_what_one_frame_sees_beyond_its_range_counts_for_another(tmp_path):
    """A short range: the wall is out of it for the first frame, and in it for the last."""
    source = open_source(made.raw(tmp_path))
    last = source.viewpoint(3).T_world_camera[0, 3]
    reach = 15.07 - last + 0.3
    every, counts = lidar_truth(source, SIZE, reach)
    alone, _ = lidar_truth(source, SIZE, reach, frames=[3])
    assert counts.out_of_range > 100
    assert occupied(alone) < occupied(every)
