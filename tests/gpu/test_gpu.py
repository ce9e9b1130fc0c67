"""Maps on graphics cards, without one: in numba's simulator, as machine code, and what is reported to users."""

import json
import os
import subprocess
import sys
import warnings
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numba import cuda

import stereovox as sv
from stereovox.cli import main
from stereovox.errors import ConfigError
from stereovox.integrate import make_integrator
from stereovox.kernels import _gpu
from stereovox.kernels.device import on_usable_device
from stereovox.maps import make_map

HERE = Path(__file__).parent
LIBRARY = "numba-cuda is not installed; run: pip install 'stereovox[cuda]'"
CARD = "no NVIDIA graphics card, or no driver for it, was found"


def run_here(*command, **environment):
    """Run a file of this folder in a process of its own, and return it; some things must be set before numba loads."""
    return subprocess.run(
        [sys.executable, *command],
        cwd=HERE.parents[1],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )


def test_maps_in_the_simulator_are_those_of_the_processor():
    run = run_here(
        "-m", "pytest", "-W", "ignore", "-p", "no:cacheprovider", "tests/gpu/in_simulator.py",
        NUMBA_ENABLE_CUDASIM="1",
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-1000:]
    assert "passed" in run.stdout
    assert "skipped" not in run.stdout


@pytest.mark.skipif(
    find_spec("numba_cuda") is None or find_spec("cuda") is None, reason="numba-cuda is not installed: stereovox[cuda]"
)
def test_all_kernels_become_machine_code():
    run = run_here(HERE / "made_ptx.py", "8.7")
    assert run.returncode == 0, run.stderr[-3000:]
    kernels = json.loads(run.stdout)["kernels"]
    assert set(kernels) == set(all_kernels())
    for name, codes in kernels.items():
        assert not any(code["stack"] or code["spilled"] for code in codes), name
        assert name.endswith("rescale_steps") or not any(code["double"] for code in codes), name


def all_kernels():
    """Return the names of all kernels for cards, from the text of their files."""
    for path in sorted((HERE.parents[1] / "src/stereovox").rglob("_gpu.py")):
        module = ".".join(("stereovox", *path.relative_to(HERE.parents[1] / "src/stereovox").with_suffix("").parts))
        lines = path.read_text().splitlines()
        for before, line in pairwise(lines):
            if before == "@gpu_kernel":
                yield f"{module}.{line.removeprefix('def ').partition('(')[0]}"


@pytest.fixture(params=[LIBRARY, CARD], ids=["library", "card"])
def missing(request, monkeypatch):
    """Why there is no card: numba-cuda or the card itself is not there."""
    monkeypatch.setattr(_gpu, "find_spec", lambda name: None if request.param == LIBRARY else object())
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    return request.param


def test_without_a_card_the_processor_maps_and_says_so_once(missing):
    with pytest.warns(RuntimeWarning, match="graphics card|stereovox\\[cuda\\]") as told:
        mapper = sv.Mapper(device="cuda", voxel_size=0.2)
    assert [str(one.message) for one in told] == [
        f'device "cuda": {missing}; this map is made on the processor (device "cpu")'
    ]
    assert told[0].filename == __file__
    assert mapper.config.device == mapper.map.config.device == "cpu"
    camera = sv.PinholeCamera(64, 48, 40.0, 40.0, 32.0, 24.0)
    assert mapper.add(sv.Frame(np.ones((48, 64), np.float32), camera, np.eye(4))).cells


def test_a_card_that_can_be_used_is_used(monkeypatch):
    monkeypatch.setattr(_gpu, "find_spec", lambda name: object())
    monkeypatch.setattr(cuda, "is_available", lambda: True)
    assert on_usable_device(sv.load_config(device="cuda")).device == "cuda"


def test_a_library_that_does_not_load_is_no_card(monkeypatch):
    monkeypatch.setitem(sys.modules, "stereovox.kernels._gpu", None)
    said = []
    assert on_usable_device(sv.load_config(device="cuda"), said.append).device == "cpu"
    assert said[0].startswith('device "cuda": numba-cuda cannot be loaded (')


def test_nobody_is_told_about_cards_who_did_not_ask(missing):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sv.Mapper(voxel_size=0.2)


def test_the_command_says_so_in_one_line(missing, tmp_path, capsys):
    arguments = ["map", "sim:room", "--frames", ":2", "--voxel-size", "0.2", "--device", "cuda"]
    assert main([*arguments, "--out", str(tmp_path / "m.svox")]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "cuda" in line]
    assert lines == [f'device "cuda": {missing}; this map is made on the processor (device "cpu")']
    assert sv.load_map(tmp_path / "m.svox").config.device == "cpu"


def test_what_needs_a_card_and_has_no_mapper_raises(missing):
    for make in (make_integrator, make_map):
        with pytest.raises(ConfigError, match='device "cuda": '):
            make(sv.load_config(device="cuda"))


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"integrator": "ray"}, "integrator ray"),
        ({"threads": 2}, "threads 2"),
        ({"window.size": [9, 9, 9]}, "window.size"),
        ({"max_memory": "1 GB"}, "max_memory"),
        ({"map.keep_times": True}, "map.keep_times True"),
        ({"sphere.step_deg": 1.0}, "sphere.step_deg 1.0"),
        ({"profile": "ist2019"}, "dimensions 2"),
    ],
    ids=str,
)
def test_what_a_card_cannot_do_is_named(settings, named):
    with pytest.raises(ConfigError, match=named) as error:
        sv.load_config(**settings, device="cuda")
    assert 'use device "cpu"' in str(error.value)
    assert len(str(error.value)) < 200


def test_a_floor_is_not_for_the_card():
    with pytest.raises(ConfigError, match="maps of floors"):
        sv.GridMapper(device="cuda")


def test_nothing_of_cards_is_loaded_by_who_does_not_ask():
    text = "import stereovox, sys; stereovox.Mapper(); print([name for name in sys.modules if '_gpu' in name])"
    assert run_here("-c", text).stdout.strip() == "[]"
