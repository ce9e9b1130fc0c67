# SPDX-License-Identifier: Apache-2.0
"""Which bad images are refused, and how many good ones?

    python benchmarks/bad_images.py [SOURCE] [--voxel-size 0.05] [--max-range 5] [--frames A:B:S] [--every 5] [--seed 0]
                                    [--set key=value ...] [--json]
    python benchmarks/bad_images.py --last 1 4 20 [--seeds 0:3] [--clouds] [--set key=value ...] [--json]

All frames of SOURCE are mapped one by one. Before every N-th of them each kind of bad frame is offered instead, to the
map as it is then, and undone. An accepted one is harmless if it changes the state of less than 0.1 % of the certain
cells on which it has evidence, and frees no occupied one; changes that the true frame also makes do not count.

With --last, frames are bad for this many seconds, or the world changes from some moment on: how much of it does the
map accept, and when? Each seed is a random hall (`stereovox_lab.checks.lasting`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

import stereovox as sv
from stereovox.cli.options import add_settings, overrides
from stereovox_lab.checks.bad_images import trial
from stereovox_lab.checks.lasting import CHANGES, FAULTS, Trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", nargs="?", default="sim:room")
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--max-range", type=float, default=5.0)
    parser.add_argument("--frames", default=":", help="a Python slice")
    parser.add_argument("--every", type=int, default=5, help="bad frames before every so many; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    add_settings(parser, "trust.max_disagreement=1")
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--last", type=float, nargs="+", metavar="S", help="faults and changes that last so many seconds"
    )
    parser.add_argument("--seeds", default="0:1", help="halls for --last, a Python slice")
    parser.add_argument("--clouds", action="store_true", help="a lidar in place of the camera, with --last")
    wanted = parser.parse_args()
    if wanted.last:
        lasting(wanted)
        return
    found = trial(sv.open_source(wanted.source, frames=wanted.frames), wanted.every, wanted.seed, **overrides(wanted))
    if wanted.json:
        print(json.dumps(found))
        return
    print(f"{found['frames']} good frames, refused: {found['refused'] or 'none'}")
    print(f"{'instead':24}{'frames':>7}{'refused':>9}{'harmless':>9}{'neither':>9}  reasons")
    for kind, row in found["bad"].items():
        shares = "".join(f"{row[name]:9.3f}" for name in ("refused", "harmless", "left"))
        print(f"{kind:24}{row['frames']:7}{shares}  {row['reasons'] or ''}")


def lasting(wanted: argparse.Namespace) -> None:
    """Print, for each hall, the effect of lasting faults and of changes."""
    begin, end = map(int, wanted.seeds.split(":"))
    rows = []
    for seed in range(begin, end):
        tried = Trial(seed, wanted.clouds, **overrides(wanted))
        for kind in FAULTS:
            found = asdict(tried.fault(kind, wanted.last))
            rows.append({"seed": seed, "fault": kind, **found})
            if not wanted.json:
                told = "".join(
                    f"{found['accepted'][s]:8}{found['freed'][s]:8}{found['changed'][s]:8}" for s in wanted.last
                )
                print(f"{seed:4} {kind:22}{told}  {found['reasons'] or ''}", flush=True)
        for kind in CHANGES:
            found = tried.change(kind)
            rows.append({"seed": seed, "change": kind, **found})
            if not wanted.json:
                told = f"refused {sum(found['refused'].values()):4}, longest {found['longest_s']:5.1f} s"
                print(f"{seed:4} {kind:22}{told}, taken {found['taken']:.3f} of {found['cells']}", flush=True)
    if wanted.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
