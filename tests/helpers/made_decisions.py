# SPDX-License-Identifier: Apache-2.0
"""The table of decisions again, slow and obvious: dicts of cells, their neighbours, and plain Python."""

from made_scores import neighbours

NAMES = ("unknown", "free", "tentative", "occupied")


def share(part, whole):
    return part / whole if whole else None


def decisions(states, truth, tolerance, chosen=None):
    """states: {cell: name of its state, of known cells}; truth: {cell: holds a surface}; chosen: cells that count."""
    cells = [cell for cell in truth if chosen is None or cell in chosen]

    def state(cell):
        return states.get(cell, "unknown")

    def any_near(cell, within, wanted):
        return any(state(near) in wanted for near in neighbours(cell, within))

    surface, air = [cell for cell in cells if truth[cell]], [cell for cell in cells if not truth[cell]]
    known = [cell for cell in surface if state(cell) != "unknown"]
    lost = [cell for cell in surface if state(cell) == "free"]
    alone = [cell for cell in lost if not any_near(cell, 1, ("tentative", "occupied"))]
    occupied, free = ([cell for cell in cells if state(cell) == wanted] for wanted in ("occupied", "free"))
    found = {"surface": len(surface), "air": len(air), "known": len(known), "occupied": len(occupied)}
    for name in NAMES:
        found[f"surface_{name}"] = share(sum(state(cell) == name for cell in surface), len(surface))
        found[f"air_{name}"] = share(sum(state(cell) == name for cell in air), len(air))
    close = [cell for cell in occupied if any(truth.get(near, False) for near in neighbours(cell, tolerance))]
    return found | {
        "free": len(free),
        "surface_free_alone": share(len(alone), len(surface)),
        "surface_occupied_near": share(sum(any_near(cell, tolerance, ("occupied",)) for cell in surface), len(surface)),
        "surface_near": share(
            sum(any_near(cell, tolerance, ("occupied", "tentative")) for cell in surface), len(surface)
        ),
        "known_free": share(len(lost), len(known)),
        "known_free_alone": share(len(alone), len(known)),
        "occupied_hit": share(sum(truth[cell] for cell in occupied), len(occupied)),
        "occupied_near": share(len(close), len(occupied)),
        "occupied_air": share(sum(not truth[cell] for cell in occupied), len(occupied)),
        "free_wrong": share(sum(truth[cell] for cell in free), len(free)),
    }
