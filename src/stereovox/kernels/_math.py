# SPDX-License-Identifier: Apache-2.0
"""Functions that kernels for processor and graphics card call by the same name; see `kernels/_gpu.py`."""

import numpy as np

from stereovox.kernels._jit import cell


@cell
def floor(x):
    """Return the largest whole number not above a float32, as a float32."""
    return np.floor(x)


@cell
def square_root(x):
    """Return the square root of a float32."""
    return np.sqrt(x)
