# SPDX-License-Identifier: Apache-2.0
"""Find out from recordings what a camera measures wrongly, how noisy it is, or how cameras and trackers stand.

`stereovox calibrate wall --help`, `noise --help`, `pair --help`, `stereo --help` and `import --help` tell more.
"""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentParser, Namespace
from importlib import import_module
from typing import Any

KINDS = ("wall", "noise", "pair", "stereo", "import")
"""Each is a module `calibrate_*` here, made as those of the commands."""
EXAMPLE = "stereovox calibrate wall recordings/wall --distance 1.4 --out camera.toml"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the kinds with their options."""
    kinds = parser.add_subparsers(dest="kind", metavar="|".join(KINDS), required=True)
    options: list[str] = getattr(parser, "options", [])  # those that a slip of the pen is compared with
    for name in KINDS:
        module = _module(name)
        about = str(module.__doc__).strip()
        kind = kinds.add_parser(
            name, help=about.splitlines()[0], description=about, epilog=f"example: {module.EXAMPLE}"
        )
        module.add_arguments(kind)
        kind.add_argument(
            "--json", action="store_true", default=SUPPRESS, help="print one JSON object as the last line of stdout"
        )
        options += getattr(kind, "options", [])


def run(arguments: Namespace) -> dict[str, Any]:
    """Run one of them."""
    return _module(arguments.kind).run(arguments)


def _module(name: str) -> Any:
    return import_module(f"stereovox.cli.calibrate_{name}")
