# SPDX-License-Identifier: Apache-2.0
"""Write docs/figures.md, and pages of docs/reference from argparse, the settings and the tables of checks and outputs.

    python docs/make_reference.py

A test compares the files with what is written here.
"""

from __future__ import annotations

import re
import runpy
from argparse import SUPPRESS, Action, ArgumentParser
from collections.abc import Set
from dataclasses import fields, is_dataclass
from inspect import getdoc
from itertools import starmap
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ByteSize
from pydantic.fields import FieldInfo

from stereovox import Config, cli, load_config, opening, registry
from stereovox.config import profile_names
from stereovox.mapping import entrance
from stereovox.products import context
from stereovox.ros import options as ros_options
from stereovox.sensors import SENSORS
from stereovox.simulate import simulation, surround
from stereovox.simulate.floors import floor
from stereovox.sources.bags import recording
from stereovox.sources.clouds import bag as cloud_bag
from stereovox.sources.clouds import folder as cloud_folder
from stereovox.sources.clouds.options import LidarOptions
from stereovox.sources.realsense import realsense
from stereovox.sources.rgbd.folder import FolderOptions
from stereovox.sources.rigs.pair_file import PairSettings
from stereovox.sources.robots import bag, carmen

FOLDER = Path(__file__).resolve().parent / "reference"
SOURCE = "<!-- Written by docs/make_reference.py from {}: change it there. -->"

COMMANDS = """# Commands

{source}

- `stereovox --help` lists all commands, `stereovox map --help` the options of one.
- Options come after the command, and are written in full. A value that begins with a minus needs `=`: `--up=-y`.
- Tab completes commands and options after `pip install 'stereovox[complete]'` and, in `.bashrc` or `.zshrc`,
  `eval "$(register-python-argcomplete stereovox)"`; in fish
  `register-python-argcomplete --shell fish stereovox | source`.
- Text and progress go to stderr. With `--json`, which every command has, the last line of stdout is one JSON object.
- Exit status: 0 for success; 2 for bad usage or bad input, with one line that names the file or value and the remedy;
  3 for a map that was written but may be wrong ([self-check](../robots.md#self-check)) or holds less than half of what
  came, and for a trajectory with gaps ([tracking](../tracking.md)); 130 after Ctrl-C and 143 after
  SIGTERM. `map` and `grid` then save the map as far as it got.
- Recordings are recognised by their contents, wherever they lie: [Recordings](../recordings.md).

| command | |
|---|---|
{overview}
"""

SETTINGS = """# Settings

{source}

Every setting has a default, so a profile names only what differs. It is a TOML file:

```toml
# garage.toml, used as: stereovox map SOURCE --out MAP --profile garage.toml
voxel_size = 0.1
max_range = 8.0

[sensor]
model = "valenti"
p_free = 0.3
```

On the command line: `--set max_range=8 --set sensor.model=valenti`. In Python: `sv.Mapper(max_range=8.0,
**{{"sensor.model": "valenti"}})`. An unknown name is an error that suggests the right one. The settings that a map was
made with are saved in it. Lengths are metres unless the description says otherwise. Which settings matter:
[How to choose](../choosing.md).
"""

OPTIONS = """# Options

{source}

Options of a recording follow its name after a `?`, joined by `&`; quote them in a shell:
`'scan?depth_scale=1000&poses=trajectory.log'`. Keys of [`pair.toml`](../recordings.md#a-depth-camera-and-a-tracker) are
lines of that file. Parameters of the [ROS 2 node](../ros2.md) begin with `ros.`; most are
also options of [`stereovox ros2`](commands.md#ros2).
"""
NAMED = {
    "Depth images": FolderOptions,
    "Bags": recording.Options,
    "RealSense": realsense.Options,
    "pair.toml": PairSettings,
    "Clouds": LidarOptions,
    "Folders of clouds": cloud_folder.Options,
    "Clouds of a bag": cloud_bag.Options,
    "Bags of ground robots": bag.RobotOptions,
    "CARMEN logs": carmen.Options,
    "Simulations": simulation.Options,
    "sim:surround": surround.Options,
    "sim:floor": floor.Options,
    "ROS 2": ros_options.Options,
}
"""Classes of options, by what takes them."""

LAYOUTS = """# Layouts

{source}

What `stereovox map` and `sv.open_source` read, in the order in which they are tried, and what commands for ground
robots read, as the classes describe themselves. [Recordings](../recordings.md) is the page to begin with;
`stereovox info` shows what a path holds.
"""

REFUSALS = """# Refusals

{source}

What `Mapper.add` (the first three kinds of input) and `GridMapper.add` (the others) check before a measurement may
change a map. A cell is the function that refuses, or why there is nothing to check. All recordings, running cameras,
ROS 2 and fleets enter through these two, so the checks are the same. A refused input changes nothing but the count of
refusals.
[What a map promises](../safety.md#which-frames-may-change-the-map) explains the checks of time, pose and content. In
Python: `stereovox.mapping.entrance.CHECKS`.

{table}

Reasons that sources, trackers and localisation give:

| refused as | when |
|---|---|
{others}
"""

OUTPUTS = """# Outputs

{source}

What leaves a map: functions and classes of `stereovox` (`sv`), outputs of `stereovox live`, files by their ending, and
ROS topics. For each property of the map, a cell says what the output does with it: it *uses* it, *refuses* if it is
bad, *carries* it *along*, or the number of the note that says why it has no meaning there.
[What a map promises](../safety.md) explains ages, health and what unknown means. In Python:
`stereovox.products.context.OUTPUTS`.

{table}
"""


def main() -> None:
    """Write the pages."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages().items():
        (FOLDER / name).write_text(text)


def pages() -> dict[str, str]:
    """Return the text of each page by its file's name."""
    return {
        "commands.md": _commands(),
        "settings.md": _settings(),
        "options.md": _options(),
        "layouts.md": _layouts(),
        "refusals.md": _refusals(),
        "outputs.md": _outputs(),
        "../figures.md": runpy.run_path(str(FOLDER.parents[1] / "benchmarks/results.py"))["page"](),
    }


def _refusals() -> str:
    others = [f"| `{reason}` | {when} |" for reason, when in entrance.ELSEWHERE.items()]
    source = SOURCE.format("stereovox.mapping.entrance")
    return REFUSALS.format(source=source, table="\n".join(entrance.table()), others="\n".join(others))


def _outputs() -> str:
    return OUTPUTS.format(source=SOURCE.format("stereovox.products.context"), table="\n".join(context.table()))


def _options() -> str:
    return "\n".join([OPTIONS.format(source=SOURCE.format("the classes of options")), *starmap(_class, NAMED.items())])


def _class(title: str, kind: type) -> str:
    inherited = {field.name for base in kind.__bases__ if is_dataclass(base) for field in fields(base)}
    defaults = {field.name: field.default for field in fields(kind) if field.name not in inherited}
    prefix = ros_options.PREFIX if kind is ros_options.Options else ""
    about, texts = _described(kind, list(defaults), prefix)
    lines = [f"## {title}", "", about, "", "| option | default | |", "|---|---|---|"]
    for name, default in defaults.items():
        shown = "" if default in (None, "", ()) or default != default else f"`{_value(default)}`"  # NaN: not set
        lines.append(f"| `{prefix}{name}` | {shown} | {_cell(texts[name])} |")
    return "\n".join([*lines, ""])


def _layouts() -> str:
    parts = [LAYOUTS.format(source=SOURCE.format("the classes in stereovox.opening"))]
    for title, known in (("", opening.SOURCES), ("", opening.STREAMS), ("robot: ", opening.ROBOTS)):
        for name in known:
            doc = str(getdoc(registry.find("sources", known, name)))
            about, *_ = re.split(r"\n\n(?:Args|Attributes|Raises):\n", doc)
            parts.append(f"## {title}{name}\n\n```text\n{about}\n```\n")
    return "\n".join(parts)


def _commands() -> str:
    modules = {name: cli.command_module(name) for name in cli.commands()}
    overview = [f"| [`{name}`](#{name}) | {_cell(_first(module.__doc__))} |" for name, module in modules.items()]
    parts = [COMMANDS.format(source=SOURCE.format("src/stereovox/cli"), overview="\n".join(overview))]
    for name, module in modules.items():
        parser = cli._Parser(prog=f"stereovox {name}", description=module.__doc__, examples=module.EXAMPLES)
        module.add_arguments(parser)
        parts.append(_command(name, parser, "##"))
    return "\n".join(parts)


def _command(name: str, parser: ArgumentParser, heading: str) -> str:
    actions = [action for action in parser._actions if {"--help", "--json"}.isdisjoint(action.option_strings)]
    kinds = [action for action in actions if isinstance(action.choices, dict)]
    options = [action for action in actions if action not in kinds]
    lines = [f"{heading} {name}", "", str(parser.description).strip(), ""]
    if options:
        lines += ["```text", _usage(parser.prog, options), "```", "", "| argument | default | |", "|---|---|---|"]
        lines += [f"| `{_name(action)}` | {_default(action)} | {_help(parser, action)} |" for action in options]
        lines += ["", "```bash", *parser.examples.splitlines(), "```", ""]
    for action in kinds:
        lines += [_command(f"{name} {kind}", sub, heading + "#") for kind, sub in action.choices.items()]
    return "\n".join(lines)


def _usage(program: str, actions: list[Action]) -> str:
    """Return what must be given, and whether there is more."""
    needed = [_name(action) for action in actions if action.required]
    needed += ["[options]"] if any(action.option_strings and not action.required for action in actions) else []
    return " ".join([program, *needed])


def _name(action: Action) -> str:
    """Return an option with its value, or the name of a positional argument, as the usage shows it."""
    names = action.metavar or ("" if action.nargs == 0 else _alternatives(action))
    value = " ".join(names) if isinstance(names, tuple) else names
    if action.nargs == "?":
        value = f"[{value}]"
    elif action.nargs in ("*", "+"):
        value += " ..."
    return " ".join([*action.option_strings[-1:], value]).strip().replace("|", "\\|")


def _alternatives(action: Action) -> str:
    return "|".join(map(str, action.choices)) if action.choices else action.dest.upper()


def _default(action: Action) -> str:
    if action.required:
        return "required"
    return "" if action.default in (None, False, SUPPRESS) or action.default == [] else f"`{action.default}`"


def _help(parser: ArgumentParser, action: Action) -> str:
    return _cell(parser._get_formatter()._expand_help(action)) if action.help else ""


def _settings() -> str:
    parts = [SETTINGS.format(source=SOURCE.format("stereovox.Config")), _section("General", "", Config)]
    for name, field in Config.model_fields.items():
        if _is_section(field.annotation):
            parts.append(_section(name, f"{name}.", field.annotation))
            if name == "sensor":
                parts.append(_sensors())
    return "\n".join([*parts, _profiles()])


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _section(title: str, prefix: str, model: type[BaseModel]) -> str:
    nested = {name for name, field in model.model_fields.items() if _is_section(field.annotation)}
    about, texts = _described(model, list(model.model_fields), prefix, nested)
    lines = [f"## {title}", "", about, "", "| setting | type | default | |", "|---|---|---|---|"]
    for name, field in model.model_fields.items():
        if name not in nested:
            default = "not set" if field.default is None else f"`{_value(field.default)}`"
            lines.append(f"| `{prefix}{name}` | {_type(field)} | {default} | {_cell(texts[name])} |")
    return "\n".join([*lines, ""])


def _described(kind: type, names: list[str], prefix: str, nested: Set[str] = frozenset()) -> tuple[str, dict[str, str]]:
    """Return what a class's docstring says of the whole, and of each of `names`: `name: text` or `name, name: text`.

    nested: names that need no text. prefix: of names that are referred to, because they are described together.
    """
    text = " ".join(str(kind.__doc__).replace("Attributes:\n", "").split())
    text = re.sub(r"docs/(\w+)\.md", r"[\g<0>](../\1.md)", text)
    text = re.sub(r"(\w+?)1 \.\.\. \w+4:", r"\g<1>1, \g<1>2, \g<1>3, \g<1>4:", text)
    any_name = "|".join(sorted(names, key=len, reverse=True))
    about, *entries = re.split(rf"(?<=\s)((?:{any_name})(?:, (?:{any_name}))*): ", text)
    said: dict[str, str] = {}
    for group, entry in zip(entries[::2], entries[1::2], strict=True):
        entry = entry.strip().rstrip(".;")
        first, *others = group.split(", ")
        said |= {first: entry[:1].lower() + entry[1:], **dict.fromkeys(others, f"see `{prefix}{first}`")}
    if missing := [name for name in names if name not in said and name not in nested]:
        raise ValueError(f"{kind.__name__}: its docstring does not describe {', '.join(missing)}")
    return about.strip(), said


def _type(field: FieldInfo) -> str:
    limits = [
        f"{sign} {getattr(limit, name):g}" for limit in field.metadata for name, sign in LIMITS if hasattr(limit, name)
    ]
    return _cell(", ".join([_kind(field.annotation), *limits]))


LIMITS = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"), ("multiple_of", "multiple of"))
KINDS = {bool: "true or false", int: "whole number", float: "number", str: "text", ByteSize: "bytes"}


def _kind(kind: Any) -> str:
    if get_origin(kind) in (Union, UnionType):
        return _kind(next(part for part in get_args(kind) if part is not type(None)))
    if get_origin(kind) is Literal:
        return " or ".join(f"`{value}`" for value in get_args(kind))
    return f"{len(get_args(kind))} numbers" if get_origin(kind) is tuple else KINDS[kind]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else str(value)


def _sensors() -> str:
    lines = ["The parameters of a model stand next to its name, for example `sensor.p_free`:", ""]
    lines += ["| `sensor.model` | parameters and defaults | |", "|---|---|---|"]
    for name in SENSORS:
        model = registry.find("sensors", SENSORS, name)
        numbers = ", ".join(f"`{field.name}` {field.default}" for field in fields(model))
        lines.append(f"| `{name}` | {numbers} | {_cell(_first(model.__doc__))} |")
    return "\n".join([*lines, ""])


def _profiles() -> str:
    """Return a table of what the built-in profiles change."""
    usual, *changed = ["default", *(name for name in profile_names() if name != "default")]
    flat = {name: _flat(load_config(name).model_dump()) for name in (usual, *changed)}
    names = [name for name in dict.fromkeys(key for values in flat.values() for key in values) if name != "profile"]
    lines = ["## Profiles", "", "What the built-in profiles change. An empty field is the default.", ""]
    lines += [f"| setting | {' | '.join(f'`{name}`' for name in flat)} |", f"|---|{'---|' * len(flat)}"]
    for name in names:
        row = [values.get(name) for values in flat.values()]
        if any(value != row[0] for value in row):
            shown = [_shown(row[0]), *("" if value == row[0] else _shown(value) for value in row[1:])]
            lines.append(f"| `{name}` | {' | '.join(shown)} |")
    return "\n".join([*lines, ""])


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


def _shown(value: Any) -> str:
    return "" if value is None else f"`{_value(value)}`"


def _first(doc: str | None) -> str:
    return " ".join(str(doc).strip().split("\n\n")[0].split())


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    main()
