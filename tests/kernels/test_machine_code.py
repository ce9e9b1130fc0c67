# SPDX-License-Identifier: Apache-2.0
"""What is read out of machine code for other processors, `reference/machine_code.py`, is what is in it."""

import pytest
from machine_code import CORTEX_A72, HASWELL, SAPPHIRE_RAPIDS, ZEN_3, Arithmetic, arithmetic, listings, loops

TWO_KERNELS = """
import numba
import machine_code
from stereovox.kernels import _jit

@_jit.kernel
def shares(parts, wholes, out):
    for i in range(out.size):
        out[i] = parts[i] / wholes[i]

@_jit.kernel
def totals(parts, out):
    for i in range(1, out.size):
        out[i] = out[i - 1] / parts[i]

rows = numba.float32[::1]
shares.compile((rows, rows, rows))
totals.compile((rows, rows))
if numba.core.config.CPU_NAME == "haswell":
    for kernel in (shares, totals):
        [theirs] = kernel.inspect_asm().values()
        assert machine_code.arithmetic(theirs) == machine_code.arithmetic(machine_code.assembly_for(kernel, "haswell"))
"""


def test_listings_of_other_processors_have_their_vectors(monkeypatch):
    """And what numba itself makes for a named processor is the same."""
    monkeypatch.setenv("NUMBA_CPU_NAME", "haswell")
    monkeypatch.setenv("NUMBA_CPU_FEATURES", "")
    processors = {HASWELL: 8, ZEN_3: 8, SAPPHIRE_RAPIDS: 16, CORTEX_A72: 4}
    made = listings(TWO_KERNELS, ["__main__:shares", "__main__:totals"], processors)
    for kernels, lanes in zip(made, processors.values(), strict=True):
        assert max(arithmetic(loop).lanes for loop in loops(kernels["__main__:shares"])) == lanes
        chain = [arithmetic(loop) for loop in loops(kernels["__main__:totals"])]
        assert {loop.lanes for loop in chain} == {1}
        assert sum(loop.single_divisions for loop in chain) > 0
        assert sum(loop.wide_divisions for loop in chain) == 0


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("vdivps\t%ymm1, %ymm2, %ymm3", (1, 0, 0, 0, 8)),
        ("vdivps\t(%rax,%rcx,4), %zmm2, %zmm3", (1, 0, 0, 0, 16)),
        ("divps\t%xmm1, %xmm2", (1, 0, 0, 0, 4)),
        ("vdivss\t%xmm1, %xmm2, %xmm3", (0, 0, 1, 0, 1)),
        ("fdiv\tv0.4s, v1.4s, v2.4s", (1, 0, 0, 0, 4)),
        ("fdiv\ts0, s1, s2", (0, 0, 1, 0, 1)),
        ("vmulps\t%ymm1, %ymm2, %ymm3", (0, 1, 0, 0, 8)),
        ("vfnmadd231ps\t%zmm1, %zmm2, %zmm3 {%k1}", (0, 1, 0, 0, 16)),
        ("vfmsub213ss\t%xmm1, %xmm2, %xmm3", (0, 0, 0, 1, 1)),
        ("fmla\tv0.4s, v1.4s, v2.s[0]", (0, 1, 0, 0, 4)),
        ("fnmadd\ts0, s1, s2, s3", (0, 0, 0, 1, 1)),
        *[(line, (0, 0, 0, 0, 1)) for line in ("vdivpd\t%ymm1, %ymm2, %ymm3", "fdiv\td0, d1, d2", "mul\tw0, w1, w2")],
    ],
)
def test_one_instruction(line, found):
    assert arithmetic(f"\t{line}\n") == Arithmetic(*found)


def test_innermost_loops_are_found():
    nest = [".LBB0_1:", "\tone", ".LBB0_2:", "\ttwo", "\tjne\t.LBB0_2", "\tb.ne\t.LBB0_1"]
    text = "\n".join([*nest, ".LBB0_3:", "\ttbnz\tw0, #3, .LBB0_3", "\tjmp\t.LBB0_4", ".LBB0_4:"])
    assert [loop.split()[1] for loop in loops(text)] == ["two", "tbnz"]
