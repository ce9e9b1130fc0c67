# SPDX-License-Identifier: Apache-2.0
"""The picture of coverage: a line for each flight, their median, and a cross where one collided."""

import numpy as np

from stereovox.view.evaluation import coverage_figure


def flight(scene, coverage, collided=None):
    return {"scene": scene, "coverage": coverage, "collided_s": collided}


def test_lines_medians_and_crosses():
    flights = [
        flight("a", [[0, 0], [10, 0.4]]),
        flight("a", [[0, 0], [10, 0.6], [20, 0.8]]),
        flight("a", [[0, 0], [4, 0.2]], collided=4),
        flight("b", [[0, 0], [10, 0.9]]),
    ]
    left, right = coverage_figure(flights).axes
    assert [len(axis.lines) for axis in (left, right)] == [5, 2]
    assert [axis.get_title(loc="left") for axis in (left, right)] == ["a, 3 flights", "b, 1 flights"]
    crosses = [line for line in left.lines if line.get_marker() == "x"]
    assert np.array_equal(crosses[0].get_xydata(), [[4, 0.2]])
    median = left.lines[-1].get_xydata()
    assert median[-1].tolist() == [20, 0.4]  # flights that ended keep their last share
