"""Outcomes of cases, their counts, and the files of failing cases."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

# What may come of a case. Those in capitals are failures.
REFUSED = "a sentence"
NAMELESS = "a sentence that names no file"
EQUAL = "as the original"
ASKED = "otherwise, as the change asks for"
FINISHED = "finished all the same"
OTHERWISE = "OTHERWISE"
TRACEBACK = "TRACEBACK"
HANG = "HANG"
CRASH = "CRASH"
CODE = "CODE RUN"
CHANGED = "READER CHANGED"
MEMORY = "MEMORY"
LONG = "LONG MESSAGE"
LOST = "LOST"
WEIGHTS = "OTHER WEIGHTS"
METRICS = "OTHER METRICS"
FILES = "OTHER FILES"
LEFT = "PROCESSES LEFT"


@dataclass(frozen=True)
class Outcome:
    """The outcome of one case."""

    category: str
    what: str = ""
    """What was done to the library: its kind, a colon, details."""
    said: str = ""
    """What it said: a message, or a traceback."""

    @property
    def bad(self) -> bool:
        """It is a failure."""
        return self.category.isupper()

    @property
    def cause(self) -> str:
        """What was done, or where an exception was raised: equal for cases that fail alike.

        Without numbers and names of files.
        """
        lines = [line.strip() for line in self.said.splitlines() if line.strip()]
        places = [line for line in lines if line.startswith('File "') and "/skillweave/" in line]
        place = f"[{places[-1].split('/skillweave/')[-1]}] " if places else ""
        said = lines[-1] if lines and self.category in (TRACEBACK, METRICS, LOST) else ""
        text = place + said or self.what.split(":")[0]
        return re.sub(r"0x\w+|\d[\d.e]*", "N", re.sub(r"'/[^']*'", "'...'", text))[:110]


@dataclass
class Tally:
    """The counts of one part, and an example of each cause of failure."""

    part: str
    words: str
    """Further words of the command line: the seed, the samples."""
    counts: Counter[str] = field(default_factory=Counter)
    causes: dict[tuple[str, str], list[int]] = field(default_factory=dict)

    def add(self, number: int, outcome: Outcome, kept: Path) -> None:
        """Count a case; a bad one is appended to ``kept``, a file of JSON lines."""
        self.counts[outcome.category] += 1
        if outcome.bad:
            self.causes.setdefault((outcome.category, outcome.cause), []).append(number)
            kept.parent.mkdir(parents=True, exist_ok=True)
            with kept.open("a") as file:
                again = {"again": self.again(number)}
                file.write(json.dumps(again | asdict(outcome)) + "\n")

    def again(self, number: int) -> str:
        """Return the command that does one case again."""
        return f"python -m scripts.torture {self.part} {self.words} --case {number}"

    @property
    def bad(self) -> int:
        """The number of failed cases."""
        return sum(n for category, n in self.counts.items() if category.isupper())

    def examples(self) -> str:
        """Return a line for each cause of failure, the most frequent first."""
        found = sorted(self.causes.items(), key=lambda item: -len(item[1]))
        return "\n".join(
            f"{len(cases):>6} × {category}: {cause}\n         {self.again(cases[0])}"
            for (category, cause), cases in found
        )


def table(tallies: Iterable[Tally]) -> str:
    """Return one table: a row for each category, a column for each part."""
    tallies = list(tallies)
    names = sorted({c for t in tallies for c in t.counts}, key=lambda c: (c.isupper(), c))
    rows = [["", *(t.part for t in tallies)]]
    rows += [[name, *(f"{t.counts[name]:,}" for t in tallies)] for name in names]
    rows += [["cases", *(f"{t.counts.total():,}" for t in tallies)]]
    rows += [["failures", *(f"{t.bad:,}" for t in tallies)]]
    first = max(len(row[0]) for row in rows)
    return "\n".join(row[0].ljust(first) + "".join(c.rjust(12) for c in row[1:]) for row in rows)
