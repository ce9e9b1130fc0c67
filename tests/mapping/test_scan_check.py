# SPDX-License-Identifier: Apache-2.0
"""Grids, SLAM and localisation alike refuse a mount that is not rigid; rounded ones are made exact."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.frame.validate import validate_scan, validate_upright_scan
from stereovox.geometry import se2, se3
from stereovox.localize.amcl.localise import Localiser
from stereovox.localize.slam.pipeline import Slam
from stereovox.mapper import GridMapper
from stereovox.maps.occupancy import OccupancyGrid

MOUNT = se2.lifted([0.2, -0.1, 0.3])
SCAN = Scan(np.full(40, 3.0, np.float32), -1.0, 0.05, 0.02, 8.0, np.eye(4), MOUNT, name="scan 7")
FAR = MOUNT.copy()
FAR[0, 3] = 1e9
BAD = {
    "NaN": np.full((4, 4), np.nan),
    "3x3": np.eye(3),
    "mirror": np.diag([1.0, -1, 1, 1]),
    "scale": np.diag([1.1, 1.1, 1.1, 1]),
    "no numbers": [["a"]],
    "nothing": None,
    "far": FAR,
}


@pytest.mark.parametrize(
    "check", [lambda scan: validate_scan(scan, 5e-3), lambda scan: validate_upright_scan(scan, load_config())]
)
@pytest.mark.parametrize("what", BAD)
def test_a_bad_mount_is_one_line(check, what):
    with pytest.raises(FrameRefused) as caught:
        check(replace(SCAN, T_base_sensor=BAD[what]))
    assert caught.value.reason == ("mount_too_far" if what == "far" else "mount_not_rigid")
    assert "scan 7" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mount_of_few_digits_is_made_rigid():
    off = MOUNT.copy()
    off[:3, :3] = np.round(off[:3, :3], 4)
    assert 1e-6 < se3.rigidity_error(off) < 5e-3
    assert se3.rigidity_error(validate_scan(replace(SCAN, T_base_sensor=off), 5e-3).T_base_sensor) < 1e-14
    assert np.array_equal(validate_scan(SCAN, 5e-3).T_base_sensor, MOUNT)
    with pytest.raises(FrameRefused):
        validate_scan(replace(SCAN, T_base_sensor=off), 1e-7)


@pytest.mark.parametrize("what", BAD)
def test_all_who_take_scans_refuse_it(what):
    reason = "mount_too_far" if what == "far" else "mount_not_rigid"
    bad = replace(SCAN, T_base_sensor=BAD[what])
    slam = Slam(load_config())
    slam.add(bad)
    assert slam.refused == {reason: 1}
    cells = np.zeros((40, 40), np.int8)
    cells[0] = 100
    localiser = Localiser(OccupancyGrid(cells, 0.1, (0.0, 0.0, 0.0)), load_config(), start=np.array([2.0, 2.0, 0.0]))
    with pytest.raises(FrameRefused) as caught:
        localiser.add(bad)
    assert caught.value.reason == reason
    assert GridMapper("ist2019").add(bad).refused == reason
