"""The errors that acting raises; ``skillweave.errors`` has all kinds."""

from __future__ import annotations

import re

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # all but tab and newline
    "\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]"  # order and lines of text
)


def printable(text: str) -> str:
    r"""Escape the control characters of a text (``\x1b`` for the one that terminals obey).

    Tabs and newlines do not change.
    """
    return _CONTROLS.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"


class SkillweaveError(Exception):
    """Base class of all errors that Skillweave raises."""

    def __init__(self, message: str = "") -> None:
        super().__init__(printable(message))


class DeclarationError(SkillweaveError):
    """A setting, an argument or a declaration is wrong; raised before anything is trained."""


class RunError(SkillweaveError):
    """A run or another file is missing, damaged, in use, of other settings, or not writable."""


class SkillError(SkillweaveError):
    """Code of a skill, a selector or a reflex failed, or returned an unusable value."""


class PolicyError(SkillweaveError):
    """A policy cannot be loaded or exported, does not fit where it is used, or failed there."""
