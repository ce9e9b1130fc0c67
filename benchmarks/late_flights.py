# SPDX-License-Identifier: Apache-2.0
"""Are messages to an autopilot true when sent, although images and poses arrive up to 5 s late?

    python benchmarks/late_flights.py [--seeds 0:1000] [--arrival] [--json]

Each seed is another hall with pillars, path, number of cameras and clock. Delays of images and of poses are none,
constant, growing, jumping or only at the start, up to 5 s, half of them up to 0.6 s; every fifth flight has only the
poses of its images. A distance is too far if the nearest surface in its 5 degrees is nearer by more than 0.3 m plus the
body's motion in 0.1 s, and too near if nothing within its 15 degrees, plus 5 and the body's turn in 0.1 s, is that
near. Sectors sent as unknown are ignored. `--arrival`: ages count from arrival, as before.

Rules were chosen on seeds 10000:10020; figures are of 0:1000.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from time import process_time

from stereovox_lab.flights.late import LateFlight, fly_late, setup_of


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", default="0:1000", metavar="A:B")
    parser.add_argument("--arrival", action="store_true", help="count ages from arrival")
    parser.add_argument("--json", action="store_true", help="the summary alone")
    given = parser.parse_args()
    first, _, last = given.seeds.partition(":")
    cpu, flights = process_time(), []
    for seed in range(int(first), int(last)):
        flights.append(fly_late(seed, replace(setup_of(seed), arrival=given.arrival)))
        if flights[-1].bad_messages and not given.json:
            print(f"seed {seed}: {setup_of(seed)}: {flights[-1]}", flush=True)
    print(
        json.dumps({"seeds": given.seeds, "arrival": given.arrival, **told(flights)} | {"cpu_s": process_time() - cpu})
    )


def told(flights: list[LateFlight]) -> dict[str, object]:
    """Return the summary of all flights."""
    why: Counter[str] = sum((flight.why for flight in flights), Counter())
    names = "messages", "bad_messages", "distances", "too_far", "too_near", "images"
    return {
        "flights": len(flights),
        "bad_flights": sum(flight.bad_messages > 0 for flight in flights),
        "silent_flights": sum(flight.messages == 0 for flight in flights),
        **{name: sum(getattr(flight, name) for flight in flights) for name in names},
        "worst_m": round(max(flight.worst_m for flight in flights), 2),
        "not_sent": dict(why.most_common(6)),
    }


if __name__ == "__main__":
    main()
