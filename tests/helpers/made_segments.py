# SPDX-License-Identifier: Apache-2.0
import numpy as np


def distance_to(segments, points):
    """Return how far points (N, 2) are from the nearest segment, (N,) metres."""
    nearest = np.full(len(np.asarray(points)), np.inf)
    for x0, y0, x1, y1 in segments:
        along = np.array([x1 - x0, y1 - y0])
        start = np.asarray(points, float) - (x0, y0)
        share = np.clip(start @ along / max(along @ along, 1e-12), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(start - share[:, None] * along, axis=1))
    return nearest
