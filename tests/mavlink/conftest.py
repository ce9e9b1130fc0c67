"""An autopilot in a process of its own."""

import json
import queue
import subprocess
import sys
import threading
from pathlib import Path
from time import monotonic

import pytest

PATIENCE_S = 60.0


class Autopilot:
    """A running `autopilot.py` and what it has told so far."""

    def __init__(self, ahead_s=1234.5, poses="none", port=0):
        words = [
            sys.executable,
            str(Path(__file__).parents[1] / "helpers/autopilot.py"),
            str(port),
            str(ahead_s),
            poses,
        ]
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self._lines = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self.ahead_s, self.told = ahead_s, []
        self.port = self._lines.get(timeout=PATIENCE_S)["port"]
        self.url = f"udpout:127.0.0.1:{self.port}"

    def wait_for(self, kind, wanted=lambda told: True, number=1):
        """Return the next so many messages of a kind that are wanted."""
        found, end = [], monotonic() + PATIENCE_S
        while len(found) < number:
            told = self._lines.get(timeout=max(end - monotonic(), 0.001))
            self.told.append(told)
            if told["is"] == kind and wanted(told):
                found.append(told)
        return found

    def drain(self):
        """Return all that it has told and nobody waited for."""
        found = []
        while not self._lines.empty():
            found.append(self._lines.get())
        return found

    def end(self):
        self._process.kill()
        self._process.wait()

    def _read(self):
        for line in self._process.stdout:
            self._lines.put(json.loads(line))


@pytest.fixture
def start_autopilot():
    started = []

    def start(**kwargs):
        started.append(Autopilot(**kwargs))
        return started[-1]

    yield start
    for autopilot in started:
        autopilot.end()
