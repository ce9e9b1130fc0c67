# SPDX-License-Identifier: Apache-2.0
"""Options behind the folder of a stereo recording, and poses of any form instead of its own."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources import parameters
from stereovox.sources.poses.poses import OTHER_CLOCK, Poses, in_time_of, seconds_from_ns
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses, image_numbers, in_optical_axes, read_poses

POSES: Mapping[str, Any] = {"poses": "", "axes": "", "invert": False}
"""Options of all stereo recordings: a file or folder of poses instead of the layout's own (see `rgbd.pose_files`);
axes of the posed camera, `optical`, `opengl` or `ros`; whether they are world to camera."""


def folder_and_options(where: str | os.PathLike[str], known: Mapping[str, Any]) -> tuple[Path, dict[str, Any]]:
    """Return the folder in `FOLDER?key=value` and its options, with the defaults in `known`.

    Raises SourceError for unknown or incomplete options, unknown axes, and a non-positive `fps`.
    """
    text = os.fspath(where)
    folder = folder_part(text)
    try:
        given = parameters.typed(parameters.split(f"folder{text[len(folder) :]}")[1], known)
        if given.get("axes", "optical") not in AXES:
            raise SourceError(f"axes={given['axes']} is unknown{did_you_mean(given['axes'], AXES)}")
        if given.get("fps", 1.0) <= 0:
            raise SourceError(f"fps={given['fps']:g} must be positive")
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None
    return Path(folder), {**known, **given}


def poses_of_images(path: Path, stamps_ns: Sequence[int]) -> Poses:
    """Return the poses in a file or folder of any form (see `rgbd.pose_files`), over time.

    stamps_ns: times of the images in ascending order. Poses without times are assigned one to each image; so are poses
    whose times do not overlap the images', if their numbers are equal. Raises SourceError if they are not.
    """
    found, stamps = read_poses(path), sorted(set(stamps_ns))
    if isinstance(found, Poses):
        found = in_time_of(found, stamps)
        if found.stamps_ns[0] <= stamps[-1] and stamps[0] <= found.stamps_ns[-1]:
            return found
        if len(found) != len(stamps):
            ours, theirs = (
                f"{seconds_from_ns(start)} to {seconds_from_ns(end)} s"
                for start, end in ((stamps[0], stamps[-1]), (int(found.stamps_ns[0]), int(found.stamps_ns[-1])))
            )
            said = f"poses from {theirs}, images from {ours}: no time in common"
            raise SourceError(f"{path}: {said}; give poses of this recording")
        assigned = Poses(stamps, found.T_world_body, where=str(path))
        if image_numbers(found) is None:
            assigned.note = f"{path}: {OTHER_CLOCK}"
        return assigned
    if len(found) != len(stamps):
        raise SourceError(f"{path}: holds {len(found)} poses for {len(stamps)} images; give one for each")
    return _over_time(found, stamps)


def as_body(poses: Poses, T_body_left: Transform, axes: str, inverted: bool) -> Poses:
    """Return T_world_body over time from poses of the left eye in `axes`; without `axes` they are already the
    body's."""
    if not axes and not inverted:
        return poses
    T_left_body = inverse(T_body_left) if axes else np.eye(4)
    T = [in_optical_axes(T, axes or "optical", inverted) @ T_left_body for T in poses.T_world_body]
    return poses.of(T)


def _over_time(poses: ImagePoses, stamps: Sequence[int]) -> Poses:
    T, faults = np.full((len(stamps), 4, 4), np.nan), {}
    for i, stamp in enumerate(stamps):
        try:
            T[i] = poses.at(i)
        except FrameRefused as refused:
            faults[stamp] = str(refused)
    return Poses(stamps, T, where=poses.where, faults=faults)
