"""A hook of MkDocs: what a page links to outside docs/ is named instead, for the site does not hold it."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

# `[text](../path)` or `![text](../path)`, whose text may go over a line's end.
OUTSIDE = re.compile(r"(!?)\[([^\]]*)\]\(\.\./([^)#\s]+)(#[^)\s]*)?\)")
PICTURES = "elsewhere"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A link outside becomes its text and the file's path; a picture is taken along (below)."""

    def replaced(link: re.Match[str]) -> str:
        mark, text, path = link[1], link[2], link[3]
        if mark:
            return f"![{text}]({PICTURES}/{path})"
        return text if text.strip("`") == path else f"{text} (`{path}`)"

    return OUTSIDE.sub(replaced, markdown)


def on_files(files: Any, config: Any) -> Any:
    """Pictures outside docs/ that a page shows become files of the site."""
    from mkdocs.structure.files import File

    docs = Path(config["docs_dir"])
    shown = {
        link[3] for page in sorted(docs.glob("*.md")) for link in OUTSIDE.finditer(page.read_text("utf-8")) if link[1]
    }
    for path in sorted(shown):
        source = docs.parent / path
        files.append(File.generated(config, posixpath.join(PICTURES, path), abs_src_path=str(source)))
    return files
