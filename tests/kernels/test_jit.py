# SPDX-License-Identifier: Apache-2.0
"""The kernels' decorator and where it keeps machine code."""

import hashlib
import importlib
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from operator import attrgetter
from pathlib import Path

import llvmlite
import machine_code
import numba
import numpy as np
import pytest
from full_disks import full_disk
from llvmlite.binding import get_host_cpu_features as host_features
from packaging.requirements import Requirement

import stereovox as sv
from stereovox.files.safe_io import replacing
from stereovox.kernels import _jit

PACKAGE = Path(sv.__file__).parent
fresh_cache_folder = _jit.cache_folder.__wrapped__
ENVIRONMENT = ("STEREOVOX_CACHE", "XDG_CACHE_HOME", "HOME")
MAP_A_FRAME = """
import json, pickle, sys
import machine_code
machine_code.record()
import stereovox as sv
from numba.core.dispatcher import Dispatcher
from stereovox.depth import _images as depth
from stereovox.integrate import _hits, _projective, _windows
from stereovox.maps.cells import _pool as maps

mapper = sv.Mapper(voxel_size=0.1)
mapper.add(pickle.load(sys.stdin.buffer))
kernels = [value for room in (depth, _projective, _hits, _windows, maps) for value in vars(room).values()]
compiled = {kernel.py_func.__name__: kernel for kernel in kernels if getattr(kernel, "signatures", None)}
made = {
    "cells": [array.tolist() for array in mapper.map.cells()],
    "types": {name: str(kernel.signatures) for name, kernel in compiled.items()},
}
modules = [module for name, module in list(sys.modules.items()) if name.startswith("stereovox.")]
everything = [value for module in modules for value in vars(module).values()]
if not any(value.stats.cache_hits for value in everything if isinstance(value, Dispatcher)):  # all is compiled here
    made["assembly"] = {name: "".join(kernel.inspect_asm().values()) for name, kernel in compiled.items()}
    made["wide"] = {
        name: machine_code.assembly_for(kernel, "skylake-avx512") for name, kernel in compiled.items()
    }
print(json.dumps(made))
"""
HASWELL = {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}
"""Without the second, numba takes a name alone together with all that this processor can do."""
ARITHMETIC = re.compile(
    r"^\s+(v?(?:add|sub|mul|div|sqrt|min|max|round|rndscale|hadd|hsub|addsub|cmp\w*|cvt\w+2|fn?m\w+)pd|vcvtt?pd2\w+)"
    r"\s.*%[yz]mm",
    re.MULTILINE,
)
"""Instructions that compute with wide vectors of doubles, or convert them; others just move 64 bits of anything.

In an xmm register they are no loop: without AVX-512 a single whole number of 64 bits is made a double in this way.
"""
PROBE_CELLS = "from stereovox.kernels._jit import cell\n\n\n@cell\ndef g(x):\n    return x + 1\n"
PROBE = (
    "from stereovox.kernels._jit import kernel\nfrom stereovox._probe_cells import g\n\n\n"
    "@kernel\ndef f(x):\n    return 10 * g(x)\n"
)
ASK_THE_PROBE = """
import json
from stereovox._probe import f
from stereovox.kernels._jit import cache_folder

answer, count = f(1), lambda counts: sum(counts.values())
print(json.dumps({
    "folder": str(cache_folder()), "answer": answer,
    "hits": count(f.stats.cache_hits), "misses": count(f.stats.cache_misses),
}))
"""


def run(program, data=b"", **environment):
    kept = {name: value for name, value in os.environ.items() if name not in ENVIRONMENT}
    command = [sys.executable, "-B", "-c", program]
    done = subprocess.run(command, env={**kept, **environment}, input=data, capture_output=True, timeout=1800)
    assert done.returncode == 0, done.stderr.decode()
    return json.loads(done.stdout)


@pytest.fixture
def a_file(tmp_path):
    """Where a folder should be: nothing can be made below it, not even by root."""
    file = tmp_path / "a_file"
    file.touch()
    return str(file)


def test_a_second_process_compiles_nothing_again(tmp_path, probed_package):
    where = {"PYTHONPATH": str(probed_package.parent), "STEREOVOX_CACHE": str(tmp_path), "HOME": str(tmp_path)}
    first, second = (run(ASK_THE_PROBE, **where) for _ in range(2))
    assert first["answer"] == second["answer"] == 20
    assert (first["hits"], first["misses"]) == (0, 1)
    assert (second["hits"], second["misses"]) == (1, 0)
    assert Path(first["folder"]).is_relative_to(tmp_path)


def test_kernels_run_where_home_cannot_be_written(tmp_path, a_file, probed_package):
    where = {"PYTHONPATH": str(probed_package.parent), "HOME": a_file, "XDG_CACHE_HOME": a_file}
    answer = run(ASK_THE_PROBE, **where, TMPDIR=str(tmp_path))
    assert answer["answer"] == 20
    assert Path(answer["folder"]).is_relative_to(tmp_path)


def test_kernels_run_where_nothing_can_be_written(monkeypatch):
    monkeypatch.setattr(_jit, "_writable", lambda folder: False)
    assert fresh_cache_folder() is None
    monkeypatch.setattr(_jit, "cache_folder", fresh_cache_folder)
    double = _jit.kernel(lambda x: 2 * x)
    assert double(4) == 8
    assert double.stats.cache_path is None


def test_kernels_run_on_a_full_disk(monkeypatch, tmp_path):
    monkeypatch.setattr(_jit, "cache_folder", lambda: tmp_path)
    double, half = _jit.kernel(_double), _jit.kernel(_half)
    assert half(4.0) == 2
    saved = sorted(tmp_path.rglob("*"))
    assert saved
    with full_disk(100):
        assert double(4) == 8
    assert [path for path in sorted(tmp_path.rglob("*")) if path.suffix in (".nbc", ".nbi")] == [
        path for path in saved if path.suffix in (".nbc", ".nbi")
    ]
    assert double(4.0) == 8  # compiled, and saved, once there is room


def _double(x):
    return 2 * x


def _half(x):
    return x / 2


def test_the_cache_is_looked_for_in_this_order(monkeypatch, tmp_path, a_file):
    def found():
        return fresh_cache_folder().relative_to(tmp_path).parts[0]

    for name, folder in zip(ENVIRONMENT, ("own", "xdg", "home"), strict=True):
        monkeypatch.setenv(name, str(tmp_path / folder))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert found() == "own"
    monkeypatch.setenv("STEREOVOX_CACHE", a_file)
    assert found() == "xdg"
    monkeypatch.delenv("STEREOVOX_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert found() == "home"
    monkeypatch.setattr(Path, "home", _no_home)
    assert found() == "temporary"


def _no_home():
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("function", [lambda x: x, "no function"])
def test_numbas_own_setting_is_left_as_it_was(monkeypatch, function):
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", "theirs")
    try:
        _jit.kernel(function)
    except Exception:
        assert function == "no function"
    assert numba.core.config.CACHE_DIR == "theirs"


@pytest.fixture
def copied_package(tmp_path):
    copy = tmp_path / "package" / "stereovox"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


@pytest.fixture
def probed_package(copied_package):
    """A copy with a kernel that compiles in no time, and calls a cell of another file."""
    (copied_package / "_probe_cells.py").write_text(PROBE_CELLS)
    (copied_package / "_probe.py").write_text(PROBE)
    return copied_package


def test_only_kernel_files_change_the_hash(monkeypatch, copied_package):
    here = _jit._source_hash()
    monkeypatch.setattr(_jit, "__file__", str(copied_package / "kernels/_jit.py"))
    assert _jit._source_hash() == here
    for file, renews in (("mapper.py", False), ("integrate/_cells.py", True), ("maps/cells/_pool.py", True)):
        before = _jit._source_hash()
        with (copied_package / file).open("a") as opened:
            opened.write("# a change\n")
        assert (_jit._source_hash() != before) == renews, file


def test_a_change_in_a_called_file_reaches_the_cached_caller(tmp_path, probed_package):
    where = {"PYTHONPATH": str(probed_package.parent), "STEREOVOX_CACHE": str(tmp_path / "cache")}
    assert run(ASK_THE_PROBE, **where)["answer"] == 20
    (probed_package / "_probe_cells.py").write_text(PROBE_CELLS.replace("x + 1", "x + 2"))
    assert run(ASK_THE_PROBE, **where)["answer"] == 30


def test_kernels_see_nan_and_infinity():
    """Full fast-math promises the compiler that there are none, and it then drops these tests."""

    @_jit.kernel
    def kinds(values, out):
        for i in range(values.size):
            out[i] = 1 if values[i] != values[i] else (2 if values[i] == np.float32(np.inf) else 0)

    out = np.zeros(4, np.int32)
    kinds(np.array([np.nan, np.inf, -np.inf, 1], np.float32), out)
    assert out.tolist() == [1, 2, 0, 0]


def test_a_division_by_zero_in_a_kernel_is_no_error():
    divide = _jit.kernel(lambda a, b: a / b)
    assert divide(np.float32(1), np.float32(0)) == np.inf


def assembly(kernel):
    return "\n".join(kernel.inspect_asm().values())


PRIVATE = {
    "numba.core.caching": ("FunctionCache.save_overload",),
    "numba.core.config": ("CACHE_DIR",),
    "numba.core.compiler": ("CompilerBase.define_pipelines", "DefaultPassBuilder.define_nopython_pipeline"),
    "numba.core.compiler_machinery": ("register_pass", "PassManager.finalize"),
    "numba.core.lowering": ("Lower.setup_function",),
    "numba.core.typed_passes": ("NativeLowering.lowering_class",),
    "numba.core.compiler:Flags": ("noalias", "nrt", "forceinline", "no_cpython_wrapper", "no_cfunc_wrapper"),
}
"""What `kernels/_jit.py` takes from inside of numba, which may change in any version of it."""


def missing_names(private):
    """Those of `private` that this numba does not have, in full."""
    for place, names in private.items():
        module, _, holder = place.partition(":")
        found = importlib.import_module(module)
        for name in names:
            try:
                attrgetter(f"{holder}.{name}" if holder else name)(found)
            except AttributeError:
                yield f"{place}.{name}".replace(":", ".")


def test_this_numba_has_all_that_is_private_in_it_and_taken():
    missing = [*missing_names(PRIVATE)]
    assert not missing, (
        f"numba {numba.__version__} has no {', '.join(missing)} any more; change kernels/_jit.py, "
        "or pin numba in pyproject.toml to the last version that has it"
    )


def test_a_name_that_is_gone_is_named():
    gone = {"numba.core.lowering": ("Lower.lower", "Lower.prepare"), "numba.core.compiler:Flags": ("no_such_flag",)}
    assert [*missing_names(gone)] == ["numba.core.lowering.Lower.prepare", "numba.core.compiler.Flags.no_such_flag"]


def test_promises_and_wide_vectors_reach_the_compiler(monkeypatch):
    """A numba that goes another way through its pipeline could leave them out without a word; code would be slower."""
    monkeypatch.setattr(_jit, "cache_folder", lambda: None)

    @_jit.kernel
    def double(numbers, out):
        for i in range(numbers.size):
            out[i] = numbers[i] + numbers[i]

    double(np.ones(4, np.float32), np.zeros(4, np.float32))
    [code] = double.inspect_llvm().values()
    lost = f"with numba {numba.__version__} kernels/_jit.py has lost"
    assert re.search(r"\bnoalias\b[^,]*%arg\.out\.4", code), (
        f"{lost} the promise that arrays do not overlap (flags.noalias)"
    )
    assert '"prefer-vector-width"="512"' in code, f"{lost} the width of vectors (Lower.setup_function, NativeLowering)"


def test_the_numba_installed_is_one_that_was_tried():
    project = tomllib.loads((PACKAGE.parents[1] / "pyproject.toml").read_text())["project"]
    [pin] = [Requirement(line) for line in project["dependencies"] if line.startswith("numba")]
    assert numba.__version__ in pin.specifier
    assert "999" not in pin.specifier, "any numba to come is allowed, though kernels/_jit.py rests on its inside"


def needs(*features):
    missing = [name for name in features if not host_features().get(name)]
    return pytest.mark.skipif(bool(missing), reason=f"this processor has no {', '.join(missing)}")


@needs("avx512f")
@pytest.mark.skipif("NUMBA_CPU_NAME" in os.environ, reason="compiles for another processor")
def test_rows_of_numbers_use_the_widest_vectors(monkeypatch):
    monkeypatch.setattr(_jit, "cache_folder", lambda: None)  # of machine code from the cache the assembly is not known

    @_jit.kernel
    def double(numbers, out):
        for i in range(numbers.size):
            out[i] = numbers[i] + numbers[i]

    numbers, out = np.arange(100, dtype=np.float32), np.zeros(100, np.float32)
    double(numbers, out)
    assert (out == 2 * numbers).all()
    assert "zmm" in assembly(double)


def mapped_elsewhere(frame, fresh, **target):
    """Return what `MAP_A_FRAME` reports for a processor.

    Its machine code is kept where that of all kernels is, in a folder that the kernels' files name; the listings, which
    take a minute, lie next to it. They hold for the types of arguments that come with them; else they are made anew.
    """
    folder, path = _jit.cache_folder(), os.pathsep.join(filter(None, sys.path))
    rest = [Path(machine_code.__file__).read_text(), MAP_A_FRAME, llvmlite.__version__, str(target)]
    kept = folder / f"listings-{hashlib.sha256(''.join(rest).encode()).hexdigest()[:16]}.json"
    for place in (folder.parents[1], fresh):
        made = run(MAP_A_FRAME, pickle.dumps(frame), STEREOVOX_CACHE=str(place), PYTHONPATH=path, **target)
        if "wide" in made:
            with replacing(kept) as file:
                file.write(json.dumps(made).encode())
            return made
        listed = json.loads(kept.read_text()) if kept.exists() else {}
        if made["types"].items() <= listed.get("types", {}).items():  # of what kernels call nothing is known here
            return {**listed, **made}
    raise AssertionError("in an empty folder nothing was compiled")


@pytest.mark.slow
def test_kernels_for_any_processor_compute_in_float32_and_make_the_same_map(tmp_path):
    """An int32 times a float32 is a float64 in numba: easily written, never seen, and twice as slow."""
    frame, mapper = next(iter(sv.open_source("sim:room", "0:1"))), sv.Mapper(voxel_size=0.1)
    mapper.add(frame)
    target = HASWELL if all(host_features().get(name) for name in ("avx2", "fma", "bmi2")) else {}
    made = mapped_elsewhere(frame, tmp_path, **target)
    assert {"scatter", "weigh", "survey", "evaluate", "classify"} <= made["assembly"].keys() == made["wide"].keys()
    for listed in (made["assembly"], made["wide"]):
        for name, text in listed.items():
            assert "\tret" in text, name
            doubles = set(ARITHMETIC.findall(text))
            assert not doubles, (name, doubles)
    assert not any("zmm" in text for text in made["assembly"].values()) or not target
    assert any("zmm" in text for text in made["wide"].values())
    (indices, log_odds), (their_indices, theirs) = mapper.map.cells(), made["cells"]
    assert (indices == their_indices).all()
    assert np.abs(log_odds - theirs).max() <= 0.05
    assert (log_odds != theirs).mean() <= 1e-3  # where a sum is rounded is the compiler's choice: docs/integrators.md


@pytest.mark.parametrize(
    "line", ["vfmadd213pd", "vcvtps2pd", "vcvtpd2ps", "vcvttpd2dqy", "vcmpltpd", "mulpd", "vrndscalepd"]
)
def test_arithmetic_on_doubles_is_known(line):
    assert ARITHMETIC.findall(f"\t{line}\t%ymm1, %ymm2, %ymm3\n") == [line]


@pytest.mark.parametrize(
    "line",
    ["vpermpd", "vunpcklpd", "vmovupd", "vbroadcastpd", "vshufpd", "vblendvpd", "vandpd", "vgatherqpd", "vmulps"],
)
def test_instructions_that_move_doubles_are_no_arithmetic(line):
    assert not ARITHMETIC.findall(f"\t{line}\t%ymm1, %ymm2, %ymm3\n")


def test_a_kernel_that_falls_into_doubles_is_found(monkeypatch):
    monkeypatch.setattr(_jit, "cache_folder", lambda: None)

    @_jit.kernel
    def half(numbers, out):
        for i in range(numbers.size):
            out[i] = 0.1 * numbers[i]

    half(np.ones(100, np.float32), np.zeros(100, np.float32))
    assert ARITHMETIC.search(assembly(half)) or not host_features().get("avx")


def test_kernels_make_no_arrays():
    @_jit.kernel
    def make(n):
        return np.empty(n).size

    with pytest.raises(numba.TypingError):
        make(3)
