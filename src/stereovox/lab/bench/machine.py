# SPDX-License-Identifier: Apache-2.0
"""Describe the machine that a benchmark ran on."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Return `cpu`, `cores` (that this process may use), `memory_gb`, `python`, `numpy`, `numba` and `system`."""
    total = _meminfo("MemTotal")
    return {
        "cpu": _cpu(),
        "cores": cores(),
        "memory_gb": None if total is None else round(total / 1e9, 1),
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "system": f"{platform.system()} {platform.machine()}",
    }


def machine_line(facts: dict[str, Any]) -> str:
    """Format the result of `machine` as one line."""
    cores = f"{facts['cores']} core{'s' * (facts['cores'] != 1)}"
    versions = ", ".join(f"{name} {facts[name]}" for name in ("python", "numpy", "numba"))
    return f"{facts['cpu']}, {cores}; {versions}; {facts['system']}"


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_left() -> int | None:
    """Return the bytes of memory that are free or can be freed; None where the system does not report it."""
    return _meminfo("MemAvailable")


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
