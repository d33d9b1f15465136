"""Colours of skills and captions, and how they are written."""

from __future__ import annotations

from typing import TypeAlias

RGB: TypeAlias = tuple[int, int, int]

# From Okabe & Ito (2008), without the yellow that is lost on white, and four more, chosen to be
# far from these and from each other as people with a protan, deutan or tritan deficiency see them
# (Machado et al. 2009). Each has a contrast of at least 3 to black and 1.9 to white.
PALETTE: tuple[RGB, ...] = (
    (230, 159, 0),
    (0, 114, 178),
    (210, 0, 60),
    (142, 202, 112),
    (120, 0, 255),
    (86, 180, 233),
    (0, 158, 115),
    (213, 94, 0),
    (204, 121, 167),
    (135, 105, 255),
)
WHITE = (255, 255, 255)
BLACK = (0, 0, 0)
BAND = (28, 28, 32)
"""The ground of a caption."""
LINE = (110, 110, 118)
"""The line between a frame and its caption."""
OWN_COLORS = (BAND, LINE, WHITE, BLACK, *PALETTE)
"""Colours that captions are made of."""


def hex_of(color: RGB) -> str:
    """Return a colour as the web writes it: ``#e69f00``."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def is_light(color: RGB) -> bool:
    """Return whether black is read better than white on a colour (WCAG 2)."""
    red, green, blue = ((c / 255) ** 2.2 for c in color)
    # Black and white contrast equally with a relative luminance of 0.18.
    return bool(0.2126 * red + 0.7152 * green + 0.0722 * blue > 0.18)


def color_of(index: int, wanted: RGB | None = None) -> RGB:
    """Return the colour of skill number ``index``: its own, else the palette's."""
    return PALETTE[index % len(PALETTE)] if wanted is None else wanted
