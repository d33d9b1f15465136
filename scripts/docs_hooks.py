"""What MkDocs asks while it builds the site: pictures are put into the page itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

PICTURE = re.compile(r"!\[([^\]]*)\]\((?:\.\./)*(pictures/[\w-]+\.svg)\)")
DOCS = Path(__file__).parents[1] / "docs"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """An SVG that is part of the page has the colours of the page: those of light and of dark.

    As an image it would follow the system, and not the switch of the page.
    """

    def inline(found: re.Match[str]) -> str:
        drawing = (DOCS / found[2]).read_text().strip()
        drawing = "\n".join(line for line in drawing.splitlines() if line.strip())
        return (
            f'<figure class="picture">\n{drawing}\n<figcaption>{found[1]}</figcaption>\n</figure>'
        )

    return PICTURE.sub(inline, markdown)
