"""Depth images made for tests: slanted walls, thin things, holes, no returns."""

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import from_quaternion

CAMERA = PinholeCamera(64, 48, 40.0, 40.0, 31.3, 23.8, 0.05)


def made_image(seed: int, camera: VirtualCamera = CAMERA, far_share: float = 0.1) -> DepthImage:
    """A slanted wall with a thin pole and a box before it, 10 % holes, a region without return, a random pose."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width] / [[[camera.height]], [[camera.width]]]
    depth = 1.6 + rng.uniform(-1, 1) * u + rng.uniform(-0.5, 0.5) * v + 0.01 * rng.normal(size=u.shape)
    depth[:, camera.width // 3] = 0.8
    depth[camera.height // 2 :, camera.width // 2 : camera.width // 2 + 9] = 1.1
    depth[: int(far_share * camera.height)] = np.inf
    depth[rng.random(u.shape) < 0.1] = np.nan
    depth[-3:, -6:] = np.nan
    reason = np.select([np.isnan(depth), np.isinf(depth)], [Reason.UNMATCHED, Reason.TOO_FAR], Reason.VALID)
    T = from_quaternion(rng.uniform(-20, 20, 3), rng.normal(size=4))
    return DepthImage(depth.astype(np.float32), reason.astype(np.uint8), camera, T)


def rows_of(evidence):
    """Evidence as rows (N, 4) of a cell and its thousandths, the same for the same cells whatever the blocks' order."""
    coords = np.concatenate([evidence.coords, evidence.uniform])
    order = np.lexsort(coords.T)
    assert (np.diff(coords[order], axis=0) != 0).any(axis=1).all(), "a block stands in the evidence twice"
    uniform = np.repeat(evidence.uniform_values[:, None], 512, axis=1)
    values = np.concatenate([evidence.values, uniform])[order]
    block, column = np.nonzero(values)
    cells = coords[order][block] * 8 + np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
    return np.column_stack([cells, values[block, column]])


def cells_of(evidence):
    """Evidence as a dict from cell to thousandths."""
    rows = rows_of(evidence)
    return dict(zip(map(tuple, rows[:, :3].tolist()), rows[:, 3].tolist(), strict=True))
