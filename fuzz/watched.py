# SPDX-License-Identifier: Apache-2.0
"""Batches of random frames in a separate process, which is recorded and replaced if it dies or hangs."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, process_time
from typing import Any

from frames import BATCH, Tally, run, warm_up, without

HUNG_S, STUCK_S = 60.0, 900.0
"""Seconds of processor time, and by the clock, after which a call counts as hung.

By the clock alone, a call on a busy machine would count as hung. A call that waits forever uses no processor time.
"""
MEMORY = 4 << 30
"""Most memory of a batch in bytes."""
RENEWED = 2
"""Batches of a process: holes in its heap count against MEMORY."""
NEVER = (float("inf"), float("inf"))
LOOKS_S = 1.0
PR_SET_PDEATHSIG = 1


class Watched:
    """Runs batches one after another until frames or time are used up.

    memory: MB after the first batch and after the last, without the allocator's reserve: glibc allocates arrays of up
    to 32 MB from its heap once some of that size were freed, and holes in it stay with the process.
    """

    def __init__(self, seed: int, words: Sequence[str], told: Callable[[str], None]):
        self.memory: dict[str, Any] = {}
        self._known: set[str] = set()
        self._seed, self._words, self._told = seed, list(words), told
        self._context = get_context("spawn")  # forked threads of the kernels would hang
        self._number, self._since = self._context.Value("q", 0), self._context.Array("d", 2)

    def run(self, frames: int, seconds: float) -> Tally:
        """Return the results."""
        tally, batch, until = Tally(), 0, monotonic() + seconds
        while batch * BATCH < frames and monotonic() < until:
            batch = self._batches(tally, batch, frames, until)
        return tally

    def _batches(self, tally: Tally, batch: int, frames: int, until: float) -> int:
        """Run batches in a new process while it lives; return the number of the next one."""
        mine, theirs = self._context.Pipe()
        task = self._seed, self._words, batch, frames, until
        self._since[:] = NEVER  # until the first call
        process = self._context.Process(target=_work, args=(theirs, self._number, self._since, *task), daemon=True)
        process.start()
        theirs.close()
        try:
            while True:
                if mine.poll(LOOKS_S):
                    seen, megabytes = mine.recv()
                    tally.join(seen)
                    self.memory = {"memory_mb": [*self.memory.get("memory_mb", [megabytes])[:1], megabytes]}
                    self._tell(batch, seen, tally, megabytes)
                    batch += 1
                elif self._hangs(process.pid):
                    return self._lost(tally.hung, batch, f"no answer for {HUNG_S:.0f} s of work or {STUCK_S:.0f} s")
        except EOFError:  # it ended or died
            process.join()
            if process.exitcode:
                return self._lost(tally.bad, batch, f"the process ended with {process.exitcode}")
            return batch
        finally:
            process.kill()
            process.join()

    def _hangs(self, pid: int | None) -> bool:
        """Return whether the call that process `pid` is in has worked, or waited, for too long."""
        since, worked = self._since[:]
        return monotonic() - since > STUCK_S or _processor_s(pid) - worked > HUNG_S

    def _lost(self, lines: list[str], batch: int, what: str) -> int:
        lines.append(f"[{self._seed}, {batch}], frame {self._number.value}: {what}")
        self._told(lines[-1])
        return batch + 1

    def _tell(self, batch: int, seen: Tally, tally: Tally, megabytes: float) -> None:
        """Report progress, and each new failure once."""
        for line in seen.bad:
            what = line.partition(": ")[2]
            if what not in self._known:
                self._known.add(what)
                self._told(line)
        longest = tally.slowest[0][0] if tally.slowest else 0.0
        self._told(
            f"batch {batch}: {sum(tally.frames.values())} frames, {len(tally.bad)} crashes, {len(tally.hung)} hangs, "
            f"{tally.slow} slow, {longest:.0f} ms, {megabytes:.0f} MB"
        )


def _work(
    tell: Connection, number: Any, since: Any, seed: int, words: Sequence[str], batch: int, frames: int, until: float
) -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # else a hung process would outlive its parent
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    kinds, odd = without(words)

    def alive(now: int) -> bool:
        number.value = now
        since[:] = monotonic(), process_time() if now else NEVER[1]  # kernels are compiled before the first frame
        return now % 100 > 0 or monotonic() < until

    warm_up([seed, batch, 0], kinds, odd, alive)
    for now in range(batch, batch + RENEWED):
        if now * BATCH >= frames or monotonic() >= until:
            break
        seen = run(min(BATCH, frames - now * BATCH), [seed, now], 0, kinds, odd, alive)
        since[:] = NEVER
        tell.send((seen, _megabytes()))


def _processor_s(pid: int | None) -> float:
    """Return the seconds of processor time that a process took, 0 if it has ended."""
    try:
        user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    except (OSError, ValueError):
        return 0.0
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def _megabytes() -> float:
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6
