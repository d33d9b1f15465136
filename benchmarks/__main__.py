"""``make bench``: the quick ones. ``make figures`` runs all of them on all seeds (many hours)."""

from __future__ import annotations

import sys

from benchmarks.common import run_command

QUICK = (
    ["startup"],
    ["report"],
    ["updates"],
    ["acting"],
    ["replay"],
    ["speed", "--seeds", "0"],
    ["off_policy", "--seeds", "0", "--sizes", "small"],
    ["population", "--seeds", "0"],
    ["flat", "--seeds", "0"],
)
ALL = (
    ["startup"],
    ["report"],
    ["updates"],
    ["acting"],
    ["speed"],
    ["flat"],
    ["hierarchy"],
    ["hierarchy", "--apart", "--no-flat"],
    ["ablation"],
    ["replay"],
    ["off_policy"],
    ["learning"],
    ["mixed"],
    ["population"],
    ["collecting"],
    ["reading"],
    ["search"],
    ["four_rooms"],
    ["together"],
    ["nested"],
    ["one_skill"],
    ["export"],
)


def main() -> None:
    for name, *arguments in ALL if "--all" in sys.argv else QUICK:
        print(f"== {name}", flush=True)
        run_command([sys.executable, "-m", f"benchmarks.{name}", *arguments])


if __name__ == "__main__":
    main()
