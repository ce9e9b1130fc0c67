# SPDX-License-Identifier: Apache-2.0
"""Fixes of a GNSS receiver in a bag become metres."""

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker

from stereovox.errors import SourceError
from stereovox.sources.bags.fixes import in_metres, read_fixes

HERE = (47.3769, 8.5417, 408.0)
NAN = float("nan")


def bag(path, fixes, topics=("/fix",)):
    """Write fixes (status, latitude, longitude, height) a second apart, the later ones first."""
    with RobotBagMaker(path) as made:
        for topic in topics:
            for n, (status, latitude, longitude, altitude) in reversed(list(enumerate(fixes))):
                made.fix(START_NS + n * 1000 * MS, latitude, longitude, altitude, status, topic)
    return str(made.path)


@pytest.mark.parametrize(
    ("latitude", "north", "east"),
    [
        (0, 110.574, 111.320),
        (15, 110.649, 107.551),
        (30, 110.852, 96.486),
        (45, 111.132, 78.847),
        (60, 111.412, 55.800),
    ],
)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_degree_is_as_long_as_tables_say(latitude, north, east, side):
    """Lengths of a degree in km, as printed in atlases (WGS 84)."""
    step, at = 1e-3, side * latitude
    places = in_metres([(at, 179.9, 0), (at + step, 179.9, 0), (at, 179.9 + step, 0), (at, 179.9, 7)])
    expected = [[0, 0, 0], [0, north, 0], [east, 0, 0], [0, 0, 7]]
    np.testing.assert_allclose(places, expected, atol=1.5e-3)


@pytest.mark.parametrize("name", ["walk.bag", "walk.db3"])
def test_fixes_of_a_bag(tmp_path, name):
    north = HERE[0] + 1e-4
    fixes = [(0, *HERE), (-1, north, *HERE[1:]), (2, *HERE[:2], NAN), (0, 123.0, 0, 0), (1, north, HERE[1], 410.0)]
    stamps, places = read_fixes(bag(tmp_path / name, fixes))
    assert (stamps - START_NS).tolist() == [0, 4_000_000_000]
    np.testing.assert_allclose(places, [[0, 0, 0], [0, 11.118, 2]], atol=2e-3)


def test_several_receivers_must_be_told_apart(tmp_path):
    path = bag(tmp_path / "walk.bag", [(0, *HERE)], ("/front/fix", "/rear/fix"))
    with pytest.raises(SourceError, match=r"\?topic=/front/fix or \?topic=/rear/fix"):
        read_fixes(path)
    assert len(read_fixes(f"{path}?topic=/rear/fix")[0]) == 1
    with pytest.raises(SourceError, match=r"no topic /rear/fxi .*did you mean '/rear/fix'"):
        read_fixes(f"{path}?topic=/rear/fxi")


def test_bags_without_fixes_are_refused(tmp_path):
    with pytest.raises(SourceError, match="has no fix with latitude"):
        read_fixes(bag(tmp_path / "lost.bag", [(-1, *HERE)]))
    with RobotBagMaker(tmp_path / "none.bag") as made:
        made.tf(START_NS, "map", "body", [0, 0, 0, 0, 0, 0, 1])
    with pytest.raises(SourceError, match="holds no sensor_msgs/NavSatFix"):
        read_fixes(str(made.path))
