"""Figure 9: how long ``skillweave --help`` takes, against ``python -c pass`` in the same run."""

from __future__ import annotations

import sys
import time

from benchmarks.common import median, report, run_command


def seconds(*arguments: str) -> float:
    times = []
    for _ in range(10):
        started = time.perf_counter()
        run_command([sys.executable, *arguments], capture=True)
        times.append(time.perf_counter() - started)
    return median(times)


def main() -> None:
    bare, ours = seconds("-c", "pass"), seconds("-m", "skillweave", "--help")
    report("startup", {"help_seconds": ours, "bare_python_seconds": bare, "ratio": ours / bare})


if __name__ == "__main__":
    main()
