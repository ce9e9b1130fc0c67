# SPDX-License-Identifier: Apache-2.0
"""Tracking on recordings with poses: error, share of lost frames, processor time; against peers.

    python benchmarks/track.py RECORDING [RECORDING ...] [--frames A:B:S] [--peers] [--json] [setting=value ...]

Peers, if installed (`pip install small_gicp kiss-icp`) and if the recording has depth images: small_gicp's GICP of
points on a Gaussian voxel map (points and voxels of 0.05 m, starting from constant velocity), KISS-ICP with its
defaults, and OpenCV's projective association from image to image (cv2).
Errors are in metres, after rigid alignment (ATE) and without (off: largest error with the first poses aligned).
"""

import argparse
import importlib.util
import json
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config, parse_value
from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory_score import angles_deg, score_trajectory
from stereovox.frame import AnyFrame, Frame
from stereovox.geometry.se3 import inverse, orthonormalise
from stereovox.opening import open_source
from stereovox.sources.poses.poses import Poses
from stereovox.track.tracker import Tracker

Track = Callable[[AnyFrame], NDArray[np.float64] | None]
"""Takes a frame; returns its pose (4, 4) in the tracker's own world, None if lost."""


def stereovox(settings: dict[str, Any]) -> Track:
    """Return our tracker."""
    tracker = Tracker(load_config(**settings))

    def track(frame: AnyFrame) -> NDArray[np.float64] | None:
        tracked = tracker.add(frame)
        return None if tracked.lost else tracked.T_world_sensor

    return track


def small_gicp() -> Track:
    """Return small_gicp's GICP on a Gaussian voxel map."""
    import small_gicp as library

    state: dict[str, Any] = {"map": library.GaussianVoxelMap(0.05), "T": np.eye(4), "motion": np.eye(4)}

    def track(frame: AnyFrame) -> NDArray[np.float64]:
        cloud, tree = library.preprocess_points(points_of(frame), 0.05, 10, 1)
        del tree
        if state["map"].size():
            found = library.align(state["map"], cloud, state["T"] @ state["motion"], 0.2, 1, 20)
            state["motion"] = inverse(state["T"]) @ found.T_target_source
            state["T"] = orthonormalise(found.T_target_source)
        state["map"].insert(cloud, state["T"])
        return state["T"]

    return track


def kiss_icp() -> Track:
    """Return KISS-ICP, as for a lidar of 5 m."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 5.0, 0.3, False
    config.mapping.voxel_size = 0.05
    odometry = KissICP(config)

    def track(frame: AnyFrame) -> NDArray[np.float64]:
        points = points_of(frame)
        odometry.register_frame(points, np.zeros(len(points)))
        return np.asarray(odometry.last_pose)

    return track


def projective() -> Track:
    """Return OpenCV's projective association, point to plane, from image to image (OpenCV 5)."""
    import cv2

    state: dict[str, Any] = {"before": None, "T": np.eye(4), "odometry": None}

    def track(frame: AnyFrame) -> NDArray[np.float64]:
        assert isinstance(frame, Frame)
        assert isinstance(frame.camera, PinholeCamera)
        camera, depth = frame.camera, np.asarray(frame.depth * frame.depth_scale, np.float32)
        depth[(frame.depth == 0) | (frame.depth == 65535)] = np.nan
        if state["odometry"] is None:
            settings = cv2.OdometrySettings()
            K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
            settings.setCameraMatrix(np.array(K, np.float32))
            settings.setMinDepth(0.3)
            settings.setMaxDepth(5.0)
            state["odometry"] = cv2.Odometry(cv2.OdometryType_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
        now = cv2.OdometryFrame(depth)
        if state["before"] is not None:
            state["odometry"].prepareFrames(now, state["before"])
            found, motion = state["odometry"].compute(now, state["before"])
            state["T"] = orthonormalise(state["T"] @ motion) if found else state["T"]
        state["before"] = now
        return state["T"]

    return track


PEERS: dict[str, Callable[[], Track]] = {"small_gicp": small_gicp, "kiss_icp": kiss_icp, "cv2": projective}


def points_of(frame: AnyFrame) -> NDArray[np.float64]:
    """Return the points (N, 3) of every fourth pixel, in both directions, with a depth up to 5 m."""
    assert isinstance(frame, Frame)
    depth = np.where((frame.depth == 0) | (frame.depth == 65535), np.nan, frame.depth * frame.depth_scale)
    points = frame.camera.back_project(depth)[2::4, 2::4].reshape(-1, 3)
    return points[(points[:, 2] > 0.3) & (points[:, 2] < 5)]


def run(frames: Iterable[AnyFrame], make: Callable[[], Track]) -> dict[str, float]:
    """Return the figures of one tracker on the frames of a recording."""
    track, poses, truth, times, lost = make(), [], [], [], 0
    for number, frame in enumerate(frames):
        if frame.fault:
            continue
        start = time.process_time()
        pose = track(frame)
        times.append(1e3 * (time.process_time() - start))
        if pose is None:
            lost += number > 0  # the first one counts once the second is tracked
        else:
            poses.append(pose)
            truth.append(frame.T_world_sensor)
    if len(poses) < 3:
        return {"frames": len(times), "lost": lost}
    found, true = np.array(poses), np.array(truth)
    laid = true[0] @ inverse(found[0]) @ found
    numbers = np.arange(len(found))
    score = score_trajectory(Poses(numbers, found), Poses(numbers, true))
    return {
        "frames": len(times),
        "lost": lost,
        "way_m": score.length_m,
        "ate_m": score.position_m.rmse,
        "off_m": float(np.linalg.norm(laid[:, :3, 3] - true[:, :3, 3], axis=1).max()),
        "off_deg": float(angles_deg(np.linalg.inv(true) @ laid).max()),
        "cpu_ms": float(np.median(times)),
        "cpu_ms_99": float(np.percentile(times, 99)),
    }


def warm_up(frames: Iterable[AnyFrame], track: Track) -> None:
    """Track some frames, to compile."""
    for frame in frames:
        if not frame.fault:
            track(frame)


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="+", metavar="RECORDING or setting=value")
    parser.add_argument("--frames")
    parser.add_argument("--peers", action="store_true")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    given = [w for w in arguments.words if "=" in w and not w.startswith("sim:") and "?" not in w]
    settings = {word.partition("=")[0]: parse_value(word.partition("=")[2]) for word in given}
    trackers: dict[str, Callable[[], Track]] = {"stereovox": lambda: stereovox(settings)}
    if arguments.peers:
        trackers |= {name: make for name, make in PEERS.items() if importlib.util.find_spec(name)}
    rows = []
    for where in arguments.words:
        if where in given:
            continue
        frames = list(open_source(where, arguments.frames))
        for name, make in trackers.items():
            warm_up(frames[:5], make())
            rows.append({"recording": where, "tracker": name, **run(frames, make)})
            if not arguments.json:
                print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{v}" for k, v in rows[-1].items()))
    if arguments.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    try:
        main()
    except StereovoxError as error:
        raise SystemExit(str(error)) from None
