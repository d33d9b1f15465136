"""README's example as it stands, and a flat agent with as many steps.

    python -m benchmarks.first_example [--seeds 0 1 2 3 4 5 6 7 8 9]

Solved is the share of 100 episodes of Gymnasium's environment, with seeds that training never saw,
that end at the exit. Seconds are those of training.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import report, table
from skillweave import Hierarchy

README = Path(__file__).parents[1] / "README.md"


def declared() -> Hierarchy:
    """Return the hierarchy that README's first block of Python declares."""
    code = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.S)[0]
    names: dict[str, Any] = {"__name__": "readme"}
    exec(compile(code, str(README), "exec"), names)
    found: Hierarchy = names["hierarchy"]
    return found


def learn(seed: int) -> dict[str, Any]:
    row: dict[str, Any] = {"seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        for name, flat in (("hierarchy", False), ("flat", True)):
            run = declared().train(Path(folder) / name, seed=seed, flat=flat, quiet=True)
            row[name] = run.evaluate(100).mean
            row[f"{name} seconds"] = round(sum(s["seconds"] for s in run.info()["stages"]), 1)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(10)))
    rows: list[dict[str, Any]] = []
    for seed in parser.parse_args().seeds:
        rows.append(learn(seed))
        print(table(list(rows[0]), [list(r.values()) for r in rows]), flush=True)
    found = {k: [r[k] for r in rows] for k in ("hierarchy", "flat", "hierarchy seconds")}
    worst = {"hierarchy": min(found["hierarchy"]), "flat": max(found["flat"])}
    report(
        "first-example", {"worst": worst, "slowest": max(found["hierarchy seconds"]), "rows": rows}
    )


if __name__ == "__main__":
    main()
