# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.robot_track import fit_share
from stereovox.localize.track import Track
from stereovox.maps.occupancy import OccupancyGrid

STAMPS = np.arange(1, 6) * 10**8


def room():
    """4 x 4 m, with its lower left corner at (-2, -2)."""
    cells = np.zeros((80, 80), np.int8)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    return OccupancyGrid(cells, 0.05, (-2.0, -2.0, 0.0))


def track(*correction):
    motion = np.broadcast_to(np.array(correction, float), (5, 3))
    return Track(STAMPS, motion.copy(), motion.copy())


def scans():
    angles = np.linspace(-np.pi, np.pi, 90, endpoint=False)
    ranges = 1.97 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    one = Scan(ranges.astype(np.float32), -np.pi, 2 * np.pi / 90, 0.1, 5.0, se2.lifted([0, 0, 0]))
    return [replace(one, stamp_ns=int(stamp)) for stamp in STAMPS]


def test_the_share_of_beams_that_end_where_the_map_has_something():
    assert fit_share(room(), scans(), track(0, 0, 0)) == 1
    assert fit_share(room(), scans(), track(0.2, 0, 0)) > 0.9
    off = fit_share(room(), scans(), track(0.6, 0.6, 0))
    assert off is not None
    assert off < 0.4
    assert fit_share(room(), scans(), track(90, 0, 0)) == 0


def test_beams_that_met_nothing_and_scans_with_faults_say_nothing():
    nothing = [replace(scan, ranges=np.full(90, np.inf, np.float32)) for scan in scans()]
    assert fit_share(room(), nothing, track(0, 0, 0)) is None
    mixed = [replace(scans()[0], fault="unreadable"), *scans()[1:]]
    assert fit_share(room(), mixed, track(0, 0, 0)) == pytest.approx(1)
