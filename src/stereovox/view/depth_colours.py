# SPDX-License-Identifier: Apache-2.0
"""A depth image in colours that tell why a pixel has no value."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import DepthImage, Reason
from stereovox.view.live import colour_depth

REASON_COLOURS = {
    Reason.UNMATCHED: "#1a1a1a",
    Reason.TOO_NEAR: "#e6399b",
    Reason.TOO_FAR: "#cfe3f7",
    Reason.MASKED: "#b9a16b",
    Reason.UNKNOWN: "#7d7d7d",
}
SHARED = "near red, far blue"
WIDEST_PX = 480


def depth_picture(image: DepthImage, max_range: float) -> NDArray[np.uint8]:
    """Return a depth image as RGB (rows, columns, 3), at most `WIDEST_PX` wide: near red, far blue, else the reason.

    max_range: metres; what is farther has the colour of that distance.
    """
    step = -(-image.depth_m.shape[1] // WIDEST_PX)
    depth_m, reason = image.depth_m[::step, ::step], image.reason[::step, ::step]
    picture = colour_depth(np.where(reason == Reason.VALID, depth_m, np.nan), max_range)
    for why, colour in REASON_COLOURS.items():
        picture[reason == why] = tuple(bytes.fromhex(colour[1:]))
    return picture


def reasons_key() -> str:
    """Return a line of HTML that tells what the colours mean."""
    swatch = '<span style="display:inline-block;width:.8em;height:.8em;border:1px solid #888;background:{}"></span> {}'
    words = [swatch.format(colour, why.name.lower().replace("_", " ")) for why, colour in REASON_COLOURS.items()]
    body = " &nbsp; ".join([SHARED, *words])
    return f'<div style="font-size:.75em;line-height:1.7;padding:0 1em .6em">{body}</div>'
