# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twin of the kernels that pack images: number by number, in Python's own whole numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def split(bits: NDArray[np.unsignedinteger]) -> NDArray[np.uint8]:
    """Return the planes (bytes, height, width) of an image's differences, as `_packing.split` writes them."""
    rows, width = bits.tolist(), bits.itemsize
    modulus = 256**width
    planes = np.zeros((width, *bits.shape), np.uint8)
    for v, row in enumerate(rows):
        for u, number in enumerate(row):
            before = row[u - 1] if u else (rows[v - 1][0] if v else 0)
            step = (number - before) % modulus
            signed = step if step < modulus // 2 else step - modulus
            folded = 2 * signed if signed >= 0 else -2 * signed - 1
            planes[:, v, u] = list(folded.to_bytes(width, "little"))
    return planes
