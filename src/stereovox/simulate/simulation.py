# SPDX-License-Identifier: Apache-2.0
"""Recordings without files: a simulated depth camera in a built-in scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.cameras.wide import Lens
from stereovox.errors import ConfigError, SourceError
from stereovox.frame import Frame, Photo, Reason
from stereovox.geometry.se3 import Transform, inverse
from stereovox.simulate.d435 import D435, classify, depth_camera, photograph
from stereovox.simulate.flight import CameraPath, drifting
from stereovox.simulate.floors.drive import WIDTH
from stereovox.simulate.honest import honest_d435, honest_kinect
from stereovox.simulate.scene import Scene
from stereovox.simulate.stage import Face, Stage, one_of, within
from stereovox.sources import parameters
from stereovox.sources.base import DepthSource

SCENES = {
    "room": "stereovox.simulate.scenes.room:stage",
    "box": "stereovox.simulate.scenes.hall:box_stage",
    "aisle": "stereovox.simulate.scenes.hall:aisle_stage",
    "apartment": "stereovox.simulate.scenes.apartment:stage",
    "wall": "stereovox.simulate.scenes.hall:wall_stage",
    "flight": "stereovox.simulate.flight:stage",
    "town": "stereovox.simulate.scenes.town:stage",
    "loop": "stereovox.simulate.scenes.corridors:stage",
    "offices": "stereovox.simulate.scenes.offices:stage",
    "racks": "stereovox.simulate.scenes.racks:stage",
    "hall": "stereovox.simulate.scenes.hall:stage",
}
"""Functions that return a `Stage`; their keyword arguments and defaults are the scene's parameters."""
AXES = ("world", "optical")
SIMPLE = "simple"
CAMERAS = (SIMPLE, "d435", "kinect")
GREY_NOISE = 1.5
"""Noise of photographs, in grey levels."""
OWN = -1.0
"""Marks the camera's own value."""


@dataclass(frozen=True)
class Options:
    """Parameters of every simulation. A 0 that means "the scene's own" leaves the choice to the scene.

    axes: `world` (z up) or `optical` (Chien 2020: x right, y down, z forward, origin at the first camera).
    frames: number of frames on the same path (0: the scene's own); noise: 0 for exact depth; seed: of the noise.
    camera: `simple` (noise independent from pixel to pixel, true reasons for invalid pixels), or one with realistic
        errors: `d435`, `kinect` (docs/simulations.md).
    image_width: pixels (0: the scene's own, mostly 848; of a Kinect 640); the height follows, the field of view stays.
    barrel: relative error by which the left and right borders appear too far; toe_in: degrees by which the right eye is
        turned unnoticed; farthest: largest depth that the camera delivers, metres (0: the scene's own).
    subpixel, correlation: size of the noise, and the Gaussian that smooths it, in pixels (-1: the camera's own).
    photo: contrast of the pattern on all surfaces in a grey image taken with the depth and registered to it (0.5:
        strong, 0.05: painted walls; 0: no image).
    drift: error of the poses, in metres per metre travelled (0.01 is a good tracker's), in all directions; the
        heading drifts too, roll and pitch stay right, and no place is recognised. Images show the true poses.
    """

    axes: str = "world"
    frames: int = 0
    noise: bool = True
    seed: int = 0
    camera: str = SIMPLE
    image_width: int = 0
    barrel: float = 0.0
    toe_in: float = 0.0
    subpixel: float = OWN
    correlation: float = OWN
    farthest: float = 0.0
    photo: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        one_of("axes", self.axes, AXES)
        one_of("camera", self.camera, CAMERAS)
        within("frames", self.frames, 0, 10_000_000)
        within("seed", self.seed, 0, 2**63)
        if self.image_width:
            within("image_width", self.image_width, 16, 1920)
        within("barrel", self.barrel, -0.5, 1)
        within("toe_in", self.toe_in, -1, 1)
        for name in ("subpixel", "correlation"):
            if getattr(self, name) != OWN:
                within(name, getattr(self, name), 0, 5)
        within("farthest", self.farthest, 0, 65)
        within("photo", self.photo, 0, 1)
        within("drift", self.drift, 0, 0.2)


class Simulation(DepthSource):
    """Frames of a simulated depth camera in a built-in scene.

    location: `sim:SCENE`, or with parameters `sim:SCENE?key=value&key=value`:

        sim:room                                    furnished room and corridor (the demo)
        sim:box?size=large|small&distance=2&x=0&y=0&wall=4.1        a box before a wall; the camera stands
        sim:aisle?length=12&width=1.27&speed=0       a narrow aisle; the camera stands, or walks at `speed`
        sim:apartment?speed=0.8                     six rooms, scanned by hand
        sim:wall?distance=1.4&tilt=0&turn=0         a flat wall that fills the view
        sim:flight?length=2000&speed=5              out and back along the same hall
        sim:town?blocks=6&drive=0&length=120        streets with houses, lamps, trees and cars; a drive through them
        sim:loop?length=60&laps=2&plan=0           a ring of corridors, walked round several times
        sim:offices?offices=8&visits=10&walk=0      a corridor with offices of one kind, some visited again
        sim:hall?plan=0                             a hall at random, with pillars, posts, boxes and lamps

    See the scene functions for their parameters, and `Options` for those of every scene. World: z up, x forward, y
    left, metres; with `axes=optical` x right, y down, z forward from the first camera. Frames can be read in any order
    and are always the same for the same `seed`.
    Reasons of the `simple` camera are the true ones: TOO_NEAR, TOO_FAR (beyond the device's `farthest`, and known to be
    free no farther), UNMATCHED next to edges and where the right eye sees nothing. The others have no reasons.
    noise: False gives exact depth in metres (float32, inf if there is nothing) without noise or holes.
    frames: number of frames on the whole path; None: the scene's own. The duration of the path does not change.
    Raises SourceError for an unknown scene or parameter and for values out of range.
    """

    layout = f"simulation ({', '.join(f'sim:{name}' for name in SCENES)})"

    def __init__(
        self, location: str | Path = "sim:room", *, noise: bool = True, frames: int | None = None, seed: int = 0
    ):
        self.name = str(location)
        texts = {"noise": noise, "frames": frames or 0, "seed": seed}
        try:
            self.options, stage = _read(self.name.removeprefix("sim:"), texts)
        except (SourceError, ConfigError) as error:
            raise SourceError(f"{location}: {error}") from None
        self.device = _device(stage.device, self.options)
        self.camera = self.device.camera
        self.noise, self.seed = self.options.noise, self.options.seed
        self._frames = self.options.frames or stage.frames
        self.period_ns = round(1e9 / stage.hz * max(stage.frames - 1, 1) / max(self._frames - 1, 1))
        self._world = stage
        self.up = "z" if self.options.axes == "world" else ""
        self._seen: tuple[Transform, NDArray[np.float32]] | None = None

    @classmethod
    def recognises(cls, location: str | Path) -> bool:
        """Return whether `location` names a simulation."""
        return str(location).startswith("sim:")

    @cached_property
    def stage(self) -> Stage:
        """The scene and the path through it, in the frame of the poses."""
        return self._in_frame(self._world)

    @property
    def scene(self) -> Scene:
        """The solids around the camera, in the frame of the poses."""
        return self.stage.scene

    @property
    def faces(self) -> tuple[Face, ...]:
        """Flat surfaces for evaluating a map, in the frame of the poses; empty for `sim:room`."""
        return self.stage.faces

    def __len__(self) -> int:
        return self._frames

    def frame(self, i: int) -> Frame:
        """Return frame `i` (negative: from the end); raises IndexError for a frame that does not exist."""
        i = range(len(self))[i]
        return self.observe(i, self.true_depth(i))

    def true_depth(self, i: int) -> NDArray[np.float32]:
        """Return the exact depth (height, width) in metres along the optical axis, inf if there is nothing;
        read-only."""
        T = self._world.path(self._share(i))  # the frame of the poses must not change the image
        seen = self._seen
        if seen is None or not np.array_equal(seen[0], T):
            seen = self._seen = (T, self._cast(T))  # cache for a static camera
        return seen[1]

    def observe(self, i: int, true_depth_m: NDArray[np.float32]) -> Frame:
        """Return the camera's frame `i` for the exact depth `true_depth_m` (height, width)."""
        T_world_camera = self._world.path(self._share(i))
        name = f"{self.name} frame {i}"
        return self._taken(true_depth_m, i, T_world_camera, self.pose(i), i * self.period_ns, name, self._photo(i))

    def frame_from(
        self, T_world_camera: Transform, number: int, stamp_ns: int, T_reported: Transform | None = None
    ) -> Frame:
        """Return the camera's frame from any pose off its path, world z up.

        T_world_camera: (4, 4), the true pose. number: different numbers give different noise. T_reported: the pose of
        the frame; None: the true one.
        """
        reported = T_world_camera if T_reported is None else T_reported
        depth_m = self._cast(T_world_camera)
        return self._taken(depth_m, number, T_world_camera, reported, stamp_ns, f"{self.name} look {number}", None)

    def _taken(
        self,
        true_depth_m: NDArray[np.float32],
        number: int,
        T_world_camera: Transform,
        T_reported: Transform,
        stamp_ns: int,
        name: str,
        photo: Photo | None,
    ) -> Frame:
        if self.noise:
            depth, reason = self.device.measure(true_depth_m, [self.seed, number], T_world_camera)
            scale = 0.001
        else:
            depth, scale = self.device.distorted(true_depth_m), 1.0
            reason = classify(depth, self.device.nearest, self.device.farthest)
            depth = np.where(reason == Reason.VALID, depth, np.float32(0))
        return Frame(
            depth, self.camera, T_reported, stamp_ns, scale, reason, name, farthest=self.device.farthest, photo=photo
        )

    def _photo(self, i: int) -> Photo | None:
        """Return the grey image of frame `i`, rendered when it is needed; None if `photo` is 0."""
        if not self.options.photo:
            return None
        camera = self.camera
        lens = Lens("pinhole", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        T, seed = self._world.path(self._share(i)), [self.seed, i, 1]
        contrast = self.options.photo
        return Photo(lambda: photograph(self._world.scene, lens, T, GREY_NOISE, seed, contrast), camera)

    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) as reported with frame `i`, drifted; raises IndexError beyond the last."""
        self._check(i)
        return self._reported(self._share(i))

    def true_pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) from which frame `i` was taken; raises IndexError beyond the last."""
        self._check(i)
        return self.stage.path(self._share(i))

    def upright_pose_at(self, stamp_ns: float) -> Transform:
        """Return the true T_world_camera (4, 4) at any time, world z up whatever `axes` is.

        The camera is static before the first frame and after the last.
        """
        last = max(len(self) - 1, 1) * self.period_ns
        return self._world.path(min(max(stamp_ns / last, 0.0), 1.0))

    @cached_property
    def _reported(self) -> CameraPath:
        """The poses as reported in frames."""
        if not self.options.drift:
            return self.stage.path
        seconds = (self._world.frames - 1) / self._world.hz
        random = np.random.default_rng([self.seed, 0, 2])  # separate from the noise
        return self._in_frame(
            replace(self._world, path=drifting(self._world.path, seconds, self.options.drift, random))
        ).path

    def _in_frame(self, stage: Stage) -> Stage:
        """Return a stage, world z up, in the frame of the poses."""
        return stage if self.options.axes == "world" else stage.moved(inverse(self._world.path(0.0)))

    def _check(self, i: int) -> None:
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name} has frames 0 to {len(self) - 1}, not {i}")

    def _share(self, i: int) -> float:
        return i / max(len(self) - 1, 1)

    def _cast(self, T_world_camera: Transform) -> NDArray[np.float32]:
        directions = self._directions @ T_world_camera[:3, :3].T.astype(np.float32)
        depth = self._world.scene.cast(T_world_camera[:3, 3], directions)
        depth.setflags(write=False)
        return depth.reshape(self.camera.height, self.camera.width)

    @cached_property
    def _directions(self) -> NDArray[np.float32]:
        x, y = self.camera.ray_slopes()
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1)
        return np.ascontiguousarray(grid.reshape(-1, 3))


def _read(text: str, texts: dict[str, Any]) -> tuple[Options, Stage]:
    """Return the options and the stage of a location without its `sim:`; `texts` holds defaults."""
    name, written = parameters.split(text)
    build = registry.find("scenes", SCENES, name)
    own, common = parameters.defaults(build), parameters.defaults(Options)
    values = parameters.typed(written, {**common, **own})
    options = Options(**{**texts, **{key: value for key, value in values.items() if key in common}})
    return options, build(**{key: value for key, value in values.items() if key in own})


def _device(own: D435, options: Options) -> D435:
    if options.image_width and options.camera != "kinect":
        own = replace(own, camera=replace(depth_camera(options.image_width), baseline=own.camera.baseline))
    if options.camera == "kinect":
        own = honest_kinect(options.image_width or WIDTH)
    elif options.camera == "d435":
        own = honest_d435(own)
    return replace(
        own,
        farthest=options.farthest or own.farthest,
        subpixel=own.subpixel if options.subpixel == OWN else options.subpixel,
        correlation_px=own.correlation_px if options.correlation == OWN else options.correlation,
        barrel=options.barrel,
        toe_in=float(np.radians(options.toe_in)),
    )
