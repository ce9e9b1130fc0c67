# SPDX-License-Identifier: Apache-2.0
"""Report of the demo, a self-contained HTML page: the run, its speed, and the quality of the map."""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing

EXPLANATIONS = {
    "precision": "Of the cells the map calls occupied, the share that a surface really touches.",
    "recall": "Of the known cells that a surface touches, the share the map calls occupied.",
    "tolerance_precision": "The same as precision, but a surface in a neighbouring cell counts as well.",
    "tolerance_recall": "The same as recall, but an occupied neighbouring cell counts as well.",
    "accuracy": "Of all known cells, the share the map is right about.",
    "specificity": "Of the known cells that are really free, the share the map does not call occupied.",
    "npv": "Of the cells the map does not call occupied, the share that no surface touches.",
}
LABELS = {
    "tolerance_precision": "precision within one cell",
    "tolerance_recall": "recall within one cell",
    "npv": "negative predictive value",
}


def write_report(path: str | Path, summary: dict[str, Any], picture: str | Path) -> None:
    """Write the page of a demo run: `summary` as `lab.demo.demo` returns it, `picture` a PNG file to embed.

    Raises StereovoxError if the file cannot be written.
    """
    text = report(summary, Path(picture).read_bytes())
    with replacing(path, StereovoxError) as file:
        file.write(text.encode())


def report(summary: dict[str, Any], png: bytes) -> str:
    """Return the page as text; see `write_report`."""
    page = (files("stereovox.view.report") / "demo.html").read_text(encoding="utf-8")
    fields = {
        "title": f"Map of {summary['source']}",
        "lead": _lead(summary),
        "tiles": _tiles(summary),
        "picture": base64.b64encode(png).decode(),
        "parts": _parts(summary["parts"], summary["min_frames"]),
        "accuracy": _accuracy(summary["accuracy"]),
        "counts": _counts(summary["accuracy"]),
        "times": _times(summary),
        "settings": _table(["setting", "value"], _flat(summary["settings"])),
    }
    for name, text in fields.items():
        page = page.replace(f"{{{{{name}}}}}", text if name != "title" else escape(text))
    return page


def _lead(summary: dict[str, Any]) -> str:
    missing = summary["missing"]
    verdict = (
        "Every piece of the scene that the camera saw often enough stands in the map."
        if not missing
        else f"<strong>{len(missing)} pieces are missing:</strong> {escape(', '.join(missing))}."
    )
    return (
        f"{summary['frames']:,} depth images of a simulated {escape(summary['camera'])} became a map with cells of "
        f"{100 * summary['voxel_size']:g} cm. Because the scene is built in, its exact occupancy is known and every "
        f"cell of the map can be checked. {verdict}"
    )


def _tiles(summary: dict[str, Any]) -> str:
    accuracy, pieces = summary["accuracy"], sum(part["pieces"] for part in summary["parts"].values())
    tiles = [
        (f"{summary['frame_ms']['median']:.1f} ms", "a frame, median"),
        (_percent(accuracy["tolerance_precision"]), "precision within one cell"),
        (_percent(accuracy["tolerance_recall"]), "recall within one cell"),
        (f"{summary['occupied']:,}", "occupied cells"),
        (f"{summary['memory_bytes'] / 1e6:.1f} MB", "memory of the map"),
        (str(len(summary["missing"])), f"of {pieces} pieces missing"),
    ]
    boxes = (f'<div class="tile"><b>{escape(value)}</b><span>{escape(label)}</span></div>' for value, label in tiles)
    return "".join(boxes)


def _accuracy(accuracy: dict[str, Any]) -> str:
    rows = [(LABELS.get(key, key), _percent(accuracy[key]), text) for key, text in EXPLANATIONS.items()]
    return _table(["measure", "value", "what it says"], rows)


def _counts(accuracy: dict[str, Any]) -> str:
    return (
        f"Known cells: {accuracy['tp']:,} rightly occupied, {accuracy['fp']:,} wrongly occupied, "
        f"{accuracy['tn']:,} rightly not occupied, {accuracy['fn']:,} wrongly not occupied. "
        f"{accuracy['excluded']:,} known cells lie wholly inside walls and furniture, where no camera can look, "
        f"and do not count. {accuracy['free_in_solid']:,} cells that hold a surface or lie inside a solid "
        "are called free: the error that matters most to a robot."
    )


def _parts(parts: dict[str, dict[str, Any]], min_frames: int) -> str:
    rows = [
        (
            name.replace("_", " "),
            part["pieces"],
            ", ".join(part["missing"]) or "none",
            f"{part['seen_cells']:,}",
            _percent(part["recall"]),
            _percent(part["tolerance_recall"]),
            f"{100 * part['longest_gap']:.0f} cm",
        )
        for name, part in parts.items()
    ]
    seen = f"cells seen by {min_frames}+ frames"
    return _table(["part", "pieces", "missing", seen, "occupied", "within one cell", "longest gap"], rows)


def _times(summary: dict[str, Any]) -> str:
    names = {
        "depth_ms": "check and prepare the depth image",
        "integrate_ms": "put it into the map",
        "frame_ms": "the whole frame",
    }
    keys = ["median", "p90", "p99", "max"]
    rows = [(label, *(f"{summary[name][key]:.2f} ms" for key in keys)) for name, label in names.items()]
    return _table(["step", *keys], rows)


def _flat(settings: dict[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, "from the camera" if value is None else value


def _table(heads: list[str], rows: Iterable[tuple[Any, ...]]) -> str:
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
