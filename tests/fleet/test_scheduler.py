# SPDX-License-Identifier: Apache-2.0
"""Scheduler and workers in processes of their own, as on a cluster, with a map in an object store; and a restart."""

import socket
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from time import sleep
from uuid import uuid4

import pytest
from made_fleet import SETTINGS, alone, assert_same, recording

from stereovox.errors import StereovoxError
from stereovox.fleet import map_fleet

pytest.importorskip("distributed")


@contextmanager
def process(module, *words):
    """Run a module of Dask; it is killed at the end."""
    started = subprocess.Popen(
        [sys.executable, "-m", module, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield started
    finally:
        started.kill()
        started.wait()


@contextmanager
def cluster(port):
    """Run a scheduler and two workers; yield the scheduler once it listens, however long that takes."""
    address = f"tcp://127.0.0.1:{port}"
    with ExitStack() as stack:
        head = stack.enter_context(
            process("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        )
        while head.poll() is None and not listens(port):
            sleep(0.1)
        for _ in range(2):
            stack.enter_context(process("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"))
        yield head


def listens(port):
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def test_a_scheduler_that_is_killed_and_started_again_loses_nothing(s3):
    out, port = f"{s3}/{uuid4().hex}/city.svox", free_port()
    settings = {**SETTINGS, "box_m": 3.2, "scheduler": f"tcp://127.0.0.1:{port}"}
    with cluster(port) as head:

        def lose(done, total, doing):
            if doing == "boxes" and done:
                head.kill()

        with pytest.raises(StereovoxError, match="--resume") as lost:
            map_fleet([recording(1)], out, progress=lose, **settings)
        assert "\n" not in str(lost.value)
    with cluster(port):
        made = map_fleet([recording(1)], out, resume=True, **settings)
    assert 0 < made.boxes[1] < made.boxes[0]  # what was done stays
    assert not made.recordings[0].seconds
    assert_same(made.map.storage.blocks(), alone(recording(1)).storage.blocks())
