# SPDX-License-Identifier: Apache-2.0
"""Kill `stereovox map` at random moments (`kill -9`) and check what is left.

    python benchmarks/kill.py --kills 200 [SOURCE] [--frames :100] [--voxel-size 0.1] [--json]

After each kill the map must open and contain all frames of the last checkpoint, and `--resume` must end with the same
cells, counts, window and settings as an undisturbed run, and leave nothing else behind. Every second run keeps cells
outside the window in tiles on disk; every seventh frame has a fault and is refused. Checkpoints are far more frequent
than by default, so that many kills hit one. Kills are between the first map on disk and the end of the process. Ctrl-C
ends the trials and prints the results.

The runs are real processes, forked from this one, which has loaded the kernels for all of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import sys
import tempfile
import time
from argparse import ArgumentParser, Namespace
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from stereovox.cli import main
from stereovox.mapper import Mapper
from stereovox.maps import load_map, make_map
from stereovox.opening import open_stream
from stereovox.runs import engine

CONTEXT = get_context("fork")
PLAIN: list[str] = []
KEEP = ["--set", "window.size=[4, 4, 3]", "--set", "window.trigger=0.3", "--set", "window.outside=keep"]
REST = 1
"""Instead of 25: half of the time is spent on checkpoints."""


def command(out: Path, given: Namespace, settings: list[str], *more: str) -> list[str]:
    """Return the words of one run."""
    words = ["map", given.source, "--out", str(out), "--frames", given.frames, "--voxel-size", str(given.voxel_size)]
    return [*words, "--checkpoint", "0.001", *settings, *more]


def perform(words: list[str], done: Any, saved: Any) -> None:
    """Run a command in this process; `done` and `saved` count the frames in the map and on disk for others."""
    engine.REST = REST
    add, save = Mapper.add, engine.Checkpoints.save

    def add_or_refuse(mapper: Mapper, frame: Any) -> Any:
        faulty = done.value % 7 == 3
        report = add(mapper, replace(frame, fault="unreadable", fault_detail="made so") if faulty else frame)
        done.value += 1
        return report

    def save_and_tell(self: engine.Checkpoints, frames: int) -> None:
        save(self, frames)
        saved.value = frames

    Mapper.add, engine.Checkpoints.save = add_or_refuse, save_and_tell
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os._exit(main(words))


def started(words: list[str], frames: int = 0) -> tuple[Any, Any, Any]:
    """Return a process that runs a command on a map of `frames` frames, and its two counters."""
    done, saved = CONTEXT.Value("q", frames, lock=False), CONTEXT.Value("q", frames, lock=False)
    process = CONTEXT.Process(target=perform, args=(words, done, saved))
    process.start()
    return process, done, saved


def contents(out: Path) -> dict[str, Any]:
    """Return a map's content, read by a separate process; `digest` covers all its cells."""
    reader, writer = CONTEXT.Pipe(duplex=False)

    def read() -> None:
        try:
            one = load_map(out)
            cells = b"".join(part.tobytes() for part in one.storage.blocks())
            writer.send(
                {
                    "digest": hashlib.sha256(cells).hexdigest(),
                    "frames": one.frames,
                    "refused": one.frames_refused,
                    "last_frame": one.history.last_frame,
                    "window": one.storage.window_state,
                    "config": one.config.model_dump(),
                }
            )
        except Exception as error:
            writer.send({"error": f"{type(error).__name__}: {error}"})

    process = CONTEXT.Process(target=read)
    process.start()
    writer.close()  # else a dying reader would be waited for forever
    found = reader.recv()
    process.join()
    return found


def left_over(out: Path) -> list[str]:
    """Return files in and next to a map that belong to no complete one."""
    data = json.loads((out / "manifest.json").read_text())["data"]
    inside = [entry.name for entry in out.iterdir() if entry.name not in (data, "manifest.json")]
    return inside + [entry.name for entry in out.parent.iterdir() if entry != out]


def undisturbed(folder: Path, given: Namespace, settings: list[str]) -> tuple[dict[str, Any], float]:
    """Return the result of a whole run, and its duration from its first map on."""
    out = folder / "whole" / "map.svox"
    out.parent.mkdir()
    process, _, _ = started(command(out, given, settings))
    wait_for_map(process, out)
    start = time.monotonic()
    process.join()
    seconds = time.monotonic() - start
    found = contents(out)
    if process.exitcode or "error" in found:
        sys.exit(f"a run without any kill failed: status {process.exitcode}, {found}")
    return found, seconds


def wait_for_map(process: Any, out: Path) -> None:
    """Wait until the first map is on disk."""
    while process.is_alive() and not (out / "manifest.json").exists():
        time.sleep(0.0005)


def trial(out: Path, given: Namespace, settings: list[str], whole: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Kill one run, check what is left, resume it and check again."""
    process, done, saved = started(command(out, given, settings))
    wait_for_map(process, out)
    time.sleep(random.uniform(0, seconds))
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    found = contents(out)
    if process.exitcode != -signal.SIGKILL:
        return {"killed": False}
    told: dict[str, Any] = {"killed": True, "opened": "error" not in found, "error": found.get("error")}
    if not told["opened"]:
        return told
    held = found["frames"] + found["refused"]
    told |= {"frames": held, "missing": done.value - held, "lost": max(0, saved.value - held)}
    told["in_a_save"] = any(name.startswith(("cells-", ".manifest")) for name in left_over(out))
    start = time.monotonic()
    again, _, _ = started(command(out, given, settings, "--resume"), held)
    again.join()
    told["resume_s"] = time.monotonic() - start
    told["equal"] = again.exitcode == 0 and contents(out) == whole
    told["left"] = left_over(out)
    return told


def summary(told: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Return the figures of all trials."""
    opened = [one for one in told if one["opened"]]
    if not opened:
        return {"kills": len(told), "opened": 0, "resumed_equal": 0, "failures": told[:5]}
    return {
        "kills": len(told),
        "kills_in_a_save": sum(one["in_a_save"] for one in opened),
        "opened": len(opened),
        "frames_missing_most": max(one["missing"] for one in opened),
        "frames_missing_median": sorted(one["missing"] for one in opened)[len(opened) // 2],
        "checkpoints_lost": sum(one["lost"] > 0 for one in opened),
        "resumed_equal": sum(one["equal"] for one in opened),
        "with_things_left_after_resume": sum(bool(one["left"]) for one in opened),
        "resume_s_median": round(sorted(one["resume_s"] for one in opened)[len(opened) // 2], 2),
        "seconds": round(seconds, 1),
        "failures": [one for one in told if not (one["opened"] and one["equal"] and not one["lost"])][:5],
    }


def parsed() -> Namespace:
    """Return the options."""
    parser = ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("source", nargs="?", default="sim:room?image_width=160")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--frames", default=":100")
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def judged() -> int:
    """Kill and report; the status is 1 if a promise was broken."""
    given = parsed()
    random.seed(given.seed)
    # Loads the kernels for all later processes. Zarr is not used here: its thread would be lost.
    for words in ({}, {"window": {"size": [4, 4, 3], "trigger": 0.3}}):
        mapper = Mapper("default", voxel_size=given.voxel_size, **words)
        for frame in open_stream(given.source, given.frames):
            mapper.add(frame)
        make_map(mapper.config, mapper.map).storage.blocks()
    start, told = time.monotonic(), []
    with tempfile.TemporaryDirectory(prefix="stereovox-kill-") as name:
        kinds = []
        for n, settings in enumerate((PLAIN, KEEP)):
            (Path(name) / str(n)).mkdir()
            kinds.append((settings, *undisturbed(Path(name) / str(n), given, settings)))
        with suppress(KeyboardInterrupt):
            while len(told) < given.kills:
                with tempfile.TemporaryDirectory(dir=name) as place:
                    one = trial(Path(place) / "map.svox", given, *kinds[len(told) % 2])
                if one["killed"]:  # else it had already ended
                    told.append(one)
                    print(f"\r{len(told)} of {given.kills}", end="", file=sys.stderr, flush=True)
    found = summary(told, time.monotonic() - start)
    print(file=sys.stderr)
    print(json.dumps(found) if given.json else "\n".join(f"{key:30} {value}" for key, value in found.items()))
    kept = found["opened"] == found["resumed_equal"] == found["kills"]
    return 0 if kept and told and not found["checkpoints_lost"] and not found["with_things_left_after_resume"] else 1


if __name__ == "__main__":
    sys.exit(judged())
