"""Speed of collecting: in one process and in several, and with calls of any length.

    python -m benchmarks.collecting [workers] [calls] [together] [--rounds 3] [--steps 40000]

``workers``: PPO on MiniGrid's DoorKey-8x8 in Python, by two workers, by one, by Stable-Baselines3
with ``SubprocVecEnv`` (the same network, rollouts and epochs), and the same number of environments
stepped alone in two processes. ``calls``: a selector on EnvPool's LunarLander whose calls last 1 to
64 steps at random, against the same selector with all calls of 32. ``together``: the recipe
``lunar-lander``, whose selector learns over skills that stay as they are, then all together: as it
is, with the task's advantage for skills, and with the settings of ``chains.LANDER_TOGETHER``.
Ratios are of steps per second by the clock, within a round; the median round counts.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import machine
from skillweave import PPO, Apart, EnvSpec, Hierarchy, Network, Skill, recipes, train_agent
from skillweave.cli.overrides import apply_overrides
from skillweave.types import Array, Step
from skillweave.workers import Ray

GRID = "MiniGrid-DoorKey-8x8-v0"
ENVS, ROWS, EPOCHS, BATCH = 32, 128, 4, 1024
NETWORK = Network((64, 64), "tanh")


class Flat(gym.ObservationWrapper[Any, Any, Any]):
    """MiniGrid's 7 × 7 cells in view as numbers: kinds, and shut doors."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0.0, 10.0, (50,), np.float32)

    def observation(self, observation: Any) -> Any:
        image = observation["image"]
        return np.append(image[..., 0], image[..., 2].max()).astype(np.float32)


def grid(render_mode: str | None = None) -> gym.Env[Any, Any]:
    import minigrid  # registers the environments

    assert minigrid
    return Flat(gym.make(GRID, render_mode=render_mode))


def ours(workers: int, steps: int, cluster: Ray | None = None, env: Any = grid) -> float:
    config = PPO(
        num_envs=ENVS,
        n_steps=ROWS,
        batch_size=BATCH,
        update_epochs=EPOCHS,
        network=NETWORK,
        normalize_obs=False,
    )
    with tempfile.TemporaryDirectory() as folder:
        spec = EnvSpec(env, engine="sync", workers=workers)
        run = train_agent(spec, config, steps, Path(folder) / "run", quiet=True, cluster=cluster)
        return float(run.info()["stages"][0]["steps_per_second"])


def stable_baselines(steps: int) -> float:
    import torch
    from stable_baselines3 import PPO as Theirs
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    torch.set_num_threads(1)
    env = make_vec_env(grid, ENVS, vec_env_cls=SubprocVecEnv)
    model = Theirs(
        "MlpPolicy",
        env,
        n_steps=ROWS,
        batch_size=BATCH,
        n_epochs=EPOCHS,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64]},
    )
    began = time.perf_counter()
    model.learn(steps)
    found = model.num_timesteps / (time.perf_counter() - began)
    env.close()
    return found


def _step_alone(steps: int, ready: Any) -> None:
    envs = [grid() for _ in range(ENVS // 2)]
    for i, env in enumerate(envs):
        env.reset(seed=i)
    actions = np.random.default_rng(0).integers(7, size=(steps // ENVS, len(envs)))
    ready.wait()
    for row in actions:
        for env, action in zip(envs, row, strict=True):
            _, _, terminated, truncated, _ = env.step(int(action))
            if terminated or truncated:
                env.reset()


def alone(steps: int) -> float:
    """Return the environments of two workers, stepped by two processes that do nothing else."""
    context = multiprocessing.get_context("fork")
    ready = context.Barrier(3)
    processes = [context.Process(target=_step_alone, args=(steps, ready)) for _ in range(2)]
    for process in processes:
        process.start()
    ready.wait()
    began = time.perf_counter()
    for process in processes:
        process.join()
    return steps / (time.perf_counter() - began)


class Glide(Skill):
    """Any reward will do; calls end at random, where ``ends`` is set."""

    ends = True

    def reward(self, step: Step) -> Array:
        return step.reward

    def termination(self, step: Step) -> Array:
        if not self.ends:
            return np.zeros(len(step.reward), bool)
        # As if the length were drawn evenly from 1 to 64 when the call begins: what is left of 64
        # steps ends now with this chance. A function of the state, so that it can be repeated.
        chance = 1.0 / np.maximum(1, 65 - step.elapsed)
        digits = np.abs(step.next_obs[:, :6].astype(np.float64)).sum(1) * 1e4
        ends: Array = digits % 1.0 < chance
        return ends


def calls(random_lengths: bool, steps: int) -> float:
    skills = [type(name, (Glide,), {"ends": random_lengths})() for name in ("One", "Two", "Three")]
    small = PPO(num_envs=64, n_steps=64, update_epochs=4, network=Network((64, 64), "tanh"))
    hierarchy = Hierarchy(
        "LunarLander-v3",
        skills,
        call_steps=64 if random_lengths else 32,
        algorithm=small,
        selector=PPO(num_envs=256, n_steps=256, update_epochs=4, network=NETWORK),
        apart=Apart(skill_steps=5_000, selector_steps=steps),
    )
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", quiet=True)
        return float(run.info()["stages"][-1]["steps_per_second"])


TOGETHER: dict[str, list[str]] = {
    "as in the recipe": [],
    "without the task's advantage": ["together.task_weight=0"],
}
"""By name, what is changed in the recipe."""


def together(changed: list[str], steps: int) -> tuple[float, float]:
    """Measure the selector over frozen skills, then all learners together."""
    hierarchy = recipes.load("lunar-lander")
    budgets = ["apart.skill_steps=5000", "skills.landing.steps=5000"]
    budgets += [f"apart.selector_steps={steps}"]
    budgets += ["learn=apart, then together", f"together.steps={steps}"]
    apply_overrides(hierarchy, budgets + changed)
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", quiet=True)
        selector, after = (float(s["steps_per_second"]) for s in run.info()["stages"][-2:])
    return selector, after


def compared(
    measure: Callable[[], dict[str, float]], ratios: dict[str, tuple[str, str]], rounds: int
) -> dict[str, Any]:
    """Return steps per second by name, measured once a round, and the median of ratios."""
    found: list[dict[str, float]] = []
    for _ in range(rounds):
        found.append(measure())
        print({k: round(v) for k, v in found[-1].items()}, flush=True)
    speeds = {k: statistics.median(f[k] for f in found) for k in found[0]}
    return {"steps per second": {k: round(v) for k, v in speeds.items()}} | {
        name: round(statistics.median(f[a] / f[b] for f in found), 3)
        for name, (a, b) in ratios.items()
    }


def of_workers(steps: int) -> dict[str, float]:
    return {
        "two workers": ours(2, steps),
        "one": ours(1, steps),
        "Stable-Baselines3": stable_baselines(steps),
        "environments alone": alone(steps),
    }


def of_calls(steps: int) -> dict[str, float]:
    return {"1 to 64": calls(True, steps), "32": calls(False, steps)}


def of_together(steps: int) -> dict[str, float]:
    found: dict[str, float] = {}
    for name, changed in TOGETHER.items():
        found[f"selector, {name}"], found[name] = together(changed, steps)
    return found


def main() -> None:
    others = ("one", "Stable-Baselines3", "environments alone")
    # By name: what measures a round, how many times the steps it takes, and the ratios.
    every: dict[str, tuple[Callable[[int], dict[str, float]], int, dict[str, tuple[str, str]]]] = {
        "workers": (of_workers, 1, {f"two workers / {k}": ("two workers", k) for k in others}),
        "calls": (of_calls, 10, {"calls of 1 to 64 / calls of 32": ("1 to 64", "32")}),
        "together": (
            of_together,
            10,
            {f"{k} / selector alone": (k, f"selector, {k}") for k in TOGETHER},
        ),
    }
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("which", nargs="*", default=list(every))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=40_960)
    given = parser.parse_args()
    if unknown := [name for name in given.which if name not in every]:
        parser.error(f"there is no {unknown[0]!r}: {', '.join(every)}")
    summary: dict[str, Any] = {"machine": machine()}
    for name in given.which:
        measure, times, ratios = every[name]
        summary[name] = compared(partial(measure, times * given.steps), ratios, given.rounds)
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
