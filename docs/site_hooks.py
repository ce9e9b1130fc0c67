# SPDX-License-Identifier: Apache-2.0
"""What mkdocs.yml adds to the pages in docs/: files of the repository that they link to, so that links work in both."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md")
"""Files next to docs/ that become pages."""
INTO_DOCS = re.compile(r"\]\(docs/")


def on_files(files: Files, config: Any) -> Files:
    """Add pages and examples, as if they lay in docs/."""
    examples = (path for path in sorted((ROOT / "examples").rglob("*.*")) if path.suffix != ".pyc" and path.is_file())
    for name in (*PAGES, *(path.relative_to(ROOT).as_posix() for path in examples)):
        if files.get_file_from_path(name) is None:
            files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links between docs/ and its parent into links within docs/."""
    if page.file.src_uri in PAGES:
        return INTO_DOCS.sub("](", markdown)
    up = "../" * page.file.src_uri.count("/")
    return markdown.replace(f"](../{up}", f"]({up}")
