# SPDX-License-Identifier: Apache-2.0
"""Agreement of the projective integrator with exact ray casting at one update per cell and frame.

python benchmarks/agreement.py RECORDING [FRAMES] [SENSOR]      for example: recordings/kitchen ::4 stereo
"""

import sys
from time import perf_counter

import stereovox as sv
from stereovox_lab.checks.agreement import agreement


def main(recording: str, frames: str = "::1", sensor: str = "stereo") -> None:
    columns = ("prec", "rec", "prec 1", "rec 1", "wr.free", "free p", "free r")
    print(" cell", *(f"{column:>7}" for column in columns), "  ms, rays ms")
    for voxel_size in (0.2, 0.1, 0.05, 0.02):
        settings = {"voxel_size": voxel_size, "sensor.model": sensor}
        projective = sv.Mapper("default", **settings)
        rays = sv.Mapper("default", integrator="ray", **{"ray.update": "once"}, **settings)
        spent = [0.0, 0.0]
        source = sv.open_source(recording, frames)
        for frame in source:
            for i, mapper in enumerate((projective, rays)):
                start = perf_counter()
                mapper.add(frame)
                spent[i] += perf_counter() - start
        shares = " ".join(f"{share:7.4f}" for share in agreement(projective.map, rays.map).values())
        print(
            f"{voxel_size:5.2f} {shares}   {1e3 * spent[0] / len(source):.2f}, {1e3 * spent[1] / len(source):.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
