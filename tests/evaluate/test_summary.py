# SPDX-License-Identifier: Apache-2.0
"""What a summary of a run says of its times."""

import stereovox as sv
from stereovox.evaluate.metrics import summarise
from stereovox.frame import UpdateReport


def test_the_time_to_match_is_that_of_pairs_also_beside_clouds():
    pair, cloud = UpdateReport(1.0, 2.0, 3, match_ms=50.0), UpdateReport(1.0, 2.0, 3)
    voxel_map = sv.Mapper(voxel_size=0.2).map
    assert summarise(voxel_map, [pair, cloud, cloud, pair, cloud])["match_ms"]["median"] == 50
    assert summarise(voxel_map, [cloud, cloud])["match_ms"] == {"median": 0, "p90": 0, "p99": 0, "max": 0}
