# SPDX-License-Identifier: Apache-2.0
"""Poses that are levelled by gravity stay level where loops are closed; others are bent as the loops say."""

import numpy as np
import pytest
from made_loops import bare_closer

from stereovox.config import load_config
from stereovox.correct.loops.closer import Loop
from stereovox.correct.loops.submaps import FLOOR, Match
from stereovox.errors import ConfigError
from stereovox.geometry.se3 import inverse, rotation_matrix

pytest.importorskip("gtsam")
SIDEWAYS = {"up": "-y"}


def closed(made, tilt_deg=3.0):
    """Close a loop from the first submap to the last that says that the last one leans; return how far each does."""
    before = [submap.T_map_anchor for submap in made.submaps]
    leaning = inverse(before[0]) @ before[-1]
    leaning[:3, :3] = leaning[:3, :3] @ rotation_matrix(np.radians([tilt_deg, 0, 0]))
    made.loops.append(Loop(0, len(before) - 1, Match(leaning, FLOOR, 1.0, held=True), 0.0, 0.0))
    made._solve()
    return [lean_deg(one, submap.T_map_anchor, made._up) for one, submap in zip(before, made.submaps, strict=True)]


def lean_deg(before, after, up):
    ups = before[:3, :3].T @ up, after[:3, :3].T @ up
    return np.degrees(np.linalg.norm(np.cross(*ups)))


def test_levelled_poses_stay_level():
    free, held = closed(bare_closer()), closed(bare_closer(**{"loops.upright_deg": 0.1}))
    assert len(free) > 10
    assert max(free) > 1.0
    assert max(held) < 0.2


def test_the_setting_says_how_level():
    leans = [max(closed(bare_closer(**{"loops.upright_deg": deg}))) for deg in (0.1, 0.5, 5.0)]
    assert leans[0] < leans[1] < leans[2] < max(closed(bare_closer()))


def test_up_is_that_of_the_map():
    """A world whose -y is up: the same, turned."""
    R = rotation_matrix([np.pi / 2, 0, 0])  # level z becomes -y
    assert np.allclose(R @ [0, 0, 1], [0, -1, 0])
    plain = closed(bare_closer(**{"loops.upright_deg": 0.3}))
    turned = closed(bare_closer(R, **{"loops.upright_deg": 0.3}, **SIDEWAYS))
    assert np.allclose(plain, turned, atol=1e-3)


def test_poses_are_known_to_lean_less_than_they_may_be_turned():
    free, held = bare_closer(), bare_closer(**{"loops.upright_deg": 0.1})
    for made, leaning in ((free, (0.3, 5.0)), (held, (0.0, 0.15))):
        covariance = made._graph().covariances([0], len(made.submaps) - 1)[0]
        up = made.submaps[-1].T_odom_anchor[:3, :3].T @ made._up
        across = np.linalg.svd(up[None])[2][1:]
        lean = np.degrees(np.sqrt(np.linalg.eigvalsh(across @ covariance[:3, :3] @ across.T)))
        assert leaning[0] < lean.min()
        assert lean.max() < leaning[1]
        assert np.degrees(np.sqrt(up @ covariance[:3, :3] @ up)) > 0.3  # the heading drifts


def test_a_recording_that_is_joined_keeps_its_up():
    """It came in a world of its own, whose -y is up."""
    R = rotation_matrix([np.pi / 2, 0, 0])
    one, other = bare_closer(**{"loops.upright_deg": 0.1}), bare_closer(R, **{"loops.upright_deg": 0.1}, **SIDEWAYS)
    T_one_other = np.eye(4)
    T_one_other[:3, :3] = R.T
    expected = [T_one_other @ submap.T_map_anchor for submap in other.submaps]
    count = len(one.submaps)
    between = inverse(one.submaps[0].T_map_anchor) @ expected[0]
    one.join(other, T_one_other, [Loop(0, 0, Match(between, FLOOR, 1.0, held=True), 0.0, 0.0)])
    leans = [lean_deg(T, s.T_map_anchor, one._up) for T, s in zip(expected, one.submaps[count:], strict=True)]
    assert max(leans) < 0.01
    assert max(closed(one)) < 0.2


@pytest.mark.parametrize("deg", [0, -1, 60])
def test_angles_that_are_none_are_refused(deg):
    with pytest.raises(ConfigError, match="upright_deg"):
        load_config(**{"loops.upright_deg": deg})
