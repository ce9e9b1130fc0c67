# SPDX-License-Identifier: Apache-2.0
"""The command line. Text for people goes to stderr; with --json the last line of stdout is one JSON object.

Exit status: 0 ok, 2 bad usage or bad input (one line names the problem and the cure), 3 the result is written but in
doubt (its `doubts`), 130 stopped by Ctrl-C, 143 by SIGTERM.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from typing import Any, NoReturn

import stereovox
from stereovox.errors import DISK_FULL, StereovoxError, did_you_mean, one_line, printed
from stereovox.registry import entry_points

GROUPS = {
    "Start": ("start", ("demo", "info", "simulate")),
    "Map": ("map", ("map", "live", "fleet", "track", "slam", "localize", "import")),
    "Look": ("look", ("picture", "view", "sphere", "export")),
    "Ask": ("ask", ("distance", "path", "frontiers", "ground", "grid", "diff")),
    "Correct": ("correct", ("merge", "loops", "remap", "crop", "coarsen", "calibrate")),
    "Robots": ("robots", ("ros2",)),
    "Prove": ("prove", ("eval", "score", "truth")),
}
"""Groups of the help: the folder of their commands, and the commands.

Each command is a module with a docstring, `EXAMPLES` (one per line), `add_arguments(parser)` and
`run(arguments) -> dict`; it may name its `GROUP`. The module of a command that is a Python keyword has a trailing
underscore. Other packages add commands as entry points `name = "module"` in the group `stereovox.commands`.
"""
COMMANDS = {name: f"stereovox.cli.{folder}.{name}" for folder, names in GROUPS.values() for name in names}
COMMANDS |= {"import": "stereovox.cli.map.import_", "calibrate": "stereovox.cli.calibrate"}
"""Module of each built-in command."""

DOUBTED = 3
"""Exit status of a command that wrote a map which may be wrong, or a trajectory with gaps."""
UNUSABLE = "check that it exists and that you have permission"
GLOBAL_OPTIONS = ("-h", "--help", "--version")
"""Options that may come before a command or without one."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = sys.argv[1:] if argv is None else argv
    if "_ARGCOMPLETE" in os.environ:  # the shell asks for completions
        _complete(os.environ.get("COMP_LINE", "").split()[1:])
    try:
        _check_command(words)
        arguments = _parse(words)
        result = command_module(arguments.command).run(arguments)
        failed = _print_json(result) if arguments.json else 0
        return failed or (2 if result.get("not_written") else DOUBTED if result.get("doubts") else 0)
    except StereovoxError as error:
        return _fail(" ".join(str(error).split()), 2, words)
    except OSError as error:  # not foreseen by a command: a folder without search permission, a full disk
        where = f"{error.filename}: " if error.filename else ""
        full = error.errno in DISK_FULL
        cure = "the file being written is incomplete; remove it, and make room" if full else UNUSABLE
        return _fail(f"{where}{error.strerror or error}; {cure}", 2, words)
    except MemoryError:
        return _fail("not enough memory; use larger cells (--voxel-size) or a shorter --max-range", 2)
    except KeyboardInterrupt as stopped:
        return _fail("stopped", 128 + (stopped.args[0] if stopped.args else signal.SIGINT))


def _print_json(result: dict[str, Any]) -> int:
    try:
        print(json.dumps(result, allow_nan=False))
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # otherwise Python tries again at exit
        if not isinstance(error, BrokenPipeError):  # a reader that stops early is no mistake
            return _fail(f"standard output: {error.strerror}; redirect it to a place with room", 2)
    return 0


def _fail(message: str, status: int, words: Sequence[str] = ()) -> int:
    names = [name for word in words for name in (word, word.partition("?")[0], word.partition("=")[2])]
    print(f"stereovox: {printed(one_line(message), names)}", file=sys.stderr)
    return status


class _Parser(argparse.ArgumentParser):
    """Argument parser that accepts full option names only and raises errors that `main` prints as one line."""

    def __init__(self, examples: str = "", **settings: Any):
        self.examples, self.options = examples, list[str]()
        self._words: Sequence[str] = ()
        super().__init__(**settings, allow_abbrev=False)

    def add_argument(self, *names: Any, **settings: Any) -> argparse.Action:
        self.options += [name.removeprefix("--") for name in names if name.startswith("--")]
        return super().add_argument(*names, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self._words = args or ()
        return super().parse_known_args(args, namespace)

    def format_help(self) -> str:
        lines = [f"  {line}\n" for line in self.examples.splitlines()]
        return "".join([super().format_help(), *(["\nexamples:\n"] if lines else []), *lines])

    def error(self, message: str) -> NoReturn:
        raise StereovoxError(f"{message}{self._minus_hint(message)}; see: {self.prog} --help")

    def _minus_hint(self, message: str) -> str:
        """Return a hint on how to write a value that begins with a minus, if that is the mistake."""
        option = message.partition(":")[0].split("/")[-1].removeprefix("argument ")
        for word, value in pairwise(self._words):
            if word == option and value.startswith("-") and value.removeprefix("--") not in self.options:
                return f" (write {option}={value})"
        return ""

    def refuse(self, word: str, arguments: argparse.Namespace) -> NoReturn:
        """Raise the error for an argument that was not recognised."""
        for action in self._actions:
            if isinstance(action.choices, dict):
                action.choices[getattr(arguments, action.dest)].refuse(word, arguments)
        option = word.partition("=")[0]
        if option.startswith("-"):
            self.error(f"unknown option '{option}'{did_you_mean(option.strip('-'), self.options, '--')}")
        self.error(f"unexpected argument '{word}'")


def _complete(words: Sequence[str]) -> None:
    """Print the possible next words for the shell, and exit; do nothing if argcomplete is not installed."""
    try:
        from argcomplete import autocomplete
    except ImportError:
        return
    autocomplete(_parser(words[:1] if len(words) > 1 and words[0] in commands() else ()))


def _parse(words: Sequence[str]) -> argparse.Namespace:
    parser = _parser(words)
    arguments, left = parser.parse_known_args(words)
    if left:
        parser.refuse(left[0], arguments)
    return arguments


def _parser(words: Sequence[str]) -> _Parser:
    """Return the parser of the command at the start of `words`, or of all commands."""
    parser = _Parser(prog="stereovox", description=stereovox.__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--version", action="version", version=f"stereovox {stereovox.__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)
    one = bool(words) and not words[0].startswith("-")  # importing the modules of all commands takes long
    modules = {words[0]: command_module(words[0])} if one else _all_modules()
    for name, module in modules.items():
        about = str(module.__doc__).strip()
        command = subparsers.add_parser(name, description=about, examples=module.EXAMPLES)
        module.add_arguments(command)
        command.add_argument("--json", action="store_true", help="print one JSON object as the last line of stdout")
    subparsers.help = _grouped(modules)
    return parser


def _grouped(modules: Mapping[str, Any]) -> str:
    """Return the first line of each command's description, under the name of its group."""
    groups: dict[str, list[str]] = {group: [] for group in GROUPS}
    for name, module in modules.items():
        group = next((group for group, (_, names) in GROUPS.items() if name in names), getattr(module, "GROUP", "More"))
        groups.setdefault(group, []).append(f"  {name:10} {str(module.__doc__).strip().splitlines()[0]}")
    return "\n".join(line for group, lines in groups.items() if lines for line in (group, *lines))


def commands() -> dict[str, str]:
    """Return the module of each command by name: the built-in ones, then other packages' in alphabetical order."""
    others = {entry.name: entry.value for entry in entry_points(group="stereovox.commands")}
    return COMMANDS | {name: others[name] for name in sorted(others) if name not in COMMANDS}


def _check_command(words: Sequence[str]) -> None:
    """Raise an error that suggests the right command or order of options, as argparse does not."""
    if words and words[0].startswith("-") and words[0] not in GLOBAL_OPTIONS:
        option, command = words[0].partition("=")[0], next((word for word in words if word in commands()), "COMMAND")
        raise StereovoxError(f"'{option}' is before the command; write it after: stereovox {command} ... {option}")
    empty = next((word for word in words if word.startswith("--") and word.endswith("=--")), None)
    if empty is not None:  # argparse takes the value for the end of all options
        raise StereovoxError(f"'{empty}': '--' is no value; give another")
    if words and not words[0].startswith("-") and words[0] not in COMMANDS and words[0] not in (known := commands()):
        raise StereovoxError(f"unknown command '{words[0]}'{did_you_mean(words[0], known)}; see: stereovox --help")


def command_module(name: str) -> Any:
    """Return the module of a command. Raises StereovoxError if it is another package's and cannot be imported."""
    if name in COMMANDS:
        return import_module(COMMANDS[name])
    try:
        return import_module(commands()[name])
    except ImportError as error:
        raise StereovoxError(f"the command {name} of another package cannot be imported: {error}") from error


def _all_modules() -> dict[str, Any]:
    """Return the modules of all commands; those of other packages that cannot be imported are skipped with a note."""
    found = {}
    for name in commands():
        try:
            found[name] = command_module(name)
        except StereovoxError as error:
            print(f"note: {error}", file=sys.stderr)
    return found
