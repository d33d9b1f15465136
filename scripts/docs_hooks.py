"""Hooks of MkDocs: pictures become part of the page, and numbers keep their units beside them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

UNIT = re.compile(r"(?<=\d) (?=%|\()|(?<=%) (?=\()")
PICTURE = re.compile(r"!\[([^\]]*)\]\((?:\.\./)*(pictures/[\w-]+\.svg)\)")
DOCS = Path(__file__).parents[1] / "docs"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put every SVG into its page, and no line break between a table's number and its unit.

    An SVG that is part of the page has the colours of the page. As an image it would follow the
    system's colours, not the page's switch.
    """

    def inline(found: re.Match[str]) -> str:
        drawing = (DOCS / found[2]).read_text().strip()
        drawing = "\n".join(line for line in drawing.splitlines() if line.strip())
        return (
            f'<figure class="picture">\n{drawing}\n<figcaption>{found[1]}</figcaption>\n</figure>'
        )

    lines = [
        UNIT.sub("\u00a0", line) if line.startswith("|") else line for line in markdown.splitlines()
    ]
    return PICTURE.sub(inline, "\n".join(lines))
