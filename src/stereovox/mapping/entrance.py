# SPDX-License-Identifier: Apache-2.0
"""All checks before a measurement may change a map: one row per check, one cell per kind of input.

A cell is the function that refuses, or the reason why there is nothing to check. All sources of measurements (arrays,
recordings, live cameras, ROS, fleets) hand them to `Mapper.add` or `GridMapper.add`, so the checks are the same.
tests/mapping/test_entrance.py offers a bad input for each cell, and disables each function to prove that it refuses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from stereovox.depth import DepthPipeline, cloud, quality, scan
from stereovox.depth.prepare import _check_image, prepare
from stereovox.depth.stereo import pipeline as stereo
from stereovox.frame import validate
from stereovox.integrate import Integration, beams, views
from stereovox.integrate.points import Points
from stereovox.mapping.deadline import Deadline
from stereovox.mapping.disagreement import DisagreementMonitor
from stereovox.mapping.gate import Gate
from stereovox.maps.cells.capped import CappedStorage
from stereovox.maps.grid_map import GridStorage

IMAGE, PAIR, CLOUD = "depth image", "stereo pair", "cloud"
SCAN, IMAGE_SCAN, PAIR_SCAN = "2-D scan", "depth image to scan", "stereo pair to scan"
RANGE, FLOOR_RANGE = "range", "range in a grid"
KINDS = IMAGE, PAIR, CLOUD, SCAN, IMAGE_SCAN, PAIR_SCAN, RANGE, FLOOR_RANGE
"""Kinds of input: the first three and ranges enter a `Mapper`, the others a `GridMapper`."""
Refuses = Callable[..., Any]
Cell = Refuses | tuple[Refuses, ...] | str
"""The function that refuses a bad input, or several (the later ones back up the first); or why nothing is checked."""


class Check(NamedTuple):
    """One check of all kinds of input.

    Attributes:
        reason: The code under which refusals are counted.
        when: When an input is refused.
        cells: By kind of input.
        setting: The settings that change it, "" for none.
    """

    reason: str
    when: str
    cells: dict[str, Cell]
    setting: str = ""


def _cells(one: Cell, *others: Cell, ranged: Cell | None = None, on_floor: Cell | None = None) -> dict[str, Cell]:
    """Return the cells of all kinds: one for all, three (images and pairs, clouds, scans), or six.

    ranged, on_floor: those of ranges, and of ranges in a grid; None: that of the clouds which they become, and as
    `ranged` or that of scans.
    """
    if len(others) == 2:
        others = (one, *others, one, one)
    cells: dict[str, Cell] = dict(zip(KINDS, (one, *others) if others else [one] * 6, strict=False))
    cells[RANGE] = cells[CLOUD] if ranged is None else ranged
    cells[FLOOR_RANGE] = on_floor or (cells[SCAN] if ranged is None else ranged)
    return cells


METRES = "its numbers are metres by definition; see `bad_units`"
FROM_PAIR = "its depth is made here, in metres"
SPACE = "3-D evidence may have any attitude"
OWN_POSE = "its pose is the sensor's own"
LIT = "it is no picture: bad light leaves values missing"
BOUNDED = "the grid's work is bounded by `max_range`, which may span 4096 cells"
NO_PIXELS = "it has no pixels"
BY_CAMERA = "the camera bounds its size"
ONE_NUMBER = "it is one number; see `no_valid_range`"
YIELDS = "it yields to the map: what is surely occupied stays, and an arc confirms no occupied cell"
ANY_MAPPER = "both mappers accept it"
FAULT_OF_PAIR = validate.validate_fields, stereo.grey_rectified

CHECKS = (
    Check("bad_form", "a field has the wrong type", _cells(validate._check_fields)),
    Check("bad_form", "it is no frame at all, an array is masked, or `pose_sigma` is not two deviations",
          _cells(validate.validate_fields)),
    Check("bad_form", "the mapper does not accept this kind",
          _cells(ANY_MAPPER, ANY_MAPPER, 
                 (DepthPipeline.matched, validate.validate_fields, validate._check_fields), validate.validate_fields,
                 ANY_MAPPER, ANY_MAPPER, ranged=ANY_MAPPER)),
    Check("bad_stamp", "a stamp is no int64", _cells(validate._check_fields)),
    Check("bad_sensor", "the sensor's name is not text", _cells(validate._check_fields)),
    Check("bad_sensor", "the sensor's name is not printable, or longer than 256 characters",
          _cells(Gate._identify)),
    Check("bad_sensor", "it is the 65th sensor", _cells(Gate._fitting)),
    Check("(its own)", "the source could not deliver it, and says why (`fault`)",
          _cells(validate.validate_fields, FAULT_OF_PAIR, *[validate.validate_fields] * 3, FAULT_OF_PAIR)),
    Check("bad_dtype", "values have the wrong type",
          _cells(_check_image, stereo.grey, cloud._points, validate.validate_scan, _check_image,
                 stereo.grey, ranged="it is one number; see `bad_form`")),
    Check("bad_shape", "the shape of an array does not match its camera, or its points",
          _cells(_check_image, stereo.grey, cloud._points, validate.validate_scan, _check_image,
                 stereo.grey, ranged="it is one number; see `bad_form`")),
    Check("bad_scale", "integer depths have no positive `depth_scale`: 1500 may be 1.5 m or 1.5 km",
          _cells(_check_image, FROM_PAIR, METRES, METRES, _check_image, FROM_PAIR)),
    Check("bad_reason", "reasons of pixels are invalid",
          _cells(_check_image, FROM_PAIR, NO_PIXELS, NO_PIXELS, _check_image, FROM_PAIR)),
    Check("bad_camera", "the view is out of proportion to the image",
          _cells(views.check_view, views.check_view, NO_PIXELS, NO_PIXELS, BOUNDED, BOUNDED)),
    Check("view_too_large", "there is evidence on more cells than can be kept or fit the image",
          _cells(views.check_blocks, views.check_blocks, Points._is_wide, BOUNDED, BOUNDED, BOUNDED)),
    Check("too_many_points", "a cloud has over 8,388,608 points", 
          _cells(BY_CAMERA, cloud._points, "see `too_many_beams`",
                 ranged="as many rays as its cone needs are made here")),
    Check("too_many_beams", "a scan has over 65,536 beams",
          _cells(BY_CAMERA, "see `too_many_points`", beams._beams_of, on_floor="see `too_many_points`")),
    Check("bad_scan", "angles or limits are invalid",
          _cells(BY_CAMERA, NO_PIXELS, validate.validate_scan, on_floor="a `RangeSensor` cannot have others")),
    Check("bad_clear", "`clear` or `clear_from` has the wrong length",
          _cells("it has none", "see `bad_shape`", beams._beams_of, ranged="it has none")),
    Check("no_pose", "there is no pose", _cells(validate.rigid_pose)),
    Check("pose_not_finite", "the pose holds NaN or infinity", _cells(validate._check_place)),
    Check("pose_too_far", "the position is 1000 km or more from the origin", _cells(validate._check_place)),
    Check("pose_too_far", "it is more than about 2^30 cells from the map's origin",
          _cells(*[views.check_place] * 3, *[beams.check_near] * 3)),
    Check("pose_not_rigid", "the pose is a mirror, a scale or a shear", _cells(validate.rigid_pose),
          "pose_rigidity_tolerance"),
    Check("mount_not_rigid", "the lidar's mount on the robot is no rigid motion",
          _cells(OWN_POSE, OWN_POSE, validate._rigid_mount, on_floor=OWN_POSE)),
    Check("mount_too_far", "the lidar's mount is 1000 km or more from the robot",
          _cells(OWN_POSE, OWN_POSE, validate._rigid_mount, on_floor=OWN_POSE)),
    Check("pose_extrapolated",
          "its pose is more than 0.05 s away from the nearest measured one (`pose_off_ns`)", _cells(Gate._identify),
          "trust.max_pose_off_s"),
    Check("stamp_backwards", "it is earlier than the last trusted one", _cells(Gate._settled), "trust.ordered"),
    Check("clock_reset", "it is more than 1 s earlier, or more than an hour later", _cells(Gate._settled),
          "trust.clock_reset_s, trust.max_gap_s"),
    Check("pose_jump", "it would have moved at more than 40 m/s or 1500 degrees/s", _cells(Gate._settled),
          "trust.max_speed_mps, trust.max_turn_dps"),
    Check("frozen_image", "it is identical to the previous one, but the sensor has moved by over 1 cm or 0.5 degrees",
          _cells(Gate._look, ranged="one number may well be the one before"), "trust.frozen"),
    Check("frozen_image", "it repeats what the sensor saw from elsewhere, with new noise",
          _cells(*[Gate._glances] * 3, *["a scan may look the same from many places"] * 3,
                 ranged="one number may well be the one before"), "trust.frozen"),
    Check("bad_units", "half of its depths or ranges are far above or far below the map's limits",
          _cells(quality.check_unit, quality.check_unit_of_rays, quality.check_unit_of_rays, ranged=ONE_NUMBER)),
    Check("no_valid_depth", "not one pixel has a value, and none is too far",
          _cells(prepare, "see `no_valid_point`", "see `no_valid_range`")),
    Check("no_valid_point", "not one ray can be used",
          _cells("see `no_valid_depth`", cloud.checked_cloud, "see `no_valid_range`", ranged=ONE_NUMBER)),
    Check("no_valid_range", "not one beam has a range, or nothing was heard, which clears nothing (`silence_clears`)",
          _cells("see `no_valid_depth`", "see `no_valid_point`", quality.check_scan, ranged=cloud.distance_of)),
    Check("too_few_values", "less than 0.5 % of the pixels, points or beams have a value or are too far",
          _cells(quality._check_share, quality._check_number, quality._check_number,
                 ranged=ONE_NUMBER), "trust.min_valid_share"),
    Check("no_surfaces", "less than half of the values resemble their neighbours, as values on surfaces do",
          _cells(quality.check_depth, quality._check_alike, quality._check_alike,
                 ranged=ONE_NUMBER), "trust.min_surface_share"),
    Check("too_dark", "90 % of an image is black",
          _cells(LIT, quality.check_light, LIT, LIT, LIT, quality.check_light), "trust.max_unexposed_share"),
    Check("overexposed", "90 % of an image is saturated",
          _cells(LIT, quality.check_light, LIT, LIT, LIT, quality.check_light), "trust.max_unexposed_share"),
    Check("tilted", "the lidar leans by more than 5 degrees, so its beams meet the floor",
          _cells(SPACE, SPACE, SPACE, validate.validate_upright_scan, "see `camera_tilted`", "see `camera_tilted`",
                 on_floor=cloud.level_range),
          "grid.max_tilt_deg"),
    Check("camera_tilted", "no row of the image is level (method `rows`; `cloud` accepts any attitude)",
          _cells(SPACE, SPACE, SPACE, "see `tilted`", scan.level_rows, scan.level_rows), "scan.off_level_deg"),
    Check("camera_vertical", "the camera looks straight up or down",
          _cells(SPACE, SPACE, SPACE, "see `tilted`", scan.levelled, scan.levelled)),
    Check("below_floor", "the camera, or much of what it sees, is below the floor",
          _cells(SPACE, SPACE, SPACE, "a lidar measures at one height", scan.check_floor, scan.check_floor),
          "scan.floor"),
    Check("heights_not_seen", "the camera sees nothing of `scan.heights`",
          _cells(SPACE, SPACE, SPACE, "a lidar measures at one height", scan.check_heights, scan.check_heights),
          "scan.heights"),
    Check("disagrees_with_map", "more of it contradicts the map than is usual for its sensor",
          _cells(DisagreementMonitor.check, ranged=YIELDS), "trust.max_disagreement, trust.pose_error_m"),
    Check("contradicts_map", "frames have disagreed for `trust.changed_s`, and do not show a changed world",
          _cells(DisagreementMonitor.check, ranged=YIELDS), "trust.changed_s"),
    Check("camera_moved", "frames have disagreed for `trust.changed_s`, and would agree from another pose",
          _cells(DisagreementMonitor.check, ranged=YIELDS), "trust.moved_s"),
    Check("memory_full", "its cells do not fit into `max_memory`",
          _cells(CappedStorage.check_room, CappedStorage.check_room, CappedStorage.check_room, GridStorage.check_room,
                 GridStorage.check_room, GridStorage.check_room), "max_memory, when_full"),
    Check("no_time", "frames take longer than `deadline_ms` even at the quickest level",
          _cells(*[Deadline.quality] * 3, *["a floor grid has no deadline: a scan takes about a millisecond"] * 3),
          "deadline_ms"),
    Check("no_clouds", "clouds are mapped on the processor only",
          _cells("it is mapped there too", Integration.evidence, "grids are made on the processor only"), "device"),
)  # fmt: skip
"""All checks; rows with the same reason differ in where they are made."""

ELSEWHERE = {
    "missing_file": "no such image or cloud",
    "unreadable": "the file or message is damaged, truncated, or of another kind",
    "bad_pose_file": "a pose cannot be read",
    "low_confidence": "camera pair, live: the tracker's confidence is below `min_confidence`",
    "not_localised": "the ROS 2 node does not know where the robot is in its map",
    "clock_doubt": "live, ROS 2: the offset between the clocks of sensors and poses is unknown",
    "no_camera": "ROS 2: no camera info was received; bags and ROS 2: the image is of another camera",
    "tracking_lost": "tracking: the camera's pose is unknown",
    "no_photo": "tracking: a depth image has no color image taken with it",
    "unconfirmed": "first frames of a map that the next one contradicts; they are taken out again",
    "not_in_order": "SLAM and localisation: not later than the previous scan",
}
"""Reasons that sources, trackers and localisation give as the `fault` of a frame, which is then refused."""


def table(checks: Sequence[Check] = CHECKS) -> list[str]:
    """Return the table as lines of Markdown: for each check and kind its function, or why it has none."""
    head = f"| refused as | when | {' | '.join(KINDS)} | setting |"
    lines = [head, "|" + "---|" * (len(KINDS) + 3)]
    for check in checks:
        cells = " | ".join(_shown(check.cells[kind]) for kind in KINDS)
        lines.append(f"| `{check.reason}` | {check.when} | {cells} | {_settings(check.setting)} |")
    return lines


def _settings(names: str) -> str:
    return ", ".join(f"`{name}`" for name in names.split(", ")) if names else "-"


def functions(cell: Cell) -> tuple[Refuses, ...]:
    """Return the functions of a cell."""
    if isinstance(cell, str):
        return ()
    return cell if isinstance(cell, tuple) else (cell,)


def _shown(cell: Cell) -> str:
    if isinstance(cell, str):
        return f"-: {cell}"
    return ", ".join(f"`{function.__qualname__.removeprefix('_')}`" for function in functions(cell))
