# SPDX-License-Identifier: Apache-2.0
"""Scenes with a thin pole, as `thin.py` maps them: the geometry, the camera's motion, and its measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

from stereovox import Frame, PinholeCamera
from stereovox.frame import Reason
from stereovox.simulate.honest import RealisticDepthCamera

HZ = 30
HFOV_DEG, BASELINE, SUBPIXEL = 91.2, 0.05, 0.08
"""Parameters of a RealSense D435."""
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
ALONG_PX, ALONG_CELLS = 40, 4
"""Half the judged length of the pole in a random scene, at least: in pixels, and in cells."""
ROOM_PX = 24
"""Margin in pixels around that part in a random scene's image."""


@dataclass(frozen=True)
class Scene:
    """A pole, its background, a camera and its motion.

    pole: its thickness in metres; distance: from the camera's mean position to its axis. tilt_deg: of the pole, in the
    image (90: level); lean_deg: towards the wall. gap: metres from the axis to the wall behind, inf for none;
    slant_deg: of the wall. width: pixels across the whole image; focal: its focal length in pixels, 0: from `hfov_deg`.
    noise, motion: one of NOISES and MOTIONS; swing: metres that the camera moves to each side. pose_noise: standard
    deviation of the poses given to the map, in metres along each axis and degrees about each. nearest: least depth that
    the camera delivers, in metres; nearer pixels have no value, without a reason. box: first column and
    row, columns and rows of the part of the image that is used. along: half the length of pole that is judged, in
    metres; 0: nearly all that is seen.
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
    focal: float = 0.0
    baseline: float = BASELINE
    lean_deg: float = 0.0
    slant_deg: float = 0.0
    swing: float = 0.5
    box: tuple[int, int, int, int] | None = None
    along: float = 0.0

    @property
    def camera(self) -> PinholeCamera:
        hfov = 2 * np.degrees(np.arctan(0.5 * self.width / self.focal)) if self.focal else self.hfov_deg
        whole = PinholeCamera.from_field_of_view(self.width, round(self.width * ASPECT), hfov, self.baseline)
        if self.box:
            u, v, columns, rows = self.box
            return replace(whole, width=columns, height=rows, cx=whole.cx - u, cy=whole.cy - v)
        rows = min(whole.height, ROWS)  # the rest of the image shows more of the same
        return replace(whole, height=rows, cy=(rows - 1) / 2)

    @property
    def pixels(self) -> float:
        """Width of the pole in pixels."""
        return self.pole * self.camera.fx / self.distance

    @property
    def axis(self) -> NDArray[np.float64]:
        tilt, lean = radians(self.tilt_deg), radians(self.lean_deg)
        return np.array([sin(lean), sin(tilt) * cos(lean), cos(tilt) * cos(lean)])

    @property
    def sigma(self) -> float:
        """Noise of depth at the pole's distance, in metres, as the map assumes it."""
        return self.distance**2 * SUBPIXEL / (self.camera.fx * self.baseline)

    @property
    def gap_sigma(self) -> float:
        """Gap between the pole's front and the wall in sigma of inverse depth."""
        near = self.distance - self.pole / 2
        return (1 / near - 1 / (self.distance + self.gap)) * self.distance**2 / self.sigma


def px(pixels: float, distance: float = 4.0, width: int = 320, **other: object) -> Scene:
    """Return a scene with a pole `pixels` wide."""
    scene = Scene(0.01, distance=distance, width=width, **other)
    return replace(scene, pole=pixels * distance / scene.camera.fx)


def pose(scene: Scene, i: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return T_world_camera (4, 4) of frame `i`: the world's x is forward, y left, z up; the pole's foot at (0, 0)."""
    phase = 2 * i / max(scene.frames - 1, 1) - 1  # -1 to 1 over the run
    place, yaw, pitch = np.array([-scene.distance, 0.0123, 0.0077]), 0.0, 0.0
    if scene.motion == "sideways":
        place[1] += scene.swing * phase
    elif scene.motion == "up":
        place[2] += 0.6 * scene.swing * phase
        place[1] += 0.02 * phase
    elif scene.motion == "towards":
        place[0] += 0.25 * scene.distance * phase
    elif scene.motion == "turning":
        yaw = radians(20) * phase
    elif scene.motion == "shaking":
        place = place + 0.02 * random.standard_normal(3)
        yaw, pitch = radians(1.0) * random.standard_normal(2)
    elif scene.motion == "approach":  # ends so near that the camera no longer sees the pole
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
    wall = np.full(root.shape, np.inf)
    with np.errstate(invalid="ignore", divide="ignore"):
        pole = np.where(root > 0, (-half - np.sqrt(root)) / square, np.inf)
        if np.isfinite(scene.gap):
            slope = tan(radians(scene.slant_deg))
            wall = (scene.gap - place[0] - slope * place[1]) / (rays[..., 0] + slope * rays[..., 1])
    pole[~(pole > 0)] = np.inf
    wall[~(wall > 0)] = np.inf
    return np.minimum(pole, wall)


def measured(
    scene: Scene, T: NDArray, random: np.random.Generator, seed: list[int]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the camera's image: depth in metres (0: none) and the reason of each pixel.

    seed: of the run and of the frame, for a camera that draws its own numbers.
    """
    depth = true_depth(scene, T)
    if scene.noise == HONEST:
        millimetres, reason = RealisticDepthCamera(scene.camera, nearest=scene.nearest).measure(depth, seed, T)
        return millimetres.astype(np.float32) / 1000, reason
    if scene.noise == "flying":
        depth = flying(scene, T, depth, random)
    inverse = 1 / depth
    if scene.noise in ("d435", "smooth"):
        noise = random.standard_normal(depth.shape)
        if scene.noise == "smooth":
            noise = smoothed(noise)
        inverse = inverse + SUBPIXEL / (scene.camera.fx * scene.baseline) * noise
    depth = np.where(inverse > 1e-9, 1 / np.maximum(inverse, 1e-9), np.inf)
    reason = np.where(depth > FARTHEST, Reason.TOO_FAR, Reason.VALID).astype(np.uint8)
    reason[depth < scene.nearest] = Reason.TOO_NEAR if scene.reported else Reason.UNKNOWN
    return np.where(reason == Reason.VALID, depth, 0).astype(np.float32), reason


def flying(scene: Scene, T: NDArray, depth: NDArray, random: np.random.Generator) -> NDArray[np.float64]:
    """Let pixels on two surfaces measure a depth in between, as cameras with wide pixels or windows do."""
    corners = [true_depth(scene, T, du, dv) for du in (-0.4, 0.4) for dv in (-0.4, 0.4)]
    near, far = np.min([depth, *corners], axis=0), np.max([depth, *corners], axis=0)
    mixed = (far > near + 0.05) & (random.random(depth.shape) < 0.5)
    far = np.where(np.isfinite(far), far, np.minimum(near, FARTHEST) + 2)
    return np.where(
        mixed, np.minimum(near, FARTHEST) + random.random(depth.shape) * (far - np.minimum(near, FARTHEST)), depth
    )


def smoothed(noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return noise correlated over about a pixel on each side, of equal size."""
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / 1.0) ** 2)
    kernel /= np.sqrt((kernel**2).sum())
    for axis in (0, 1):
        noise = np.apply_along_axis(np.convolve, axis, noise, kernel, mode="same")
    return noise


def shaken(T: NDArray, noise: tuple[float, float], random: np.random.Generator) -> NDArray[np.float64]:
    """Return the pose from a tracker with this noise."""
    metres, degrees = noise
    off = np.eye(4)
    off[:3, :3] = rotation(*np.radians(degrees * random.standard_normal(3)))
    off[:3, 3] = metres * random.standard_normal(3)
    return T @ off


def start_of(seed: int) -> NDArray[np.float64]:
    """Return the scene's pose (4, 4) in the map's world: the grid is arbitrarily placed relative to the pole."""
    start = np.eye(4)
    start[:3, 3] = np.random.default_rng([seed, 77]).uniform(-1, 1, 3)
    return start


def frames_of(scene: Scene, seed: int) -> list[Frame]:
    """Return the frames of a scene with the poses given to the map."""
    random = np.random.default_rng([seed, 77])
    random.uniform(-1, 1, 3)  # of `start_of`
    start = start_of(seed)
    frames = []
    for i in range(scene.frames):
        T = pose(scene, i, random)
        depth, reason = measured(scene, T, random, [seed, i])
        T = start @ shaken(T, scene.pose_noise, random)
        frames.append(Frame(depth, scene.camera, T, round(i * 1e9 / HZ), 1.0, reason, f"thin {i}"))
    return frames


CAMERAS: dict[str, tuple[int, float, float]] = {
    "D435 424": (424, 0.0, 0.05),
    "D435 640": (640, 0.0, 0.05),
    "D435 848": (848, 0.0, 0.05),
    "f 330": (480, 330.0, 0.05),
    "Kinect 525": (640, 525.0, 0.075),
    "Kinect 585": (640, 585.0, 0.075),
}
"""Pixels across, focal length (0: the D435's) and baseline of the cameras of random scenes."""
APART: dict[str, str] = {"camera": "Kinect 585", "noise": "smooth"}
"""The camera and the noise on which no setting was chosen."""
CELLS = (0.02, 0.03, 0.05, 0.1, 0.2)
POSE_NOISES = ((0.0, 0.0), (0.0, 0.0), (0.003, 0.1), (0.010, 0.3))


def random_scene(seed: int, apart: bool = False) -> tuple[str, Scene, float]:
    """Return a name, a scene and the side of its cells in metres. apart: with the camera or the noise of APART."""
    random = np.random.default_rng([seed, 4711])
    cameras, noises = list(CAMERAS), [*NOISES, "honest"]
    camera, noise = str(random.choice(cameras)), str(random.choice(noises))
    if apart and random.random() < 0.5:
        camera = APART["camera"] if seed % 2 else camera
        noise = noise if seed % 2 else APART["noise"]
    if not apart:
        camera = "Kinect 525" if camera == APART["camera"] else camera
        noise = "d435" if noise == APART["noise"] else noise
    width, focal, baseline = CAMERAS[camera]
    pixels, distance = float(np.exp(random.uniform(np.log(0.3), np.log(4)))), random.uniform(0.8, 5.0)
    tilt = float(random.choice([0.0, 90.0, random.uniform(-90, 90)]))
    scene = px(
        pixels, distance, width, focal=focal, baseline=baseline, noise=noise, tilt_deg=tilt,
        motion=str(random.choice(MOTIONS)), pose_noise=POSE_NOISES[random.integers(len(POSE_NOISES))],
        frames=int(random.choice([5, 10, 20, 40, 60])), swing=0.125 * distance,
    )  # fmt: skip
    voxel_size = float(random.choice(CELLS))
    part = 0.4 * scene.width * ASPECT * distance / scene.camera.fx  # of the pole, that the camera sees
    along = min(max(ALONG_PX * distance / scene.camera.fx, ALONG_CELLS * voxel_size), part)
    voxel_size = min(voxel_size, max(size for size in CELLS if 2.5 * size < along or size == CELLS[0]))
    scene = with_background(replace(scene, along=along), random)
    return named(scene, camera, voxel_size), replace(scene, box=box_of(scene, voxel_size)), voxel_size


def with_background(scene: Scene, random: np.random.Generator) -> Scene:
    """Return the scene with a wall 0.5 to 10 sigma behind (mostly), a far one, a slanted one, or nothing."""
    kind, sigmas, lean, slant = random.random(), np.exp(random.uniform(np.log(0.5), np.log(10))), *random.random(2)
    if kind > 0.85:
        return replace(scene, gap=np.inf, lean_deg=40 * lean * (kind > 0.92))
    inverse = 1 / scene.distance - sigmas * scene.sigma / scene.distance**2
    gap = 1 / inverse - scene.distance + scene.pole / 2 if inverse > 0.1 else 0.8
    gap = 0.8 if kind > 0.7 else max(gap, 0.6 * scene.pole)
    most = np.degrees(np.arctan(0.4 * (gap - scene.pole / 2) / scene.along))  # so that it stays in front of the wall
    slant = 45 * slant if kind > 0.6 else 0.0
    across = abs(scene.axis[1]) * scene.along + 0.01
    slant = min(slant, float(np.degrees(np.arctan(0.4 * gap / across))))
    return replace(scene, gap=float(gap), lean_deg=float(min(40.0, most) * lean), slant_deg=slant)


def box_of(scene: Scene, voxel_size: float) -> tuple[int, int, int, int]:
    """Return the part of the image (first column and row, columns and rows) that shows the judged part of the pole."""
    whole = replace(scene, box=(0, 0, scene.width, round(scene.width * ASPECT))).camera
    spots = np.concatenate(
        [pixels_of(scene, whole, pose(scene, i, np.random.default_rng(i))) for i in range(scene.frames)]
    )
    room = ROOM_PX + 3 * voxel_size * whole.fx / scene.distance
    low, high = np.floor(spots.min(0) - room), np.ceil(spots.max(0) + room)
    low, high = np.maximum(low, 0), np.minimum(high, [whole.width, whole.height])
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def pixels_of(scene: Scene, camera: PinholeCamera, T: NDArray) -> NDArray[np.float64]:
    """Return column and row (N, 2) in the image of points on the judged part of the pole from this pose."""
    points = np.linspace(-scene.along, scene.along, 41)[:, None] * scene.axis
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def named(scene: Scene, camera: str, voxel_size: float) -> str:
    behind = f"{scene.gap_sigma:.1f} sigma" if np.isfinite(scene.gap) else "open"
    turned = f"tilt {scene.tilt_deg:.0f} lean {scene.lean_deg:.0f} slant {scene.slant_deg:.0f}"
    moved = f"{scene.motion} {scene.frames}, {1000 * scene.pose_noise[0]:.0f} mm"
    return (
        f"{scene.pixels:.1f} px {1000 * scene.pole:.0f} mm at {scene.distance:.1f} m, {behind}, {turned}, {camera}, "
        f"{scene.noise}, {moved}, {voxel_size:g} m"
    )
