# SPDX-License-Identifier: Apache-2.0
"""Confidence images next to depth images, as in ARKit: 0 low, 1 medium, 2 high."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereovox.errors import FrameRefused
from stereovox.files.safe_io import read_bounded
from stereovox.sources.images import MAX_BYTES, decode_png
from stereovox.sources.rgbd.depth_files import Depth

KINDS = frozenset({(8, 0)})


def without_low(depth: Depth, path: Path, lowest: int) -> Depth:
    """Return a depth image with 0 where its confidence is less than `lowest`.

    Args:
        depth: (height, width) in any unit.
            path: 8-bit grey PNG of the same size, values growing with the confidence; without it all is kept.
            lowest: Smallest confidence that is kept.

        Returns:
            (height, width), of the same type; 0 is invalid.

    Raises:
        FrameRefused: `unreadable`, `bad_dtype` or `bad_shape` of the confidence image.
    """
    try:
        content = read_bounded(path, MAX_BYTES)
    except FileNotFoundError:
        return depth
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable or remove it") from None
    size = depth.shape[1], depth.shape[0]
    confidence = decode_png(path, content, size, KINDS, "confidence must be an 8-bit grey PNG")
    return np.where(confidence.astype(np.uint8) < lowest, depth.dtype.type(0), depth)
