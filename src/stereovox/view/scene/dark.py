# SPDX-License-Identifier: Apache-2.0
"""Dark pictures: a finished figure with its page, letters and flat colours replaced; drawing code has no themes."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereovox.maps import State
from stereovox.view.panels import GREY, INK, LINE, STATE_COLOURS

PAGE = "#12161d"
MAX_STATES = 16
"""Colour maps with more colours are scales, which are kept."""
COLOURS = {
    "#ffffff": PAGE,
    "#000000": "#eef1f6",
    INK: "#eef1f6",
    GREY: "#a5aebd",
    LINE: "#3a4352",
    STATE_COLOURS[State.UNKNOWN]: "#232a35",
    STATE_COLOURS[State.FREE]: "#4a5568",
    STATE_COLOURS[State.OCCUPIED]: "#f4f6fa",
    "#f3f4f6": "#1a2029",
    "#dfe2e7": "#2b3340",
}
"""Colours of light pages, and their replacements; all others are kept."""


def darken(figure: Any) -> None:
    """Turn a finished figure of this package into one on a dark page."""
    figure.draw_without_rendering()  # creates ticks and their labels
    for artist in figure.findobj():
        for name in ("color", "facecolor", "edgecolor", "markeredgecolor", "markerfacecolor"):
            _exchange(artist, name)
    for axis in figure.axes:
        for image in axis.images:
            _exchange_map(image)


def _exchange(artist: Any, name: str) -> None:
    get, put = getattr(artist, f"get_{name}", None), getattr(artist, f"set_{name}", None)
    if get is None or put is None:
        return
    colours = get()
    if isinstance(colours, np.ndarray) and colours.ndim == 2:
        put([_dark(one) for one in colours])
    elif colours is not None and len(colours):
        put(_dark(colours))


def _dark(colour: Any) -> Any:
    """Return a colour's replacement on a dark page, with the same opacity."""
    from matplotlib.colors import is_color_like, to_hex, to_rgba

    if not is_color_like(colour):  # "none" of a line's marker, for example
        return colour
    other = COLOURS.get(to_hex(colour))
    return colour if other is None else to_rgba(other, to_rgba(colour)[3])


def _exchange_map(image: Any) -> None:
    """Replace the flat colours of states; colours of heights and log-odds are kept."""
    from matplotlib.colors import ListedColormap

    colours = image.get_cmap()
    if image.get_array().ndim == 2 and isinstance(colours, ListedColormap) and colours.N <= MAX_STATES:
        image.set_cmap(ListedColormap([_dark(one) for one in colours(np.arange(colours.N))]))
