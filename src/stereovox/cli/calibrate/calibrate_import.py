# SPDX-License-Identifier: Apache-2.0
"""Convert a stereo calibration from another tool to a rig file.

Supported: KITTI (calib_cam_to_cam.txt, or calib.txt with --size), ROS (camera_info yaml of the left and the right
eye), OpenCV (yml with M1 D1 M2 D2 R T, or intrinsics.yml and extrinsics.yml), Kalibr (camchain yaml, pinhole-radtan
and pinhole-equi, also as OpenVINS writes it), EuRoC (cam0/sensor.yaml and cam1/sensor.yaml), and the settings of
ORB-SLAM3, VINS-Fusion, OKVIS and Basalt (kb4).
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

from stereovox.cli.recordings import check_outputs
from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

EXAMPLES = """stereovox calibrate import camchain.yaml --out recordings/flight/rig.toml
stereovox calibrate import calibration.yaml --out rig.toml --json"""

MAX_BASELINE_M = 5.0
"""A longer baseline likely means a calibration in millimetres."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("files", nargs="+", metavar="FILE", help="the calibration; for ROS two files, left eye first")
    parser.add_argument("--out", required=True, metavar="FILE", help="rig file to write, for example rig.toml")
    parser.add_argument("--size", metavar="WxH", help="size of the images in pixels, if the file lacks it")
    parser.add_argument(
        "--lens", default="", metavar="MODEL", help="fisheye, for an OpenCV calibration of fisheye lenses"
    )
    parser.add_argument("--name", default="stereo", metavar="NAME", help="name of the pair (%(default)s)")
    parser.add_argument(
        "--rectify",
        default="",
        metavar="MODEL",
        help="pinhole, spherical or cylindrical (a pinhole; fisheyes: spherical)",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Convert the calibration and print what it contains."""
    from stereovox.files.safe_io import replacing
    from stereovox.sources.calibration.calibration_files import import_rig
    from stereovox.sources.rigs.rig_file import Virtual, rig_text, usual_virtual

    check_outputs(arguments.out)
    files = [Path(name) for name in arguments.files]
    rig = import_rig(files, image_size(arguments.size), arguments.lens, arguments.name)
    wanted = Virtual(arguments.rectify) if arguments.rectify else None
    virtual = tuple(replace(pair, virtual=wanted or usual_virtual(pair.eyes)) for pair in rig.pairs)
    rig = replace(rig, pairs=virtual)
    stereo = rig.stereo_pairs(Path(arguments.out).parent)
    remarks = (f"stereovox calibrate import {' '.join(path.name for path in files)}",)
    with replacing(arguments.out) as file:
        file.write(rig_text(rig, remarks).encode())
    for pair in stereo:
        camera = pair.camera
        kind = "rectified images" if pair.eyes is None else f"{pair.eyes.left.model} lenses"
        say(f"  {pair.name}: {kind}, {camera.width}x{camera.height} pixels, baseline {camera.baseline:.4f} m")
        if (camera.baseline or 0) > MAX_BASELINE_M:
            say(f"  note: a long baseline; was {pair.name} calibrated in millimetres? The rig file needs metres")
    say(f"saved {arguments.out}; put the images and poses next to it: docs/rigs.md")
    pairs = [{"name": pair.name, "baseline_m": pair.camera.baseline, "rectified": pair.eyes is None} for pair in stereo]
    return {"pairs": pairs, "out": arguments.out}


def image_size(text: str | None) -> tuple[int, int] | None:
    """Return width and height of `640x480`; raises StereovoxError for anything else."""
    if text is None:
        return None
    try:
        width, height = (int(word) for word in text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (0 < width < 100_000 and 0 < height < 100_000):
        raise StereovoxError(f"--size {text}: write width x height in pixels, for example 640x480")
    return width, height
