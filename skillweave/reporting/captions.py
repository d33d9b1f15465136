"""Captions, apart from videos: a band under a frame with the acting skill."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from skillweave.reporting.palette import BAND, BLACK, LINE, RGB, WHITE
from skillweave.reporting.video_file import extra
from skillweave.types import Array

MIN_WIDTH = 240  # pixels; smaller frames are enlarged


def caption(
    frame: Array, text_left: str, color: RGB, text_right: str, size: int | None = None
) -> Array:
    """Return the frame above a dark band: the acting skill on its left, text on its right.

    Nothing of the frame is covered. A frame narrower than ``MIN_WIDTH`` is enlarged k times. A
    left text too long for its room is shortened; where it is empty there is no chip.

    Args:
        frame: (H, W, 3) uint8.
        size: of the font, in pixels; None: in proportion to the frame.

    Returns:
        (H·k + band, W·k, 3) uint8, of even height.
    """
    factor = -(-MIN_WIDTH // frame.shape[1])
    if factor > 1:
        frame = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    height, width = frame.shape[:2]
    size = size or min(max(round(min(height / 22, width / 28)), 12), 40)
    band, margin = round(1.8 * size), size // 2
    band += (height + band) % 2
    out = np.empty((height + band, width, 3), np.uint8)
    out[:height], out[height], out[height + 1 :] = frame, LINE, BAND
    right = _text(text_right, size, WHITE, BAND)[:, : width - 2 * margin]
    room = width - 2 * margin - right.shape[1]
    _paste(out[height + 1 :], right, margin + room)
    if text_left and room > 2 * size:
        _paste(out[height + 1 :], _chip(text_left, color, size, room - size), margin)
    return out


def _paste(band: Array, patch: Array, left: int) -> None:
    top = (band.shape[0] - patch.shape[0]) // 2
    band[top : top + patch.shape[0], left : left + patch.shape[1]] = patch


@functools.lru_cache(maxsize=16)
def _font(size: int) -> Any:
    return extra("PIL.ImageFont").load_default(size=size)


@functools.lru_cache(maxsize=256)
def _text(text: str, size: int, ink: RGB, ground: RGB) -> Array:
    """Return one line of text, (line height, its width, 3)."""
    font = _font(size)
    box = (max(1, round(font.getlength(text))), sum(font.getmetrics()))
    image = extra("PIL.Image").new("RGB", box, ground)
    extra("PIL.ImageDraw").Draw(image).text((0, 0), text, fill=ink, font=font)
    return np.asarray(image)


@functools.lru_cache(maxsize=256)
def _chip(text: str, color: RGB, size: int, width: int) -> Array:
    """Return a name on its colour, at most ``width`` pixels wide."""
    # Black and white contrast equally with a relative luminance of 0.18 (WCAG 2).
    luminance = (np.asarray(color) / 255) ** 2.2 @ (0.2126, 0.7152, 0.0722)
    short, pad = text, size // 2
    while text and _font(size).getlength(short) > width - 2 * pad:
        text = text[:-1]
        short = f"{text}..." if text else ""
    name = _text(short, size, BLACK if luminance > 0.18 else WHITE, color)
    chip = np.full((name.shape[0] + 2, name.shape[1] + 2 * pad, 3), color, np.uint8)
    _paste(chip, name, pad)
    return chip
