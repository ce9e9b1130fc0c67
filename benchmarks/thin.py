# SPDX-License-Identifier: Apache-2.0
"""Poles and wires of 0.3 to 4 pixels in maps: stereovox and OctoMap on the same frames.

    python benchmarks/thin.py [--sweep | --random N [--apart] | --gaps | --poses] [--seeds 3] [--first-seed 0]
                              [--only WORDS] [--alone] [--set key=value ...] [--json] [--camera d435]
                              [--picture thin.png]

A pole is in front of a wall, or of nothing, and a simulated camera sees it while it rests, flies or turns. `lost`:
share of the layers of cells along the observed pole without an occupied cell that the pole touches. `free`: share of
the cells that the pole touches and the map calls free. Truth is exact, a cylinder.
The cases' own noise is independent from pixel to pixel; `--camera d435` uses a realistic camera in all
of them (`stereovox.simulate.honest`).

`--random N` takes N random scenes, one for each seed from `--first-seed` on; with `--apart` half of them with
the camera or the noise on which no setting was chosen. `--gaps` and `--poses` vary the gap behind the pole and the
noise of poses. All end with the excess of stereovox over OctoMap: the largest, that of the worst twentieth, and the
mean.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from thin_scenes import (
    BACKGROUNDS,
    HONEST,
    MOTIONS,
    NOISES,
    Scene,
    box_of,
    frames_of,
    pixels_of,
    px,
    random_scene,
    start_of,
)

from stereovox import Frame, Mapper
from stereovox.cli.options import add_settings, overrides
from stereovox.frame import Reason


def touched(scene: Scene, seed: int, voxel_size: float, low: float, high: float) -> tuple[NDArray, NDArray]:
    """Return a point (N, 3) in each cell that the pole touches between two places along its axis, and the cells'
    layers.

    low, high: metres along the world axis nearest to the pole's, along which layers are counted.
    """
    start = start_of(seed)[:3, 3]
    a, radius = scene.axis, scene.pole / 2
    main = int(np.argmax(np.abs(a)))
    other = np.cross(a, [1.0, 0.0, 0.0])
    other /= np.linalg.norm(other)
    along = np.arange(low, high, voxel_size / 40) / a[main]
    turn = np.arange(0, 2 * np.pi, 2 * np.pi / max(12, int(2 * np.pi * radius / (voxel_size / 40))))
    ring = radius * (np.cos(turn)[:, None] * np.cross(other, a) + np.sin(turn)[:, None] * other)
    points = (start + along[:, None, None] * a + ring).reshape(-1, 3)
    cells = np.unique(np.floor(points / voxel_size).astype(int), axis=0)
    layers = cells[:, main]
    whole = (layers > layers.min()) & (layers < layers.max())
    return (cells[whole] + 0.5) * voxel_size, layers[whole]


@dataclass
class Found:
    """lost, free: shares as above, between 0 and 1. wall: mean number of occupied cells in columns through the wall."""

    lost: float
    free: float
    wall: float


def judged(state: Any, scene: Scene, seed: int, voxel_size: float) -> Found:
    """Score a map: `state` returns 1 for free, 3 for occupied cells at points (N, 3)."""
    reach = 0.8 * scene.distance * scene.camera.cy / scene.camera.fy
    if scene.motion == "approach":
        reach = 0.12
    if scene.motion in ("up", "towards"):
        reach *= 0.5
    if scene.along:
        reach = scene.along * float(np.abs(scene.axis).max())
    points, layers = touched(scene, seed, voxel_size, -reach, reach)
    states = state(points)
    found = {layer for layer, what in zip(layers, states, strict=True) if what == 3}
    start = start_of(seed)[:3, 3]
    thick = np.nan
    if np.isfinite(scene.gap) and not scene.along:
        x = np.arange(-0.15 if scene.gap > 0.5 else 0, 1.0, voxel_size) + scene.gap
        y, z = np.arange(0.3, 0.8, voxel_size), np.arange(-0.2, 0.2, voxel_size)
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
        thick = float((state((grid + start).reshape(-1, 3)).reshape(grid.shape[:3]) == 3).sum(0).mean())
    return Found(1 - len(found) / len(set(layers.tolist())), float((states == 1).mean()), thick)


def with_stereovox(scene: Scene, frames: list[Frame], voxel_size: float, **settings: Any) -> Any:
    mapper = Mapper(voxel_size=voxel_size, max_range=max(5.0, 1.5 * scene.distance), **settings)
    for frame in frames:
        refused = mapper.add(frame).refused
        assert scene.along or not refused, refused  # in a random scene a frame may be off the map
    return mapper.map.state


def with_octomap(scene: Scene, frames: list[Frame], seed: int, voxel_size: float) -> Any:
    """Map with OctoMap's own numbers: 0.7 for a hit, 0.4 for a miss; a cell is occupied above 0.5."""
    import octomap

    tree = octomap.OcTree(voxel_size)
    for frame in frames:
        z, reach, place = np.asarray(frame.depth, float), max(5.0, 1.5 * scene.distance), frame.T_world_sensor[:3, 3]
        z = np.where((frame.reason == Reason.TOO_FAR) | (z > reach), 2 * reach, z)
        if scene.along:  # rays away from the pole's cells change nothing there, and take hours
            T = np.linalg.inv(start_of(seed)) @ frame.T_world_sensor
            z[~near_pole(scene, frame, T, voxel_size)] = 0
            reach = min(reach, float(np.linalg.norm(T[:3, 3])) + scene.along + scene.pole + 3 * voxel_size)
        points = frame.camera.back_project(z)[z > 0] @ frame.T_world_sensor[:3, :3].T + place
        tree.insertPointCloud(points, place.copy(), reach, False, True)

    def state(points: NDArray) -> NDArray:
        nodes = [tree.search(point) for point in points]
        return np.array([0 if _none(node) else (3 if tree.isNodeOccupied(node) else 1) for node in nodes])

    return state


def near_pole(scene: Scene, frame: Frame, T: NDArray, voxel_size: float) -> NDArray[np.bool_]:
    """Return which pixels (height, width) see cells of the judged part of the pole from this pose."""
    camera = frame.camera
    spots = pixels_of(scene, camera, T)
    nearest = (0.7 if scene.motion == "towards" else 0.9) * scene.distance - scene.along * abs(scene.axis[0])
    room = (0.5 * scene.pole + 2 * voxel_size) * camera.fx / nearest + 2
    v, u = np.mgrid[: camera.height, : camera.width]
    first, along = spots[0], spots[-1] - spots[0]
    t = np.clip(((u - first[0]) * along[0] + (v - first[1]) * along[1]) / (along @ along), 0, 1)
    return np.hypot(u - first[0] - t * along[0], v - first[1] - t * along[1]) < room


def _none(node: Any) -> bool:
    try:
        node.getOccupancy()
    except Exception:
        return True
    return False


CASES: dict[str, tuple[Scene, float, dict[str, Any]]] = {
    "13 mm, close wall, D435 320": (Scene(0.013, 4.6, 0.2, 320, "d435"), 0.1, {}),
    "27 mm, close wall, D435 320": (Scene(0.027, 4.6, 0.2, 320, "d435"), 0.1, {}),
    "60 mm, close wall, D435 320": (Scene(0.060, 4.6, 0.2, 320, "d435"), 0.1, {}),
    "30 mm, close wall, D435 848": (Scene(0.030, 4.6, 0.2, 848, "d435"), 0.1, {}),
    "50 mm, close wall, D435 848": (Scene(0.050, 4.6, 0.2, 848, "d435"), 0.1, {}),
    "0.5 px, exact": (px(0.5), 0.05, {}),
    "0.5 px, tilted": (px(0.5, tilt_deg=20.0), 0.05, {}),
    "0.5 px, flying": (px(0.5, noise="flying"), 0.05, {}),
    "0.5 px, D435": (px(0.5, noise="d435"), 0.05, {}),
    "0.5 px, flying, 640 wide": (px(0.5, width=640, noise="flying"), 0.05, {}),
    "0.5 px, D435, 640 wide": (px(0.5, width=640, noise="d435"), 0.05, {}),
    "0.5 px, D435, 848 wide": (px(0.5, width=848, noise="d435"), 0.05, {}),
    "1 px, D435, 640 wide": (px(1.0, width=640, noise="d435"), 0.05, {}),
    "1 px, shaken poses": (px(1.0, pose_noise=(0.010, 0.3)), 0.05, {}),
    "1 px, D435, still": (px(1.0, noise="d435", motion="still"), 0.05, {}),
    "1 px, D435, sideways": (px(1.0, noise="d435"), 0.05, {}),
    "1 px, exact, ray": (px(1.0), 0.05, {"integrator": "ray"}),
    "10 mm, approached": (Scene(0.010, 1.5, 2.0, 320, "d435", "approach", nearest=0.3), 0.05, {}),
    "20 mm, approached": (Scene(0.020, 1.5, 2.0, 320, "d435", "approach", nearest=0.3), 0.05, {}),
    "20 mm, approached, reported": (
        Scene(0.020, 1.5, 2.0, 320, "d435", "approach", nearest=0.3, reported=True),
        0.05,
        {},
    ),
}


def compared(
    scene: Scene, voxel_size: float, seeds: range, peer: bool = True, **settings: Any
) -> dict[str, dict[str, float]]:
    """Return the mean scores of both libraries, by name, on the same frames of a scene."""
    found: dict[str, list[Found]] = {"stereovox": [], "octomap": []}
    for seed in seeds:
        frames = frames_of(scene, seed)
        found["stereovox"].append(
            judged(with_stereovox(scene, frames, voxel_size, **settings), scene, seed, voxel_size)
        )
        if peer:
            found["octomap"].append(judged(with_octomap(scene, frames, seed, voxel_size), scene, seed, voxel_size))
    return {
        who: {key: float(np.mean([getattr(one, key) for one in some])) for key in ("lost", "free", "wall")}
        for who, some in found.items()
        if some
    }


def sweep() -> dict[str, tuple[Scene, float, dict[str, Any]]]:
    """Return poles of 0.3 to 4 pixels with all noises, motions and backgrounds, by both integrators."""
    scenes = {
        f"{pixels} px, {noise}, {motion}, {background}": (
            px(pixels, width=424, noise=noise, motion=motion, gap=gap), 0.1, {},
        )
        for pixels in (0.3, 0.5, 1, 2, 4)
        for noise in NOISES
        for motion in MOTIONS
        for background, gap in BACKGROUNDS.items()
    }  # fmt: skip
    rays = {f"{name}, ray": (scene, size, {"integrator": "ray"}) for name, (scene, size, _) in scenes.items()}
    return {**scenes, **rays}


def gaps() -> dict[str, tuple[Scene, float, dict[str, Any]]]:
    """Return a pole of 0.9 pixels at half a sigma to ten in front of its wall, upright, level and leaning."""
    scenes = {}
    for sigmas in (0.5, 1, 1.5, 2, 2.3, 2.6, 3, 4, 6, 10):
        for tilt_deg in (0.0, 30.0, 90.0):
            scene = Scene(0.009, 3.3, np.inf, 480, "d435", focal=330.0, tilt_deg=tilt_deg, frames=40, along=0.4)
            gap = 1 / (1 / 3.2955 - sigmas * scene.sigma / 3.3**2) - 3.3
            scene = replace(scene, gap=gap)
            scenes[f"{sigmas} sigma, tilt {tilt_deg:.0f}"] = replace(scene, box=box_of(scene, 0.05)), 0.05, {}
    return scenes


def poses() -> dict[str, tuple[Scene, float, dict[str, Any]]]:
    """Return a pole of 13 mm with pose errors of up to 20 mm and 0.6 degrees."""
    return {
        f"poses off by {mm} mm, {degrees} deg, {voxel_size} m": (
            Scene(0.013, 2.0, 0.8, 424, "d435", pose_noise=(mm / 1000, degrees), frames=40), voxel_size, {},
        )
        for mm, degrees in ((0, 0.0), (3, 0.1), (10, 0.3), (20, 0.6))
        for voxel_size in (0.02, 0.05)
    }  # fmt: skip


def excesses(rows: dict[str, dict[str, dict[str, float]]]) -> Iterator[str]:
    """Yield a line for `lost` and `free`: by how much stereovox exceeds OctoMap, in points, and both means."""
    both = [row for row in rows.values() if len(row) == 2]
    for key in ("lost", "free"):
        ours, theirs = (100 * np.array([row[who][key] for row in both]) for who in ("stereovox", "octomap"))
        if len(both):
            over = ours - theirs
            yield (
                f"{key}: over OctoMap at most {over.max():.1f} points, {np.percentile(over, 95):.1f} in the worst "
                f"twentieth, {over.mean():.1f} on average; more than 2 in {(over > 2).sum()} of {len(both)}; "
                f"means {ours.mean():.1f} and {theirs.mean():.1f} %"
            )


def draw(rows: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draw lost and free shares of both libraries, one line per case."""
    from stereovox.view.figures import blank, labels, png_of

    figure = blank(9, 1.5 + 0.28 * len(rows))
    charts = figure.subplots(1, 2, sharey=True)
    at = np.arange(len(rows))
    for chart, key in zip(charts, ("lost", "free"), strict=True):
        for shift, who in ((-0.2, "stereovox"), (0.2, "octomap")):
            shares = [100 * row.get(who, {}).get(key, np.nan) for row in rows.values()]
            bars = chart.barh(at + shift, shares, 0.38, label=who)
            chart.bar_label(bars, fmt="%.0f", fontsize=6, padding=2)
        chart.set_yticks(at, list(rows), fontsize=7)
        chart.set_xlim(0, 110)
        labels(chart, f"{key}, per cent", "")
    charts[0].invert_yaxis()
    charts[1].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    path.write_bytes(png_of(figure, 120))


def chosen(wanted: argparse.Namespace) -> Iterator[tuple[str, Scene, float, dict[str, Any], range]]:
    """Yield name, scene, side of cells, settings and seeds of all requested cases."""
    if wanted.random:
        for seed in range(wanted.first_seed, wanted.first_seed + wanted.random):
            name, scene, voxel_size = random_scene(seed, wanted.apart)
            yield f"{seed}: {name}", scene, voxel_size, {}, range(seed, seed + 1)
        return
    cases = sweep() if wanted.sweep else gaps() if wanted.gaps else poses() if wanted.poses else CASES
    for name, (scene, voxel_size, settings) in cases.items():
        yield name, scene, voxel_size, settings, range(wanted.first_seed, wanted.first_seed + wanted.seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sweep", action="store_true", help="all sizes, noises, motions, backgrounds: takes hours")
    parser.add_argument("--random", type=int, default=0, metavar="N", help="so many random scenes")
    parser.add_argument("--apart", action="store_true", help="with --random: half with what no setting was chosen on")
    parser.add_argument("--gaps", action="store_true", help="a pole at half a sigma to ten before its wall")
    parser.add_argument("--poses", action="store_true", help="a pole with poses that are off")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--alone", action="store_true", help="without OctoMap")
    parser.add_argument("--camera", choices=["d435"], help="one that errs as a real one does, in all cases")
    add_settings(parser, "sensor.passes=0.25")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--picture", type=Path)
    wanted = parser.parse_args()
    given = overrides(wanted)
    rows = {}
    for name, scene, voxel_size, settings, some in chosen(wanted):
        if wanted.only not in name:
            continue
        scene = replace(scene, noise=HONEST) if wanted.camera else scene
        rows[name] = compared(scene, voxel_size, some, not wanted.alone, **{**settings, **given})
        if not wanted.json:
            shown = (f"{who}: lost {row['lost']:6.1%} free {row['free']:6.1%}" for who, row in rows[name].items())
            print(f"{name:32} {scene.pixels:5.2f} px ", *shown, sep="  ", flush=True)
    if not wanted.json:
        print(*excesses(rows), sep="\n")
    if wanted.json:
        print(json.dumps(rows))
    if wanted.picture:
        draw(rows, wanted.picture)


if __name__ == "__main__":
    main()
