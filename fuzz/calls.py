# SPDX-License-Identifier: Apache-2.0
"""Random calls of all commands on random files: python fuzz/calls.py [--calls N] [--seed S] [--json].

The files are small recordings of every layout, maps, clouds and logs; copies that are truncated, damaged, renamed,
mixed or lack a part; and unexpected names. A call must end with 0 or 2, and with 2 its last line must be the only
error, of at most 300 characters, and name something of the call. Ends with 1 if one did not.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent
PLACES = (HERE, HERE.parent / "tests/helpers", HERE.parent / "tests/sources/rgbd")
MAX_LINE, MAX_SECONDS, MAX_MEMORY = 300, 30, 6 << 30
RENEWED = 150
"""Calls after which the files are renewed, because commands overwrite them."""


class Outcome(NamedTuple):
    """The outcome of a call. status: None if it raised. printed: its whole stderr."""

    words: list[str]
    status: int | None
    printed: str
    seconds: float

    def problem(self) -> str:
        """Return the violation, empty if there is none."""
        errors = [line for line in self.printed.splitlines() if line.startswith("stereovox: ")]
        if self.status is None or "Traceback" in self.printed:
            return "raised"
        if self.status not in (0, 2):
            return f"ended with {self.status}"
        if self.status == 0:
            return "an error and yet 0" if errors else ""
        if len(errors) != 1 or not self.printed.endswith(f"{errors[0]}\n"):
            return f"{len(errors)} errors, or not the last line"
        if len(errors[0]) > MAX_LINE:
            return f"an error of {len(errors[0])} characters"
        return "" if self._is_named(errors[0]) else "names nothing of the call"

    def _is_named(self, line: str) -> bool:
        parts = [part for word in self.words for part in (word, *re.split(r"[=?/,]", word.strip("-")))]
        parts += [part.replace("-", "_") for part in parts]  # a setting of that name
        parts += [Path(part).stem for part in parts]  # a recording in a file of that name
        parts += os.listdir()  # a message may name a file from an option, or a neighbour
        named = any(part[:12] in line or repr(part[:12])[1:-1] in line for part in parts if part)
        other_file = re.match(r"stereovox: \S+\.\w+: ", line)  # the file named by one of these
        return named or other_file is not None or "" in self.words or not self.words or "pip install" in line


def main() -> int:
    """Make the calls and print the failed ones, or with --json one object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first call")
    parser.add_argument("--show", action="store_true", help="print every call and its last line")
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    arguments = parser.parse_args()
    sys.path[:0] = map(str, PLACES)
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_MEMORY, MAX_MEMORY))
    with tempfile.TemporaryDirectory(prefix="stereovox-calls-") as folder:
        counts, problems = run(Path(folder), arguments)
    result = {"calls": sum(counts["status"].values()), **{key: dict(value) for key, value in counts.items()}}
    result |= {"problems": problems}
    if arguments.json:
        print(json.dumps(result))
    return 1 if problems else 0


def run(folder: Path, arguments: argparse.Namespace) -> tuple[dict[str, Counter[str]], list[str]]:
    """Return the numbers of outcomes, by status and by command, and the violations."""
    from call_files import Files
    from call_words import call

    counts: dict[str, Counter[str]] = {"status": Counter(), "command": Counter(), "done": Counter()}
    problems: list[str] = []
    files = Files(folder / "files")
    for number in range(arguments.first, arguments.first + arguments.calls):
        dice = random.Random(f"{arguments.seed} {number}")
        if not number % RENEWED or number == arguments.first:
            files.renew(random.Random(f"{arguments.seed} {number // RENEWED}"))
        os.chdir(files.folder)
        words = call(files.names(dice), dice)
        outcome = attempt(words, folder / "printed")
        counts["status"][str(outcome.status)] += 1
        counts["command"]["".join(words[:1])] += 1
        counts["done"]["".join(words[:1])] += outcome.status == 0
        problem = outcome.problem()
        last = (outcome.printed.splitlines() or [""])[-1]
        if arguments.show or outcome.seconds > MAX_SECONDS / 3:
            print(number, f"{outcome.seconds:.1f} s", outcome.status, ascii(words), last[:400], file=sys.stderr)
        if problem:
            problems.append(f"{number}: {problem}: {words!a}: {outcome.printed[-1500:]}")
            print(problems[-1], file=sys.stderr, flush=True)
    os.chdir(HERE)
    return counts, problems


class TooLong(BaseException):
    """A call did not end in time."""


def attempt(words: Sequence[str], captured: Path) -> Outcome:
    """Make one call, with all output of it and its libraries in the file `captured`."""
    from stereovox.cli import main as command_line

    start, kept = time.monotonic(), [os.dup(1), os.dup(2)]
    sys.stdout.flush()
    sys.stderr.flush()
    signal.signal(signal.SIGALRM, _too_long)
    with captured.open("w+", errors="surrogateescape") as out, captured.with_suffix(".out").open("w") as data:
        os.dup2(data.fileno(), 1)
        os.dup2(out.fileno(), 2)
        signal.alarm(MAX_SECONDS)
        status = None
        try:
            status = command_line(list(words))
        except SystemExit as ended:
            status = 2 if isinstance(ended.code, str) else int(ended.code or 0)
        except (Exception, TooLong):
            traceback.print_exc()
        finally:
            signal.alarm(0)
            sys.stdout.flush()
            sys.stderr.flush()
            for number, file in enumerate(kept, 1):
                os.dup2(file, number)
                os.close(file)
        out.seek(0)
        return Outcome(list(words), status, out.read(), time.monotonic() - start)


def _too_long(*_: Any) -> None:
    raise TooLong


if __name__ == "__main__":
    sys.exit(main())
