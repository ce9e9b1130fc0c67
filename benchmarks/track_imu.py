# SPDX-License-Identifier: Apache-2.0
"""Tracking with and without an IMU, on recordings and simulations with poses: lost images, errors, tilt.

    python benchmarks/track_imu.py RECORDING [--frames A:B:S] [--cover FROM:TO:EVERY] [--seeds N] [--json]

The IMU is synthesised from the poses (smooth curves through them, 200 readings a second, noise, bias and delay of a
cheap one, drawn by seed), so those must be exact: a simulation. It is never the recording's own. --cover: from the
first image named to the last one, two of EVERY images are black. Errors are in metres and degrees against the poses,
from the first tracked image.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory_score import angles_deg
from stereovox.frame import AnyFrame, Frame
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.imu import Imu, ImuReadings
from stereovox.track.tracker import Tracker

HZ, NOISE, BIAS, FORCE_NOISE, DELAY_S = 200.0, 0.003, 0.02, 0.05, 0.002
"""Readings a second; noise and bias of rates in rad/s (standard deviations), noise of forces in m/s^2, seconds."""


def made_imu(frames: Sequence[AnyFrame], seed: int) -> ImuReadings:
    """Return the readings of an IMU with the camera's axes, in a world with z up."""
    rng = np.random.default_rng(seed)
    stamps = np.array([frame.stamp_ns for frame in frames])
    poses = np.array([frame.T_world_sensor for frame in frames])
    seconds = (stamps - stamps[0]) / 1e9
    turns = RotationSpline(seconds, Rotation.from_matrix(poses[:, :3, :3]))
    places = CubicSpline(seconds, poses[:, :3, 3])
    at = np.arange(0, seconds[-1], 1 / HZ)
    rates = turns(at, 1) + rng.normal(size=3) * BIAS / np.sqrt(3) + NOISE * rng.normal(size=(len(at), 3))
    forces = turns(at).inv().apply(places(at, 2) + np.array([0, 0, 9.81])) + FORCE_NOISE * rng.normal(size=(len(at), 3))
    return ImuReadings(stamps[0] + np.round((at + DELAY_S) * 1e9).astype(np.int64), rates, forces, name="made IMU")


def run(frames: Sequence[AnyFrame], imu: Imu | None) -> dict[str, Any]:
    """Return the figures of one run."""
    tracker = Tracker(imu=imu)
    found = [(frame, tracker.add(frame)) for frame in frames if not frame.fault]
    kept = [(frame.T_world_sensor, one.T_world_sensor) for frame, one in found if not one.lost]
    if len(kept) < 2:
        return {"images": len(found), "lost": len(found) - 1, "imu": tracker.imu_use}
    true, poses = (np.array(part) for part in zip(*kept, strict=True))
    off = np.linalg.inv(true) @ true[0] @ inverse(poses[0]) @ poses
    tilt = np.degrees(np.arccos(np.clip(np.sum(true[0, 2, :3] * poses[0, 2, :3]), -1, 1)))
    return {
        "images": len(found),
        "lost": len(found) - 1 - len(kept),  # the first one counts once the second is tracked
        "off_m": float(np.linalg.norm(off[:, :3, 3], axis=1).max()),
        "off_deg": float(angles_deg(off).max()),
        "tilt_deg": float(tilt),
        "imu": tracker.imu_use,
    }


def covered(frames: Sequence[AnyFrame], cover: str) -> list[AnyFrame]:
    """Return frames, with two of every EVERY black."""
    first, last, every = map(int, cover.split(":"))
    return [
        replace(frame, depth=np.zeros_like(frame.depth), reason=None)
        if isinstance(frame, Frame) and first <= i <= last and (i - first) % every < 2
        else frame
        for i, frame in enumerate(frames)
    ]


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", default=":")
    parser.add_argument("--cover")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    whole = list(open_source(arguments.recording))
    picked = range(len(whole))[slice(*(int(word) if word else None for word in arguments.frames.split(":")))]
    frames = [whole[i] for i in picked]
    frames = covered(frames, arguments.cover) if arguments.cover else frames
    rows = [{"with": "no IMU", **run(frames, None)}]
    rows += [{"with": f"IMU, seed {seed}", **run(frames, made_imu(whole, seed))} for seed in range(arguments.seeds)]
    for row in rows:
        if not arguments.json:
            print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    try:
        main()
    except StereovoxError as error:
        raise SystemExit(str(error)) from None
