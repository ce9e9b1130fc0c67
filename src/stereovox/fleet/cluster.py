# SPDX-License-Identifier: Apache-2.0
"""The Dask cluster that runs a fleet's tasks, on this machine or any other."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing import resource_tracker
from os import cpu_count
from pkgutil import resolve_name
from typing import Any
from uuid import uuid4

from stereovox import __version__
from stereovox.errors import MissingExtra, StereovoxError

LOST_WORKERS = 20
"""Workers that may be lost on the same task before giving up."""
RETRIES = 2
"""Retries of a failed task, on another worker if there is one."""
SILENT = 60
"""Above all logging levels: while closing, Dask logs tracebacks as critical. Failures are raised."""
PATIENCE_S = 10
"""Seconds a scheduler may take to answer."""


class Cluster:
    """Runs tasks on a Dask cluster."""

    def __init__(self, client: Any):
        self._client, self._name = client, uuid4().hex  # another run's tasks of the same name write elsewhere

    def results(
        self,
        function: Callable[..., Any],
        tasks: Mapping[str, tuple[Any, ...]],
        priority: Mapping[str, int] | None = None,
    ) -> Iterator[tuple[str, Any]]:
        """Yield name and result of tasks as they end, starting high priorities first. A failure cancels the others.

        Raises StereovoxError if a task fails, or cannot be done because its workers die or the scheduler is gone.
        """
        from distributed import KilledWorker, as_completed

        submitted = {
            self._client.submit(
                function, *given, key=f"{function.__name__}-{self._name}-{name}", retries=RETRIES,
                priority=(priority or {}).get(name, 0),
            ): name
            for name, given in tasks.items()
        }  # fmt: skip
        try:
            for future in as_completed(list(submitted)):
                yield submitted[future], _result(future)
        except KilledWorker as error:
            name = str(error.task).partition(f"{self._name}-")[2]
            raise StereovoxError(
                f"the workers that had '{name}' died {LOST_WORKERS} times (too little memory?); finished work "
                "is kept, continue with --resume"
            ) from None
        except OSError as error:
            raise StereovoxError(
                f"the cluster is lost ({error}); finished work is kept, continue with --resume"
            ) from None
        except Exception as error:
            if type(error).__name__ not in ("CancelledError", "FutureCancelledError", "CommClosedError"):
                raise
            raise StereovoxError("the scheduler is lost; finished work is kept, continue with --resume") from None
        finally:
            self._client.cancel(list(submitted), force=True)


def _result(future: Any) -> Any:
    """Return the result of a task that ended; raises StereovoxError for a system error of its worker."""
    if future.status == "error" and isinstance(error := future.exception(), OSError):
        where = f"{error.filename}: " if error.filename else ""
        raise StereovoxError(
            f"a worker failed ({where}{error.strerror or error}); finished work is kept, continue with --resume"
        )
    return future.result()


@contextmanager
def cluster(
    scheduler: str | None, workers: int | None, notify: Callable[[str], object] = lambda line: None
) -> Iterator[Cluster]:
    """Yield a task runner: the cluster of a scheduler, or processes of this machine that end with it.

    notify: called with each line that a user should see. Raises StereovoxError if no scheduler answers or a worker
    has another stereovox, and for less than one worker; MissingExtra if Dask is not installed.
    """
    if workers is not None and workers < 1:
        raise StereovoxError(f"{workers} workers: give 1 or more, or leave it out for one on each core")
    try:
        import dask.config
        from distributed import Client, LocalCluster
    except ImportError:
        raise MissingExtra("dask[distributed]", "fleet") from None
    with dask.config.set({"distributed.scheduler.allowed-failures": LOST_WORKERS}):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=PATIENCE_S)
            except (OSError, ValueError) as error:
                raise StereovoxError(f"{scheduler}: no Dask scheduler answers ({error}); check the address") from None
            with client:
                _check_workers(client, scheduler, notify)
                yield Cluster(client)
            return
        number = workers or cpu_count() or 1
        with _spared_ctrl_c():
            local: Any = LocalCluster(
                n_workers=number, threads_per_worker=1, processes=True, memory_limit=0, silence_logs=SILENT,
                dashboard_address="127.0.0.1:0",
            )  # fmt: skip
        with local as cluster, Client(cluster) as client:
            cluster.adapt(minimum=number, maximum=number, interval="1s")  # also if a nanny is lost with its worker
            yield Cluster(client)


def _check_workers(client: Any, scheduler: str, notify: Callable[[str], object]) -> None:
    """Raise StereovoxError if a worker has another stereovox: it would die on a task that it cannot read."""
    versions = client.run(resolve_name, "stereovox.__version__", on_error="return")
    for worker, theirs in versions.items():
        theirs = "no stereovox" if isinstance(theirs, (ImportError, AttributeError)) else theirs
        if isinstance(theirs, str) and theirs != __version__:  # else it has just left
            raise StereovoxError(f"{worker}: this worker has {theirs}, here is {__version__}; install the same on all")
    if not versions:
        notify(f"note: {scheduler} has no workers yet; waiting for some (dask worker {scheduler})")


@contextmanager
def _spared_ctrl_c() -> Iterator[None]:
    """Shield threads and processes started here, and by these, from Ctrl-C: their owner ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # else it lets Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
