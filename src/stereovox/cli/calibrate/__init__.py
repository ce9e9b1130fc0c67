# SPDX-License-Identifier: Apache-2.0
"""Calibrate depth errors, noise, a stereo pair, or a camera on a tracker, from recordings.

See `stereovox calibrate wall --help`, `noise --help`, `pair --help`, `stereo --help` and `import --help`.
"""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentParser, Namespace
from importlib import import_module
from typing import Any

KINDS = ("wall", "noise", "pair", "stereo", "import")
"""Each is a module `calibrate_*` of this package with the parts of a command."""
EXAMPLES = """stereovox calibrate wall recordings/wall --distance 1.4 --out camera.toml
stereovox calibrate noise wall-1m wall-2m --out noise.toml"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the kinds of calibration and their options."""
    kinds = parser.add_subparsers(dest="kind", metavar="|".join(KINDS), required=True)
    for name in KINDS:
        module = _module(name)
        about = str(module.__doc__).strip()
        kind = kinds.add_parser(name, help=about.splitlines()[0], description=about, examples=module.EXAMPLES)
        module.add_arguments(kind)
        kind.add_argument(
            "--json", action="store_true", default=SUPPRESS, help="print one JSON object as the last line of stdout"
        )


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the chosen calibration."""
    return _module(arguments.kind).run(arguments)


def _module(name: str) -> Any:
    return import_module(f"stereovox.cli.calibrate.calibrate_{name}")
