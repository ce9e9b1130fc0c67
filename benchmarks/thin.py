# SPDX-License-Identifier: Apache-2.0
"""What becomes of poles and wires of 0.3 to 4 pixels: stereovox and OctoMap on the same frames.

    python benchmarks/thin.py [--sweep] [--seeds 3] [--only WORDS] [--alone] [--set key=value ...] [--json]
                              [--camera d435] [--picture thin.png]

A pole stands before a wall, or before nothing, and a simulated camera looks at it while it stands, flies or turns.
`lost`: share of the layers of cells along the pole, as far as it was seen, without one occupied cell that the pole
touches. `free`: share of the cells that the pole touches and the map calls free. Truth is exact, a cylinder.
The cases' own noise is independent from pixel to pixel; `--camera d435` takes all of them with a camera that errs as a
real one does (`stereovox.simulate.honest`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox import Frame, Mapper, PinholeCamera
from stereovox.cli.options import add_settings, overrides
from stereovox.frame import Reason
from stereovox.simulate.honest import HonestCamera

HZ = 30
HFOV_DEG, BASELINE, SUBPIXEL = 91.2, 0.05, 0.08
"""Of a RealSense D435."""
ASPECT = 480 / 848
ROWS = 128
"""Rows of its image that are used."""
NEAREST, FARTHEST = 0.195, 10.0
"""Depths in metres that the simulated camera delivers."""
NOISES = ("exact", "flying", "d435", "smooth")
HONEST = "honest"
"""The noise of `--camera d435`."""
MOTIONS = ("still", "sideways", "up", "towards", "turning", "shaking")
BACKGROUNDS = {"close": 0.2, "wall": 0.8, "open": np.inf}
"""Metres from the pole's axis to the wall behind it."""


@dataclass(frozen=True)
class Scene:
    """A pole, what is behind it, a camera and how it moves.

    pole: its thickness in metres; distance: from the camera's mean place to its axis. tilt_deg: of the pole, in the
    image. gap: metres from the axis to the wall behind, inf for none. width: pixels across. noise, motion: one of
    NOISES and MOTIONS. pose_noise: standard deviation of the poses given to the map, in metres along each axis and
    degrees about each. nearest: least depth that the camera delivers, in metres; nearer pixels have no value, and the
    camera does not say why.
    """

    pole: float
    distance: float = 4.0
    gap: float = 0.8
    width: int = 320
    noise: str = "exact"
    motion: str = "sideways"
    tilt_deg: float = 0.0
    pose_noise: tuple[float, float] = (0.0, 0.0)
    frames: int = 60
    nearest: float = NEAREST
    reported: bool = False
    hfov_deg: float = HFOV_DEG

    @property
    def camera(self) -> PinholeCamera:
        whole = PinholeCamera.from_field_of_view(self.width, round(self.width * ASPECT), self.hfov_deg, BASELINE)
        rows = min(whole.height, ROWS)  # the rest of the image shows more of the same
        return replace(whole, height=rows, cy=(rows - 1) / 2)

    @property
    def pixels(self) -> float:
        """Width of the pole in pixels."""
        return self.pole * self.camera.fx / self.distance

    @property
    def axis(self) -> NDArray[np.float64]:
        return np.array([0.0, sin(radians(self.tilt_deg)), cos(radians(self.tilt_deg))])


def pose(scene: Scene, i: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return T_world_camera (4, 4) of frame `i`: the world's x is forward, y left, z up; the pole's foot at (0, 0)."""
    phase = 2 * i / max(scene.frames - 1, 1) - 1  # -1 to 1 over the run
    place, yaw, pitch = np.array([-scene.distance, 0.0123, 0.0077]), 0.0, 0.0
    if scene.motion == "sideways":
        place[1] += 0.5 * phase
    elif scene.motion == "up":
        place[2] += 0.3 * phase
        place[1] += 0.02 * phase
    elif scene.motion == "towards":
        place[0] += 0.25 * scene.distance * phase
    elif scene.motion == "turning":
        yaw = radians(20) * phase
    elif scene.motion == "shaking":
        place = place + 0.02 * random.standard_normal(3)
        yaw, pitch = radians(1.0) * random.standard_normal(2)
    elif scene.motion == "approach":  # ends so near that the camera is blind to the pole
        place[0] = -(scene.distance + (0.2 - scene.distance) * min(1.0, 1.5 * i / (scene.frames - 1)))
        place[1] = 0.0
    elif scene.motion != "still":
        raise ValueError(f"motion '{scene.motion}' is none of {MOTIONS}")
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T = np.eye(4)
    T[:3, :3] = rotation(yaw, pitch) @ level
    T[:3, 3] = place
    return T


def rotation(yaw: float, pitch: float, roll: float = 0.0) -> NDArray[np.float64]:
    cy, sy, cp, sp, cr, sr = cos(yaw), sin(yaw), cos(pitch), sin(pitch), cos(roll), sin(roll)
    return (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )


def true_depth(scene: Scene, T: NDArray, du: float = 0.0, dv: float = 0.0) -> NDArray[np.float64]:
    """Return the exact depth (height, width) along the optical axis at pixels moved by (du, dv); inf: nothing."""
    camera = scene.camera
    x = (np.arange(camera.width) + du - camera.cx) / camera.fx
    y = (np.arange(camera.height) + dv - camera.cy) / camera.fy
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1) @ T[:3, :3].T
    a, place = scene.axis, T[:3, 3]
    across, start = rays - (rays @ a)[..., None] * a, place - (place @ a) * a
    square, half = (across**2).sum(-1), across @ start
    root = half**2 - square * (start @ start - (scene.pole / 2) ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        pole = np.where(root > 0, (-half - np.sqrt(root)) / square, np.inf)
        wall = (scene.gap - place[0]) / rays[..., 0] if np.isfinite(scene.gap) else np.full(pole.shape, np.inf)
    pole[~(pole > 0)] = np.inf
    wall[~(wall > 0)] = np.inf
    return np.minimum(pole, wall)


def measured(
    scene: Scene, T: NDArray, random: np.random.Generator, seed: list[int]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return what the camera makes of it: depth in metres (0: none) and the reason of each pixel.

    seed: of the run and of the frame, for a camera that draws its own numbers.
    """
    depth = true_depth(scene, T)
    if scene.noise == HONEST:
        millimetres, reason = HonestCamera(scene.camera, nearest=scene.nearest).measure(depth, seed, T)
        return millimetres.astype(np.float32) / 1000, reason
    if scene.noise == "flying":
        depth = flying(scene, T, depth, random)
    inverse = 1 / depth
    if scene.noise in ("d435", "smooth"):
        noise = random.standard_normal(depth.shape)
        if scene.noise == "smooth":
            noise = smoothed(noise)
        inverse = inverse + SUBPIXEL / (scene.camera.fx * BASELINE) * noise
    depth = np.where(inverse > 1e-9, 1 / np.maximum(inverse, 1e-9), np.inf)
    reason = np.where(depth > FARTHEST, Reason.TOO_FAR, Reason.VALID).astype(np.uint8)
    reason[depth < scene.nearest] = Reason.TOO_NEAR if scene.reported else Reason.UNKNOWN
    return np.where(reason == Reason.VALID, depth, 0).astype(np.float32), reason


def flying(scene: Scene, T: NDArray, depth: NDArray, random: np.random.Generator) -> NDArray[np.float64]:
    """Let pixels that see two surfaces measure something between them, as cameras with wide pixels or windows do."""
    corners = [true_depth(scene, T, du, dv) for du in (-0.4, 0.4) for dv in (-0.4, 0.4)]
    near, far = np.min([depth, *corners], axis=0), np.max([depth, *corners], axis=0)
    mixed = (far - near > 0.05) & (random.random(depth.shape) < 0.5)
    far = np.where(np.isfinite(far), far, near + 2)
    return np.where(mixed, near + random.random(depth.shape) * (far - near), depth)


def smoothed(noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return noise that is alike over about a pixel on each side, of the same size."""
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / 1.0) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    for axis in (0, 1):
        noise = np.apply_along_axis(np.convolve, axis, noise, kernel, mode="same")
    return noise


def shaken(T: NDArray, noise: tuple[float, float], random: np.random.Generator) -> NDArray[np.float64]:
    """Return the pose that a tracker with this noise gives."""
    metres, degrees = noise
    off = np.eye(4)
    off[:3, :3] = rotation(*np.radians(degrees * random.standard_normal(3)))
    off[:3, 3] = metres * random.standard_normal(3)
    return T @ off


def frames_of(scene: Scene, seed: int) -> list[Frame]:
    """Return the frames of a scene with the poses that the map is told."""
    random = np.random.default_rng([seed, 77])
    start = np.eye(4)  # the grid stands anyhow to the pole
    start[:3, 3] = random.uniform(-1, 1, 3)
    frames = []
    for i in range(scene.frames):
        T = pose(scene, i, random)
        depth, reason = measured(scene, T, random, [seed, i])
        T = start @ shaken(T, scene.pose_noise, random)
        frames.append(Frame(depth, scene.camera, T, round(i * 1e9 / HZ), 1.0, reason, f"thin {i}"))
    return frames


def touched(scene: Scene, seed: int, voxel_size: float, low: float, high: float) -> tuple[NDArray, NDArray]:
    """Return a point in each cell the pole touches between two heights, (N, 3) metres, and the cells' layers (N,)."""
    start = np.random.default_rng([seed, 77]).uniform(-1, 1, 3)
    a, radius = scene.axis, scene.pole / 2
    beside = np.array([1.0, 0.0, 0.0]), np.cross(a, [1.0, 0.0, 0.0])
    along = np.arange(low, high, voxel_size / 40) / a[2]
    turn = np.arange(0, 2 * np.pi, 2 * np.pi / max(12, int(2 * np.pi * radius / (voxel_size / 40))))
    ring = radius * (np.cos(turn)[:, None] * beside[0] + np.sin(turn)[:, None] * beside[1])
    points = (start + along[:, None, None] * a + ring).reshape(-1, 3)
    cells = np.unique(np.floor(points / voxel_size).astype(int), axis=0)
    layers = cells[:, 2]
    whole = (layers > layers.min()) & (layers < layers.max())
    return (cells[whole] + 0.5) * voxel_size, layers[whole]


@dataclass
class Found:
    """lost, free: shares as above, between 0 and 1. wall: mean occupied cells of columns through the wall."""

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
    points, layers = touched(scene, seed, voxel_size, -reach, reach)
    states = state(points)
    found = {layer for layer, what in zip(layers, states, strict=True) if what == 3}
    start = np.random.default_rng([seed, 77]).uniform(-1, 1, 3)
    thick = np.nan
    if np.isfinite(scene.gap):
        x = np.arange(-0.15 if scene.gap > 0.5 else 0, 1.0, voxel_size) + scene.gap
        y, z = np.arange(0.3, 0.8, voxel_size), np.arange(-0.2, 0.2, voxel_size)
        grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)
        thick = float((state((grid + start).reshape(-1, 3)).reshape(grid.shape[:3]) == 3).sum(0).mean())
    return Found(1 - len(found) / len(set(layers.tolist())), float((states == 1).mean()), thick)


def with_stereovox(scene: Scene, frames: list[Frame], voxel_size: float, **settings: Any) -> Any:
    mapper = Mapper(voxel_size=voxel_size, max_range=max(5.0, 1.5 * scene.distance), **settings)
    for frame in frames:
        refused = mapper.add(frame).refused
        assert not refused, refused
    return mapper.map.state


def with_octomap(scene: Scene, frames: list[Frame], voxel_size: float) -> Any:
    """Map with OctoMap's own numbers: 0.7 for a hit, 0.4 for a miss; a cell is occupied above 0.5."""
    import octomap

    tree = octomap.OcTree(voxel_size)
    reach = max(5.0, 1.5 * scene.distance)
    for frame in frames:
        z = np.asarray(frame.depth, float)
        far = frame.reason == Reason.TOO_FAR
        z = np.where(far | (z > reach), 2 * reach, z)
        points = frame.camera.back_project(z)[z > 0] @ frame.T_world_sensor[:3, :3].T + frame.T_world_sensor[:3, 3]
        tree.insertPointCloud(points, frame.T_world_sensor[:3, 3].copy(), reach, False, True)

    def state(points: NDArray) -> NDArray:
        nodes = [tree.search(point) for point in points]
        return np.array([0 if _none(node) else (3 if tree.isNodeOccupied(node) else 1) for node in nodes])

    return state


def _none(node: Any) -> bool:
    try:
        node.getOccupancy()
    except Exception:
        return True
    return False


def px(pixels: float, distance: float = 4.0, width: int = 320, **other: Any) -> Scene:
    """Return a scene with a pole of so many pixels."""
    scene = Scene(0.01, distance=distance, width=width, **other)
    return replace(scene, pole=pixels * distance / scene.camera.fx)


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
            found["octomap"].append(judged(with_octomap(scene, frames, voxel_size), scene, seed, voxel_size))
    return {
        who: {key: float(np.mean([getattr(one, key) for one in some])) for key in ("lost", "free", "wall")}
        for who, some in found.items()
        if some
    }


def sweep() -> dict[str, tuple[Scene, float, dict[str, Any]]]:
    """Return poles of 0.3 to 4 pixels under all noises, motions and backgrounds, by both integrators."""
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


def draw(rows: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draw lost and free shares of both libraries, a line a case."""
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sweep", action="store_true", help="all sizes, noises, motions, backgrounds: takes hours")
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
    seeds = range(wanted.first_seed, wanted.first_seed + wanted.seeds)
    rows = {}
    for name, (scene, voxel_size, settings) in (sweep() if wanted.sweep else CASES).items():
        if wanted.only not in name:
            continue
        scene = replace(scene, noise=HONEST) if wanted.camera else scene
        rows[name] = compared(scene, voxel_size, seeds, not wanted.alone, **{**settings, **given})
        if not wanted.json:
            shown = (f"{who}: lost {row['lost']:6.1%} free {row['free']:6.1%}" for who, row in rows[name].items())
            print(f"{name:32} {scene.pixels:5.2f} px ", *shown, sep="  ", flush=True)
    if wanted.json:
        print(json.dumps(rows))
    if wanted.picture:
        draw(rows, wanted.picture)


if __name__ == "__main__":
    main()
