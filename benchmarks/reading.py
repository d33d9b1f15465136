"""Length of the code to read in order to follow one gradient from environment to weights.

    python -m benchmarks.reading

A few rounds of training (collect, keep, learn) are watched: which files of the library have
functions that run, how many lines these files have, and how many lines the functions have that ran.
Beside it stands the walk through them that ``docs/one-gradient.md`` proposes.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import skillweave
from skillweave import PPO, SAC, EnvSpec, SkillweaveError
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.registry import make_algorithm
from skillweave.experience.acting import Acting
from skillweave.experience.group import Collectors
from skillweave.training.episodes import Episodes
from skillweave.training.learner import Stack
from skillweave.training.learning_task import skill_task
from skillweave.training.loop import Loop
from skillweave.training.role import agent_role
from skillweave.training.stack_learner import learner_of

ROOT = Path(skillweave.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "one-gradient.md"
ROUNDS: dict[str, tuple[str, Any]] = {
    "PPO": ("CartPole-v1", PPO(num_envs=4, n_steps=32)),
    "SAC": ("Pendulum-v1", SAC(num_envs=4, learning_starts=8)),
}


def one_round(env: str, config: Any, steps: int) -> Callable[[], None]:
    """Return a function that collects and learns, everything made before."""
    learning_task = skill_task(agent_role(EnvSpec(env, engine="sync")))
    algorithm = make_algorithm(config, *learning_task.role.spaces)
    stack = Stack(algorithm, algorithm.init([Seeds(0)]))
    learner = learner_of(stack, config.num_envs, Seeds(0))
    acting = Acting([(algorithm, 1)], config.num_envs)
    collectors = Collectors([learning_task.collector(config.num_envs, acting)])
    return lambda: void(Loop(learner, collectors, Episodes(), Seeds(0), steps).run())


def void(_: Any) -> None:
    """Nothing."""


def watched(run: Callable[[], None]) -> set[CodeType]:
    """Return the library's functions that ran."""
    found: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(ROOT)):
            found.add(frame.f_code)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        run()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return found


def walk(algorithm: str) -> dict[str, list[str]]:
    """Return by file the functions that the page names for this algorithm."""
    section = PAGE.read_text().split(f"## {algorithm}")[1].split("\n## ")[0]
    found: dict[str, list[str]] = {}
    for line in section.splitlines():
        if line.startswith("| `"):
            _, file, functions, *_ = line.split("|")
            found.setdefault(file.strip(" `"), []).extend(re.findall(r"`([^`]+)`", functions))
    return found


def lines_of(codes: set[CodeType]) -> int:
    """Return the lines of functions, docstrings included; of one inside another, once."""
    return sum(len(inspect.getsourcelines(c)[0]) for c in codes if "<" not in c.co_qualname)


def file_of(code: CodeType) -> str:
    """Relative to the package."""
    return Path(code.co_filename).relative_to(ROOT).as_posix()


def on_the_walk(algorithm: str, codes: set[CodeType]) -> set[CodeType]:
    """Those of the functions that ran which the page names.

    Raises:
        SkillweaveError: it names one that did not run.
    """
    by_name = {(file_of(c), c.co_qualname): c for c in codes}
    named = {(file, name) for file, names in walk(algorithm).items() for name in names}
    if missing := named - by_name.keys():
        listed = ", ".join(f"{name} in {file}" for file, name in sorted(missing))
        raise SkillweaveError(f"{PAGE.name}, {algorithm}: these did not run: {listed}")
    return {by_name[place] for place in named}


def counted(codes: set[CodeType], sizes: dict[str, int]) -> dict[str, int]:
    """Return the number of files and lines of functions; ``sizes``: the lines of whole files."""
    files = {file_of(c) for c in codes}
    whole = sum(sizes[file] for file in files)
    return {"files": len(files), "lines": lines_of(codes), "of whole files": whole}


def main() -> None:
    figures = {}
    for name, (env, config) in ROUNDS.items():
        codes = watched(one_round(env, config, 256))
        sizes = {f: len((ROOT / f).read_text().splitlines()) for f in {file_of(c) for c in codes}}
        parts = {"walk": on_the_walk(name, codes), "all that runs": codes}
        figures[name] = {part: counted(found, sizes) for part, found in parts.items()}
        for file, lines in sorted(sizes.items()):
            print(f"{name}  {lines:4}  {file}")
    print(json.dumps(figures))


if __name__ == "__main__":
    try:
        main()
    except SkillweaveError as error:
        sys.exit(f"error: {error}")
