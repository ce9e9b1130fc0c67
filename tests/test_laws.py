# SPDX-License-Identifier: Apache-2.0
"""Laws of a map, for random frames: what a frame may change, what it must not, and what does not matter."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.frame import Reason
from stereovox.geometry.se3 import from_quaternion

SIZE, REACH = 0.25, 4.0
SLACK = 1.5 * SIZE
"""Of cells about the way of light; half the diagonal of a cell is 0.87 of its side."""
LAWS = settings(deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
"""Always the same examples, however slow the machine."""
CAMERAS = {
    "pinhole": sv.PinholeCamera(12, 9, 10.0, 10.0, 5.5, 4.0, 0.2),
    "narrow": sv.PinholeCamera(5, 4, 60.0, 50.0, 8.0, 1.0, 0.2),
    "spherical": SphericalCamera.from_field_of_view(14, 8, 160.0, 120.0, 0.2),
    "cylindrical": CylindricalCamera.from_field_of_view(10, 8, 110.0, 100.0, 0.2),
}
INTEGRATORS = {
    "projective": {},
    "every": {"integrator": "ray", "ray.update": "every"},
    "once": {"integrator": "ray", "ray.update": "once"},
    "line": {"integrator": "line"},
}
NO_VALUE = [Reason.UNMATCHED, Reason.TOO_NEAR, Reason.MASKED, Reason.UNKNOWN]
FOLLOWING = {"window.size": (14, 14, 14), "window.trigger": 0.5}


def made_frame(seed, camera, share=0.6, patches=True):
    """A slanted wall of which a share has no value, in patches, for reasons the source tells; some of it far."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = np.clip(rng.uniform(0.6, 3.4) + rng.normal() * 0.1 * u + rng.normal() * 0.1 * v, 0.4, 3.8)
    shape = (4, 4) if patches else depth.shape
    what = rng.choice([0, Reason.TOO_FAR, *NO_VALUE], shape, p=[0.8 - share, 0.2, *[share / 4] * 4])
    reason = what[v % 4, u % 4] if not patches else what[4 * v // camera.height, 4 * u // camera.width]
    depth[reason == Reason.TOO_FAR] = 0  # a depth would contradict it
    turn = rng.normal(size=4)
    T = from_quaternion(rng.uniform(-0.4, 0.4, 3), turn)
    return sv.Frame(depth.astype(np.float32), camera, T, reason=reason.astype(np.uint8))


def seen_by(frame, centres, slack):
    """Tell which points (N, 3) lie within `slack` metres of the way of light that some pixel has seen to its end.

    The plain reference: no grid, no projection, no sensor model. A pixel with a value sees up to it, one that is told
    to be too far up to the maximum range, all others nothing. A pixel is as wide as its neighbours are away.
    """
    columns, rows = frame.camera.rays()
    ray = np.empty((frame.camera.height, frame.camera.width, 3))
    ray[..., 0], ray[..., 1:] = columns, rows[:, None]
    reach = np.select([frame.reason == 0, frame.reason == Reason.TOO_FAR], [frame.depth, REACH], 0.0)
    ray, reach = ray.reshape(-1, 3), reach.ravel()
    steps = [np.abs(np.diff(columns)).max(), np.abs(np.diff(rows, axis=0)).max()]
    ray, reach = ray[reach > 0], reach[reach > 0]
    local = (centres - frame.T_world_sensor[:3, 3]) @ frame.T_world_sensor[:3, :3]
    along = np.clip(local @ ray.T / (ray * ray).sum(axis=1), 0, reach)
    away = np.linalg.norm(local[:, None] - along[..., None] * ray[None], axis=2)
    return (away <= slack + along * np.hypot(*steps)).any(axis=1)


def log_odds_of(voxel_map):
    """Cells by index, and the log-odds of each."""
    cells, values = voxel_map.cells()
    return dict(zip(map(tuple, cells.tolist()), values.tolist(), strict=True))


def mapper_of(**more):
    return sv.Mapper(voxel_size=SIZE, max_range=REACH, **{"depth.denoise": False, **more})


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(LAWS, max_examples=8)
@given(seed=st.integers(0, 2**31), cell=st.sampled_from(["int16", "int8", "uint8"]), window=st.booleans())
def test_only_what_was_seen_changes(integrator, camera, seed, cell, window):
    """Pixels that are unmatched, too near, masked or unknown change nothing; all of a frame lies where it looked."""
    mapper = mapper_of(**INTEGRATORS[integrator], **(FOLLOWING if window else {}), **{"map.cell": cell})
    lowest = mapper.config.map.log_odds_min
    for number in range(3):
        frame = made_frame(seed + number, CAMERAS[camera])
        before = log_odds_of(mapper.map)
        report = mapper.add(frame)
        after = log_odds_of(mapper.map)
        changed = np.array([cell for cell in after if after[cell] != before.get(cell)]).reshape(-1, 3)
        assert report.refused in (None, "no_valid_depth")  # frames without stamps may be anywhere
        assert report.cells >= len(changed) * (report.refused is None)
        assert (not len(changed)) if report.refused else seen_by(frame, mapper.map.centers(changed), SLACK).all()
        assert window or before.keys() <= after.keys()
        assert all(lowest - 0.01 <= value <= 3.51 for value in after.values())


@pytest.mark.parametrize("camera", ["pinhole", "spherical", "cylindrical"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("why", NO_VALUE)
def test_a_wall_stays_whatever_hides_it(integrator, camera, why):
    """However often a frame is seen that has no value but for one corner, the rest of the wall stays as it was."""
    mapper, camera = mapper_of(**INTEGRATORS[integrator]), CAMERAS[camera]
    frame = sv.Frame(np.full((camera.height, camera.width), 1.5, np.float32), camera, np.eye(4))
    for _ in range(5):
        mapper.add(replace(frame, reason=np.zeros(frame.depth.shape, np.uint8)))
    before = log_odds_of(mapper.map)
    reason = np.full(frame.depth.shape, why, np.uint8)
    reason[:2, :2] = Reason.TOO_FAR
    depth = np.where(reason == Reason.TOO_FAR, 0, np.float32(3.9))
    blind = replace(frame, depth=depth.astype(np.float32), reason=reason)
    for _ in range(5):
        assert mapper.add(blind).refused is None
    after = log_odds_of(mapper.map)
    lowered = np.array([cell for cell, value in before.items() if after[cell] < value]).reshape(-1, 3)
    assert seen_by(blind, mapper.map.centers(lowered), SLACK).all()
    assert 0 < len(lowered) < 0.7 * len(before)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(LAWS, max_examples=10)
@given(seed=st.integers(0, 2**31), camera=st.sampled_from(sorted(CAMERAS)))
def test_the_order_of_frames_does_not_matter_before_the_clamp(integrator, seed, camera):
    wide = {"map.log_odds_min": -30, "map.log_odds_max": 30, "trust.max_disagreement": 1}  # they contradict each other
    frames = [made_frame(seed + number, CAMERAS[camera], patches=False) for number in range(3)]
    maps = []
    for order in ((0, 1, 2), (2, 0, 1)):
        mapper = mapper_of(**INTEGRATORS[integrator], **wide)
        for number in order:
            assert mapper.add(frames[number]).refused in (None, "no_valid_depth")
        maps.append(mapper.map.storage.blocks())
    assert all((a == b).all() for a, b in zip(*maps, strict=True))


@settings(LAWS, max_examples=10)
@given(seed=st.integers(0, 2**31), integrator=st.sampled_from(sorted(INTEGRATORS)))
def test_a_window_and_threads_change_no_cell_within(seed, integrator):
    plain, rolling = mapper_of(**INTEGRATORS[integrator]), mapper_of(threads=2, **INTEGRATORS[integrator], **FOLLOWING)
    for number in range(3):
        for mapper in (plain, rolling):
            assert mapper.add(made_frame(seed + number, CAMERAS["pinhole"])).refused in (None, "no_valid_depth")
    assert log_odds_of(plain.map) == log_odds_of(rolling.map)


@settings(LAWS, max_examples=25)
@given(
    seed=st.integers(0, 2**31),
    traversal=st.sampled_from(["exact", "bresenham"]),
    way=st.sampled_from(["once", "every"]),
)
def test_beams_change_only_what_they_passed(seed, traversal, way):
    """NaN and -inf say nothing, +inf clears to the maximum range, a hit clears up to itself."""
    rng = np.random.default_rng(seed)
    mapper = sv.GridMapper(voxel_size=SIZE, max_range=REACH, **{"grid.traversal": traversal, "grid.update": way})
    ranges = rng.uniform(0.2, 5.5, 24)
    ranges[rng.random(24) < 0.7] = rng.choice([np.nan, -np.inf, np.inf, 0.0, -1.0, 9.0])
    ranges[0] = 1.0
    pose = from_quaternion([*rng.uniform(-1, 1, 2), 0], [0, 0, *rng.normal(size=2)])
    scan = sv.Scan(ranges.astype(np.float32), -np.pi, np.pi / 12, 0.1, 6.0, pose)
    assert mapper.add(scan).refused is None
    reach = np.where((ranges >= 0.1) & (ranges <= 6), np.minimum(ranges, REACH), np.where(ranges == np.inf, REACH, 0))
    directions = pose[:2, :2] @ [np.cos(scan.angles), np.sin(scan.angles)]
    centres = (mapper.map.cells()[0] + 0.5) * SIZE - pose[:2, 3]
    along = np.clip(centres @ directions, 0, reach)
    away = np.linalg.norm(centres[:, None] - along[..., None] * directions.T[None], axis=2)
    assert (away <= 1.1 * SIZE)[:, reach > 0].any(axis=1).all()
    assert len(centres)
