# SPDX-License-Identifier: Apache-2.0
"""Small recordings in the ASL layout (EuRoC, TUM VI)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from made_recordings import write_png
from made_rigs import FORWARD, eyes, picture

from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens

START = 1_520_530_308_199_447_626
STEP = 50_000_000
HEADER = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"


def matrix_text(T: np.ndarray) -> str:
    return f"  cols: 4\n  rows: 4\n  data: [{', '.join(f'{number:.12g}' for number in np.ravel(T))}]\n"


def sensor_text(lens: Lens, T_body_camera: np.ndarray, distortion: str) -> str:
    return (
        f"%YAML:1.0\n# made\nsensor_type: camera\nT_BS:\n{matrix_text(T_body_camera)}"
        f"resolution: [{lens.width}, {lens.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{lens.fx}, {lens.fy}, {lens.cx}, {lens.cy}] #fu, fv, cu, cv\n"
        f"distortion_model: {distortion}\ndistortion_coefficients: {list(lens.distortion)}\n"
    )


def poses_csv(stamps: Sequence[int]) -> str:
    """The body is at (i, 2, 3), turned by 90 degrees about z: w x y z, then a speed."""
    half = np.sqrt(0.5)
    return "\r\n".join([HEADER, *(f"{ns},{i},2,3,{half},0,0,{half},0.1,0.2,0.3" for i, ns in enumerate(stamps)), ""])


def asl(
    folder: Path, pair: Eyes | None = None, *, count: int = 2, distortion: str = "equidistant", truth: str = ""
) -> Path:
    """Write `mav0` with `count` images of each eye, their calibration and poses in the folder `truth`."""
    pair = pair or eyes()
    root = folder / "mav0"
    stamps = [START + i * STEP for i in range(count)]
    places = (FORWARD, FORWARD @ pair.T_left_right)
    for side, (lens, T_body_camera) in enumerate(zip((pair.left, pair.right), places, strict=True)):
        camera = root / f"cam{side}"
        for i, stamp in enumerate(stamps):
            write_png(camera / "data" / f"{stamp}.png", picture(2 * i + side, (lens.width, lens.height)))
        (camera / "data.csv").write_text(
            "#timestamp [ns],filename\r\n" + "".join(f"{ns},{ns}.png\r\n" for ns in stamps)
        )
        (camera / "sensor.yaml").write_text(sensor_text(lens, T_body_camera, distortion))
    place = root / (truth or "state_groundtruth_estimate0")
    place.mkdir()
    (place / "data.csv").write_text(poses_csv([stamps[0] - 20_000_000, *(ns + 20_000_000 for ns in stamps)]))
    return folder
