# SPDX-License-Identifier: Apache-2.0
"""Claims about simulated beams and floor maps, and whether they hold."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from stereovox.evaluate.grid_align import three_states
from stereovox.evaluate.grid_scores import GridScores
from stereovox.maps import State
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.ist.drives import Place
from stereovox_lab.papers.ist.fans import Fan
from stereovox_lab.papers.ist.survey import Judged, Survey
from stereovox_lab.papers.ist.variants import MIDDLE, OURS, THEIRS

RIGHT, AREA = 0.98, 0.03
"""Least share of places on the beams with the right state; largest difference of counted cells from the areas."""
TARGET_PERCENT = 10.0
WALL_M, WAY_M = 0.04, 0.10
"""Largest median distance in metres of walls from the reference's; largest RMS error in metres of a trajectory."""
FOUND = 0.9
"""Least share of the reference's wall cells with a map wall cell within one cell."""
HIDDEN = 0.9
"""Least share of the reference's known cells behind a shut door that must be unknown to a map."""
DRAWN_ODOMETRY = "ist2019, odometry"


def numbers_of(found: Survey) -> dict[str, Any]:
    """Return maps, scores, trajectories and times."""
    slam = found.reference.slam
    return {
        "scans": len(found.recording.robot.scans),
        "frames": len(found.recording.robot.frames),
        "first_scans": len(found.recording.first.scans),
        "megabytes": found.recording.megabytes,
        "closures": slam.closures,
        "doubts": [{**doubt.as_dict(), "text": doubt.line()} for doubt in slam.doubts],
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


def fan_claims(many: Fan, few: Fan) -> list[Claim]:
    """Return the claims on Fig 3."""
    assert many.expected_free is not None
    assert many.expected_occupied is not None
    free = abs(many.free / many.expected_free - 1)
    occupied = abs(many.occupied / many.expected_occupied - 1)
    return [
        Claim(
            "700 beams: free are the cells nearer than the measurement, occupied those within the thickness behind",
            f"areas of sector and ring: {many.expected_free:,.0f} and {many.expected_occupied:,.0f} cells",
            f"{many.free:,} and {many.occupied:,} cells",
            free <= AREA and occupied <= 2 * AREA,
        ),
        Claim("700 beams: the rest is unknown", "0 known cells beyond", f"{many.beyond}", many.beyond == 0),
        Claim(
            "10 beams: free up to the object found, occupied there",
            f"at least {100 * RIGHT:.0f} % of places on the beams",
            f"{100 * few.right:.1f} %",
            few.right >= RIGHT,
        ),
    ]


def claims_of(found: Survey, place: Place | None) -> list[Claim]:
    """Return the claims on one floor; there are none for a user's own recording."""
    theirs, ours, middle = (found.judged[name] for name in (THEIRS, OURS, MIDDLE))
    told = place.error_percent if place else None
    claims = [
        Claim(
            "profile ist2019: error (Eq 7) below the report's",
            "-" if told is None else f"{told:g} %",
            _percent(theirs),
            None if told is None else theirs.scores.eq7_percent < told,
        )
    ]
    if place is None:
        return [_doubts(found, None), *claims, *(_beside(one) for one in (middle, ours))]
    claims += [_target(middle), _beside(ours), _walls(middle), _found(middle)]
    odometry = found.judged.get(DRAWN_ODOMETRY)
    if odometry is not None:
        less = theirs.scores.eq7_percent < odometry.scores.eq7_percent
        claims.append(
            Claim(
                "localisation makes the map better than odometry alone",
                "less error",
                f"{_percent(theirs)} against {_percent(odometry)}",
                less,
            )
        )
    if found.excluded:
        claims.append(_door(theirs))
    doubts = found.reference.slam.doubts
    of_reference = [_doubted(claim) for claim in claims] if doubts else claims
    return [_doubts(found, not doubts), *of_reference, *_band(ours, theirs), *_format_errors(found)]


def _doubts(found: Survey, holds: bool | None) -> Claim:
    ours = "; ".join(doubt.line() for doubt in found.reference.slam.doubts)
    return Claim("SLAM's self-check of the reference map", "no doubts", ours or "none", holds)


def _doubted(claim: Claim) -> Claim:
    """Return a claim on maps next to the reference, which is doubted: so it does not hold, whatever its figure."""
    return claim if claim.holds is None else replace(claim, holds=False, ours=f"{claim.ours}; the reference is doubted")


def _door(one: Judged) -> Claim:
    """Return whether the excluded region is the one hidden by the shut door."""
    states, known = three_states(one.laid.map), three_states(one.laid.reference) != State.UNKNOWN
    known &= one.laid.excluded
    hidden = known & (states == State.UNKNOWN)
    ours = (
        f"{hidden.sum():,} of the {known.sum():,} cells that the reference knows there; error {_percent(one)}, nothing "
        f"left out {one.with_door.eq7_percent:.1f}\u00a0%"
    )
    return Claim(
        "the region left out is what a door shut since then hides: unknown to the map",
        f"the white rectangle is made black; here at least {100 * HIDDEN:g} % of its cells",
        ours,
        bool(hidden.sum() >= HIDDEN * max(known.sum(), 1)),
    )


def update_ms(found: Survey, name: str) -> float:
    """Return median milliseconds from depth image to updated map."""
    return float(found.judged[name].made.figures["frame_ms"]["median"])


def _target(one: Judged) -> Claim:
    text = f"{one.made.variant.name} ({one.made.variant.what}): error (Eq 7)"
    return Claim(
        text, f"at most {TARGET_PERCENT:g} % (our target)", _percent(one), one.scores.eq7_percent <= TARGET_PERCENT
    )


def _beside(one: Judged) -> Claim:
    text = f"{one.made.variant.name} ({one.made.variant.what}): error (Eq 7)"
    return Claim(text, "-", _percent(one), None)


def _band(ours: Judged, theirs: Judged) -> list[Claim]:
    """Return the claims on all obstacles in a robot's way, which the lidar's reference does not contain."""
    if not (ours.of_building and theirs.of_building):
        return []
    mine, printed = (one.of_building["band"].eq7_percent for one in (ours, theirs))
    text = f"{ours.made.variant.name}: error (Eq 7) against all that stands 0.1 to 1.8 m over the building's floor"
    less = f"{ours.made.variant.name}: less of it than {theirs.made.variant.name}, which sees one height only"
    return [
        Claim(text, f"at most {TARGET_PERCENT:g} % (our target)", f"{mine:.1f}\u00a0%", mine <= TARGET_PERCENT),
        Claim(less, "less", f"{mine:.1f}\u00a0% against {printed:.1f}\u00a0%", mine < printed),
    ]


def _walls(one: Judged) -> Claim:
    there, back = one.scores.to_reference.median, one.scores.from_reference.median
    holds = there is not None and back is not None and max(there, back) <= WALL_M
    ours = "no walls" if there is None or back is None else f"{100 * there:.1f} and {100 * back:.1f} cm"
    text = f"{one.made.variant.name}: walls to the reference's walls and back, median"
    return Claim(text, f"at most {100 * WALL_M:g} cm", ours, holds)


def _found(one: Judged) -> Claim:
    """Return whether the map has the reference's walls; Eq 7 hardly shows it, because few cells are walls."""
    share = one.scores.occupied.tolerance_recall
    ours = "no walls" if share is None else f"{100 * share:.1f}\u00a0%"
    text = f"{one.made.variant.name}: the reference's wall cells that have one of the map within one cell"
    return Claim(text, f"at least {100 * FOUND:g} %", ours, share is not None and share >= FOUND)


def _format_errors(found: Survey) -> list[Claim]:
    ways = {"SLAM's way": found.reference.way_error, "AMCL's way": found.way_error}
    return [
        Claim(f"{name}, off the true one (RMS, laid on it as a whole)", f"at most {100 * WAY_M:g} cm",
              f"{100 * error.position_rms_m:.1f} cm, {error.yaw_rms_deg:.2f} degrees", error.position_rms_m <= WAY_M)
        for name, error in ways.items() if error is not None
    ]  # fmt: skip


def eq7(scores: GridScores) -> str:
    """Return the error of Eq 7 with its two parts."""
    errors = scores.errors
    parts = (errors.eq7_percent, errors.eq7_coverage_percent, errors.eq7_contradiction_percent)
    return "{:.1f}\u00a0% (coverage {:.1f}, contradiction {:.1f})".format(*parts)


def _percent(one: Judged) -> str:
    return eq7(one.scores)
