# SPDX-License-Identifier: Apache-2.0
"""What only shows in long runs: kernels that compile in the middle of one, and mappers that stay when dropped."""

import gc
import json
import weakref
from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.products.projection import LiveProjection

LATER_KERNELS = """
import json
import sys
from dataclasses import replace

import numpy as np
from numba.core.dispatcher import Dispatcher

import stereovox as sv
from stereovox.frame import Scan
from stereovox.mapper import GridMapper


def compiled():
    rooms = [vars(module) for name, module in list(sys.modules.items()) if name.startswith("stereovox")]
    kernels = {thing for room in rooms for thing in room.values() if isinstance(thing, Dispatcher)}
    return {f"{kernel.py_func.__name__}{signature}" for kernel in kernels for signature in kernel.signatures}


def of_other_kinds(frame):
    depth, T = frame.depth, frame.T_world_sensor
    fixed, fixed_T = depth.copy(), T.copy()
    fixed.flags.writeable = fixed_T.flags.writeable = False
    buffer = np.frombuffer(bytearray(depth.nbytes + 1), np.uint8)[1:].view(depth.dtype).reshape(depth.shape)
    buffer[:] = depth
    for other in (fixed, np.asfortranarray(depth), np.repeat(depth, 2, axis=1)[:, ::2], buffer, depth.astype(float)):
        yield replace(frame, depth=other)
    yield replace(frame, depth=np.matrix(depth), depth_scale=np.float16(1), farthest=np.float16(np.inf))
    yield replace(frame, reason=np.matrix(np.zeros(depth.shape, np.uint8)))
    for other in (fixed_T, np.asfortranarray(T), T.tolist(), T.astype(np.float32)):
        yield replace(frame, T_world_sensor=other)


def scans(frames):
    for n, frame in enumerate(frames):
        ranges = np.linspace(1, 4 + 0.001 * n, 90, dtype=np.float32)
        fixed = ranges.copy()
        fixed.flags.writeable = False
        pose = np.eye(4)
        pose[0, 3] = 0.5 * n
        given = {} if n < 2 else {"clear": fixed, "clear_from": np.zeros(90)}
        kinds = ranges, fixed, ranges.astype(float), np.repeat(ranges, 2)[::2], np.matrix(ranges).A1
        yield Scan(kinds[n % 5], -1.5, 0.03, 0.1, 4.0, pose, stamp_ns=frame.stamp_ns, **given)


source, settings = GIVEN
grid, settings = settings.pop("grid", False), {"voxel_size": 0.1, "trust.ordered": False, **settings}
frames = [replace(f, depth=(f.depth * f.depth_scale).astype(np.float32), depth_scale=1.0, reason=None)
          if hasattr(f, "depth") else f for f in sv.open_source(source, ":60:5")]
mapper = (GridMapper if grid else sv.Mapper)(**settings)
others = [*of_other_kinds(frames[3])] if not grid and hasattr(frames[0], "depth") else []
others += [replace(f, depth=0.5 * f.depth) for f in frames if others]  # they disagree with the map
cameras, allowed, later, doubted = set(), set(), set(), not others
for seen in [*(scans(frames) if grid else frames), *others]:
    refused = mapper.add(seen).refused
    assert refused in (None, "no_time", "disagrees_with_map", "contradicts_map"), refused
    doubted |= refused == "disagrees_with_map"
    camera = getattr(seen, "camera", getattr(seen, "pair", None))
    if camera not in cameras:  # its first frame may compile
        allowed |= compiled()
    cameras.add(camera)
    later |= compiled() - allowed
assert doubted or "deadline_ms" in settings
print(json.dumps({"quality": dict(mapper.map.history.quality), "cameras": len(cameras), "later": sorted(later)}))
if hasattr(mapper.map, "close"):
    mapper.map.close()
"""
WINDOW = {"window.size": (4, 4, 3), "map.keep_times": True}


@pytest.mark.parametrize(
    ("source", "settings"),
    [
        ("sim:room?image_width=160", {}),
        ("sim:room?image_width=160", {"deadline_ms": 0.01, "voxel_size": 0.01}),
        ("sim:room?image_width=160", {**WINDOW, "threads": 2}),
        ("sim:room?image_width=160", {**WINDOW, "window.outside": "keep", "map.forget_s": 1.0}),
        ("sim:room?image_width=160", {"integrator": "ray", "threads": 2, "sphere.step_deg": 2.0}),
        ("sim:surround?scale=0.5", {"deadline_ms": 0.01}),
        ("sim:room?image_width=160", {"grid": True}),
    ],
    ids=["projective", "deadline", "window", "tiles", "ray", "stereo", "grid"],
)
def test_nothing_is_compiled_after_the_first_frame_of_a_camera(source, settings, tmp_path, run_script):
    """In processes forked from one that has imported what they need, and compiled or loaded no kernel."""
    (tmp_path / "later.py").write_text(LATER_KERNELS.replace("GIVEN", repr((source, settings))))
    status, said = run_script(tmp_path / "later.py")
    assert status == 0, said
    told = json.loads(said.splitlines()[-1])
    assert told["cameras"] == (4 if source.startswith("sim:surround") else 1)
    assert told["later"] == []
    if "deadline_ms" in settings:
        assert set(told["quality"]) == {"full", "near", "coarse"}, "or no other way was taken"


@pytest.fixture
def without_collector():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(scope="module")
def frames():
    depth = np.full((12, 16), 2.0, np.float32)
    pinhole = sv.PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5, 0.05)
    wide = sv.SphericalCamera.from_field_of_view(16, 12, 120, 120, 0.05)
    return [sv.Frame(depth, camera, np.eye(4)) for camera in (pinhole, wide)]


@pytest.mark.parametrize(
    "settings",
    [{}, {"integrator": "ray"}, {"integrator": "line"}, {"deadline_ms": 50.0}, WINDOW, {"threads": 2}],
    ids=str,
)
def test_a_dropped_mapper_is_gone_at_once(frames, without_collector, settings):
    sv.Mapper(**settings).add(frames[0])  # compiling leaves cycles, once
    mapper = sv.Mapper(**settings)
    for n, frame in enumerate(frames):
        assert mapper.add(replace(frame, stamp_ns=n)).refused is None
    parts = [mapper, mapper.map, *(level.integrator for level in mapper._deadline._levels)]
    left = [weakref.ref(part) for part in parts]
    del mapper, parts
    assert [ref() for ref in left] == [None] * len(left)


def test_a_map_does_not_hold_who_looks_at_it(frames, without_collector):
    mapper = sv.Mapper(up="z")
    projection = LiveProjection(mapper.map)
    mapper.add(frames[0])
    assert projection.grid() is not None
    dropped, voxel_map = weakref.ref(projection), weakref.ref(mapper.map)
    del projection
    assert dropped() is None
    assert mapper.add(replace(frames[0], stamp_ns=1)).refused is None
    del mapper
    assert voxel_map() is None
