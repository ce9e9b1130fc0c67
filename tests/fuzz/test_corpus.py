# SPDX-License-Identifier: Apache-2.0
"""Every reader against what broke one before, and against some thousand changed files; always the same ones."""

import json
import random
import subprocess
import sys
import zlib
from math import inf
from pathlib import Path

import pytest

from bounded import Unbounded, check
from mutate import mutated, with_right_sums
from stereovox.errors import StereovoxError
from targets import TARGETS, Target

FUZZ = Path(__file__).resolve().parents[2] / "fuzz"
CHANGES = 60
PATIENCE = 20.0
"""Seconds of processor time: here only what never ends is a mistake; fuzz/run.py looks closer."""


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_raises_stereovox_errors_alone(tmp_path, name):
    target, dice = TARGETS[name], random.Random(7)
    (tmp_path / "seeds").mkdir()
    (tmp_path / "place").mkdir()
    seeds = target.seeds(tmp_path / "seeds")
    assert seeds
    assert {check(target, seed, tmp_path / "place", inf) for seed in seeds} == {"read"}  # kernels may be compiled
    for path in sorted((FUZZ / "corpus" / name).glob("*")):
        check(target, path.read_bytes(), tmp_path / "place", PATIENCE)
    for _ in range(CHANGES):
        check(target, mutated(dice.choice(seeds), dice), tmp_path / "place", PATIENCE)


def test_the_corpus_is_small_and_of_known_targets():
    assert {path.name for path in (FUZZ / "corpus").iterdir()} <= set(TARGETS)
    assert sum(path.stat().st_size for path in (FUZZ / "corpus").rglob("*") if path.is_file()) < 200_000


def target(read):
    return Target(lambda _: [], lambda data, folder: read())


def raising(error):
    raise error


def test_what_a_check_finds(tmp_path, monkeypatch):
    assert check(target(lambda: None), b"", tmp_path) == "read"
    assert check(target(lambda: raising(StereovoxError("a.toml: x"))), b"", tmp_path) == "refused"
    with pytest.raises(KeyError):
        check(target(lambda: raising(KeyError("a"))), b"", tmp_path)
    with pytest.raises(AssertionError, match="no single line"):
        check(target(lambda: raising(StereovoxError(""))), b"", tmp_path)
    times = iter([0.0, 1.5])
    monkeypatch.setattr("bounded.time.process_time", lambda: next(times))
    with pytest.raises(Unbounded, match=r"took 1\.5 s"):
        check(target(lambda: None), b"", tmp_path)
    monkeypatch.undo()
    peaks = iter([0, 2 << 30])
    monkeypatch.setattr("bounded.peak_bytes", lambda: next(peaks))
    with pytest.raises(Unbounded, match="took 2048 MiB"):
        check(target(lambda: None), b"", tmp_path)


def test_changes_are_the_same_for_the_same_seed():
    first, again, other = ([mutated(b"a = 1.5\n" * 9, random.Random(n)) for _ in range(9)] for n in (1, 1, 2))
    assert first == again != other


def test_sums_of_a_png_are_put_right():
    start = b"\x89PNG\r\n\x1a\n\0\0\0\1IDATx"
    assert with_right_sums(start + b"\0\0\0\0 end") == start + zlib.crc32(b"IDATx").to_bytes(4) + b" end"


@pytest.mark.parametrize("how", [[], ["--coverage"]], ids=["plain", "guided"])
def test_the_long_run_counts(how):
    if how:
        pytest.importorskip("atheris")
    command = [sys.executable, str(FUZZ / "run.py"), "--target", "camera", "--runs", "200", "--json", *how]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)["targets"]["camera"]
    assert (told["runs"], told["crashes"], told["hangs"]) == (200, 0, 0)
    assert told["refused"] > told["read"]


def test_the_long_run_tells_of_a_target_that_is_gone():
    done = subprocess.run([sys.executable, str(FUZZ / "run.py"), "--target", "none"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "KeyError: 'none'" in done.stderr
