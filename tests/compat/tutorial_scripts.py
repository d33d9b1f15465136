"""The tutorial's scripts, taken from its text, with budgets cut down by patching constants."""

from __future__ import annotations

import re
from pathlib import Path

TEXT = Path(__file__).with_name("tutorial.txt")
SHIM = "skillweave.compat.agilerl"
HEADINGS = {
    "skills": "Rendering individual skills\n",
    "hierarchy": "Rendering the hierarchical policy\n",
    "training": "Full training code\n\nFull code\n",
}
CUT = {
    '"EPISODES": 1000': '"EPISODES": {episodes}',
    '"EVO_EPOCHS": 5': '"EVO_EPOCHS": 2',
    "range(500)": "range(5)",
    "episodes = 3": "episodes = 1",
    "max_steps = 100 ": "max_steps = 2 ",
    "            500  # Max": "            20  # Max",
}
"""Constants, and what stands in their place; nothing else of a script changes but the import."""


def scripts() -> dict[str, str]:
    """Each script as it stands in the text."""
    text = TEXT.read_text()
    starts = sorted((text.index(h) + len(h), name) for name, h in HEADINGS.items())
    ends = [text.rindex("\n", 0, at - len(HEADINGS[name])) for at, name in starts[1:]]
    found = zip(starts, [*ends, len(text)], strict=True)
    return {name: text[start:end] + "\n" for (start, name), end in found}


def moved(script: str) -> str:
    """A script with the import root changed, and nothing else."""
    return re.sub(r"^(from|import) agilerl\b", rf"\1 {SHIM}", script, flags=re.M)


def short(script: str, episodes: int = 2) -> str:
    """A script that runs in seconds: the same, with smaller constants."""
    for old, new in CUT.items():
        script = script.replace(old, new.format(episodes=episodes))
    return moved(script)
