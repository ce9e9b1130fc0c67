# SPDX-License-Identifier: Apache-2.0
"""`rig.toml`: any number of stereo pairs, their lenses, where they sit on the vehicle, and their masks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.files import replacing
from stereovox.geometry import Transform
from stereovox.rigs import Eyes, StereoPair, VirtualCamera
from stereovox.sources.images import read_picture_png

FILE = "rig.toml"


@dataclass(frozen=True)
class Virtual:
    """The camera that the images of a pair's eyes are rectified to; see `stereovox.rigs.virtual_camera`."""

    model: str = "pinhole"
    size: tuple[int, int] | None = None
    hfov_deg: float | None = None
    vfov_deg: float | None = None


@dataclass(frozen=True, eq=False)
class RigPair:
    """One `[[pair]]` of a rig file. It has either `eyes`, whose images are to be rectified, or `camera`.

    name: for messages, and the folder of its images. left, right: folders of images, from the file's own folder on;
        "": `NAME/left` and `NAME/right`. index: file of lines `stamp left [right]` (seconds, file names in these
        folders); "": images are named by their time in nanoseconds.
    camera: what the images were rectified to, with the baseline. virtual: what they are to be rectified to.
    T_body_left: (4, 4) maps the optical frame of the left eye (as it is where there are `eyes`, rectified where there
        are none) into the vehicle's, in which the poses are.
    mask_rectangles: (u0, v0, u1, v1) in pixels of the rectified left image: columns from u0 up to but not including u1
        and rows from v0 up to v1 are not to be used. mask: a PNG of that image's size; only what is white in it may be.
    """

    name: str = "stereo"
    left: str = ""
    right: str = ""
    index: str = ""
    camera: VirtualCamera | None = None
    eyes: Eyes | None = None
    T_body_left: Transform = field(default_factory=lambda: np.eye(4))
    virtual: Virtual = Virtual()
    mask_rectangles: tuple[tuple[int, int, int, int], ...] = ()
    mask: str = ""

    def folders(self) -> tuple[str, str]:
        """Return the folders of the left and of the right images, from the rig file's own folder on."""
        return self.left or os.path.join(self.name, "left"), self.right or os.path.join(self.name, "right")

    def stereo_pair(self, folder: Path | str = ".") -> StereoPair:
        """Return the pair; `folder` is where its mask is looked for.

        Raises SourceError, one line, for a mask that cannot be read or has another size, a rectangle that lies outside
        the image, and a virtual camera that cannot be.
        """
        try:
            pair = self._bare()
        except StereovoxError as error:
            raise SourceError(f"pair '{self.name}': {error}") from None
        valid = self._valid(pair.camera, Path(folder))
        return StereoPair(pair.camera, pair.eyes, pair.T_body_camera, valid, self.name)

    def _bare(self) -> StereoPair:
        if self.eyes is None:
            if self.camera is None:
                raise SourceError("has neither [pair.camera] nor both lenses; give one of them")
            return StereoPair(self.camera, None, self.T_body_left, name=self.name)
        v = self.virtual
        return StereoPair.from_eyes(
            self.eyes, v.model, size=v.size, hfov_deg=v.hfov_deg, vfov_deg=v.vfov_deg, T_body_left=self.T_body_left
        )

    def _valid(self, camera: VirtualCamera, folder: Path) -> NDArray[np.bool_] | None:
        if not self.mask and not self.mask_rectangles:
            return None
        valid = self._white(camera, folder / self.mask) if self.mask else np.ones((camera.height, camera.width), bool)
        for u0, v0, u1, v1 in self.mask_rectangles:
            if not (0 <= u0 < u1 <= camera.width and 0 <= v0 < v1 <= camera.height):
                inside = f"u0 < u1 <= {camera.width} and v0 < v1 <= {camera.height}"
                raise SourceError(f"pair '{self.name}': mask rectangle {[u0, v0, u1, v1]} must have {inside}")
            valid[v0:v1, u0:u1] = False
        return valid

    def _white(self, camera: VirtualCamera, path: Path) -> NDArray[np.bool_]:
        try:
            image = read_picture_png(path, (camera.width, camera.height))
        except FrameRefused as refused:
            wanted = f"{camera.width}x{camera.height} pixels, 8 bits, white where the image may be used"
            raise SourceError(f"pair '{self.name}': {refused} (a mask has {wanted})") from None
        return (image if image.ndim == 2 else image.min(axis=2)) > 127


@dataclass(frozen=True, eq=False)
class Rig:
    """What a `rig.toml` says: the pairs, and the file of poses T_world_body (TUM format), from its own folder on."""

    pairs: tuple[RigPair, ...]
    poses: str = "poses.txt"

    def stereo_pairs(self, folder: Path | str = ".") -> list[StereoPair]:
        """Return the pairs in the file's order; raises SourceError as `RigPair.stereo_pair`."""
        return [pair.stereo_pair(folder) for pair in self.pairs]


def read_rig(path: Path | str) -> Rig:
    """Return what `path` says; raises SourceError, one line with file, pair and key, for anything wrong in it."""
    from stereovox.sources.rig_tables import rig_of
    from stereovox.sources.toml_file import read_table

    table = read_table(Path(path))
    try:
        return rig_of(table)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None


def write_rig(path: Path | str, rig: Rig, remarks: Sequence[str] = ()) -> None:
    """Write `rig` so that `read_rig` gives it back; `remarks` are comments at its top. Raises SourceError."""
    from stereovox.sources.rig_tables import rig_text

    with replacing(path, SourceError) as file:
        file.write(rig_text(rig, remarks).encode())
