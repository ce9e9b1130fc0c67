# SPDX-License-Identifier: Apache-2.0
"""Show what a path holds and which commands use it.

A map and how it was made; a recording: frames, rate, camera, depth unit, poses, up direction; a bag: its topics; a
robot's log; a cloud or a map of another program; a file of poses, a calibration, settings, a depth image.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import say

EXAMPLES = """stereovox info recordings/kitchen
stereovox info kitchen.svox --json"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("path", metavar="PATH", help="folder or file; options of a recording may follow a ?")


def run(arguments: Namespace) -> dict[str, Any]:
    """Find out what the path holds, and print it."""
    from stereovox.descriptions import describe

    found = describe(arguments.path)
    for line in found.lines:
        say(line)
    if found.commands:
        say(f"use it with: {found.commands[0]}")
    for command in found.commands[1:]:
        say(f"             {command}")
    return found.facts | {"commands": found.commands}
