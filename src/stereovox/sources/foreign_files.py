# SPDX-License-Identifier: Apache-2.0
"""Files of other programs that are not recordings, and how to convert them."""

from __future__ import annotations

import os
import shlex

ARCHIVE = "is an archive; unpack it and give the folder"
VIDEO = "is a video, which holds no depth; give depth images with poses, or pairs of a stereo camera (rig.toml)"
ZED = (
    "is a ZED recording; export depth with the ZED SDK's sample: svo_export.py --mode 4 --input_svo_file {file} "
    "--output_path_dir DIR; add poses.txt and the camera there"
)
AZURE = (
    "is a video; if an Azure Kinect's, export depth with Open3D's azure_kinect_mkv_reader.py --input {file} "
    "--output DIR, and add poses.txt there"
)
PICTURE = "is a single image; give the folder that holds all images, with their poses"
CURES = {
    **dict.fromkeys((".svo", ".svo2"), ZED),
    ".mkv": AZURE,
    ".oni": "is an OpenNI recording; write its depth as 16-bit PNGs into DIR/depth with OpenNI (Python: "
    "openni2.Device.open_file), add poses.txt and the camera, and give DIR",
    ".rrd": "is a Rerun log, which is only for viewing; give the recording or map that it was made from",
    ".r3d": "is a Record3D scan; in the app export it as 'EXR + RGB', unpack that and give its folder",
    ".rec": "is a recording of an unknown program; export depth images and poses.txt",
    **dict.fromkeys((".h5", ".hdf5", ".mat", ".tfrecord"), "is a table of arrays; write its depth images as 16-bit "
                    "PNGs into DIR/depth, DIR/poses.txt and the camera, and give DIR"),
    **dict.fromkeys((".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".bz2", ".xz"), ARCHIVE),
    **dict.fromkeys((".mp4", ".mov", ".avi", ".webm"), VIDEO),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm", ".exr", ".npy"), PICTURE),
}  # fmt: skip
"""Description of each kind of file and its cure, by suffix in lower case; `{file}` is its name quoted for a shell."""
POINTER, POINTS = b"version https://git-lfs", "is a git-lfs pointer, not the file itself; get that with: git lfs pull"
"""Begin of such a pointer, and its description."""
MAX_NAME = 60
"""Longest file name that a message repeats."""


def cure_of(path: str | os.PathLike[str]) -> str:
    """Return in less than 200 characters what a file is and how to convert it; "" for others."""
    if is_pointer(path):
        return POINTS
    found = CURES.get(os.path.splitext(path)[1].lower(), "")
    name = shlex.quote(os.fspath(path))
    return found.format(file=name if len(name) <= MAX_NAME else "FILE")


def is_pointer(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is what git leaves in place of a large file that was not fetched; never raises."""
    try:
        if not os.path.isfile(path):
            return False
        with open(path, "rb") as file:
            return file.read(len(POINTER)) == POINTER
    except (OSError, ValueError):
        return False
