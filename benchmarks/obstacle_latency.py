# SPDX-License-Identifier: Apache-2.0
"""Latency from a depth image's arrival to OBSTACLE_DISTANCE in another process.

    python benchmarks/obstacle_latency.py [--seconds 20] [--hz 30] [--rate 30] [--voxel-size 0.1] [--json]

Simulated 848x480 images, rendered before, go to a mapper at `--hz`; an `ObstacleSender` sends at `--rate` over UDP on
loopback to a process that records each message's arrival. `time_usec` is the arrival of the last image, by the same
clock. So mapping, waiting, sectors and the wire are included. `cpu`: of this process, without rendering, as a share of
one core; other work on the machine disturbs it less than the latency.
"""

from __future__ import annotations

import argparse
import json
import socket
from multiprocessing import get_context
from multiprocessing.connection import Connection
from time import monotonic, process_time, sleep
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.mavlink.link import dialect

WARM_UP = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    print(json.dumps(measured(given)))


def measured(given: argparse.Namespace) -> dict[str, Any]:
    """Return latencies and losses."""
    here, there = get_context("spawn").Pipe()
    peer = get_context("spawn").Process(target=listen, args=(there,), daemon=True)
    peer.start()
    mapper, frames = sv.Mapper(voxel_size=given.voxel_size), list(sv.open_source("sim:room", frames=":90"))
    with sv.ObstacleSender(mapper, f"udpout:127.0.0.1:{here.recv()}", rate_hz=given.rate) as sender:
        for n in range(WARM_UP):
            sender.after(frames[n], mapper.add(frames[n]))
        cpu, refused, number = process_time(), 0, round(given.seconds * given.hz)
        start = monotonic()
        for n in range(number):
            sleep(max(start + n / given.hz - monotonic(), 0))
            frame = to_and_fro(frames, WARM_UP + n)
            report = mapper.add(frame)
            sender.after(frame, report)
            refused += report.refused is not None
        seconds, cpu = monotonic() - start, process_time() - cpu
        sent = sender.sent
    here.send("end")
    ages_ms = 1e3 * np.array([at - seen for at, seen in here.recv() if at >= start])
    return {
        "frames": number,
        "refused": refused,
        "frames_per_s": round(number / seconds, 1),
        "sent": sent,
        "messages_per_s": round(len(ages_ms) / seconds, 1),
        "latency_ms": {name: round(float(np.percentile(ages_ms, q)), 1) for name, q in QUANTILES.items()},
        "cpu": round(cpu / seconds, 3),
    }


QUANTILES = {"median": 50, "p90": 90, "p99": 99, "max": 100}


def to_and_fro(frames: list[sv.Frame], n: int) -> sv.Frame:
    """Return frame n of a walk back and forth, with ascending stamps."""
    from dataclasses import replace

    last = len(frames) - 1
    k = n % (2 * last)
    return replace(frames[k if k <= last else 2 * last - k], stamp_ns=round(n * 1e9 / 30))


def listen(pipe: Connection) -> None:
    """Receive messages until stopped; send back the arrival of each and of its frame."""
    m, came = dialect(), []
    parser = m.MAVLink(None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(0.05)
        pipe.send(udp.getsockname()[1])
        while not pipe.poll():
            try:
                data = udp.recv(65536)
            except TimeoutError:
                continue
            at = monotonic()
            for message in parser.parse_buffer(data) or ():
                if message.get_type() == "OBSTACLE_DISTANCE":
                    came.append((at, message.time_usec / 1e6))
    pipe.send(came)


if __name__ == "__main__":
    main()
