# SPDX-License-Identifier: Apache-2.0
"""Decorators for kernels: compile flags, and a disk cache that any change in a kernel file invalidates.

Numba recompiles a kernel when its own file changes but not when a file it calls does; so the cache folder's name
contains the hash of all kernel files (and numba's version).
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering

# Two things that make kernels fast are not available through numba's public options: the promise that arrays do not
# overlap, and vectors of 512 bits. Both need its private pipeline (numba.core), which any version may change without
# notice. So pyproject.toml allows only tested versions; tests/kernels/test_jit.py shows what a new one breaks.

FAST_MATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""Without `nnan` and `ninf`: depth images hold NaN and infinity."""

Function = Callable[..., Any]


class _WideLower(Lower):
    """Allows 512-bit vectors if the processor has them; by default LLVM uses half of that."""

    def setup_function(self, fndesc: Any) -> None:
        super().setup_function(fndesc)
        set.add(self.function.attributes, '"prefer-vector-width"="512"')  # llvmlite rejects attributes with values


@register_pass(mutates_CFG=True, analysis_only=False)
class _WideLowering(NativeLowering):
    _name = "stereovox_wide_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return _WideLower


class _KernelCompiler(CompilerBase):
    """Numba's pipeline with the promise that array arguments do not overlap; without it no gather is vectorised."""

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.passes = [(_WideLowering if p is NativeLowering else p, name) for p, name in pipeline.passes]
        pipeline.finalize()
        return [pipeline]


def kernel(function: Function) -> Function:
    """Compile `function` to machine code that releases the GIL and is cached on disk.

    An array that a kernel writes must not overlap any other argument. Kernels cannot allocate arrays, so references
    are not counted, which in small loops takes longer than the work.
    """
    return _compile(function, _nrt=False)


def allocating_kernel(function: Function) -> Function:
    """Compile `function` as `kernel` does, but allow it to allocate arrays."""
    return _compile(function)


def cell(function: Function) -> Function:
    """Compile a small function that is inlined into every kernel that calls it.

    It must not make or return arrays, so references are not counted, which inside a loop costs more than a hash
    look-up. Python cannot call it: compiling a wrapper would take as long as compiling the function.
    """
    return _compile(function, forceinline=True, _nrt=False, no_cpython_wrapper=True)


def exact_cell(function: Function) -> Function:
    """Compile a small function as `cell` does, but round each operation as NumPy does."""
    return _compile(function, forceinline=True, _nrt=False, no_cpython_wrapper=True, fastmath=False)


@lru_cache
def cache_folder() -> Path | None:
    """Return the folder of compiled kernels, None if none is writable."""
    name = f"stereovox-kernels-{_source_hash()}"
    for base in (os.environ.get("STEREOVOX_CACHE"), _user_cache(), tempfile.gettempdir()):
        folder = Path(base) / "stereovox" / name if base else None
        if folder and _writable(folder):
            return folder
    return None


def with_cache(compile_it: Callable[[bool], Function]) -> Function:
    """Return `compile_it(cache)`; `cache` is whether machine code is kept on disk, in the folder of these kernels."""
    folder = cache_folder()
    settings: Any = numba_config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(folder or "")
    try:
        compiled = compile_it(folder is not None)
    finally:
        settings.CACHE_DIR = before
    if folder is not None:
        _run_if_not_saved(compiled)
    return compiled


def _run_if_not_saved(compiled: Any) -> None:
    """Let a kernel run although its machine code cannot be saved, because the disk is full for example."""
    cache = getattr(compiled, "_cache", None)  # the simulator of graphics cards has none
    if cache is not None:
        save = cache.save_overload

        def save_overload(*overload: Any) -> None:
            with suppress(OSError):
                save(*overload)

        cache.save_overload = save_overload


def _compile(function: Function, fastmath: set[str] | bool = FAST_MATH, **options: Any) -> Function:
    options = {"no_cfunc_wrapper": True, **options}
    return with_cache(
        lambda cache: numba.njit(
            function, cache=cache, error_model="numpy", fastmath=fastmath, nogil=True, pipeline_class=_KernelCompiler,
            **options,
        )
    )  # fmt: skip


def _source_hash() -> str:
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(Path(__file__).parents[1].rglob("_*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _user_cache() -> str | None:
    try:
        return os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    except RuntimeError:
        return None


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
