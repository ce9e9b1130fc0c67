# SPDX-License-Identifier: Apache-2.0
"""Tables on the maps of one floor."""

from __future__ import annotations

from stereovox.evaluate.grid_scores import GridScores
from stereovox.evaluate.reproduce.chapter import Sheet
from stereovox.evaluate.reproduce.ist.survey import Survey

HEIGHTS = {
    "lidar": "slice at the lidar's height",
    "band": "0.1 to 1.8 m over the floor",
    "above": "the same, with table tops",
}


def maps_sheet(found: Survey) -> Sheet:
    """Return each map's scores against the reference."""
    heads = ("map", "error, Eq 7 [%]", "walls IoU", "within 1 cell", "free IoU", "known [%]",
             "walls off, median [cm]", "95 % [cm]", "and back [cm]", "ms an image")  # fmt: skip
    rows = [
        (
            name,
            *_row(one.scores),
            _cm(one.scores.from_reference.median),
            f"{one.made.figures['frame_ms']['median']:.2f}",
        )
        for name, one in found.judged.items()
    ]
    return Sheet("Maps against the reference", heads, rows)


def cells_sheet(found: Survey) -> Sheet:
    """Return what each map's error is made of."""
    heads = (
        "map",
        "missed",
        "wrongly occupied",
        "wrongly free",
        "extra",
        "forgiven",
        "error, nothing excluded [%]",
        "how",
    )
    rows = []
    for name, one in found.judged.items():
        errors = one.scores.errors
        counts = (errors.missed, errors.wrongly_occupied, errors.wrongly_free, errors.extra, errors.forgiven)
        rows.append((name, *(f"{n:,}" for n in counts), f"{one.with_door.eq7_percent:.1f}", one.made.variant.what))
    return Sheet("What the errors are made of, cells", heads, rows)


def building_sheet(found: Survey) -> list[Sheet]:
    """Return scores against the simulated building; none for somebody's own recording."""
    if found.of_building is None:
        return []
    heads = ("map", "building", "error, Eq 7 [%]", "walls IoU", "within 1 cell", "free IoU", "known [%]",
             "walls off, median [cm]", "95 % [cm]")  # fmt: skip
    rows = [("reference, by lidar", HEIGHTS["lidar"], *_row(found.of_building))]
    for name, one in found.judged.items():
        rows += [(name, HEIGHTS[key], *_row(scores)) for key, scores in one.of_building.items()]
    return [Sheet("Maps against the building itself", heads, rows)]


def poses_sheet(found: Survey) -> list[Sheet]:
    """Return how far the ways are off; none without truth."""
    heads = ("way", "off, RMS [cm]", "largest [cm]", "turn, RMS [deg]", "in 1 m of way [cm]", "seconds")
    ways = {
        "SLAM, first drive": (found.reference.way_error, found.reference.seconds),
        "AMCL, mapped drive": (found.way_error, found.localised_s),
    }
    rows = [
        (name, _cm(one.position_rms_m), _cm(one.position_max_m), f"{one.yaw_rms_deg:.2f}", _cm(one.step_rms_m),
         f"{seconds:.1f}")
        for name, (one, seconds) in ways.items() if one is not None
    ]  # fmt: skip
    return [Sheet("Ways, laid on the true ones", heads, rows)] if rows else []


def _row(scores: GridScores) -> tuple[str, ...]:
    return (
        f"{scores.eq7_percent:.1f}",
        _share(scores.occupied.iou),
        _share(scores.occupied.iou_tolerant),
        _share(scores.free_iou),
        _share(scores.coverage, 100, 1),
        _cm(scores.to_reference.median),
        _cm(scores.to_reference.p95),
    )


def _share(value: float | None, times: float = 1, digits: int = 3) -> str:
    return "-" if value is None else f"{times * value:.{digits}f}"


def _cm(metres: float | None) -> str:
    return _share(metres, 100, 1)
