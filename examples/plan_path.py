# SPDX-License-Identifier: Apache-2.0
"""Plan a way through a map for a robot that fits into a ball: A* over the cells where it touches nothing.

    python examples/plan_path.py MAP START GOAL [--through-unknown]

Places are X,Y,Z in metres; the picture is plan.png.
"""

import heapq
import sys
from itertools import product

import numpy as np

import stereovox as sv
from stereovox.view.path import picture_path

RADIUS = 0.3
STEPS = [np.array(step) for step in product((-1, 0, 1), repeat=3) if any(step)]


def plan(m, start, goal, radius, through_unknown=False):
    """Return the way (N, 3) in metres from `start` to `goal` for a ball of `radius` metres; None if missing."""
    obstacles = [sv.State.OCCUPIED, sv.State.TENTATIVE] + ([] if through_unknown else [sv.State.UNKNOWN])
    corners = np.array([*m.bounds(), start, goal])
    box = corners.min(axis=0) - 2 * radius, corners.max(axis=0) + 2 * radius
    field = sv.DistanceField(m, *box, to=obstacles, measure="gap", max_distance=2 * radius)
    fits = field.metres > radius  # from wherever in the cell, so that straight ways between neighbours are free, too
    first, last = (tuple(np.floor((place - field.origin) / field.cell).astype(int)) for place in (start, goal))
    came, lengths, ahead = {}, {first: 0.0}, [(0.0, first, first)]
    while ahead and last not in came and fits[first] and fits[last]:
        _, cell, before = heapq.heappop(ahead)
        if cell in came:
            continue
        came[cell] = before
        for step in STEPS:
            beside = tuple((cell + step).tolist())
            length = lengths[cell] + np.linalg.norm(step * field.cell)
            inside = min(beside) >= 0 and np.less(beside, fits.shape).all()
            if inside and fits[beside] and length < lengths.get(beside, np.inf):
                lengths[beside] = length
                heapq.heappush(ahead, (length + np.linalg.norm(np.subtract(last, beside) * field.cell), beside, cell))
    if last not in came:
        return None
    cells = [last]
    while cells[-1] != first:
        cells.append(came[cells[-1]])
    return np.array([start, *(field.origin + (np.array(cells[::-1]) + 0.5) * field.cell), goal])


if __name__ == "__main__":
    if len(sys.argv) < 4 or not all(place.count(",") == 2 for place in sys.argv[2:4]):
        sys.exit(__doc__)
    m = sv.load_map(sys.argv[1])
    start, goal = (np.array(place.split(","), float) for place in sys.argv[2:4])
    way = plan(m, start, goal, RADIUS, through_unknown="--through-unknown" in sys.argv)
    if way is None:
        sys.exit(f"no way is known to be free for a ball of {RADIUS} m, or it does not fit where it starts or ends")
    picture_path(m, way, RADIUS, "plan.png", "A way through the map")
    print(f"{np.linalg.norm(np.diff(way, axis=0), axis=1).sum():.2f} m through {len(way)} places; saved plan.png")
