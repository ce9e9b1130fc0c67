# SPDX-License-Identifier: Apache-2.0
"""Formulas of the three texts: what a profile makes of a small scene, next to slow twins written from the text.

One module a text. A twin is plain NumPy or Python, and shares no code with stereovox.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox_lab.papers.chapter import Claim

SHARE = 0.99
"""Least share of cells that must be alike where values are tabulated or rounded: the others are ties."""


def same(text: str, ours: ArrayLike, twin: ArrayLike, within: float = 0.0, share: float = 1.0) -> Claim:
    """Return the claim that numbers (N,) equal a twin's to `within`, at least this share of them; NaN equals NaN."""
    a, b = np.asarray(ours, float).ravel(), np.asarray(twin, float).ravel()
    if a.size != b.size or not a.size:
        return Claim(text, f"{b.size:,} values", f"{a.size:,}", False)
    alike = (np.abs(a - b) <= within) | (np.isnan(a) & np.isnan(b)) | (a == b)
    wanted = f"{'all' if share == 1 else f'{100 * share:g} %'} of {b.size:,} within {within:g}"
    off = np.abs(a - b)[~alike]
    worst = f", farthest off {np.nanmax(off, initial=0):.3g}" if off.size else ""
    return Claim(text, wanted, f"{alike.sum():,} of {a.size:,}{worst}", bool(alike.mean() >= share))


def same_cells(text: str, ours: NDArray[np.bool_], twin: NDArray[np.bool_], share: float = 1.0) -> Claim:
    """Return the claim that two sets of cells, bool arrays of one shape, are equal, up to a share of both together."""
    either, both = int((ours | twin).sum()), int((ours & twin).sum())
    found = f"{both:,} of {either:,} in both; {(twin & ~ours).sum()} missing, {(ours & ~twin).sum()} more"
    wanted = f"the same {int(twin.sum()):,} cells" + ("" if share == 1 else f", up to {100 * (1 - share):g} % ties")
    return Claim(text, wanted, found, bool(either and both >= share * either))


def settings(config: Config, printed: Mapping[str, Any], what: str) -> Claim:
    """Return the claim that a profile has the values that the text prints, or that formulas.md says were chosen."""
    wrong = []
    for name, value in printed.items():
        found: Any = config
        for part in name.split("."):
            found = getattr(found, part)
        if (list(found) if isinstance(found, tuple) else found) != value:
            wrong.append(f"{name} is {found}, not {value}")
    return Claim(f"{what}: the profile's settings", f"{len(printed)} as printed, or as chosen and stated",
                 "; ".join(wrong) or "all", not wrong)  # fmt: skip
