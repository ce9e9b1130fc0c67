# SPDX-License-Identifier: Apache-2.0
"""The experiments of IST 2019 told: simulated beams, one chapter a floor, and the table of times."""

from __future__ import annotations

from collections.abc import Sequence

from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown
from stereovox.evaluate.reproduce.ist.claims import claims_of, fan_claims, update_ms
from stereovox.evaluate.reproduce.ist.drives import Place
from stereovox.evaluate.reproduce.ist.fans import FEW, FIELD_DEG, MANY, UPDATES, Fan
from stereovox.evaluate.reproduce.ist.numbers import numbers_of
from stereovox.evaluate.reproduce.ist.publish import Published
from stereovox.evaluate.reproduce.ist.sheets import building_sheet, cells_sheet, maps_sheet, poses_sheet
from stereovox.evaluate.reproduce.ist.survey import Judged, Survey
from stereovox.evaluate.reproduce.ist.variants import OURS, THEIRS
from stereovox.view.grid_difference import binary_png, difference_png
from stereovox.view.reproduce.ist import fans_png, floor_png

EQ7 = (
    "Error: IST 2019, Eq 7: cells whose state (unknown, free, occupied) differs, over the free and occupied cells of "
    "the reference. A wall that stands one cell of 2 cm aside counts twice in it, and so does every cell of a wall "
    "that is drawn thicker; walls within one cell and the metres between walls forgive that. Maps and reference have "
    "one frame, that of the localisation; nothing was aligned afterwards."
)
POSES = (
    "Odometry: as the Pioneer's wheels tell it, without localisation. True poses: those of the simulation, moved as a "
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
        "not tell the distances."
    )
    told = {"many": many, "few": few}
    numbers = {
        name: {"beams": len(fan.scan.ranges), "free": fan.free, "occupied": fan.occupied, "right": fan.right,
               "expected_free": fan.expected_free, "expected_occupied": fan.expected_occupied, "ms": fan.ms}
        for name, fan in told.items()
    }  # fmt: skip
    return Chapter("simulation", "Simulations", method, fan_claims(many, few), [shown], numbers=numbers)


def floor_chapter(found: Survey, place: Place | None) -> Chapter:
    """Return all about one floor. place: what the report says of it; None for a recording of somebody's own."""
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
    claims = [_quicker(place, found) for place, found in surveys if place]
    if published:
        whole = published.picture + published.message
        claims.append(
            Claim(
                f"publishing a map of {published.side} x {published.side} cells takes less than in the report",
                "15 s",
                f"{whole:.2f} s: {published.picture:.3f} s for the picture, {published.message:.2f} s into a bag",
                whole < 15,
            )
        )
    method = (
        "Median seconds from depth image (simulation: scan) to updated map, without reading the file and without "
        "publishing, on this machine; the report used a 2.8 GHz Core i7 and Python."
    )
    numbers = {"rows": rows, "publish": vars(published) if published else None}
    sheet = Sheet("Table I, seconds an update", heads, rows)
    return Chapter("table1", "Table I: time", method, claims, sheets=[sheet], numbers=numbers)


def _quicker(place: Place, found: Survey) -> Claim:
    ms = update_ms(found, THEIRS)
    text = f"{place.title}: an update takes less time than in the report"
    return Claim(text, f"{place.update_s:.3f} s", f"{ms / 1e3:.4f} s", ms / 1e3 < place.update_s)


def _method(found: Survey, place: Place | None) -> str:
    robot, first = found.recording.robot, found.recording.first
    where = "A drive through a simulated floor, recorded as a ROS 1 bag of " if place else "A recording: "
    size = f"{found.recording.megabytes:.0f} MB, " if found.recording.megabytes else ""
    other = "of an earlier drive " if first is not robot else "of the same drive "
    door = "; since then a door was shut, and what lies behind it does not count" if found.excluded else ""
    return (
        f"{where}{size}{len(robot.scans)} scans and {len(robot.frames)} depth images. Reference map: SLAM from "
        f"{len(first.scans)} scans {other}({found.reference.slam.closures} loops closed), written as map_server files "
        f"and read back. Localisation in it by AMCL, mapping along that way{door}."
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
        Shown(mapped, second, f"Along the way that AMCL found: {theirs.made.variant.what}.", pictures[1]),
        Shown(difference, third, f"Profile ist2019: {_percent(theirs)} of the cells.", binary_png(theirs.laid)),
        Shown("How they differ, ist2019", "", _percent(theirs), difference_png(theirs.laid)),
        Shown("Map under default", "", f"The same way: {ours.made.variant.what}.", pictures[2]),
        Shown("How they differ, default", "", _percent(ours), difference_png(ours.laid)),
    ]


def _percent(one: Judged) -> str:
    return f"Eq 7: {one.scores.eq7_percent:.1f}\u00a0%"
