# SPDX-License-Identifier: Apache-2.0
"""Settings on the command line: a profile, the common ones by their own names, any other as KEY=VALUE."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.errors import StereovoxError

NAMED = ("voxel_size", "integrator", "max_range", "threads")
"""Settings that may have an option of their own."""


def add_settings(parser: ArgumentParser, example: str) -> None:
    """Declare --set; `example` is one setting that the command knows."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help=f"any other setting, for example {example}; repeatable",
    )


def overrides(arguments: Namespace) -> dict[str, Any]:
    """Return what stands on top of the profile; raises StereovoxError for a --set that is none."""
    from stereovox.config import parse_value

    found = {}
    for setting in arguments.settings:
        key, equals, value = setting.partition("=")
        if not equals or not key:
            raise StereovoxError(f"--set {setting}: write KEY=VALUE, for example --set sensor.p_free=0.3")
        if key.strip() in ("profile", "resume"):
            raise StereovoxError(f"--set {setting}: this is no setting; use --{key.strip()}")
        if key.strip() in ("tiles", "self"):  # other names that `Mapper` knows
            raise StereovoxError(f"--set {setting}: this is no setting; leave it out")
        found[key.strip()] = parse_value(value.strip())
    named = {name: getattr(arguments, name, None) for name in NAMED}
    return {**found, **{name: value for name, value in named.items() if value is not None}}
