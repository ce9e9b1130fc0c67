# SPDX-License-Identifier: Apache-2.0
"""The experiments of Chien 2020 told: what the thesis says, what came out here, what holds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.evaluate.reproduce.aisle import FAR_M, AisleFound
from stereovox.evaluate.reproduce.apartment import Apartment, ScanFound
from stereovox.evaluate.reproduce.boxes import DIRECTIONS, BoxFound
from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown, percent
from stereovox.evaluate.reproduce.shifting import Flight
from stereovox.evaluate.reproduce.timing import Timed, processor
from stereovox.evaluate.reproduce.tracers import Comparison
from stereovox.sources.scene import Scene
from stereovox.view import reproduce as pictures

TWO_CELLS = "occupies two cells"


def boxes(two: Sequence[BoxFound], many: Sequence[BoxFound], updates: int) -> Chapter:
    """Return experiment 1. two: the thesis's boxes at 2 m, each by line and ray; many: random placements."""
    large = [one for one in two if one.placement.size == "large"]
    small = [one for one in two if one.placement.size == "small"]
    good = Counter(one.integrator for one in many if one.within_one_cell)
    number = Counter(one.integrator for one in many)
    hidden = sum(one.hidden for one in large)
    known = sum(one.hidden_known for one in large)
    every = [one for one in many if one.placement.size == "large"]
    claims = [
        Claim("Large box (47 x 36.5 x 32 cm): cells side by side", "2", _widths(large), _all_two(large)),
        Claim("Small box (25 x 18.5 x 9 cm): cells side by side", "2", _widths(small), _all_two(small)),
        Claim("Cells of the wall and before it in the large box's shadow stay unknown", "no update results",
              f"{hidden - known} of {hidden} unknown", known == 0),
        *(Claim(f"Random placements: every side at most one cell off (`{name}`)", "a one cell margin is required",
                f"{good[name]} of {number[name]} boxes", good[name] == number[name]) for name in number),
        Claim("The same shadow behind the large boxes of the random placements", "-",
              f"{sum(one.hidden - one.hidden_known for one in every)} of {sum(one.hidden for one in every)} unknown",
              sum(one.hidden_known for one in every) == 0),
    ]  # fmt: skip
    return Chapter(
        "boxes",
        "Large and small box at 2 m",
        f"A simulated D435 stands before a box in the air; {updates} updates, cells of 0.2 m, a wall at 4.1 m behind it. "
        "The camera stands where cells meet, as in the thesis, whose boxes lie evenly on both sides of the axis. Then "
        f"{len(many) // max(len(number), 1)} boxes of both sizes at random places in view, 1 m or more away, clear of "
        "wall and floor. Every occupied cell that is not wall or floor counts as box, wherever it lies; a side is off by "
        "the number of cells between the outermost occupied cell and the cell that holds the true side.",
        claims,
        [*_box_figures("Fig 4.6", "Fig 4.7", large), *_box_figures("Fig 4.9", "Fig 4.10", small),
         Shown("4.4.1", "The thesis concludes: practical for positions, not for exact dimensions; one cell of margin.",
               "How far off each side stands, over all random placements. A box that fills less than a third of its "
               "outer cells is drawn one cell smaller there (-1).", pictures.placements_png(many))],
        [_errors(many)],
        [*_broken(many), BOX_REMARK, MODEL_REMARK],
        {"updates": updates, "two_metres": [one.figures() for one in two], "random": [one.figures() for one in many]},
    )  # fmt: skip


BOX_REMARK = (
    "The thesis explains its two cells: of the large box only 3.5 cm reach into each outer cell, whose rays mostly pass "
    "by; of the small one 12.5 cm lie in each of two cells. The same happens here. The box's front lies exactly on the "
    "border of two cells, and a block minimum is on average two standard deviations too near, so the front appears in "
    "the cell before (front +1). A box drops out altogether only if it is small and fills less than a third of each of "
    "the four cells it touches."
)
MODEL_REMARK = (
    "k, p_min and the clamp of Eq 3.3 are not given in the thesis. They were chosen so that both boxes come out two cells "
    "wide: k = 0.05 m, p_min = 0.25, clamp 0.93."
)


def apartment(found: Apartment) -> Chapter:
    """Return experiment 2."""
    scans = {scan.scan.name: scan.figures() for scan in found.scans}
    claims = []
    for name, figures in scans.items():
        wanted = name.startswith("default")
        cell = f"cells of {figures['voxel_size']:g} m"
        claims += [
            Claim(f"{name}: wall thickness, {cell}", "solid",
                  f"median {figures['thickness_median']:g}, 95 %: {figures['thickness_p95']:g}, "
                  f"{percent(figures['thin_share'])} of columns at most 2",
                  figures["thickness_p95"] <= 2 if wanted else None),
            Claim(f"{name}: straightness", "straight", _straight(figures), figures["straightness_max_m"] <= _half(figures)),
            Claim(f"{name}: corners", "90 degrees", _corners(figures), figures["corners_within_1_deg"] == 1 if wanted else None),
        ]  # fmt: skip
    off = found.drift_m[np.isfinite(found.drift_m)]
    shown = Shown(
        "Fig 4.11",
        "The apartment looks precise, thanks to the T265's SLAM and re-localization; walls are solid and straight, the "
        "corner has 90 degrees. 255 is occupied, 0 free.",
        "True floor plan (furniture brown), error of the simulated tracker, and the layer at the first camera's height of "
        "each map, with the true walls as red lines. Grey is unknown.",
        pictures.apartment_png(
            [(scan.scan.name, scan.voxel_map) for scan in found.scans],
            found.stage.scene.solids,
            found.way,
            found.reported,
        ),
    )
    method = (
        f"Six furnished rooms are walked through once, {len(found.way)} images of 848x480. The same images are mapped "
        "with exact poses and through the camera pair's files with the poses of a simulated T265: jitter, drift of 1 % of "
        "the way, re-localisation where it has been before, another clock, a mount that is a degree out of line. Walls are "
        "measured column by column where furniture and doors leave them free and the camera saw them often enough; "
        f"15 cm beside corners are left out. The tracker was {100 * np.median(off):.1f} cm off (median), "
        f"{100 * off.max():.1f} cm at most."
    )
    numbers = {
        "scans": scans,
        "frames": len(found.way),
        "drift_median_m": float(np.median(off)),
        "drift_max_m": float(off.max()),
    }
    return Chapter("apartment", "Apartment", method, claims, [shown], [_walls(found.scans)], [WALL_REMARK], numbers)


WALL_REMARK = (
    "The thesis judged by eye; here thickness is the number of occupied cells in a column through the wall, straightness "
    "the root mean square distance of the columns' middles from the fitted plane, a corner the angle between two fitted "
    "planes. With cells of 0.2 m a plane through a short wall cannot be better than some degrees, and a step of one cell "
    "in a long one counts as well. No poses are corrected afterwards: what the tracker gets wrong is in the map twice "
    "where a wall was seen twice."
)


def aisle(found: Sequence[AisleFound], scene: Scene) -> Chapter:
    """Return experiment 3."""
    claims = []
    for one in found:
        text, wanted = f"{one.variant.name}: share of the far walls' cells found", one.variant.whose == "ours"
        thesis = "-" if wanted else "full" if one.variant.downsample == 1 else "fewer with a higher ratio"
        ours = f"{percent(one.found)}, {percent(one.against_full)} of full resolution"
        claims.append(Claim(text, thesis, ours, one.against_full >= 0.95 if wanted else None))
    lines = [one for one in found if one.variant.integrator == "line"]
    falling = all(a.found > b.found for a, b in zip(lines, lines[1:], strict=False))
    claims.append(Claim("The higher the ratio, the fewer far cells", "Fig 4.12", "as in the thesis", falling))
    rows = [
        (one.variant.name, percent(one.found), percent(one.against_full), percent(one.near_found), percent(one.stray),
         f"{one.ms:.2f}") for one in found
    ]  # fmt: skip
    heads = ("variant", f"found beyond {FAR_M:g} m", "against full", "found nearer", "occupied beside walls, far", "ms")
    shown = Shown(
        "Fig 4.12",
        "Further cells cannot be updated often with a higher downsampling ratio: only the closest depth of each block "
        "counts, so the far end of the aisle is filtered out.",
        "The layer at the camera's height, aisle lying on its side; dark is occupied, cream free, grey unknown, red the "
        "true walls. Beyond the dotted line is what counts as far.",
        pictures.aisle_png(found, scene.solids),
    )
    return Chapter(
        "aisle",
        "Aisle of 12 m",
        f"The camera stands at one end of an aisle 1.27 m wide and looks along it. Far cells are those beyond {FAR_M:g} m "
        "that a wall touches and a pixel sees. All variants get the same images and the sensor model of `chien2020`, with "
        "depths up to 13 m. Full resolution by voxel traversal is the yardstick.",
        claims,
        [shown],
        [Sheet("All variants", heads, rows)],
        [AISLE_REMARK],
        {"variants": [one.figures() for one in found]},
    )


AISLE_REMARK = (
    "The footprint rule needs no smaller image: a near cell is judged by all pixels of its footprint, so nothing near is "
    "lost, and a far cell by its own few pixels. It finds more of the far walls than adding all rays does, because there "
    "a cell's hits are outvoted by rays that graze it on their way further."
)


def timing(steps: Sequence[Timed], conditions: Sequence[Timed]) -> Chapter:
    """Return experiment 4."""
    by_name = {row.row.name: row for row in (*steps, *conditions)}
    claims = [
        Claim(
            f"{row.row.name}: mean, ms",
            f"{row.row.thesis_ms:g}",
            f"{row.mean_ms:.2f}",
            row.mean_ms <= row.row.thesis_ms,
        )
        for row in (*steps, *conditions)
        if row.row.thesis_ms is not None
    ]
    sheets = [
        Sheet("Table 4.2: time of each function, ms", ("function", "thesis", "ours, mean", "median", "99 %", "what was timed"),
              [_step(row) for row in steps]),
        Sheet("Table 4.3: a whole frame, ms and frames a second", ("condition", "thesis", "thesis, fps", "ours, mean", "median",
              "ours, fps", "faster"), [_condition(row) for row in conditions]),
    ]  # fmt: skip
    shown = Shown("Table 4.3", "From 1.5 frames a second at full resolution to 35 with a ratio of 10.",
                  "A whole frame, from the raw 16-bit image to the map.", pictures.times_png(conditions))  # fmt: skip
    numbers = {"processor": processor(), "threads": 1, "rows": {name: row.figures() for name, row in by_name.items()}}
    return Chapter(
        "timing",
        "Time tables",
        f"Walking through rooms, 848x480, a map of 100x30x100 cells of 0.2 m that shifts, {steps[0].frames} frames after "
        f"the first ten; one thread of this machine ({processor()}), the thesis's is an i7-8550U. A frame is everything "
        "from the raw image to the updated map, without reading the image from the camera, which the thesis includes. "
        "With visualization means that after a frame the map is turned into pixels: 2D the layer at the camera's height, "
        "3D the occupied cells as shaded cubes, 640x640, both by NumPy on the same processor core and without a window; "
        "every fifth frame was timed.",
        claims,
        [shown],
        sheets,
        [TIME_REMARK],
        numbers,
    )


TIME_REMARK = (
    "Means are compared, since the thesis gives averages. Other programs on the machine make them larger; the median is "
    "less touched. stereovox draws no picture while it maps: a viewer runs beside it, in its own process."
)


def tracers(found: Sequence[Comparison], size: float) -> Chapter:
    """Return experiment 5."""
    claims = []
    for one in found:
        where = f"{one.downsample}x{one.downsample}" if one.downsample > 1 else "full resolution"
        missed, difference = one.only_ray / one.ray, 1 - one.occupied_both / max(one.occupied_ray, one.occupied_line)
        faster = one.median_ms("line") < one.median_ms("ray")
        claims += [
            Claim(f"{where}: line drawing is faster", "9.77 against 10.49 ms (10x10)",
                  f"{one.median_ms('line'):.2f} against {one.median_ms('ray'):.2f} ms", faster),
            Claim(f"{where}: line drawing misses cells", "misses some free cells",
                  f"{percent(missed)} of what traversal updates; {percent(one.at_rim / max(one.only_ray, 1))} of these at "
                  "the rim of the view", one.only_ray > one.only_line),
            Claim(f"{where}: the finished maps' occupied cells", "difference quite small",
                  f"{one.occupied_line:,} by line, {one.occupied_ray:,} by traversal, {one.occupied_both:,} by both "
                  f"({percent(difference)} differ)", None),
        ]  # fmt: skip
    heads = ("downsampling", "traversal", "line", "both", "only traversal", "only line", "ms, traversal", "ms, line")
    rows = [(f"{one.downsample}x{one.downsample}", f"{one.ray:,}", f"{one.line:,}", f"{one.both:,}", f"{one.only_ray:,}",
             f"{one.only_line:,}", f"{one.median_ms('ray'):.2f}", f"{one.median_ms('line'):.2f}") for one in found]  # fmt: skip
    shown = Shown(
        "Fig 3.10",
        "Line drawing makes the line as thin as possible with less effort; voxel traversal fills every cell the ray "
        "passes. Missed cells can still be updated by other rays, except close to the edge of the field of view.",
        "One frame in the apartment, seen from above. What line drawing misses lies along the edges of the view and just "
        "before surfaces.",
        pictures.tracers_png(found[0], size),
    )
    return Chapter(
        "tracers",
        "The two ray tracers",
        "The same images of the apartment by line drawing (Alg 1) and voxel traversal (Alg 2). Counted are the cells that "
        "a frame gives evidence to, summed over all frames, and the cells that are occupied at the end. Rim: 1.5 cells "
        "inside the field of view or less.",
        claims,
        [shown],
        [Sheet("Cells updated, all frames together", heads, rows)],
        [TRACER_REMARK],
        {"comparisons": [one.figures() for one in found]},
    )


TRACER_REMARK = (
    "Line drawing leaves more cells occupied: rays that only graze a cell do not clear it. So with the same sensor model "
    "its walls are thicker than those of voxel traversal."
)


def shifting(flights: Sequence[Flight]) -> Chapter:
    """Return experiment 6."""
    claims = []
    for flight in flights:
        figures = flight.figures()
        word = "cells that leave are dropped" if flight.outside == "drop" else "cells that leave are kept on disk"
        claims += [
            Claim(f"{word}: one move of the window", "not given", f"median {1e3 * figures['shift_ms_median']:.0f} "
                  f"microseconds, {1e3 * figures['stay_ms_median']:.0f} where nothing moves", None),
            Claim(f"{word}: memory of the map", "prevents the map from growing", f"{figures['memory_bytes'] / 1e6:.2f} MB, "
                  f"changed by {figures['memory_changed_bytes']} bytes", figures["memory_changed_bytes"] == 0),
            Claim(f"{word}: the camera stays in the trigger box", "1 m (Table 4.1)",
                  f"never more than {flight.most_off_m:.2f} m off the middle", flight.most_off_m <= 1.001),
        ]  # fmt: skip
    drop, keep = (flight.figures() for flight in flights)
    claims.append(Claim("Cells that left come back", "deleted, or stored elsewhere", f"{keep['occupied']:,} occupied cells "
                        f"with tiles, {drop['occupied']:,} without", keep["occupied"] > drop["occupied"]))  # fmt: skip
    shown = Shown(
        "Fig 3.14 to 3.16",
        "The map shifts by one unit when the camera hits the trigger boundary; the dynamic region moves with the vehicle, "
        "cells outside are eliminated and can be stored elsewhere.",
        "The flight from above: window (blue, the last one orange) and trigger box (red) at four moments; grey squares "
        "are tiles of 32 cells a side that were written to disk.",
        pictures.flight_png(flights[-1]),
    )
    return Chapter(
        "shifting",
        "Map shifting",
        f"{keep['metres']:.0f} m out and back through a hall at 5 m/s; window 20x6x20 m, trigger box +-1 m.",
        claims,
        [shown],
        numbers={flight.outside: flight.figures() for flight in flights},
    )


def _box_figures(plan: str, space: str, found: Sequence[BoxFound]) -> list[Shown]:
    name = found[0].placement.size
    said = {
        "large": "The box occupies two cells; the wall behind it is fully obstructed. Only 3.5 cm of it lie in the outer "
        "cells, whose rays dominate.",
        "small": "The small box also occupies two cells: 12.5 cm of it lie in each, more than half of the cell. It barely "
        "blocks the wall.",
    }
    by_name = {one.integrator: one for one in found}
    line, ray = by_name["line"], by_name["ray"]
    return [
        Shown(plan, said[name], f"The {name} box (red) in the map by line drawing and voxel traversal, the log-odds along "
              "the optical axis and those of the whole layer (line drawing).", pictures.box_png(line, ray)),
        Shown(space, "3D map; red lines: field of view with 1 m depth.", f"The {name} box before the wall, with floor, by "
              "line drawing.", pictures.space_png(line.voxel_map, f"{name.capitalize()} box at 2 m")),
    ]  # fmt: skip


def _widths(found: Sequence[BoxFound]) -> str:
    return ", ".join(f"{one.width} ({one.integrator})" for one in found)


def _all_two(found: Sequence[BoxFound]) -> bool:
    return all(one.width == 2 for one in found)


def _errors(many: Sequence[BoxFound]) -> Sheet:
    """Return how many boxes are off by so many cells, side by side."""
    rows = []
    for name in dict.fromkeys(one.integrator for one in many):
        errors = np.array([one.errors for one in many if one.integrator == name and one.errors is not None])
        for value in range(int(min(errors.min(), -1)), int(max(errors.max(), 1)) + 1):
            rows.append((name, f"{value:+d}" if value else "0", *(errors == value).sum(axis=0).tolist()))
    return Sheet("Random placements: number of boxes by cells outwards", ("tracer", "cells", *DIRECTIONS), rows)


def _broken(many: Sequence[BoxFound]) -> list[str]:
    """Return one paragraph for each placement that breaks the claim."""
    told = []
    for one in many:
        if one.within_one_cell:
            continue
        place = one.placement
        why = "not one cell is occupied" if one.errors is None else f"off by {one.figures()['errors']} cells"
        told.append(f"Breaks the claim: {place.size} box at {place.distance:g} m, x {place.x:g}, y {place.y:g}, by "
                    f"{one.integrator}: {why}.")  # fmt: skip
    return told or ["No placement breaks the claim."]


def _straight(figures: dict[str, Any]) -> str:
    return f"{1000 * figures['straightness_median_m']:.0f} mm median, {1000 * figures['straightness_max_m']:.0f} mm worst wall"


def _half(figures: dict[str, Any]) -> float:
    return figures["voxel_size"] / 2


def _corners(figures: dict[str, Any]) -> str:
    return (
        f"median {figures['corner_error_median_deg']:.2f} deg off, worst {figures['corner_error_max_deg']:.2f}; "
        f"{percent(figures['corners_within_1_deg'])} of {figures['corners']} within 1 deg"
    )


def _walls(scans: Sequence[ScanFound]) -> Sheet:
    """Return thickness (median, 95 %) and straightness of each wall in each map."""
    names = list(dict.fromkeys(name for scan in scans for name in (*scan.walls, *scan.missing)))
    rows = []
    for name in names:
        cells: list[str] = []
        for scan in scans:
            wall = scan.walls.get(name)
            cells.append("-" if wall is None else _wall(wall.figures()))
        rows.append((name, *cells))
    heads = ("wall", *(scan.scan.name for scan in scans))
    return Sheet("Each wall: thickness in cells, median / 95 %; straightness in mm", heads, rows)


def _wall(figures: dict[str, Any]) -> str:
    return f"{figures['thickness_median']:g} / {figures['thickness_p95']:g}; {1000 * figures['straight']:.0f}"


def _step(row: Timed) -> tuple[str, ...]:
    timed = getattr(row.row, "timed", "")
    return (row.row.name, _thesis(row), f"{row.mean_ms:.2f}", f"{row.ms['median']:.2f}", f"{row.ms['p99']:.2f}", timed)


def _condition(row: Timed) -> tuple[str, ...]:
    thesis = row.row.thesis_ms
    fps, faster = (f"{1000 / thesis:.1f}", f"{thesis / row.mean_ms:.1f} x") if thesis else ("-", "-")
    return (row.row.name, _thesis(row), fps, f"{row.mean_ms:.2f}", f"{row.ms['median']:.2f}", f"{1000 / row.mean_ms:.0f}",
            faster)  # fmt: skip


def _thesis(row: Timed) -> str:
    return "-" if row.row.thesis_ms is None else f"{row.row.thesis_ms:.2f}"
