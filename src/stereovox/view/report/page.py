# SPDX-License-Identifier: Apache-2.0
"""Building blocks of a report, a self-contained HTML page. All text is escaped here.

Folder of the option `--out`.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import check_local, replacing

MANY = 7
"""Largest number of columns that fit a page in large letters."""


def page(title: str, lead: str, *parts: str) -> str:
    """Return a whole page; `parts` are results of the functions below."""
    text = (files("stereovox.view.report") / "page.html").read_text(encoding="utf-8")
    fields = {"title": escape(title), "lead": escape(lead), "body": "\n".join(parts)}
    for name, value in fields.items():
        text = text.replace(f"{{{{{name}}}}}", value)
    return text


def write_page(folder: str | Path, name: str, text: str) -> Path:
    """Write a page into `folder`, created if missing, and return its path.

    Raises StereovoxError, one line, if it cannot be written.
    """
    return write_files(folder, {name: text.encode()})


def write_files(folder: str | Path, contents: dict[str, bytes]) -> Path:
    """Write files into `folder`, created if missing, each atomically; return the path of the first.

    Raises StereovoxError, one line, if one cannot be written.
    """
    check_local(folder)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StereovoxError(f"{folder}: cannot write the report ({error.strerror or error}); name a folder") from None
    for name, content in contents.items():
        with replacing(Path(folder) / name, StereovoxError) as file:
            file.write(content)
    return Path(folder) / next(iter(contents))


def section(heading: str, text: str, *parts: str) -> str:
    """Return a heading, a paragraph and `parts` below it."""
    return "\n".join([f"<h2>{escape(heading)}</h2>", f"<p>{escape(text)}</p>" if text else "", *parts])


def tiles(pairs: Iterable[tuple[str, str]]) -> str:
    """Return a row of boxes, each with a value and its label."""
    boxes = (f'<div class="tile"><b>{escape(value)}</b><span>{escape(what)}</span></div>' for value, what in pairs)
    return f'<div class="tiles">{"".join(boxes)}</div>'


def table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table; many columns are set in smaller letters to fit the page."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    size = "wide many" if len(heads) > MANY else "wide"
    return f'<div class="{size}"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def figure(png: bytes, alt: str) -> str:
    """Return a picture embedded in the page."""
    return f'<img alt="{escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def code(text: str) -> str:
    """Return preformatted text."""
    return f"<pre>{escape(text)}</pre>"


def out_folder(out: str | Path) -> Path:
    """Return the folder `out`, created if missing; raises StereovoxError, one line, if that fails."""
    check_local(out)
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a character 0
        reason = getattr(error, "strerror", None) or error
        raise StereovoxError(f"{str(out)!r}: cannot make this folder ({reason}); choose another --out") from None
    return folder
