# SPDX-License-Identifier: Apache-2.0
"""How near `stereovox calibrate pair` comes to the truth, on simulated recordings waved by hand at different times.

python benchmarks/calibrate_pair.py [RECORDINGS] [SECONDS]      for example: 6 10
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/helpers"))

import made_pairs as made

from stereovox.calibrate.pair import calibrate_pair
from stereovox.frame import Frame
from stereovox.geometry.se3 import inverse, rotation_vector
from stereovox.simulate.d435 import depth_camera
from stereovox.sources.base import Source
from stereovox.sources.poses.tracker import on_clock

HZ, WIDTH = 15, 212


class Waved(Source):
    """Depth images from `first_s` of the motion on, without poses."""

    def __init__(self, seconds: float, first_s: float):
        made.WIDTH = WIDTH
        self.name, self.camera = "waved", depth_camera(WIDTH)
        times, self._stamps = made.times(round(seconds * HZ), HZ, first_s)
        self._images = made.depth_images([made.waved(time) for time in times])

    def __len__(self) -> int:
        return len(self._images)

    def frame(self, i: int) -> Frame:
        """Return image `i`."""
        return Frame(self._images[i], self.camera, np.eye(4), self._stamps[i], 0.001)


def main(recordings: int = 6, seconds: float = 10.0) -> None:
    errors = []
    for first_s in 3.0 * np.arange(recordings):
        times, stamps = made.times(round((seconds + 1) * 200), 200, first_s - 0.5)
        poses = made.tracker_poses([made.waved(time) for time in times], stamps, jitter=1.0)
        found = calibrate_pair(Waved(seconds, first_s), on_clock(poses, -made.OFFSET_S))
        wrong = inverse(made.T_TRACKER_CAMERA) @ found.T_tracker_camera
        turn, way = np.degrees(np.linalg.norm(rotation_vector(wrong[:3, :3]))), 1e3 * np.linalg.norm(wrong[:3, 3])
        errors.append((1e3 * abs(found.clock_offset_s - made.OFFSET_S), turn, way))
        said = 1e3 * found.offset_std_s, found.rotation_std_deg.max(), 1e3 * found.translation_std_m.max()
        print("{:5.2f} ms {:5.3f} deg {:5.1f} mm,".format(*errors[-1]), end=" ")
        print("standard deviations {:.2f} ms {:.3f} deg {:.1f} mm".format(*said))
    for word, of in (("median", np.median), ("worst", np.max)):
        print(
            f"{word}: {' '.join(f'{n:.2f} {unit}' for n, unit in zip(of(errors, 0), ('ms', 'deg', 'mm'), strict=True))}"
        )


if __name__ == "__main__":
    main(*(kind(word) for kind, word in zip((int, float), sys.argv[1:], strict=False)))
