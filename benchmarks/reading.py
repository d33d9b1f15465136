"""What must be read to follow one gradient from the environment to the weights.

    python -m benchmarks.reading

One round of training (collect, keep, learn) is watched: which files of the library have functions
that run, how many lines these files have, and how many lines the functions have that ran.
"""

from __future__ import annotations

import inspect
import json
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import skillweave
from skillweave import PPO, SAC, EnvSpec
from skillweave.algorithms.registry import make_algorithm
from skillweave.collecting.acting import Acting
from skillweave.collecting.group import Collectors
from skillweave.seeding import Seeds
from skillweave.training.episodes import Episodes
from skillweave.training.learner import Stack
from skillweave.training.loop import train
from skillweave.training.replay_learner import learner_of
from skillweave.training.scene import skill_scene

ROOT = Path(skillweave.__file__).parent


def one_round(env: str, config: Any, steps: int) -> Callable[[], None]:
    """A function that collects and learns, everything made before."""
    scene = skill_scene(EnvSpec(env, engine="sync"))
    algorithm = make_algorithm(config, scene.observation_space, scene.action_space)
    stack = Stack(algorithm, algorithm.init([Seeds(0)]))
    learner = learner_of(stack, config.num_envs, Seeds(0))
    acting = Acting([(algorithm, 1)], config.num_envs)
    collectors = Collectors([scene.collector(config.num_envs, acting)])
    return lambda: void(train(learner, collectors, Episodes(), Seeds(0), steps))


def void(_: Any) -> None:
    """Nothing."""


def watched(run: Callable[[], None]) -> set[CodeType]:
    """The library's functions that ran."""
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


def main() -> None:
    figures = {}
    for name, env, config in (
        ("PPO", "CartPole-v1", PPO(num_envs=4, n_steps=32)),
        ("SAC", "Pendulum-v1", SAC(num_envs=4, learning_starts=8)),
    ):
        codes = watched(one_round(env, config, 256))
        files = sorted({c.co_filename for c in codes})
        named = {
            Path(f).relative_to(ROOT).as_posix(): len(Path(f).read_text().splitlines())
            for f in files
        }
        ran = sum(len(inspect.getsourcelines(c)[0]) for c in codes if not c.co_name.startswith("<"))
        figures[name] = {"files": len(named), "lines": sum(named.values()), "of functions": ran}
        for file, lines in named.items():
            print(f"{name}  {lines:4}  {file}")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
