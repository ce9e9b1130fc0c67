# SPDX-License-Identifier: Apache-2.0
"""Measured figures in one file, results.json, and the page docs/figures.md that is made of them.

    python benchmarks/results.py NAME [WORD=VALUE ...]              # measure an entry anew
    python benchmarks/results.py NAME [WORD=VALUE ...] -- COMMAND   # the same with another command, which is kept
    python benchmarks/results.py                                    # only write the page

WORD=VALUE replaces a word of the command when it runs (`RECORDING=...`); the file keeps the word. Programs that know
`--json` get it. An entry has `command`, `machine`, `date`, `find`, and `values`. `find` says what to take from the
output: `{"name": "PATH"}` in the JSON of the last line (`cpu_ms.p99`, `rows[library=stereovox].ms`; `rows[*].ms` takes
all, and `{key}` in the name is filled in from each), or `{"name": "PATTERN"}`, with a (group), in text. A name
that is found several times becomes a list. figures.md.in is the page with the values' names in place of figures.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
FILE, TEMPLATE, PAGE = HERE / "results.json", HERE / "figures.md.in", HERE.parent / "docs" / "figures.md"
UNKNOWN = "not recorded"
"""Machine or date of a figure from before this file."""
MARKS = ("", *"¹²³⁴⁵⁶⁷⁸⁹")
"""Marks of rows by their machine and date: none for the most common."""


@dataclass
class Result:
    """One measurement; `result["name"]` is a value, `result.run` the command and the mark of its machine."""

    command: str
    machine: str
    date: str
    find: dict[str, str] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    mark: str = ""

    def __getitem__(self, name: str) -> Figure:
        return Figure(self.values[name])

    @property
    def run(self) -> str:
        """Command as code, with the mark; scripts by their names."""
        return f"`{self.command.removeprefix('python benchmarks/')}`{self.mark}"


@dataclass(frozen=True)
class Figure:
    """A value that formats itself: three significant digits, a list as cells of a table.

    Formats: `span` for the ends of a list, `;` or `,` between its values, `pairs` for two in a cell, `*100` for a
    hundredfold, or one of Python's.
    """

    value: Any

    def __format__(self, spec: str) -> str:
        values = self.value if isinstance(self.value, list) else [self.value]
        if spec == "span":
            return " to ".join(dict.fromkeys(map(_number, (min(values), max(values)))))
        if spec in (";", ","):
            return f"{spec} ".join(map(_number, values))
        shown = [_number(value, spec.removeprefix("pairs")) for value in values]
        if spec.startswith("pairs"):
            shown = [", ".join(pair) for pair in zip(shown[::2], shown[1::2], strict=True)]
        return " | ".join(shown)


def _number(value: Any, spec: str = "") -> str:
    if spec.startswith("*"):
        return _number(float(spec[1:]) * value)
    if spec:
        return format(value, spec)
    return f"{value:.3g}" if isinstance(value, float) and abs(value) < 1000 else f"{value:,.0f}"


def main(words: list[str]) -> None:
    if words:
        at = words.index("--") if "--" in words else len(words)
        words, command = words[:at], words[at + 1 :]
        measure(words[0], dict(word.split("=", 1) for word in words[1:]), shlex.join(command))
    PAGE.write_text(page())


def load(file: Path = FILE) -> dict[str, Result]:
    """Return all results by name."""
    return {name: Result(**entry) for name, entry in json.loads(file.read_text()).items()}


def measure(name: str, replaced: Mapping[str, str], command: str = "", file: Path = FILE) -> None:
    """Run the command of an entry, or another one, and record what it prints."""
    known = load(file).get(name)
    command = command or (known.command if known else "")
    if not command:
        raise SystemExit(f"{name}: no such entry; add -- COMMAND, or choose one of {', '.join(load(file))}")
    words = [_replaced(word, replaced) for word in shlex.split(command)]
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    done = subprocess.run(
        _with_json(words), stdout=subprocess.PIPE, text=True, check=False, env={**os.environ, "PATH": folders}
    )
    values = found(done.stdout, known.find if known else {})
    if not values:
        raise SystemExit(f"{name}: nothing to record in the output; `find` of its entry in {file.name} must say what")
    record(name, command, values, file)
    if done.returncode:
        print(f"{name}: recorded, but the command ended with status {done.returncode}", file=sys.stderr)


def record(name: str, command: str, values: Mapping[str, Any], file: Path = FILE) -> None:
    """Write an entry with the name of this processor and the date."""
    results = load(file)
    find = results[name].find if name in results else {}
    results[name] = Result(command, processor(), f"{datetime.now(UTC):%Y-%m-%d}", find, dict(values))
    entries = {key: {k: v for k, v in vars(one).items() if v and k != "mark"} for key, one in results.items()}
    file.write_text(_text(entries) + "\n")


def _replaced(word: str, replaced: Mapping[str, str]) -> str:
    for old, new in replaced.items():
        word = re.sub(rf"\b{re.escape(old)}\b", lambda _, new=new: new, word)
    return word


def _with_json(words: list[str]) -> list[str]:
    """Add `--json` behind the program's name if it knows the option."""
    for n, word in enumerate(words):
        if word == "stereovox":
            return [*words[: n + 2], "--json", *words[n + 2 :]]
        if word.endswith(".py"):
            knows = '"--json"' in Path(word).read_text()
            return [*words[: n + 1], *["--json"] * knows, *words[n + 1 :]]
    return words


def found(printed: str, find: Mapping[str, str]) -> dict[str, Any]:
    """Return the values that `find` names in the output of a command; without `find` all of a JSON object."""
    try:
        data = json.loads(printed.strip().splitlines()[-1])
    except (IndexError, ValueError):
        data = None
    if not find:
        return data if isinstance(data, dict) else {}
    values: dict[str, list[Any]] = {}
    for name, place in find.items():
        matches = _by_pattern(name, place, printed) if "(" in place else _by_path(name, place, data)
        if not matches:
            raise SystemExit(f"{name}: the output has no {place}")
        for key, value in matches:
            values.setdefault(key, []).append(value)
    return {name: some if len(some) > 1 else some[0] for name, some in values.items()}


def _by_pattern(name: str, pattern: str, text: str) -> list[tuple[str, Any]]:
    return [(name, json.loads(match.replace(",", ""))) for match in re.findall(pattern, text, re.MULTILINE)]


def _by_path(name: str, path: str, data: Any) -> list[tuple[str, Any]]:
    return [(name.format(**item), value) for item, value in _reached(data, re.findall(r"\[[^\]]*\]|[^.\[]+", path), {})]


def _reached(data: Any, steps: list[str], item: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Any]]:
    """Yield what lies at the end of the steps, each with the list's item that led there."""
    if not steps:
        yield item, data
    elif steps[0].startswith("["):
        wanted = dict(part.split("=", 1) for part in steps[0][1:-1].split(",") if "=" in part)
        for one in data if isinstance(data, list) else ():
            if all(str(one.get(key)) == value for key, value in wanted.items()):
                yield from _reached(one, steps[1:], one)
    elif isinstance(data, dict) and data.get(steps[0]) is not None:
        yield from _reached(data[steps[0]], steps[1:], item)


def processor() -> str:
    """Return the name of this machine's processor, its widest vectors, and the number of cores in use."""
    try:
        facts = dict(re.findall(r"^(model name|flags)\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE))
    except OSError:
        facts = {}
    flags = facts.get("flags", "").split()
    vectors = next((name for flag, name in (("avx512f", ", AVX-512"), ("avx2", ", AVX2")) if flag in flags), "")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{facts.get('model name') or platform.processor() or platform.machine()}{vectors}, {cores} cores"


def page(file: Path = FILE, template: Path = TEMPLATE) -> str:
    """Return the page: the template with figures, commands, and marks of machines other than the usual one."""
    results = load(file)
    machines = [key for key, _ in Counter((one.machine, one.date) for one in results.values()).most_common()]
    marks = dict(zip(machines, MARKS, strict=False))
    for one in results.values():
        one.mark = marks[one.machine, one.date]
    lines = [mark + machine + f", {date}" * (date != UNKNOWN) for (machine, date), mark in marks.items()]
    return template.read_text().format(**results, machines="; ".join(lines))


def _text(value: Any, indent: str = "") -> str:
    """Return JSON with a line for each key, and lists in one line."""
    if not isinstance(value, dict) or not value:
        return json.dumps(value, ensure_ascii=False)
    lines = [f"{indent}  {json.dumps(key)}: {_text(inner, indent + '  ')}" for key, inner in value.items()]
    return "{\n" + ",\n".join(lines) + f"\n{indent}}}"


if __name__ == "__main__":
    main(sys.argv[1:])
