# SPDX-License-Identifier: Apache-2.0
"""What tests of several rooms need."""

import gc
import json
import os
import signal
import sys

import pytest
from examples import example_runner
from made_bucket import s3, where  # noqa: F401 - fixtures
from made_domains import domains  # noqa: F401 - a fixture
from xdist.scheduler import WorkStealingScheduling

from stereovox.cli import main


def pytest_configure():
    """Keep what is compiled of tests (half a minute for each worker) and of the package, in processes started too."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


def pytest_xdist_make_scheduler(config, log):
    """Give each worker neighbouring tests, so that what the tests of a file share is made once and not by each."""
    return WorkStealingScheduling(config, log)


def pytest_collection_modifyitems(items):
    """Begin with the tests that take longest, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def pytest_collection_finish():
    """Look for garbage less often, and not among the tests themselves: that is a sixteenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)


def pytest_sessionstart():
    """No test turns the power off, so none waits until files lie on the disk; a file must be open all the same."""
    os.fsync = lambda file: os.fstat(file if isinstance(file, int) else file.fileno()) and None


@pytest.fixture
def obeys_signals():
    """A process started in the background or by nohup ignores some, and so would its tests and its children."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def run_script():
    """Runs a script in a process of its own, and returns its exit status and what it printed."""
    with example_runner() as run:
        yield run


@pytest.fixture
def told_with_notes(capsys):
    """Runs a command with `--json` and returns the result and what it said besides."""

    def run(*words):
        status = main([*map(str, words), "--json"])
        out, err = capsys.readouterr()
        assert status == 0, err
        return json.loads(out.splitlines()[-1]), err

    return run
