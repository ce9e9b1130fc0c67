# SPDX-License-Identifier: Apache-2.0
"""Chapters of IST 2019: simulated beams, one chapter per floor, and the table of times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stereovox.evaluate.grid_scores import GridScores
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.view.figures import title
from stereovox.view.grid import binary_png, difference_png, draw_grid, plan
from stereovox_lab.papers.chapter import Chapter, Claim, Sheet, Shown
from stereovox_lab.papers.ist.claims import claims_of, eq7, fan_claims, numbers_of, update_ms
from stereovox_lab.papers.ist.drives import Place
from stereovox_lab.papers.ist.fans import FEW, FIELD_DEG, MANY, UPDATES, Fan
from stereovox_lab.papers.ist.publish import Published
from stereovox_lab.papers.ist.survey import Judged, Survey
from stereovox_lab.papers.ist.variants import OURS, THEIRS
from stereovox_lab.papers.pictures import figure_of, png

HEIGHTS = {
    "lidar": "slice at the lidar's height",
    "band": "0.1 to 1.8 m over the floor",
    "above": "the same, with table tops",
}
MAP_DPI = 75
ERROR_HEADS = ("error, Eq 7 [%]", "of it coverage", "of it contradiction")
EQ7 = (
    "Error: IST 2019, Eq 7: cells whose state (unknown, free, occupied) differs, over the free and occupied cells of "
    "the reference. It is the sum of two things: coverage, cells that only one of the maps knows, and contradiction, "
    "cells with opposite states in both. A wall displaced by one cell of 2 cm counts twice in it, "
    "and so does every cell of a wall that is drawn thicker; walls within one cell and the metres between walls "
    "forgive that. Maps and reference have one frame, that of the localisation; nothing was aligned afterwards."
)
POSES = (
    "Odometry: as the Pioneer's wheels report it, without localisation. True poses: of the simulation, moved as a "
    "whole to the reference's frame; what is left is not due to localisation."
)
BAND = (
    "The lidar, 22.5 cm over the floor, sees a table's legs and nothing of its top, of a 20 cm high carton, or a panel "
    "on the wall. The profile default maps all that stands between 0.1 and 1.8 m. That is right, and an error in Eq 7 "
    "all the same, whose reference does not know it: the table's area is missed. So each map is compared with the "
    "simulated building itself as well: its slice at the lidar's height, and the band."
)
LIMITS = (
    "What keeps the reference from being the truth: a lidar's noise of 1 % (at least 1 cm) a reading and the few "
    "centimetres of SLAM's way, in cells of 2 cm. Beyond that the report's own reasons count here too: a camera of 57 "
    "degrees sees less than a lidar of 240 on the same way, here in narrow places behind doors and furniture."
)
GROWS = "The map has no frame to run out of: tiles are made where a scan says something (the report's future work)."


def maps_sheet(found: Survey) -> Sheet:
    """Return each map's scores against the reference."""
    heads = ("map", *ERROR_HEADS, "walls IoU", "within 1 cell", "free IoU", "known [%]",
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
    """Return the parts of each map's error."""
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
    """Return scores against the simulated building; none for a user's own recording."""
    if found.of_building is None:
        return []
    heads = ("map", "building", *ERROR_HEADS, "walls IoU", "within 1 cell", "free IoU", "known [%]",
             "walls off, median [cm]", "95 % [cm]")  # fmt: skip
    rows = [("reference, by lidar", HEIGHTS["lidar"], *_row(found.of_building))]
    for name, one in found.judged.items():
        rows += [(name, HEIGHTS[key], *_row(scores)) for key, scores in one.of_building.items()]
    return [Sheet("Maps against the building itself", heads, rows)]


def poses_sheet(found: Survey) -> list[Sheet]:
    """Return the errors of the trajectories; none without truth."""
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
        f"{scores.errors.eq7_coverage_percent:.1f}",
        f"{scores.errors.eq7_contradiction_percent:.1f}",
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


def fans_png(fans: Sequence[Fan]) -> bytes:
    """Return the maps made by synthetic beams, side by side, with counted cells (after Fig 3)."""
    figure = figure_of(8.0)
    for axis, fan in zip(figure.subplots(1, len(fans), squeeze=False)[0], fans, strict=True):
        _fan(axis, fan)
    return png(figure)


def floor_png(grid: OccupancyGrid, heading: str, track: ArrayLike | None = None) -> bytes:
    """Return a floor's map with the robot's trajectory."""
    return png(draw_grid(grid, heading, track), MAP_DPI)


def _fan(axis: Any, fan: Fan) -> None:
    plan(axis, fan.grid)
    reach = float(fan.scan.ranges.max())
    axis.set(xlim=(-0.3, reach + 0.5), ylim=(-0.56 * reach, 0.56 * reach))
    axis.plot(0, 0, "^", color="#d1603d", markersize=9)
    ends = fan.scan.ranges[:, None] * np.column_stack([np.cos(fan.scan.angles), np.sin(fan.scan.angles)])
    if len(ends) < 50:
        axis.plot(*ends.T, ".", color="#d1603d", markersize=4)
    title(axis, f"{len(ends)} beams: {fan.free:,} cells free, {fan.occupied:,} occupied")


def fans_chapter(many: Fan, few: Fan) -> Chapter:
    """Return Fig 3."""
    shown = Shown(
        "Fig 3",
        "Left, 700 beams that all measure the same distance: free up to it, occupied in the thickness behind, unknown "
        "elsewhere. Right, ten beams with distances of their own.",
        f"The same by the profile ist2019, {UPDATES} equal scans into an empty map.",
        fans_png([many, few]),
    )
    method = (
        f"{MANY} beams over {FIELD_DEG:g} degrees, then {len(FEW)}, into an empty grid of 2 cm cells. The report does "
        "not give the distances."
    )
    told = {"many": many, "few": few}
    numbers = {
        name: {"beams": len(fan.scan.ranges), "free": fan.free, "occupied": fan.occupied, "right": fan.right,
               "expected_free": fan.expected_free, "expected_occupied": fan.expected_occupied, "ms": fan.ms}
        for name, fan in told.items()
    }  # fmt: skip
    return Chapter("simulation", "Simulations", method, fan_claims(many, few), [shown], numbers=numbers)


def floor_chapter(found: Survey, place: Place | None) -> Chapter:
    """Return the chapter on one floor. place: the report's description; None for a user's own recording."""
    name = found.recording.name
    title = place.title if place else f"Your recording: {name}"
    said = place.figures if place else ("Reference map", "Map by the depth camera", "Difference")
    return Chapter(
        name if place else "own",
        title,
        _method(found, place),
        claims_of(found, place),
        list(_shown(found, said, place is not None)),
        [maps_sheet(found), cells_sheet(found), *building_sheet(found), *poses_sheet(found)],
        [EQ7, POSES, BAND, LIMITS, GROWS] if place else [EQ7, GROWS],
        numbers_of(found),
    )


def time_chapter(many: Fan, surveys: Sequence[tuple[Place | None, Survey]], published: Published | None) -> Chapter:
    """Return Table I."""
    rows: list[tuple[str, ...]] = [("Simulation", "0.031", f"{many.ms['median'] / 1e3:.5f}", "-")]
    for place, found in surveys:
        ms = [f"{update_ms(found, name) / 1e3:.5f}" for name in (THEIRS, OURS)]
        rows.append((place.title if place else found.recording.name, f"{place.update_s:.3f}" if place else "-", *ms))
    heads = ("dataset", "report", "ours, ist2019", "ours, default")
    claims = [_update(place, found) for place, found in surveys if place]
    if published:
        whole = published.picture + published.message
        claims.append(
            Claim(
                f"publishing a map of {published.side} x {published.side} cells",
                "15 s",
                f"{whole:.2f} s: {published.picture:.3f} s for the picture, {published.message:.2f} s into a bag",
                None,
            )
        )
    method = (
        "Median seconds from depth image (simulation: scan) to updated map, without reading the file and without "
        "publishing, on this machine; the report used a 2.8 GHz Core i7 and Python. They are figures and no claims."
    )
    numbers = {"rows": rows, "publish": vars(published) if published else None}
    sheet = Sheet("Table I, seconds an update", heads, rows)
    return Chapter("table1", "Table I: time", method, claims, sheets=[sheet], numbers=numbers)


def _update(place: Place, found: Survey) -> Claim:
    ms = update_ms(found, THEIRS)
    return Claim(f"{place.title}: an update", f"{place.update_s:.3f} s", f"{ms / 1e3:.4f} s", None)


def _method(found: Survey, place: Place | None) -> str:
    robot, first = found.recording.robot, found.recording.first
    where = "A drive through a simulated floor, recorded as a ROS 1 bag of " if place else "A recording: "
    size = f"{found.recording.megabytes:.0f} MB, " if found.recording.megabytes else ""
    other = "of an earlier drive " if first is not robot else "of the same drive "
    door = "; since then a door was shut, and what lies behind it does not count" if found.excluded else ""
    return (
        f"{where}{size}{len(robot.scans)} scans and {len(robot.frames)} depth images. Reference map: SLAM from "
        f"{len(first.scans)} scans {other}({found.reference.slam.closures} loops closed), written as map_server files "
        f"and read back. Localisation in it by AMCL, mapping along that path{door}."
    )


def _shown(found: Survey, places: tuple[str, str, str], simulated: bool) -> list[Shown]:
    ours, theirs = found.judged[OURS], found.judged[THEIRS]
    reference, mapped, difference = places
    said = (
        "The reference map, by gmapping and the laser range finder.",
        "The map by the Kinect.",
        "The binary difference: white where a cell's state differs from the reference's.",
    )
    first, second, third = said if simulated else ("", "", "")
    ways = found.reference.slam.track.pose_map_base, found.track.pose_map_base
    pictures = (
        floor_png(found.reference.grid, "Reference map, by lidar and SLAM", ways[0]),
        floor_png(theirs.made.grid, "Map by the depth camera, profile ist2019", ways[1]),
        floor_png(ours.made.grid, "Map by the depth camera, profile default", ways[1]),
    )
    return [
        Shown(reference, first, "By our SLAM, with the robot's way.", pictures[0]),
        Shown(mapped, second, f"Along the path that AMCL found: {theirs.made.variant.what}.", pictures[1]),
        Shown(difference, third, f"Profile ist2019: {_percent(theirs)} of the cells.", binary_png(theirs.laid)),
        Shown("How they differ, ist2019", "", _percent(theirs), difference_png(theirs.laid)),
        Shown("Map under default", "", f"The same path: {ours.made.variant.what}.", pictures[2]),
        Shown("How they differ, default", "", _percent(ours), difference_png(ours.laid)),
    ]


def _percent(one: Judged) -> str:
    return f"Eq 7: {eq7(one.scores)}"
