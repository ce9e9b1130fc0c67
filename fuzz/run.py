# SPDX-License-Identifier: Apache-2.0
"""Fuzz the readers at length: python fuzz/run.py [--seconds S] [--target NAME] [--runs N] [--json].

Each target runs in its own process. By default mutated seeds are tried one by one; with --coverage atheris guides
mutations by the code they reach, which finds more per run but makes fewer runs. Inputs that crash, take more than a
second of processor time or more than 1 GiB are kept in fuzz/corpus/TARGET under their hash. Ends with 1 if anything was
found.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
PLACES = (HERE, HERE.parent / "tests/helpers")
OWN_SHARE = 20
"""Weight of a seed relative to a file of the corpus."""
MAX_KEPT = 10
"""New crashers of one target after which it is stopped."""


def main() -> int:
    """Run the targets and print a table, or with --json one object."""
    arguments = _arguments()
    if arguments.child:
        return _child(arguments)
    results = {name: _in_a_process(name, arguments) for name in arguments.target or _all_targets()}
    found = sum(result["crashes"] + result["hangs"] for result in results.values())
    if arguments.json:
        print(json.dumps({"targets": results, "runs": sum(result["runs"] for result in results.values())}))
    return 1 if found else 0


def _all_targets() -> list[str]:
    sys.path[:0] = map(str, PLACES)
    from targets import TARGETS

    return list(TARGETS)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3600.0, help="for each target")
    parser.add_argument("--runs", type=int, default=30_000, help="for each target")
    parser.add_argument("--target", action="append", help="one of fuzz/targets.py; repeatable (all)")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other changes")
    parser.add_argument("--coverage", action="store_true", help="guided by atheris")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    return parser.parse_args()


def _in_a_process(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="stereovox-fuzz-") as folder:
        result = Path(folder) / "result.json"
        command = [sys.executable, __file__, "--child", str(result), "--target", name]
        command += ["--seconds", str(arguments.seconds), "--runs", str(arguments.runs), "--seed", str(arguments.seed)]
        with (Path(folder) / "log").open("w+") as log:
            ended = subprocess.run(
                [*command, *["--coverage"] * arguments.coverage], stdout=log, stderr=log, check=False
            )
            log.seek(0)
            last = log.read()[-4000:]
        told = json.loads(result.read_text()) if result.exists() else {"runs": 0, "crashes": 0, "hangs": 0, "said": []}
    if ended.returncode != 0:  # a signal, or out of memory: the process itself is gone
        told["crashes"] += 1
        told["said"].append(f"ended with {ended.returncode}: {last}")
    shown = {key: value for key, value in told.items() if key != "said"}
    print(f"{name:18}", shown, *told["said"], sep="\n  " if told["said"] else "  ", file=sys.stderr, flush=True)
    return told


def _child(arguments: argparse.Namespace) -> int:
    sys.path[:0] = map(str, PLACES)
    if arguments.coverage:
        import atheris

        with atheris.instrument_imports(include=["stereovox"], enable_loader_override=False):
            from targets import TARGETS
    else:
        from targets import TARGETS
    [name] = arguments.target
    with tempfile.TemporaryDirectory(prefix="stereovox-fuzz-") as folder:
        Session(name, TARGETS[name], Path(folder), arguments).run()
    return 0


class Session:
    """Runs one target and counts."""

    def __init__(self, name: str, target: Any, folder: Path, arguments: argparse.Namespace):
        (folder / "seeds").mkdir()
        (folder / "place").mkdir()
        self.target, self.kept, self.place = target, CORPUS / name, folder / "place"
        self.seeds = OWN_SHARE * target.seeds(folder / "seeds")  # inputs once slow may still be slower than others
        self.seeds += [path.read_bytes() for path in sorted(self.kept.glob("*"))]
        self.counts, self.said, self.places = Counter(), [], []
        self.arguments, self.start, self.slowest = arguments, time.monotonic(), 0.0
        for seed in dict.fromkeys(self.seeds):  # compile kernels and import libraries outside the reader's time
            self.try_out(seed, counted=False)
        self.counts.clear()

    def run(self) -> None:
        """Try mutated seeds until time or runs are used up."""
        if self.arguments.coverage:
            return self.guided()
        from mutate import mutated

        dice = random.Random(self.arguments.seed)
        while not self.is_over():
            self.one(mutated(dice.choice(self.seeds), dice))
        self.tell()

    def guided(self) -> None:
        """The same with atheris, which never returns."""
        import atheris

        from mutate import mutated

        inputs = self.place.parent / "inputs"
        inputs.mkdir()
        for number, seed in enumerate(self.seeds):
            (inputs / f"{number}").write_bytes(seed)

        def change(data: bytes, most: int, seed: int) -> bytes:
            dice = random.Random(seed)
            return mutated(data, dice)[:most] if dice.random() < 0.5 else atheris.Mutate(data, most)

        def one(data: bytes) -> None:
            self.one(data)
            if self.is_over():
                self.tell()

        options = [f"-runs={self.arguments.runs}", f"-max_total_time={int(self.arguments.seconds)}", "-max_len=65536"]
        atheris.Setup(
            [sys.argv[0], *options, "-timeout=60", "-rss_limit_mb=4096", str(inputs)], one, custom_mutator=change
        )
        atheris.Fuzz()

    def is_over(self) -> bool:
        """Return whether it was enough."""
        late = time.monotonic() - self.start > self.arguments.seconds
        return late or self.counts["runs"] >= self.arguments.runs or len(self.said) >= MAX_KEPT

    def one(self, data: bytes) -> None:
        """Run once, and keep violations."""
        self.counts["runs"] += 1
        if self.counts["runs"] % 500 == 0:
            self.tell()
        self.try_out(data, counted=True)

    def try_out(self, data: bytes, counted: bool) -> None:
        from bounded import Unbounded, check

        begun = time.process_time()
        try:
            self.counts[check(self.target, data, self.place)] += 1
        except Unbounded as error:
            self.keep("hangs", data, str(error), counted)
        except Exception:
            self.keep("crashes", data, traceback.format_exc(limit=-4), counted)
        if counted:
            self.slowest = max(self.slowest, time.process_time() - begun)

    def keep(self, what: str, data: bytes, said: str, counted: bool) -> None:
        """Count a crasher and write it into the corpus."""
        if not counted:
            print(said, file=sys.stderr)
            return
        self.counts[what] += 1
        place = said.splitlines()[-3:]
        if place in self.places:
            return
        self.places.append(place)
        self.kept.mkdir(parents=True, exist_ok=True)
        path = self.kept / hashlib.sha256(data).hexdigest()[:12]
        path.write_bytes(data)
        self.said.append(f"{path.name}: {said}")

    def tell(self) -> None:
        """Write the counts to the parent's file."""
        from bounded import peak_bytes

        keys = ("runs", "read", "refused", "crashes", "hangs")
        told = {key: self.counts[key] for key in keys} | {
            "slowest_s": round(self.slowest, 3),
            "peak_mib": peak_bytes() >> 20,
            "seconds": round(time.monotonic() - self.start, 1),
            "said": self.said,
        }
        Path(self.arguments.child).write_text(json.dumps(told))


if __name__ == "__main__":
    sys.exit(main())
