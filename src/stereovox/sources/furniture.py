# SPDX-License-Identifier: Apache-2.0
"""What stands in the simulated apartment. Plan coordinates in metres: floor at 0, x east, y north."""

from __future__ import annotations

from stereovox.sources.scene import Point, Solid, box, cylinder

BOXES: dict[str, dict[str, tuple[Point, Point]]] = {
    "sofa": {
        "seat": ((1.2, 0.25, 0.1), (3.1, 0.9, 0.42)),
        "back": ((1.2, 0.02, 0.1), (3.1, 0.25, 0.84)),
        "arm, west": ((1.02, 0.02, 0.1), (1.2, 0.9, 0.6)),
        "arm, east": ((3.1, 0.02, 0.1), (3.28, 0.9, 0.6)),
    },
    "shelf": {
        "side, west": ((0.5, 2.88, 0), (0.53, 3.18, 1.9)),
        "side, east": ((1.67, 2.88, 0), (1.7, 3.18, 1.9)),
        **{f"board {n}": ((0.53, 2.88, z), (1.67, 3.18, z + 0.03)) for n, z in enumerate((0.1, 0.55, 1.0, 1.45, 1.87))},
        "books, low": ((0.6, 2.95, 0.58), (1.2, 3.15, 0.83)),
        "books, high": ((0.9, 2.95, 1.03), (1.6, 3.15, 1.26)),
    },
    "low table": {
        "top": ((1.7, 2.15, 0.38), (2.6, 2.65, 0.42)),
        **{
            f"leg {n}": ((x, y, 0), (x + 0.05, y + 0.05, 0.38))
            for n, (x, y) in enumerate(((1.72, 2.17), (2.53, 2.17), (1.72, 2.58), (2.53, 2.58)), 1)
        },
    },
    "kitchen": {
        "counter": ((5.3, 0.02, 0), (7.7, 0.62, 0.9)),
        "wall cupboard": ((5.3, 0.02, 1.45), (7.0, 0.37, 2.1)),
        "fridge": ((7.72, 0.02, 0), (8.36, 0.66, 1.85)),
        "table": ((7.35, 1.75, 0.71), (8.15, 2.65, 0.75)),
    },
    "bed": {
        "mattress": ((0.1, 6.0, 0.2), (2.1, 7.6, 0.55)),
        "head": ((0.02, 5.95, 0), (0.1, 7.65, 1.0)),
        "wardrobe": ((2.95, 6.0, 0), (3.57, 7.75, 2.1)),
    },
    "bath": {
        "tub": ((3.76, 7.0, 0), (5.56, 7.76, 0.55)),
        "basin": ((3.74, 5.6, 0.75), (4.16, 6.2, 0.88)),
        "washing machine": ((4.98, 6.1, 0), (5.57, 6.7, 0.85)),
    },
    "desk": {
        "top": ((7.6, 5.4, 0.71), (8.35, 7.1, 0.75)),
        "screen": ((8.1, 5.9, 0.85), (8.14, 6.5, 1.2)),
        "drawers": ((7.7, 6.6, 0), (8.3, 7.05, 0.7)),
        "bookcase": ((5.76, 6.6, 0), (6.06, 7.7, 1.8)),
    },
    "hall things": {
        "shoe rack": ((7.4, 3.36, 0), (8.3, 3.62, 0.5)),
        "chest": ((0.06, 3.36, 0), (0.5, 4.1, 0.8)),
    },
}
"""Part, name, lowest and highest corner."""


def furniture() -> list[Solid]:
    """Return all furniture, unturned boxes and round legs, chairs turned by odd angles."""
    boxes = [
        box(part, f"{part}: {name}", *corners) for part, things in BOXES.items() for name, corners in things.items()
    ]
    return [
        *boxes,
        cylinder("kitchen", "kitchen: table foot", (7.75, 2.2, 0), (7.75, 2.2, 0.71), 0.08),
        cylinder("lamp", "lamp: stand", (4.25, 0.35, 0), (4.25, 0.35, 1.5), 0.03),
        cylinder("lamp", "lamp: shade", (4.25, 0.35, 1.5), (4.25, 0.35, 1.75), 0.3),
        cylinder("desk", "desk: leg, south", (7.68, 5.48, 0), (7.68, 5.48, 0.71), 0.05),
        *_chair("kitchen chair", 7.1, 2.3, 0.35),
        *_chair("desk chair", 7.35, 6.15, -0.5),
    ]


def _chair(name: str, x: float, y: float, turn: float) -> list[Solid]:
    """Return a chair whose sitter looks along +x turned by `turn` radians."""

    def part(label: str, low: Point, high: Point) -> Solid:
        (x0, y0, z0), (x1, y1, z1) = low, high
        return box("chairs", f"{name}: {label}", (x + x0, y + y0, z0), (x + x1, y + y1, z1), turn, about=(x, y))

    return [
        part("seat", (-0.2, -0.2, 0.43), (0.2, 0.2, 0.47)),
        part("back", (-0.2, -0.2, 0.47), (-0.165, 0.2, 0.9)),
        *(
            part(f"leg {n}", (a, b, 0), (a + 0.035, b + 0.035, 0.43))
            for n, (a, b) in enumerate(((-0.2, -0.2), (0.165, -0.2), (-0.2, 0.165), (0.165, 0.165)), 1)
        ),
    ]
