# SPDX-License-Identifier: Apache-2.0
"""Disparity against lidar on scenes in the layout of KITTI stereo 2015 (training/image_2, image_3, disp_occ_0).

python benchmarks/stereo2015.py FOLDER [setting=value ...]      for example: ~/kitti_stereo2015 method=block

FOLDER contains `training`, or is `training` itself.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.config import load_config, parse_value
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import Reason, StereoFrame

SHARES = (1.0, 0.9, 0.75, 0.5, 0.25)


def main(folder: str, *settings: str) -> None:
    config = load_config(**{f"stereo.{s.partition('=')[0]}": parse_value(s.partition("=")[2]) for s in settings}).stereo
    if config.aligned != "left":
        sys.exit("the reference is the left image's: leave aligned=left")
    depth = StereoDepth(config)
    lines, errors, sure, missed = [], [], [], 0
    for path in scenes(Path(folder)):
        frame, truth = scene(path)
        depth.disparity(frame)
        start, busy = time.perf_counter(), time.process_time()
        found = depth.disparity(frame)
        wall, busy = 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - busy)
        has = np.isfinite(truth)
        kept = has & np.isfinite(found.disparity)
        error = (found.disparity - truth)[kept]
        far = np.mean(found.reason == Reason.TOO_FAR)
        lines.append((has.sum(), kept.sum(), bad3(error), d1_all(found.disparity, truth), bias(error), far, wall, busy))
        print(f"{path.stem}  {line(lines[-1])}")
        errors.append(error)
        sure.append(found.confidence[kept])
        missed += has.sum() - kept.sum()
    error, confidence = np.concatenate(errors), np.concatenate(sure)
    table = np.array(lines)
    total = [table[:, 0].sum(), table[:, 1].sum(), bad3(error), np.average(table[:, 3], weights=table[:, 0])]
    print(f"all        {line([*total, bias(error), *np.median(table[:, 5:], axis=0)])}")
    print(f"median error {np.median(np.abs(error)):.3f} px, after the median is taken off {spread(error):.3f} px")
    order = np.argsort(-confidence, kind="stable")
    for share in SHARES:
        best = order[: round(share * len(order))]
        density = 100 * len(best) / (len(error) + missed)
        print(f"surest {share:4.0%}: confidence {confidence[best[-1]]:.2f}, density {density:.1f} %, bad-3 ", end="")
        print(f"{bad3(error[best]):.2f} %")


def scenes(folder: Path) -> list[Path]:
    """The left images with a reference."""
    parent = folder if (folder / "image_2").is_dir() else folder / "training"
    return sorted((parent / "image_2").glob("*_10.png")) or sys.exit(f"{parent}: no image_2/*_10.png")


def scene(path: Path) -> tuple[StereoFrame, np.ndarray]:
    left, right = (cv2.imread(str(path.parents[1] / side / path.name), 0) for side in ("image_2", "image_3"))
    raw = cv2.imread(str(path.parents[1] / "disp_occ_0" / path.name), -1) / 256.0
    height, width = left.shape
    camera = PinholeCamera(width, height, 721.5, 721.5, 609.6, 172.9, 0.5327)
    return StereoFrame(left, right, StereoPair(camera), np.eye(4), name=path.name), np.where(raw > 0, raw, np.nan)


def bad3(error: np.ndarray) -> float:
    return 100 * float(np.mean(np.abs(error) > 3))


def bias(error: np.ndarray) -> float:
    return float(np.median(error))


def spread(error: np.ndarray) -> float:
    return float(np.median(np.abs(error - np.median(error))))


def d1_all(disparity: np.ndarray, truth: np.ndarray) -> float:
    """Per cent of truth pixels off by over 3 px and over 5 %, holes filled along rows by the farther neighbour."""
    has = np.isfinite(truth)
    error = np.abs(filled(disparity) - truth)[has]
    return 100 * float(np.mean((error > 3) & (error > 0.05 * truth[has])))


def filled(disparity: np.ndarray) -> np.ndarray:
    full = np.zeros_like(disparity)
    for row, out in zip(disparity, full, strict=True):
        have = np.flatnonzero(np.isfinite(row))
        if len(have):
            after = np.searchsorted(have, np.arange(len(row)))
            before, after = have[np.maximum(after - 1, 0)], have[np.minimum(after, len(have) - 1)]
            out[:] = np.where(np.isfinite(row), row, np.minimum(row[before], row[after]))
    return full


def line(numbers) -> str:
    has, kept, bad, d1, off, far, wall, busy = numbers
    return (
        f"density {100 * kept / has:5.1f} %  bad-3 {bad:.2f} %  D1-all {d1:.2f} %  bias {off:+.2f} px  "
        f"too far {100 * far:.1f} %  {wall:.0f} ms ({busy:.0f} ms of one core)"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
