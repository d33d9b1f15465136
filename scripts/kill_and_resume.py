"""Kill a training run at random moments, resume it each time, and compare it with a whole one.

    python scripts/kill_and_resume.py lunar-lander --kills 10 --seed 0 --set skill_steps=50000

Trains RECIPE once without interruption; then once more, sending SIGKILL at random moments and
running ``skillweave resume`` after each, until it is finished. Then every policy file must be the
same bit for bit, and no line of metrics.jsonl may stand twice. Exit code 0: so it is; 1: it is not.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STARTUP_SHARE = 0.2  # of the kills come while a process starts, the rest while it trains
LATE = 0.05  # seconds, the longest that a kill comes after its moment: it may fall into any write


@dataclass
class Kill:
    """One kill: when it was to come, and what it hit."""

    moment: str
    code: int
    at: str
    saved: str


def main() -> int:
    """Train twice, kill, resume, compare."""
    options = parse()
    out = options.out or Path(tempfile.mkdtemp(prefix="kill-and-resume-"))
    whole, killed = out / "whole", out / "killed"
    for path in (whole, killed):
        if path.exists():
            sys.exit(f"{path} exists already; choose another --out")
    rng = random.Random(options.seed)
    print(f"recipe {options.recipe}, kills {options.kills}, seed {options.seed}, in {out}")
    finish(train_command(options, whole), "the uninterrupted run")
    kills = kill_and_resume(options, killed, len(records(whole)), rng)
    print_table(kills)
    found = differences(killed, whole)
    for path in sorted((whole / "policies").iterdir()):
        equal = not any(path.name in line for line in found)
        print(f"  policies/{path.name:<32} {'identical' if equal else 'DIFFERENT'}")
    for line in found:
        print(f"  {line}")
    hits = sum(k.code == -9 for k in kills)
    print(f"{hits} of {options.kills} kills hit; {'no difference' if not found else 'DIFFERENT'}")
    if options.out is None and not found:
        shutil.rmtree(out)
    return 1 if found or hits == 0 else 0


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("recipe", help="a shipped recipe's name or a Python file")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    parser.add_argument("--train-seed", type=int, default=0, help="of the training")
    parser.add_argument("--set", action="append", default=[], help="NAME=VALUE, as in skillweave")
    parser.add_argument("--scale", type=float, default=1.0, help="multiplies every budget")
    parser.add_argument("--flat", action="store_true", help="the flat baseline instead")
    parser.add_argument("--out", type=Path, help="where the runs go; default: a temporary folder")
    return parser.parse_args()


def train_command(options: argparse.Namespace, run: Path) -> list[str]:
    """``skillweave train`` into ``run``."""
    command = [sys.executable, "-m", "skillweave", "train", options.recipe, "--out", str(run)]
    command += ["--seed", str(options.train_seed), "--scale", str(options.scale)]
    command += [part for setting in options.set for part in ("--set", setting)]
    return command + ["--flat"] * options.flat + ["--evaluate", "0", "--quiet"]


def resume_command(options: argparse.Namespace, run: Path) -> list[str]:
    """``skillweave resume`` of ``run``."""
    command = [sys.executable, "-m", "skillweave", "resume", str(run), "--recipe", options.recipe]
    return [*command, "--evaluate", "0", "--quiet"]


def kill_and_resume(
    options: argparse.Namespace, run: Path, total: int, rng: random.Random
) -> list[Kill]:
    """Kill ``run`` at rising random numbers of its ``total`` updates, then let it finish."""
    updates = sorted(rng.randrange(total) for _ in range(options.kills))
    kills = []
    for number in updates:
        command = resume_command(options, run) if started(run) else train_command(options, run)
        if not started(run) and run.exists():
            shutil.rmtree(run)  # killed before there was a run: begin again
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        late = rng.uniform(0.0, LATE)
        if rng.random() < STARTUP_SHARE:
            wait = rng.uniform(0.0, 5.0)
            moment = f"{wait:.3f} s after the start"
            end_by = time.monotonic() + wait
            while process.poll() is None and time.monotonic() < end_by:
                time.sleep(0.001)
        else:
            moment = f"{late * 1000:.0f} ms after update {number}"
            while process.poll() is None and len(records(run)) <= number:
                time.sleep(0.001)
            time.sleep(late)
        process.kill()
        _, error = process.communicate()
        if process.returncode not in (0, -9):
            sys.exit(f"a resumed run failed with code {process.returncode}: {error.decode()}")
        kills.append(Kill(moment, process.returncode, position(run), saved(run)))
    if not started(run):
        shutil.rmtree(run, ignore_errors=True)
        finish(train_command(options, run), "the killed run")
    else:
        finish(resume_command(options, run), "the killed run")
    return kills


def finish(command: list[str], what: str) -> None:
    """Run a command to its end, which must be a good one."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{what} failed with code {done.returncode}: {done.stderr}")


def started(run: Path) -> bool:
    """Whether there is a run to resume."""
    return (run / "run.json").exists()


def records(run: Path) -> list[dict[str, Any]]:
    """The whole lines of ``metrics.jsonl``."""
    path = run / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def position(run: Path) -> str:
    """How far training had come."""
    found = records(run)
    if not found:
        return "before the first update"
    return f"{found[-1]['phase']} update {found[-1]['update']} ({len(found)} in all)"


def saved(run: Path) -> str:
    """What the latest checkpoint holds, from its header alone."""
    for name in ("checkpoint", "checkpoint.previous"):
        path = run / f"{name}.safetensors"
        if path.exists():
            data = path.read_bytes()
            size = int.from_bytes(data[:8], "little")
            header = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["skillweave"])
            return f"{header['phase']} update {header['update']}"
    return "nothing yet"


def differences(run: Path, whole: Path) -> list[str]:
    """What distinguishes two finished runs; empty where they are the same."""
    found = []
    files = {p.name for r in (run, whole) for p in (r / "policies").iterdir()}
    for name in sorted(files):
        mine, theirs = run / "policies" / name, whole / "policies" / name
        if not mine.exists() or not theirs.exists():
            found.append(f"{name}: only in {mine.parent if mine.exists() else theirs.parent}")
        elif mine.read_bytes() != theirs.read_bytes():
            same = weights(mine) == weights(theirs)
            found.append(
                f"{name}: {'the same weights in other bytes' if same else 'other weights'}"
            )
    mine_keys, their_keys = ([(r["phase"], r["update"]) for r in records(p)] for p in (run, whole))
    if len(set(mine_keys)) != len(mine_keys):
        found.append("metrics.jsonl: a line stands twice")
    elif mine_keys != their_keys:
        found.append("metrics.jsonl: other updates")
    return found


def weights(path: Path) -> bytes:
    """The tensors of a safetensors file."""
    data = path.read_bytes()
    return data[8 + int.from_bytes(data[:8], "little") :]


def print_table(kills: list[Kill]) -> None:
    """A row for each kill."""
    print(f"{'#':>4}  {'moment':<30} {'ended':<9} {'position':<36} {'saved'}")
    for number, kill in enumerate(kills, 1):
        ended = "killed" if kill.code == -9 else "finished"
        print(f"{number:>4}  {kill.moment:<30} {ended:<9} {kill.at:<36} {kill.saved}")


if __name__ == "__main__":
    sys.exit(main())
