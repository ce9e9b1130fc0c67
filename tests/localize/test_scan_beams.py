# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.frame.validate import validate_scan
from stereovox.geometry.se3 import rotation_matrix
from stereovox.localize.track import beams_of

MANY = np.array([np.nan, -np.inf, 0.01, 0.0, -1.0, 1.0, 2.0, 4.0, 5.0, np.inf], np.float32)


def scan(ranges=MANY, **changes):
    return replace(Scan(np.asarray(ranges, np.float32), -0.5, 0.1, 0.02, 4.0, np.eye(4)), **changes)


def test_beams_without_a_value_say_nothing():
    beams = beams_of(scan())
    assert beams.ranges.tolist() == [1, 2, 4, 4, 4]
    assert beams.at_max.tolist() == [False, False, True, True, True]
    assert np.allclose(np.arctan2(*beams.directions.T[::-1]), scan().angles[5:])
    assert beams_of(scan(), max_range=1.5).ranges.tolist() == [1, 1.5, 1.5, 1.5, 1.5]
    assert beams_of(scan(), max_range=9.0).range_max == 4


def test_the_mount_is_honoured():
    over = np.eye(4)  # hangs upside down from the ceiling, turned: what is left of it is right
    over[:3, :3] = rotation_matrix([0, 0, 0.4]) @ rotation_matrix([np.pi, 0, 0])
    over[:3, 3] = 0.3, -0.1, 2.0
    seen = scan(T_base_sensor=over)
    across, ranges = seen.angles[5:7], MANY[5:7]
    expected = np.column_stack([ranges * np.cos(across), ranges * np.sin(across), [0, 0], [1, 1]]) @ over.T
    assert np.allclose(beams_of(seen).ends[:2], expected[:, :2])
    tilted = np.eye(4)
    tilted[:3, :3] = rotation_matrix([0, 0.5, 0])
    ahead = beams_of(scan([2.0], angle_min=0.0, T_base_sensor=tilted))
    assert np.allclose(ahead.ends, [[2 * np.cos(0.5), 0]])


def test_few_beams_are_spread_evenly():
    beams = beams_of(scan(np.linspace(1, 5, 401), angle_step=0.01))
    assert np.allclose(np.diff(beams.some(5).ranges[:3]), 1, atol=0.02)
    assert len(beams.some(5).ranges) == 5
    hits = beams.some(7, hits_only=True)
    assert len(hits.ranges) == 7
    assert not hits.at_max.any()
    assert len(beams.some(10_000).ranges) == 401


NOT_RIGID = np.diag([1.0, 1, 1.2, 1])
NOWHERE = np.full((4, 4), np.nan)


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("unreadable", {"fault": "unreadable"}),
        ("bad_shape", {"ranges": np.zeros((2, 3), np.float32)}),
        ("bad_shape", {"ranges": np.zeros(0, np.float32)}),
        ("bad_dtype", {"ranges": np.ones(5, int)}),
        ("bad_scan", {"angle_step": np.nan}),
        ("bad_scan", {"range_max": np.inf}),
        ("bad_scan", {"range_max": 0.0}),
        ("pose_not_finite", {"T_world_sensor": NOWHERE}),
        ("mount_not_rigid", {"T_base_sensor": NOWHERE}),
        ("pose_not_rigid", {"T_world_sensor": NOT_RIGID}),
        ("pose_not_rigid", {"T_world_sensor": np.eye(3)}),
        ("no_valid_range", {"ranges": np.full(5, np.nan, np.float32)}),
    ],
)
def test_what_cannot_be_trusted_is_refused(reason, changes):
    with pytest.raises(FrameRefused) as caught:
        beams_of(validate_scan(replace(scan(name="scan 7"), **changes), 5e-3))
    assert caught.value.reason == reason
    assert "\n" not in str(caught.value)
    assert "scan 7" in str(caught.value)


def test_a_limit_makes_a_lidar_without_one_usable():
    assert beams_of(scan(range_max=np.inf), max_range=6.0).range_max == 6
