# SPDX-License-Identifier: Apache-2.0
"""Shows lines `name: text` of docstrings as the lists that mkdocstrings makes of Google's sections."""

from __future__ import annotations

import re
from typing import Any

from griffe import Class, Extension, Function


class DocstringFields(Extension):
    """Puts a title above lines that describe attributes of a class, or arguments of a function."""

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        """Rewrite the docstring of a class once its attributes are known."""
        if cls.docstring:
            cls.docstring.value = titled(cls.docstring.value, [*cls.attributes], "Attributes")

    def on_function_instance(self, *, func: Function, **_: Any) -> None:
        """Rewrite the docstring of a function."""
        if func.docstring:
            func.docstring.value = titled(func.docstring.value, [item.name for item in func.parameters], "Args")


def titled(text: str, names: list[str], title: str) -> str:
    """Return a docstring with `title` above each paragraph that begins with `name: ` or `name, name: `."""
    if not names or re.search(rf"^{title}:$", text, re.MULTILINE):
        return text
    name = "|".join(map(re.escape, sorted(names, key=len, reverse=True)))
    entry = re.compile(rf"(?:^|(?<=\s))((?:{name})(?:, (?:{name}))*): ")
    paragraphs: list[str] = []
    for paragraph in text.split("\n\n"):
        line = next((n for n, line in enumerate(paragraph.splitlines()) if entry.match(line)), None)
        if line is None:
            paragraphs.append(paragraph)
            continue
        lines = paragraph.splitlines()
        paragraphs += ["\n".join(lines[:line])] if line else []
        _, *entries = entry.split(" ".join(" ".join(lines[line:]).split()))
        described = zip(entries[::2], entries[1::2], strict=True)
        paragraphs.append(
            "\n".join([f"{title}:", *(f"    {one}" for group, said in described for one in _each(group, said))])
        )
    return "\n\n".join(paragraphs)


def _each(group: str, said: str) -> list[str]:
    first, *others = group.split(", ")
    return [f"{first}: {said.strip()}", *(f"{other}: See `{first}`." for other in others)]
