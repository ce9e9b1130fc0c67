# SPDX-License-Identifier: Apache-2.0
"""Describe the machine that a benchmark ran on."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
FEATURES = {"avx2": "AVX2", "fma": "FMA", "avx512f": "AVX-512", "neon": "NEON", "sve": "SVE"}
"""Vector instructions worth reporting, by their LLVM names."""


def machine() -> dict[str, Any]:
    """Return `cpu`, `cores` (that this process may use), `memory_gb`, `python`, `numpy`, `numba` and `system`.

    Also `features`, the processor's vector instructions, and `target`, the processor that kernels are
    compiled for, by its LLVM name: this one, or NUMBA_CPU_NAME.
    """
    total = _meminfo("MemTotal")
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "memory_gb": None if total is None else round(total / 1e9, 1),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "system": f"{platform.system()} {platform.machine()}",
        "features": _features(),
        "target": _target(),
    }


def machine_line(facts: dict[str, Any]) -> str:
    """Format the result of `machine` as one line."""
    cores = f"{facts['cores']} core{'s' * (facts['cores'] != 1)}"
    versions = ", ".join(f"{name} {facts[name]}" for name in ("python", "numpy", "numba"))
    features = f" ({', '.join(facts['features'])})" if facts.get("features") else ""
    target = f"; kernels for {facts['target']}" if facts.get("target") else ""
    return f"{facts['cpu']}{features}, {cores}{target}; {versions}; {facts['system']}"


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_left() -> int | None:
    """Return the bytes of memory that are free or can be freed; None if the system does not report it."""
    return _meminfo("MemAvailable")


def on_one_processor(make: Callable[..., T], *arguments: Any) -> T:
    """Call `make` with this thread pinned to one processor; threads it starts stay pinned."""
    if not hasattr(os, "sched_setaffinity"):
        return make(*arguments)
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {_this_processor(min(allowed))})
    try:
        return make(*arguments)
    finally:
        os.sched_setaffinity(0, allowed)


def _this_processor(otherwise: int) -> int:
    """Return the processor that this thread runs on: it would have left a busy one."""
    try:
        return int(Path("/proc/thread-self/stat").read_text().rpartition(")")[2].split()[36])
    except (OSError, IndexError, ValueError):
        return otherwise


def _features() -> list[str]:
    from llvmlite import binding

    try:
        here = binding.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this system's processors
        return []
    return [name for feature, name in FEATURES.items() if here.get(feature)]


def _target() -> str:
    from llvmlite import binding

    return os.environ.get("NUMBA_CPU_NAME") or binding.get_host_cpu_name()


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _meminfo(key: str) -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{key}:")), None)
