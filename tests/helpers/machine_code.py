# SPDX-License-Identifier: Apache-2.0
"""Machine code of kernels for processors other than this one, AArch64 among them: compiled and read, never run.

`listings` runs a program in a process of its own and returns what the kernels it compiled become on other processors;
`listings_alone` compiles just those of interest, and not for this processor: most of the time saved.
What numba hands to LLVM hardly depends on the processor; so it is kept as it is there, and numba's own optimisation
is repeated with another target. `loops` finds the innermost loops of a listing, `arithmetic` counts what one divides
and multiplies, many numbers at once or one by one.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba.core import cgutils, codegen, config
from numba.core.compiler_lock import global_compiler_lock


class Processor(NamedTuple):
    """What LLVM compiles for: the name of a processor, and a triple, such as aarch64-linux-gnu."""

    cpu: str
    triple: str = "x86_64-unknown-linux-gnu"


HASWELL, ZEN_3 = Processor("haswell"), Processor("znver3")
SKYLAKE_512, SAPPHIRE_RAPIDS = Processor("skylake-avx512"), Processor("sapphirerapids")
NEOVERSE_N1 = Processor("neoverse-n1", "aarch64-linux-gnu")
CORTEX_A72 = Processor("cortex-a72", "aarch64-linux-gnu")
"""Haswell and Zen 3 have AVX2, the next two AVX-512, the last two (servers; Raspberry Pi 4) NEON."""

CALLS = """
import json, pickle, sys
import machine_code
job = json.loads(sys.argv[1])
exec(job["program"])
lines = ["import importlib, pickle"]
for name in job["kernels"]:
    assert machine_code.find(name).signatures, f"{name} was not called from Python"
    for signature in machine_code.find(name).signatures:
        types = f"pickle.loads({pickle.dumps(signature)!r})"
        lines.append("getattr(importlib.import_module({!r}), {!r}).compile({})".format(*name.split(":"), types))
print(json.dumps("\\n".join(lines)))
"""
CHILD = """
import json, os, sys
import machine_code
job = json.loads(sys.argv[1])
machine_code.record(job["runs"])
from stereovox.kernels import _jit
_jit.cache_folder = lambda: None  # what comes from the disk cache is optimised already
exec(job["program"])
processors = [machine_code.Processor(*p) for p in job["processors"]]
print(json.dumps([
    {name: machine_code.assembly_for(machine_code.find(name), *p) for name in job["kernels"]} for p in processors
]))
"""


def listings(
    program: str, kernels: list[str], processors: Iterable[Processor], runs: bool = True
) -> list[dict[str, str]]:
    """Run Python code in another process; return the assembly of each kernel in the order of the processors.

    kernels: `module:name` each; `program` must have called or compiled them, so that their arguments' types are known.
    runs: whether it calls kernels; where it does not, nothing is made for this processor.
    """
    return _answer(CHILD, {"program": program, "kernels": kernels, "processors": list(processors), "runs": runs})


def listings_alone(program: str, kernels: list[str], processors: Iterable[Processor]) -> list[dict[str, str]]:
    """Do as `listings`, but compile no more than the kernels, for such arguments as the program called them with.

    It must call them itself: of what other kernels call nothing is known where these come from the disk cache.
    """
    return listings(_answer(CALLS, {"program": program, "kernels": kernels}), kernels, processors, runs=False)


def _answer(code: str, job: dict[str, Any]) -> Any:
    here = str(Path(__file__).parent)
    path = os.pathsep.join([here, *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-B", "-c", code, json.dumps(job)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


class Arithmetic(NamedTuple):
    """How often float32 are divided and multiplied: in vectors of at least `lanes` numbers, and one by one."""

    wide_divisions: int
    wide_products: int
    single_divisions: int
    single_products: int
    lanes: int
    """Numbers in the widest vector that is divided or multiplied; 1 without any."""


DIVISION = re.compile(r"^\s+(?:v?div|f?div)(?P<kind>[ps]s)?\s(?P<operands>.*)$", re.MULTILINE)
PRODUCT = re.compile(
    r"^\s+(?:v?mul|vfn?m(?:add|sub)\d+|fmul|fn?m(?:add|sub)|fml[as])(?P<kind>[ps]s)?\s(?P<operands>.*)$", re.MULTILINE
)
LANES = {"xmm": 4, "ymm": 8, "zmm": 16}


def arithmetic(text: str) -> Arithmetic:
    """Count divisions and multiplications (with or without a sum) of float32 in a listing, x86-64 or AArch64."""
    divisions = [_lanes(match) for match in DIVISION.finditer(text)]
    products = [_lanes(match) for match in PRODUCT.finditer(text)]
    return Arithmetic(
        sum(lanes > 1 for lanes in divisions), sum(lanes > 1 for lanes in products),
        divisions.count(1), products.count(1), max([1, *divisions, *products]),
    )  # fmt: skip


def _lanes(match: re.Match[str]) -> int:
    """Return how many float32 an instruction computes; 0 for whole numbers and doubles."""
    kind, operands = match["kind"], match["operands"]
    if kind == "ps":
        return max(lanes for name, lanes in LANES.items() if name in operands)
    if kind == "ss":
        return 1
    vector = re.match(r"v\d+\.(\d)s", operands)
    return int(vector[1]) if vector else int(bool(re.match(r"s\d+", operands)))


LABEL = re.compile(r"^(\.L\w+):", re.MULTILINE)
JUMP = re.compile(r"^\s+(?:j\w+|b(?:\.\w+)?|cbn?z|tbn?z)\s.*?(\.L\w+)\s*$", re.MULTILINE)


def loops(text: str) -> list[str]:
    """Return the innermost loops of a listing, each from its label to the last jump back there."""
    starts = {match[1]: match.start() for match in LABEL.finditer(text)}
    spans: dict[int, int] = {}
    for jump in JUMP.finditer(text):
        start = starts.get(jump[1], jump.end())
        if start < jump.start():
            spans[start] = max(spans.get(start, 0), jump.end())
    inner = [(a, b) for a, b in spans.items() if not any(a < other < b for other in spans)]
    return [text[a:b] for a, b in sorted(inner)]


def record(runs: bool = True) -> None:
    """From now on keep what numba hands to LLVM, for `assembly_for`; call it before any kernel is compiled.

    runs: whether kernels will be called; where not, LLVM is spared the making of them for this processor.
    """
    library: Any = codegen.JITCodeLibrary
    plain = library.add_llvm_module

    def keep(self: Any, text: str) -> None:
        vars(self).setdefault("recorded", []).append(text)

    def add_llvm_module(self: Any, ll_module: llvm.ModuleRef) -> None:
        keep(self, str(ll_module))
        plain(self, ll_module)

    library.add_llvm_module = add_llvm_module
    if not runs:
        library.add_ir_module = lambda self, module: keep(self, cgutils.normalize_ir_text(str(module)))
        library.finalize = lambda self: setattr(self, "_finalized", True)
        library.get_pointer_to_function = lambda self, name: 0
        codegen.JITCPUCodegen.set_env = lambda self, name, environment: None


def find(name: str) -> Any:
    """Return what `module:name` names."""
    module, _, kernel = name.partition(":")
    return getattr(sys.modules[module], kernel)


def assembly_for(kernel: Any, cpu: str, triple: str = Processor("").triple) -> str:
    """Return what all compiled signatures of a kernel become on another processor; see `record`.

    kernel: a numba dispatcher that has been called.
    """
    made = [overload.library for overload in kernel.overloads.values()]
    assert made, f"{kernel.py_func.__name__} was not compiled"
    other = _other_processor(cpu, triple)
    with global_compiler_lock:
        return "\n".join(other.listing(library) for library in made)


class _OtherProcessor(codegen.CPUCodegen):
    """Numba's code generator for a processor that this process need not run on."""

    _library_class = codegen.AOTCodeLibrary

    def __init__(self, cpu: str, triple: str):
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        self._cpu, self._triple = cpu, triple
        self._made: dict[Any, Any] = {}
        super().__init__(cpu)

    def _init(self, llvm_module: llvm.ModuleRef) -> None:
        target = llvm.Target.from_triple(self._triple)
        self._tm: Any = target.create_target_machine(
            cpu=self._cpu, features="", opt=vars(config)["OPT"], reloc="static", codemodel="jitdefault", jit=True
        )
        self._data_layout: Any = str(self._tm.target_data)
        self._loopvect, self._opt_level = False, 0  # of the first, cheap pass, as in numba's own

    def _create_empty_module(self, name: str) -> Any:
        module = super()._create_empty_module(name)
        module.triple = self._triple
        return module

    def _add_module(self, module: llvm.ModuleRef) -> None:
        """Nothing is run."""

    def listing(self, library: Any) -> str:
        """Return the assembly of a library that numba made for this processor."""
        return self._tm.emit_assembly(self._again(library)._final_module)

    def _again(self, library: Any) -> Any:
        """Return the library optimised for the other processor, after those it was linked with."""
        if library not in self._made:
            again = self._made[library] = self.create_library(library.name)
            for text in library.recorded:
                module = llvm.parse_assembly(re.sub(r"(?m)^target (datalayout|triple) = .*$", "", text))
                module.triple, module.data_layout = self._triple, self._data_layout
                again.add_llvm_module(module)
            for linked in library._linking_libraries:
                again.add_linking_library(self._again(linked))
            again.finalize()
        return self._made[library]


@lru_cache
def _other_processor(cpu: str, triple: str) -> _OtherProcessor:
    """Return one for all kernels, which share much of what they call."""
    return _OtherProcessor(cpu, triple)
