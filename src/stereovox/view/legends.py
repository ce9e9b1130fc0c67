# SPDX-License-Identifier: Apache-2.0
"""The legend of the states where a panel is too narrow for title and legend side by side."""

from __future__ import annotations

from typing import Any


def keep_clear(axis: Any) -> None:
    """Put the legend above a panel into a column at its right, where it would cover the panel's title.

    To be called when all panels of the figure are there: how wide this one is, only the finished layout tells.
    """
    axis.figure.draw_without_rendering()
    legend = axis.get_legend()
    if not covered(axis):
        return
    axis.legend(
        handles=legend.legend_handles,
        labels=[text.get_text() for text in legend.get_texts()],
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        handlelength=1.2,
        fontsize=legend.get_texts()[0].get_fontsize(),
    )


def covered(axis: Any) -> bool:
    """Return whether the legend of a drawn panel touches its title."""
    from matplotlib.text import Text

    words = axis.get_title(loc="left")
    title = next(one for one in axis.get_children() if isinstance(one, Text) and one.get_text() == words)
    return bool(axis.get_legend().get_window_extent().overlaps(title.get_window_extent()))
