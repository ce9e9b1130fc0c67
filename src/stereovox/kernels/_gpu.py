# SPDX-License-Identifier: Apache-2.0
"""Kernels that run on a graphics card, and the cells they share with the processor's kernels.

The body of a `@cell` of `_jit.py` is plain Python: `on_gpu` compiles it for the card, with all cells that it calls. So
no formula is written twice. Only files that are imported when a card is requested import this one.

Launches always have the same size; each kernel loops over its work in strides of the whole grid. So
the amount of work can be stored on the card, and the processor need not wait for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dis import get_instructions
from functools import cache, lru_cache
from importlib.util import find_spec
from types import FunctionType
from typing import Any

import numba.cuda
import numpy as np
from numba.core import config
from numba.core.dispatcher import Dispatcher

from stereovox.kernels import _math
from stereovox.kernels._jit import with_cache

cuda: Any = numba.cuda
"""To a type checker, numba's module is full of classes that kernels call like functions."""
ENABLE_CUDASIM: bool = vars(config)["ENABLE_CUDASIM"]
Function = Callable[..., Any]

THREADS = 2 if ENABLE_CUDASIM else 128
"""Threads in a block of each launch."""
FEWEST_BLOCKS, BLOCKS_PER_PROCESSOR = 128, 8
"""Blocks of a launch: at least this many, below which numba warns, and this many for each multiprocessor."""


def gpu_kernel(function: Function) -> Function:
    """Compile `function` for the card at its first `launch`, and cache it on disk like the other kernels."""
    return with_cache(lambda cache: cuda.jit(function, cache=cache))


@cache
def on_gpu(cell: Function) -> Function:
    """Return the twin of a `@cell` that kernels for the card can call. The simulator runs it as plain Python.

    Its body is compiled separately, since the flags of the processor's twin let the card's compiler assume that there
    are no NaN and no infinities.
    """
    body = getattr(cell, "py_func", cell)
    names = {step.argval for step in get_instructions(body) if step.opname == "LOAD_GLOBAL"}
    scope = {name: value for name, value in body.__globals__.items() if name in names}
    scope |= {name: on_gpu(value) for name, value in scope.items() if isinstance(value, Dispatcher)}
    scope["__name__"] = body.__module__
    twin = FunctionType(body.__code__, scope, body.__name__, body.__defaults__)
    if ENABLE_CUDASIM:
        return twin
    return OWN[cell] if cell in OWN else cuda.jit(twin, device=True)


def launch(kernel: Function, *arguments: Any) -> None:
    """Run a kernel on the card; it has finished before anything is copied back."""
    kernel[_blocks(), THREADS](*arguments)


def to_gpu(array: Any) -> Any:
    """Return a copy of an array on the card; for a tuple, a tuple with copies of its arrays."""
    if isinstance(array, tuple):
        parts = [to_gpu(part) if isinstance(part, np.ndarray) else part for part in array]
        return type(array)(*parts) if hasattr(array, "_fields") else tuple(parts)
    return cuda.to_device(np.ascontiguousarray(array))


def gpu_array(shape: int | tuple[int, ...], dtype: Any, value: int | float | None = None) -> Any:
    """Return an array on the card, filled with `value` if given. Raises MemoryError if the card has no room."""
    try:
        array = cuda.device_array(shape, dtype)
    except Exception as error:  # the class differs between versions of numba
        if "OUT_OF_MEMORY" not in str(error).upper().replace(" ", "_"):
            raise
        raise MemoryError(f"the graphics card has no room for an array of shape {shape}") from None
    if value is not None:
        launch(fill, array.reshape(array.size), np.dtype(dtype).type(value))
    return array


def unusable() -> str | None:
    """Return why nothing can run on a card here; None if it can, and in numba's simulator."""
    if ENABLE_CUDASIM:
        return None
    if find_spec("numba_cuda") is None:
        return "numba-cuda is not installed; run: pip install 'stereovox[cuda]'"
    return None if cuda.is_available() else "no NVIDIA graphics card, or no driver for it, was found"


@gpu_kernel
def fill(array, value):
    """Set all elements of a flat array to `value`."""
    for i in range(cuda.grid(1), array.size, cuda.gridsize(1)):
        array[i] = value


@lru_cache
def _blocks() -> int:
    if ENABLE_CUDASIM:
        return 2
    return max(FEWEST_BLOCKS, BLOCKS_PER_PROCESSOR * cuda.get_current_device().MULTIPROCESSOR_COUNT)


if ENABLE_CUDASIM:
    OWN: dict[Function, Function] = {}
else:
    from numba.cuda import libdevice

    @cuda.jit(device=True)
    def _floor(x):
        return libdevice.floorf(x)

    @cuda.jit(device=True)
    def _square_root(x):
        return libdevice.fsqrt_rn(x)

    OWN = {_math.floor: _floor, _math.square_root: _square_root}
"""Cells for which the card has its own functions, under other names."""
