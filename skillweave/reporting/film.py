"""A film as a result: plain JSON for programs, and the film itself in a notebook."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

from skillweave.notebooks import Markup, joined, paragraph
from skillweave.terminal import printable

LARGEST = 50_000_000
"""Bytes of a film that a notebook shows: it keeps a copy inside."""


class Film(dict[str, Any]):
    """A film's ``path``, ``frames`` and ``episodes``. A notebook shows the film."""

    def __repr__(self) -> str:
        returns = ", ".join(f"{episode['return']:.1f}" for episode in self["episodes"])
        return printable(f"<Film {self['path']}: {self['frames']:,} frames, return {returns}>")

    def _repr_html_(self) -> str:
        """Return the film as a part of the page."""
        path, caption = Path(self["path"]), paragraph(repr(self).strip("<>"))
        try:
            data = path.read_bytes() if path.stat().st_size <= LARGEST else None
        except OSError as error:
            return joined([caption, paragraph(f"The film cannot be read: {error.strerror}.")])
        if data is None:
            return joined([caption, paragraph("It is too large to be shown here.")])
        text = base64.b64encode(data).decode()
        if path.suffix.lower() == ".gif":
            shown = f'<img src="data:image/gif;base64,{text}" style="max-width: 100%">'
        else:
            source = f"data:video/mp4;base64,{text}"
            shown = f'<video src="{source}" controls loop muted style="max-width: 100%"></video>'
        return joined([Markup(shown), caption])
