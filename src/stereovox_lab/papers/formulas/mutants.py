# SPDX-License-Identifier: Apache-2.0
"""Faults, each of which must make a claim of the formulas fall."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from math import radians, tan
from typing import Any
from unittest.mock import patch

import numpy as np

import stereovox.config
from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.sensors.noise import RangeNoise

CHIEN, VALENTI, IST = "chien2020", "valenti2018", "ist2019"
TABLE = "table"
"""In place of a claim: only the claim on the profile's settings can fall."""
REFUSED = "map_claims"
"""In place of a claim: stereovox refuses the fault, so that there is no map to claim anything of."""


@dataclass(frozen=True)
class Mutant:
    """One fault. what: in words. where: a setting of the profile, or `module:name` of stereovox.

    to: the setting's value; of a name: a function of the original that returns its replacement. falls: the beginning of
    a claim that must fall; empty: none can. why: why none can, or why only the claim on settings can.
    """

    paper: str
    what: str
    where: str
    to: Any
    falls: str
    why: str = ""


@contextmanager
def applied(mutant: Mutant) -> Iterator[None]:
    """Apply a fault to stereovox while the context lasts."""
    module, _, name = mutant.where.partition(":")
    if not name:
        read = stereovox.config._read_profile

        def changed(profile: Any) -> dict[str, Any]:
            settings = read(profile)
            if str(profile) == mutant.paper:
                stereovox.config._put(settings, mutant.where, mutant.to)
            return settings

        with patch.object(stereovox.config, "_read_profile", changed):
            yield
        return
    owner: Any = import_module(module)
    *owners, last = name.split(".")
    for part in owners:
        owner = getattr(owner, part)
    if isinstance(owner, dict):
        with patch.dict(owner, {last: mutant.to(owner[last])}):
            yield
        return
    with patch.object(owner, last, mutant.to(getattr(owner, last))):
        yield


def _setting(paper: str, name: str, to: Any, falls: str = TABLE, why: str = "") -> Mutant:
    return Mutant(paper, f"{name} = {to}", name, to, falls, why)


def _scaled(by: float) -> Callable[[Any], Any]:
    return lambda original: lambda *args, **more: by * original(*args, **more)


def _noise(change: Callable[[RangeNoise], RangeNoise]) -> Callable[[Any], Any]:
    return lambda original: staticmethod(lambda *args: change(original(*args)))


def _off_by_one(original: Any) -> Any:
    """Move a window one cell too far whenever it moves."""

    def centre(self: Any, axis: int, camera: float) -> int:
        found = original(self, axis, camera)
        now = found if self.box is None else (self.box[0][axis] + self.box[1][axis]) // 2
        return found + int(np.sign(found - now))

    return centre


def _andert(change: Callable[..., Any]) -> Callable[[Any], Any]:
    return lambda original: lambda self, z, z_measured, sigma: change(original, self, z, z_measured, sigma)


def _free_behind(original: Any, self: Any, z: Any, z_measured: Any, sigma: Any) -> Any:
    return np.where(z <= z_measured, original(self, z, z_measured, sigma), self.p_free)


def _largest(original: Any) -> Any:
    """Give blocks their largest depth."""

    def block(depth_m: Any, reason: Any, n: int, row: Any, out_depth: Any, out_reason: Any) -> None:
        original(depth_m, reason, n, row, out_depth, out_reason)
        height, width = out_depth.shape
        blocks = np.where(reason == 0, depth_m, 0)[: height * n, : width * n].reshape(height, n, width, n)
        np.copyto(out_depth, blocks.max(axis=(1, 3)), where=out_reason == 0)

    return block


def _mean_before(original: Any) -> Any:
    """Far before a measurement: the table's mean over all depths four sigma before it."""

    def tabulate(*args: Any, **more: Any) -> Any:
        table = original(*args, **more)
        log_odds = table.log_odds.copy()
        log_odds[:, 0] = log_odds[:, 1].mean()
        return replace(table, log_odds=log_odds, passed=log_odds[:, 0].copy())

    return tabulate


def _wider(original: Any) -> Any:
    del original

    def from_field_of_view(width: int, height: int, hfov_deg: float, baseline: float | None = None) -> PinholeCamera:
        focal = 0.5 * height / tan(radians(hfov_deg / 2))
        return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, baseline)

    return from_field_of_view


def _negated(original: Any) -> Any:
    def fitted(walls: Any) -> DepthCorrection:
        p1, p2, p3 = original(walls).coefficients
        return DepthCorrection("thesis", (-p1, -p2, p3))

    return fitted


def _plus_spread(original: Any) -> Any:
    def nearest(cells: Any, config: Any) -> Any:
        std = np.sqrt(cells.squares / np.maximum(cells.number, 1).astype(np.float32))
        return np.where(std < config.std_threshold, cells.mean + config.spread * std, original(cells, config))

    return nearest


def _farther(original: Any) -> Any:
    return lambda a, b: original(replace(a, range_m=-a.range_m), replace(b, range_m=-b.range_m))


def _printed_box(original: Any) -> Any:
    del original

    def inside(points: Any, corners: Any) -> Any:
        p0, p1, p3, p4 = corners
        axes = np.cross(p0 - p3, p0 - p4), np.cross(p0 - p1, p0 - p4), np.cross(p0 - p1, p0 - p3)
        tests = [(u @ p0 <= points @ u) & (points @ u <= u @ far) for u, far in zip(axes, (p1, p3, p4), strict=True)]
        return np.logical_and.reduce(tests)

    return inside


def _printed_tail(original: Any) -> Any:
    del original

    def tail(self: Any, sigma: Any) -> Any:
        a = self.peak(sigma)
        return sigma * np.sqrt(np.log1p(a / (a + 1 - 2 * self.p_free)) / np.log(2))

    return tail


def _of_all_cells(original: Any) -> Any:
    def errors(laid: Any, found: Any) -> Any:
        return replace(original(laid, found), eq7_percent=100 * float((found > 0).mean()))

    return errors


def _contradiction_only(original: Any) -> Any:
    def errors(laid: Any, found: Any) -> Any:
        one = original(laid, found)
        return replace(one, eq7_percent=one.eq7_contradiction_percent)

    return errors


WINDOW, MODEL, RAY = "stereovox.maps.storage.window:Window", "stereovox.sensors", "stereovox.integrate.ray:Ray"
OF_NOISE = "stereovox.sensors.noise:RangeNoise.of"
CELLS, POINTS, BYTES, BLOCKS, CLEAR = "Alg 1", "Eq 3.3 to 3.6", "3.5", "3.2", "Eq 3.4"
MARKED, CLEARED, GRID = "Eq 6.4 to 6.6", "Eq 6.2", "Eq 5.2"
MATCHER = "the text names the method; a made-up pair is matched alike by others"
UNUSED = "no formula of this text uses the noise"
MUTANTS = (
    _setting(CHIEN, "integrator", "ray", CELLS),
    _setting(CHIEN, "voxel_size", 0.25, CELLS),
    _setting(CHIEN, "depth.downsample", 4, BLOCKS),
    _setting(CHIEN, "depth.denoise", True, BLOCKS),
    _setting(CHIEN, "min_range", 0.5, BLOCKS),
    _setting(CHIEN, "max_range", 9.0, CELLS),
    _setting(CHIEN, "blind_range", 1.0, "Alg 2"),
    _setting(CHIEN, "sensor.model", "constant", REFUSED),
    _setting(CHIEN, "sensor.k", 0.06, POINTS),
    _setting(CHIEN, "sensor.p_free", 0.27, CLEAR),
    _setting(CHIEN, "sensor.p_max", 0.9, POINTS),
    _setting(CHIEN, "noise.subpixel", 0.1, POINTS),
    _setting(CHIEN, "noise.default_baseline", 0.06, POINTS),
    _setting(CHIEN, "ray.update", "once", CLEAR),
    _setting(CHIEN, "map.cell", "int16", BYTES),
    _setting(CHIEN, "map.prior", 0.4, CLEAR),
    _setting(CHIEN, "map.log_odds_min", -1.5, BYTES),
    _setting(CHIEN, "map.log_odds_max", 1.5, BYTES),
    _setting(CHIEN, "map.occupied_above", 0.65, BYTES),
    _setting(CHIEN, "map.free_below", 0.2, TABLE, "the thesis has no threshold of free cells"),
    _setting(CHIEN, "window.size", [16.0, 6.0, 20.0], "3.6"),
    _setting(CHIEN, "window.trigger", 1.4, "3.6"),
    _setting(CHIEN, "window.outside", "keep", "3.6"),
    _setting(CHIEN, "up", "z", TABLE, "cells do not depend on it; pictures and floors do"),
    Mutant(CHIEN, "the largest depth of a block", "stereovox.depth.prepare:_images.block_minimum", _largest, BLOCKS),
    Mutant(CHIEN, "Eq 3.3 without a clamp", f"{MODEL}.models:Andert.probability",
           _andert(lambda original, self, *of: original(replace(self, p_max=2.0), *of)), REFUSED),
    Mutant(CHIEN, "Eq 3.4 with p_min behind, too", f"{MODEL}.models:Andert.probability",
           _andert(_free_behind), REFUSED),
    Mutant(CHIEN, "Eq 3.5 as printed", OF_NOISE, _noise(lambda one: RangeNoise(0.0, one.s2, 0.0)), POINTS),
    Mutant(CHIEN, "Eq 3.6 with the height", "stereovox.cameras.pinhole:PinholeCamera.from_field_of_view",
           _wider, CELLS),
    Mutant(CHIEN, "Alg 3 as printed, L = P / (1 - P)", f"{MODEL}.protocol:_log_odds",
           lambda original: lambda model, p: np.exp(original(model, p)), CELLS),
    Mutant(CHIEN, "free space by the mean over depths, -1.06", "stereovox.integrate.views:tabulate", _mean_before,
           CLEAR),
    Mutant(CHIEN, "Eq 3.21 with 86 pixels a cell, as measured, not 83", f"{RAY}._cell_px", _scaled(86 / 83), CLEAR),
    Mutant(CHIEN, "Eq 3.21 without the ratio", f"{RAY}._cell_px",
           lambda original: lambda self, camera: camera.binning * original(self, camera), CLEAR),
    Mutant(CHIEN, "bytes about 128", "stereovox.maps.cells.cell_format:FORMATS.uint8",
           lambda form: replace(form, unknown=128), BYTES),
    Mutant(CHIEN, "60 bytes a unit of log-odds", "stereovox.maps.cells.cell_format:FORMATS.uint8",
           lambda form: replace(form, per_log_odds=60.0), BYTES),
    Mutant(CHIEN, "the window moves a cell too far", f"{WINDOW}._centre", _off_by_one, "3.6"),
    Mutant(CHIEN, "T265: y up kept", "stereovox.sources.poses.tracker:AXES.opengl",
           lambda axes: np.diag([-1.0, 1.0, -1.0]) @ axes.T @ axes, "4.1"),
    Mutant(CHIEN, "App. A: the fit's signs turned, as printed", "stereovox.calibrate.wall:_fit_thesis", _negated,
           "Eq A.1"),
    _setting(VALENTI, "integrator", "line", CLEARED),
    _setting(VALENTI, "voxel_size", 0.4, CLEARED),
    _setting(VALENTI, "min_range", 2.5, CLEARED),
    _setting(VALENTI, "max_range", 3.0, MARKED),
    _setting(VALENTI, "blind_range", 2.0, CLEARED),
    _setting(VALENTI, "stereo.method", "block", TABLE, MATCHER),
    _setting(VALENTI, "stereo.block_size", 9, TABLE, MATCHER),
    _setting(VALENTI, "stereo.aligned", "left", "5.1: a near"),
    _setting(VALENTI, "stereo.halve", False, TABLE, MATCHER),
    _setting(VALENTI, "stereo.rcrop", 0, "Eq 5.1"),
    _setting(VALENTI, "stereo.min_confidence", 0.5, TABLE, MATCHER),
    _setting(VALENTI, "stereo.subpixel", 0.5, MARKED),
    _setting(VALENTI, "depth.denoise", True, MARKED),
    _setting(VALENTI, "sphere.step_deg", 3.0, GRID),
    _setting(VALENTI, "sphere.statistic", "minimum", GRID),
    _setting(VALENTI, "sphere.std_threshold", 0.04, GRID),
    _setting(VALENTI, "sphere.spread", 2.5, GRID),
    _setting(VALENTI, "sensor.model", "andert", REFUSED),
    _setting(VALENTI, "sensor.k", 0.6, MARKED),
    _setting(VALENTI, "sensor.p_free", 0.35, CLEARED),
    _setting(VALENTI, "sensor.p_unknown", 0.45, MARKED),
    _setting(VALENTI, "map.cell", "int8", "7.1: bytes"),
    _setting(VALENTI, "map.prior", 0.4, CLEARED),
    _setting(VALENTI, "map.log_odds_min", -2.0, CLEARED),
    _setting(VALENTI, "map.log_odds_max", 2.0, MARKED),
    _setting(VALENTI, "map.occupied_above", 0.9, "Eq 8.1"),
    _setting(VALENTI, "map.free_below", 0.2, TABLE, "Eq 8.1 has no threshold of free cells"),
    _setting(VALENTI, "ray.update", "every", CLEARED),
    Mutant(VALENTI, "Eq 6.8 as printed", "stereovox.cameras.pinhole:PinholeCamera.depth_of",
           lambda original: lambda self, d, aligned="left": np.sqrt(self.fx * self.baseline * np.asarray(d, float)),
           "Eq 4.1"),
    Mutant(VALENTI, "Eq 4.6 as printed: sin not times B", "stereovox.cameras.wide:SphericalCamera.depth_of",
           lambda original: lambda self, d, aligned="left": original(self, d, aligned) + 0.1, "Eq 4.3"),
    Mutant(VALENTI, "Eq 4.2 and 4.7 twice as large", "stereovox.depth.stereo.disparity:depth_sigma", _scaled(2.0),
           "Eq 4.2"),
    Mutant(VALENTI, "Eq 5.4 with + 3 sigma", "stereovox.depth.sphere.grid:_nearest", _plus_spread, GRID),
    Mutant(VALENTI, "stitching: the farthest wins", "stereovox.depth.sphere.grid:_nearer", _farther, "5.4"),
    Mutant(VALENTI, "Eq 6.5: the peak times 0.6", f"{MODEL}.models:Valenti.peak", _scaled(0.6), MARKED),
    Mutant(VALENTI, "Eq 6.5 without exp(-dz)", f"{MODEL}.models:Valenti.peak",
           lambda original: lambda self, sigma: original(self, 0.0 * np.asarray(sigma)), MARKED),
    Mutant(VALENTI, "Eq 6.6: the tail as wide as before", f"{MODEL}.models:Valenti.tail",
           lambda original: lambda self, sigma: sigma, MARKED),
    Mutant(VALENTI, "Eq 6.6 as printed", f"{MODEL}.models:Valenti.tail", _printed_tail, "",
           "at the profile's p_unknown of 0.5 both forms are one"),
    Mutant(VALENTI, "Eq 6.9 without the square", OF_NOISE, _noise(lambda one: RangeNoise(0.0, one.s2, 0.0)), MARKED),
    Mutant(VALENTI, "Eq 6.10 without its constant", OF_NOISE, _noise(lambda one: replace(one, s0=0.0)), "Eq 6.9"),
    Mutant(VALENTI, "7.2: the box moves a cell too far", f"{WINDOW}._centre", _off_by_one, "7.2"),
    Mutant(VALENTI, "7.1: a fixed box that follows", f"{WINDOW}._centre",
           lambda original: lambda self, axis, camera: round(camera / self._cell[axis]), "7.1"),
    Mutant(VALENTI, "Eq 8.1 at 0.6", "stereovox.evaluate.scores:Reading.marked",
           lambda original: lambda self, threshold: original(self, 0.6), "Eq 8.1 to 8.7"),
    Mutant(VALENTI, "Eq 8.7: the root", "stereovox.evaluate.scores:brier",
           lambda original: lambda p, actual: original(p, actual) ** 0.5, "Eq 8.1 to 8.7"),
    Mutant(VALENTI, "Eq 8.9 as printed: not divided by N", "stereovox.evaluate.scores:correlation",
           lambda original: lambda p, actual: original(p, actual) * len(p), "Eq 8.8"),
    Mutant(VALENTI, "Eq A.1 to A.3 as printed", "stereovox.evaluate.lidar_truth:inside", _printed_box, "Eq A.1"),
    _setting(IST, "dimensions", 3, TABLE, "the 2-D mapper is called by itself here"),
    _setting(IST, "voxel_size", 0.03, "II-B"),
    _setting(IST, "min_range", 0.5, "III-C"),
    _setting(IST, "max_range", 4.0, "III-C"),
    _setting(IST, "scan.method", "cloud", "III-C"),
    _setting(IST, "scan.rows", 3, "III-C"),
    _setting(IST, "grid.traversal", "exact", "II-B"),
    _setting(IST, "grid.update", "once", "Eq 5"),
    _setting(IST, "grid.thickness", 0.1, "II-B"),
    _setting(IST, "grid.p_occupied", 0.68, "Eq 5"),
    _setting(IST, "grid.p_free", 0.42, "Eq 5"),
    _setting(IST, "grid.prior", 0.45, "Eq 5"),
    _setting(IST, "map.log_odds_min", -3.0, "Eq 5"),
    _setting(IST, "map.log_odds_max", 3.0, "Eq 5"),
    _setting(IST, "map.free_below", 0.1, "II-B: free"),
    _setting(IST, "map.occupied_above", 0.9, "II-B: occupied"),
    _setting(IST, "depth.denoise", True, "III-C"),
    _setting(IST, "noise.subpixel", 0.25, TABLE, UNUSED),
    _setting(IST, "noise.default_baseline", 0.1, TABLE, UNUSED),
    Mutant(IST, "Eq 7 over all cells", "stereovox.evaluate.grid_scores:cell_errors", _of_all_cells, "Eq 7"),
    Mutant(IST, "Eq 7 without cells that one map alone knows", "stereovox.evaluate.grid_scores:cell_errors",
           _contradiction_only, "Eq 7"),
)  # fmt: skip
