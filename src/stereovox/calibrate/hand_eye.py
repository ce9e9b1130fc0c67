# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration in closed form: A X = X B for motions A of a tracker, B of a camera on the same body.

Rotation after Park & Martin 1994 (rotation vectors of A are those of B, turned by X); translation by linear least
squares of (R_A - I) t_X = R_X t_B - t_A (Tsai & Lenz 1989).

Not cv2.calibrateHandEye: OpenCV 5 has none, and that of version 4 wants poses, not motions, and knows no outliers
(`benchmarks/hand_eye.py`: errors of 0.1 deg and 3 mm here, of 0.4 deg and 13 mm or more there; with 5 % of the motions
wrong 0.1 deg and 3 mm here, 3 deg and 9 cm there).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry import Transform

LEAST_TURN = np.radians(3.0)
"""Root mean square turn between registered images that tells anything."""
LEAST_SECOND_TURN = np.radians(1.2)
"""The same about the second axis: about one axis only, where the camera sits along it remains open."""


def check_turning(vectors: NDArray[np.float64]) -> None:
    """Raise StereovoxError, one line, where (N, 3) rotation vectors are too small or all about one axis."""
    weights, axes = np.linalg.eigh(vectors.T @ vectors / max(len(vectors), 1))
    first, second = np.sqrt(np.maximum(weights[::-1][:2], 0))
    if first < LEAST_TURN:
        raise StereovoxError(
            f"motion: too small, images are turned by {np.degrees(first):.1f} deg (rms); turn by 30 deg about two axes"
        )
    if second < LEAST_SECOND_TURN:
        axis = " ".join(f"{number:+.2f}" for number in axes[:, -1])
        raise StereovoxError(
            f"motion: turns about one axis only ({axis} in the camera's frame); pitch, yaw and roll while recording"
        )


def hand_eye(A: NDArray[np.float64], B: NDArray[np.float64]) -> Transform:
    """Return X (4, 4) with A X = X B, of (N, 4, 4) motions; pairs whose turns differ in size count as outliers."""
    from scipy.spatial.transform import Rotation

    a, b = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (A, B))
    differ = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1))
    usual = differ <= 3 * np.median(differ) + 1e-9
    X = np.eye(4)
    X[:3, :3] = Rotation.align_vectors(a[usual], b[usual])[0].as_matrix()
    X[:3, 3] = _translation(A[usual], B[usual], X[:3, :3])
    return X


def _translation(A: NDArray[np.float64], B: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel()
    return np.linalg.lstsq(left, right, rcond=None)[0].astype(float)
