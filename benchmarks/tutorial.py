"""The tutorial's full training code, here and on the library that it was written for.

    python -m benchmarks.tutorial [--episodes 20] [--agilerl PYTHON] [--text FILE]

The script is taken from the text; only the number of episodes is changed, and here the import
root. ``--agilerl`` names an interpreter that has ``agilerl==0.1.22`` and what the script imports
(it needs gymnasium 0.28 with Box2D, and NumPy 1). Both run without a login to Weights & Biases.
Also the time of ``getAction`` on one observation, actor and critic with 2×64 units.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import median, report, run_command

ROOT = Path(__file__).parents[1]
TEXT = ROOT / "tests/compat/tutorial.txt"


def script(text: Path, episodes: int, root: str) -> str:
    """Return the full training code with ``episodes``, on the library under ``root``."""
    code = text.read_text().split("Full training code\n\nFull code\n")[1]
    code = code.replace('"EPISODES": 1000', f'"EPISODES": {episodes}')
    return re.sub(r"^from agilerl\b", f"from {root}", code, flags=re.M)


def seconds(python: str, code: str) -> tuple[float, float]:
    """Return wall and processor seconds of a script in a process and a folder of its own.

    The interpreter's start is included. On a busy machine the processors' is the one to compare.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "full.py"
        path.write_text(code)
        env = os.environ | {
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "2",
            "WANDB_MODE": "offline",
        }
        start, before = time.perf_counter(), os.times()
        done = run_command([python, path.name], cwd=folder, env=env, capture=True, check=False)
        if done.returncode:
            sys.exit(f"{python} failed: {done.stderr[-2000:]}")
        after = os.times()
        spent = after.children_user - before.children_user
        spent += after.children_system - before.children_system
        return time.perf_counter() - start, spent


def acting(calls: int = 5_000) -> float:
    """Return microseconds of ``getAction`` on one observation; the median of 5 runs."""
    from skillweave.compat.agilerl.algorithms.ppo import PPO

    agent, obs = PPO([8], 4, False, True), np.zeros((1, 8), np.float32)
    found = []
    for _ in range(5):
        start = time.perf_counter()
        for _ in range(calls):
            agent.getAction(obs)
        found.append((time.perf_counter() - start) / calls * 1e6)
    return median(found)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--agilerl", help="an interpreter that has agilerl 0.1.22")
    parser.add_argument("--text", type=Path, default=TEXT)
    given = parser.parse_args()
    result: dict[str, Any] = {"getAction_us": acting()}
    ours = script(given.text, given.episodes, "skillweave.compat.agilerl")
    result["seconds"], result["cpu_seconds"] = seconds(sys.executable, ours)
    if given.agilerl:
        theirs = seconds(given.agilerl, script(given.text, given.episodes, "agilerl"))
        result["agilerl_seconds"], result["agilerl_cpu_seconds"] = theirs
        result["ratio"] = result["seconds"] / theirs[0]
        result["cpu_ratio"] = result["cpu_seconds"] / theirs[1]
    report("tutorial", result)


if __name__ == "__main__":
    main()
