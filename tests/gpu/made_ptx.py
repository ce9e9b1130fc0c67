"""Compile the kernels for graphics cards to machine code, with the types they are launched with; no card is needed.

    python tests/gpu/made_ptx.py 7.5 8.7 9.0

Whatever the maps and the integrator launch is compiled and not run. Prints one line of JSON for each card: the kernels
with their registers, stack bytes and spilled bytes, and those with double-precision instructions.
"""

import json
import re
import sys
from types import SimpleNamespace

import numpy as np
from cuda.bindings import nvjitlink
from numba import cuda, typeof, types
from numba.cuda import dispatcher


class OnCard(np.ndarray):
    """An array that says it is on a card."""

    def copy_to_host(self):
        return np.array(self)

    def copy_to_device(self, array):
        self[...] = array


def to_gpu(array):
    if isinstance(array, tuple):
        parts = [to_gpu(part) if isinstance(part, np.ndarray) else part for part in array]
        return type(array)(*parts) if hasattr(array, "_fields") else tuple(parts)
    return np.array(array).view(OnCard)


def gpu_array(shape, dtype, value=None):
    array = np.full(shape, 0 if value is None else value, dtype).view(OnCard)
    if value is not None:
        launch(stereovox.kernels._gpu.fill, array.reshape(array.size), np.dtype(dtype).type(value))
    return array


def typed(value):
    if isinstance(value, np.ndarray):
        return types.Array(typeof(np.zeros(1, value.dtype)).dtype, value.ndim, "C")
    if isinstance(value, tuple):
        parts = [typed(part) for part in value]
        return types.NamedTuple(parts, type(value)) if hasattr(value, "_fields") else types.BaseTuple.from_types(parts)
    return typeof(value)


def launch(kernel, *arguments):
    ptx, _ = cuda.compile_ptx(kernel.py_func, tuple(map(typed, arguments)), cc=card)
    name = kernel.py_func.__module__ + "." + kernel.py_func.__name__
    found.setdefault(name, []).append({"double": ".f64" in ptx, **machine_code(ptx)})


def machine_code(ptx):
    """Return what the assembler says of a kernel; it raises where it does not take it."""
    linker = nvjitlink.create(2, [f"-arch=sm_{card[0]}{card[1]}", "-verbose"])
    nvjitlink.add_data(linker, nvjitlink.InputType.PTX, ptx.encode(), len(ptx.encode()), "kernel")
    nvjitlink.complete(linker)
    log = bytearray(nvjitlink.get_info_log_size(linker))
    nvjitlink.get_info_log(linker, log)
    size = nvjitlink.get_linked_cubin_size(linker)
    nvjitlink.destroy(linker)
    said = log.decode()
    numbers = {"registers": r"Used (\d+) registers", "stack": r"(\d+) bytes stack", "spilled": r"(\d+) bytes spill"}
    return {"bytes": size, **{name: int(re.findall(pattern, said)[-1]) for name, pattern in numbers.items()}}


def run():
    for cell in ("int16", "int8"):
        config = stereovox.load_config(voxel_size=0.1, max_range=2.5, device="cuda", **{"map.cell": cell})
        storage = GpuStorage(config)
        camera = stereovox.PinholeCamera(32, 24, 30.0, 30.0, 16.0, 12.0)
        image = stereovox.DepthImage(np.ones((24, 32), np.float32), np.zeros((24, 32), np.uint8), camera, np.eye(4))
        integrator = GpuProjective(config)
        evidence = integrator.evidence(image)
        eye = integrator._eyes[camera]
        eye._windows._marks = True
        eye._windows.build(eye._depth_m.reshape(eye._depth_m.size))
        storage.agreement(evidence, 500)
        storage._pool._reserve(10_000)
        storage.add(type(evidence)(evidence.arrays, 1, 1))


import stereovox  # noqa: E402
import stereovox.kernels._gpu  # noqa: E402

stereovox.kernels._gpu.launch, stereovox.kernels._gpu.to_gpu, stereovox.kernels._gpu.gpu_array = (
    launch,
    to_gpu,
    gpu_array,
)
stereovox.kernels._gpu.unusable = lambda: None
from stereovox.integrate.gpu import GpuProjective  # noqa: E402
from stereovox.maps.storage.gpu import GpuStorage  # noqa: E402

for text in sys.argv[1:]:
    card, found = tuple(map(int, text.split("."))), {}
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=card)  # noqa: B023
    run()
    print(json.dumps({"card": text, "kernels": found}))
