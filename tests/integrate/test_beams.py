"""Scans become evidence: kernels against the slow twin in fractions, cell for cell, and laws that must hold."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_beams import scan_beams, scan_cells

from stereovox.config import load_config
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.integrate.beams import make_beams

KINDS = [(traversal, update) for traversal in ("exact", "bresenham") for update in ("once", "every")]
NOTHING = [np.nan, np.inf, -np.inf, 0.05, 0.0, -1.0, 3.2, 3.4, 9.0]
HIT, PASS = 847, -405


def config_of(traversal="exact", update="once", **settings):
    grid = {"grid.traversal": traversal, "grid.update": update, "grid.thickness": settings.pop("thickness", 0.0)}
    return load_config(**{"voxel_size": 0.1, "max_range": 3.0, **settings}, **grid)


def made_scan(seed=0, pose=(0.013, -0.021, 0.3), beams=60, **changes):
    """A scan of 4.2 radians with all kinds of beams."""
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.05, 3.5, beams).astype(np.float32)
    strange = rng.random(beams) < 0.3
    ranges[strange] = rng.choice(NOTHING, strange.sum())
    return replace(Scan(ranges, -2.1, 4.2 / beams, 0.1, 3.3, se2.lifted(pose)), **changes)


def along_x(*ranges, **changes):
    """Beams that all go along x, in the middle of cells of 0.1."""
    pose = se2.lifted([0.05, 0.05, 0.0])
    return replace(Scan(np.array(ranges, np.float32), 0.0, 1e-9, 0.01, 20.0, pose), **changes)


def cells_of(config, scan, origin=(0.0, 0.0, 0.0)):
    indices, values = make_beams(config).evidence(scan, origin).cells()
    return dict(zip(map(tuple, indices.tolist()), values.tolist(), strict=True))


@pytest.mark.parametrize(("traversal", "update"), KINDS)
@pytest.mark.parametrize("thickness", [0.0, 0.25])
@pytest.mark.parametrize("voxel_size", [0.3, 0.02])
def test_kernels_equal_the_reference(traversal, update, thickness, voxel_size):
    config = config_of(traversal, update, voxel_size=voxel_size, thickness=thickness)
    rng = np.random.default_rng(7)
    for seed in range(3):
        clear = rng.uniform(-0.5, 4, 60).astype(np.float32) if seed == 2 else None
        since = rng.uniform(-0.5, 2, 60).astype(np.float32) if seed == 2 else None
        scan = made_scan(seed, rng.uniform([-90, -90, -3], [90, 90, 3]), clear=clear, clear_from=since)
        origin = rng.uniform(-3, 3, 3)
        ours = cells_of(config, scan, origin)
        assert len(ours) > 100
        assert ours == scan_cells(scan, config, origin)
        np.testing.assert_array_equal(make_beams(config).evidence(scan, origin).ends, scan_beams(scan, config, origin))


@pytest.mark.parametrize(("traversal", "update"), KINDS)
@pytest.mark.parametrize("slope", [1, 1 / 2, 1 / 3])
def test_lines_through_corners_of_cells_equal_the_reference(traversal, update, slope):
    config = config_of(traversal, update, voxel_size=0.5, thickness=1.0, max_range=20.0)
    for x in (0.0, 0.25, -1.0):
        for y in (0.0, 0.5):
            step = np.arctan(slope)
            length = np.float32(6 / np.cos(step))
            scan = Scan(np.full(16, length), -8 * step, step, 0.1, 30.0, se2.lifted([x, y, 0.0]))
            assert cells_of(config, scan) == scan_cells(scan, config)


@pytest.mark.parametrize(("traversal", "update"), KINDS)
@settings(max_examples=25, deadline=None)
@given(
    numbers=st.lists(st.floats(-4, 4, width=32) | st.sampled_from(NOTHING), min_size=1, max_size=12),
    pose=st.tuples(st.floats(-20, 20), st.floats(-20, 20), st.floats(-4, 4)),
)
def test_any_scan_equals_the_reference(traversal, update, numbers, pose):
    config = config_of(traversal, update, thickness=0.2)
    scan = Scan(np.array(numbers, np.float32), -1.0, 0.61, 0.0, 3.3, se2.lifted(pose))
    assert cells_of(config, scan) == scan_cells(scan, config)


@pytest.mark.parametrize("traversal", ["exact", "bresenham"])
@pytest.mark.parametrize("name", ["mirrored", "turned", "moved"])
def test_evidence_moves_with_the_world(traversal, name):
    """Mirrored, by a quarter turn, and by whole cells, so that edges of tiles are elsewhere."""
    config = config_of(traversal, "every", voxel_size=0.125)
    rng = np.random.default_rng(3)
    scan = Scan(rng.uniform(0.3, 2.9, 90).astype(np.float32), -2.0, 0.045, 0.1, 5.0, se2.lifted([0.037, 0.061, 0]))
    T, moved = {
        "mirrored": (np.diag([-1.0, 1, 1, 1]), lambda i, j: (-1 - i, j)),
        "turned": (se2.lifted([0, 0, np.pi / 2]), lambda i, j: (-1 - j, i)),
        "moved": (se2.lifted([4.625, -6.5, 0]), lambda i, j: (i + 37, j - 52)),
    }[name]
    there = cells_of(config, replace(scan, T_world_sensor=T @ scan.T_world_sensor))
    assert there == {moved(*cell): value for cell, value in cells_of(config, scan).items()}


@pytest.mark.parametrize("traversal", ["exact", "bresenham"])
def test_what_each_kind_of_beam_says(traversal):
    def row(scan, **settings):
        cells = cells_of(config_of(traversal, **settings), scan)
        assert {j for _, j in cells} <= {0}
        return [cells.get((i, 0), 0) for i in range(max((i for i, _ in cells), default=-1) + 1)]

    assert row(along_x(0.52)) == [PASS] * 5 + [HIT]
    assert row(along_x(0.52), thickness=0.2) == [PASS] * 5 + [HIT] * 3
    assert row(along_x(np.inf), max_range=0.5) == [PASS] * 6  # ends 0.05 in, in the sixth cell
    assert row(along_x(2.0), max_range=0.5) == [PASS] * 6
    assert row(along_x(np.inf, range_max=0.3)) == [PASS] * 4
    assert row(along_x(0.4, range_max=0.3)) == []  # LaserScan: beyond range_max means nothing
    for nothing in (np.nan, -np.inf, 0.0, -1.0, 0.05):
        assert row(along_x(nothing, range_min=0.06)) == []
    assert row(along_x(0.06, range_min=0.06)) == [PASS, HIT]  # `min_range` is for depth images
    assert row(along_x(np.nan, clear=np.array([0.22], np.float32))) == [PASS] * 3
    assert row(along_x(0.52, clear=np.array([0.22], np.float32))) == [PASS] * 3 + [0, 0, HIT]
    assert row(along_x(np.inf, clear=np.array([0], np.float32))) == []
    since = np.array([0.22], np.float32)
    assert row(along_x(0.52, clear_from=since)) == [0, 0, PASS, PASS, PASS, HIT]
    assert row(along_x(0.52, clear=since, clear_from=since)) == [0] * 5 + [HIT]


@pytest.mark.parametrize("traversal", ["exact", "bresenham"])
def test_once_and_every_differ_where_beams_share_cells(traversal):
    scan = along_x(0.52, 0.52, 0.82)
    once, every = (cells_of(config_of(traversal, update), scan) for update in ("once", "every"))
    assert [once[i, 0] for i in range(9)] == [PASS] * 5 + [HIT, PASS, PASS, HIT]
    assert [every[i, 0] for i in range(9)] == [3 * PASS] * 5 + [2 * HIT + PASS, PASS, PASS, HIT]


@pytest.mark.parametrize(("traversal", "update"), KINDS)
def test_the_order_of_beams_does_not_matter(traversal, update):
    scan = made_scan(4)
    back = replace(scan, ranges=scan.ranges[::-1].copy(), angle_min=scan.angles[-1], angle_step=-scan.angle_step)
    assert cells_of(config_of(traversal, update), back) == cells_of(config_of(traversal, update), scan)


def test_gaps_between_far_beams_stay_unknown():
    scan = Scan(np.full(10, 2.5, np.float32), -0.5, 0.1, 0.1, 5.0, se2.lifted([0.01, 0.01, 0]))
    cells = cells_of(config_of(voxel_size=0.02), scan)
    ring = [(i, j) for i in range(130) for j in range(-70, 70) if 110 < np.hypot(i, j) < 118 and abs(j) < 0.4 * i]
    known = np.mean([cell in cells for cell in ring])
    assert 0.05 < known < 0.5
    assert sum(value == HIT for value in cells.values()) == 10


def test_a_sensor_that_hangs_upside_down_sees_the_mirrored_scan():
    flipped = se2.lifted([0.013, 0.021, 0.3]) @ np.diag([1.0, -1, -1, 1])
    scan = made_scan(pose=(0.013, 0.021, 0.3))
    turned = replace(scan, ranges=scan.ranges[::-1].copy(), angle_min=-scan.angle_min - 59 * scan.angle_step)
    assert cells_of(config_of(), replace(turned, T_world_sensor=flipped)) == cells_of(config_of(), scan)


def test_a_sensor_that_leans_measures_shorter_ways_over_the_floor():
    lean = np.radians(60)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(lean), 0, np.sin(lean)], [0, 1, 0], [-np.sin(lean), 0, np.cos(lean)]]
    T[:2, 3] = 0.05
    cells = cells_of(config_of(), replace(along_x(2.0), T_world_sensor=T))
    assert [cell for cell, value in cells.items() if value == HIT] == [(10, 0)]


def test_memory_is_used_again_without_traces():
    beams = make_beams(config_of())
    scans = [made_scan(seed, (seed, -seed, seed)) for seed in range(4)]
    first = [
        dict(zip(map(tuple, i.tolist()), v.tolist(), strict=True))
        for i, v in (beams.evidence(s).cells() for s in scans)
    ]
    assert first == [cells_of(config_of(), scan) for scan in scans]
    assert beams.evidence(along_x(np.nan)).cells()[0].shape == (0, 2)


def test_sums_of_very_many_beams_do_not_overflow():
    scan = along_x(*[0.52] * 65536)
    cells = cells_of(config_of(update="every", **{"grid.p_occupied": 1 - 1e-15, "grid.p_free": 1e-15}), scan)
    assert cells[0, 0] == -65536 * 32767
    assert cells[5, 0] == 65536 * 32767


def test_what_cannot_be_done_is_told():
    beams = make_beams(config_of())
    with pytest.raises(FrameRefused, match="65537 beams"):
        beams.evidence(along_x(*[1.0] * 65537))
    with pytest.raises(FrameRefused, match="clear is"):
        beams.evidence(along_x(1.0, clear=np.zeros(2, np.float32)))
    with pytest.raises(FrameRefused, match="cells from the map's origin"):
        beams.evidence(made_scan(pose=(1e9, 0, 0)))
    with pytest.raises(FrameRefused, match="angles are not finite"):
        beams.evidence(replace(along_x(1.0, 1.0), angle_step=1e308))
    for T in (np.full((4, 4), np.nan), 1e9 * np.eye(4)):
        with pytest.raises(FrameRefused):
            beams.evidence(replace(along_x(1.0), T_world_sensor=T))
    with pytest.raises(ConfigError, match=r"grid; use larger cells"):
        make_beams(load_config(max_range=500.0, voxel_size=0.1))
    with pytest.raises(ConfigError, match="did you mean 'bresenham'"):
        make_beams(config_of("bresenhan"))
