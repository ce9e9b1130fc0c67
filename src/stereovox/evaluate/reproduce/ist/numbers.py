# SPDX-License-Identifier: Apache-2.0
"""All that was measured on one floor, fit for JSON."""

from __future__ import annotations

from typing import Any

from stereovox.evaluate.reproduce.ist.survey import Survey


def numbers_of(found: Survey) -> dict[str, Any]:
    """Return maps, scores, ways and times."""
    slam = found.reference.slam
    return {
        "scans": len(found.recording.robot.scans),
        "frames": len(found.recording.robot.frames),
        "first_scans": len(found.recording.first.scans),
        "megabytes": found.recording.megabytes,
        "closures": slam.closures,
        "slam_s": found.reference.seconds,
        "amcl_s": found.localised_s,
        "excluded": [list(one) for one in found.excluded],
        "slam_way": found.reference.way_error.as_dict() if found.reference.way_error else None,
        "amcl_way": found.way_error.as_dict() if found.way_error else None,
        "reference_of_building": found.of_building.as_dict() if found.of_building else None,
        "maps": {
            name: {
                "what": one.made.variant.what,
                "figures": one.made.figures,
                "scores": one.scores.as_dict(),
                "nothing_excluded": one.with_door.as_dict(),
                "of_building": {heights: scores.as_dict() for heights, scores in one.of_building.items()},
            }
            for name, one in found.judged.items()
        },
    }
