# SPDX-License-Identifier: Apache-2.0
"""The option that says how often a map is saved while it is made."""

from __future__ import annotations

from argparse import ArgumentParser

SECONDS = 10.0
"""As `run.CHECKPOINT_S`, whose import `--help` need not wait for."""


def add_checkpoint(parser: ArgumentParser) -> None:
    """Declare the option."""
    parser.add_argument(
        "--checkpoint",
        type=float,
        default=SECONDS,
        metavar="SECONDS",
        help=f"save the map as often while it is made ({SECONDS:g}; 0: only at the end), in 4 %% of the time at most",
    )
