"""README's first example as it stands: the hierarchy against each of its skills alone.

    python -m benchmarks.first_example [--seeds 0 1 2 3 4]

Scores are 100 episodes of Gymnasium's environment with seeds that training never saw.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common import median, report, table
from skillweave import Hierarchy

README = Path(__file__).parents[1] / "README.md"


def declared() -> Hierarchy:
    """The hierarchy that README's first block of Python declares."""
    code = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.S)[0]
    names: dict[str, Any] = {"__name__": "readme"}
    exec(compile(code[: code.index("run = hierarchy.train")], str(README), "exec"), names)
    found: Hierarchy = names["hierarchy"]
    return found


def learn(seed: int) -> dict[str, Any]:
    hierarchy = declared()
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", seed=seed, quiet=True)
        scores = {s.name: run.evaluate(100, skill=s.name).mean for s in hierarchy.skills}
        whole, stages = run.evaluate(100).mean, run.info()["stages"]
    alone = {name: round(score, 1) for name, score in scores.items()}
    seconds = round(sum(p["seconds"] for p in stages), 1)
    return {"seed": seed, **alone, "hierarchy": round(whole, 1), "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    rows = []
    for seed in parser.parse_args().seeds:
        rows.append(learn(seed))
        print(table(list(rows[0]), [list(r.values()) for r in rows]), flush=True)
    scores = [r["hierarchy"] for r in rows]
    report("first-example", {"median": median(scores), "worst": min(scores), "rows": rows})


if __name__ == "__main__":
    main()
