# SPDX-License-Identifier: Apache-2.0
"""Run scripts, each in a process of its own, forked from one that has imported already what most of them need.

Run as a program, it is that process: it reads the names of scripts, and answers each with its exit status.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from numba.core.registry import cpu_target

NEEDED = [
    "stereovox.mapper",
    "stereovox.opening",
    "stereovox.simulate.scenes.room",
    "scipy.interpolate",
    "trimesh.creation",
    "zarr",
    "matplotlib.figure",
]


@contextmanager
def example_runner() -> Iterator[Any]:
    """Yield a function that runs a script as `python SCRIPT` would in its folder: exit status, and what it printed."""
    command = [sys.executable, __file__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:

        def run(script: Path) -> tuple[int, str]:
            print(script, file=server.stdin, flush=True)
            return int(server.stdout.readline()), _log_of(script).read_text()

        yield run


def _serve() -> None:
    """Import, but start no thread: a forked process has none of them."""
    for name in NEEDED:
        import_module(name)
    cpu_target.target_context.refresh()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            _run(Path(line.strip()))
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def _run(script: Path) -> None:
    """Run a script and end this process."""
    os.chdir(script.parent)
    sys.argv, sys.path[0] = [str(script)], str(script.parent)
    with _log_of(script).open("w") as log:
        for number in (1, 2):
            os.dup2(log.fileno(), number)
    os.close(0)
    status = 0
    try:
        runpy.run_path(str(script), run_name="__main__")
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _log_of(script: Path) -> Path:
    return script.with_suffix(".log")


if __name__ == "__main__":
    _serve()
