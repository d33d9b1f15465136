"""An exported hierarchy against the policy that it was made of: same actions, and how fast.

    python -m benchmarks.export [--episodes 1000] [--scale 0.02] [--recipe lunar-lander]

The recipe is trained briefly and exported. Then the policy here plays whole episodes, and the
runner is shown the same observations. Where actions differ, the two best actions of the network
that decides are compared: what differs by less than rounding is a tie. Times are
for one observation, on one thread, in turn on the same observations, so the ratio is what counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import median, report, table
from skillweave import Player, Run, recipes
from skillweave.types import Array, HierarchyPolicy

TIE = 1e-4
"""Two actions whose logits differ by less may be swapped by rounding."""


def agreement(run: Run, runner: Any, episodes: int) -> dict[str, Any]:
    """Whole episodes; the runner's memory follows from its own choices until they differ."""
    player, spec = run.player(), run.declaration.spec
    env, alike, steps, gaps = spec.make(), 0, 0, []
    for episode in range(episodes):
        obs, _ = env.reset(seed=episode)
        player.reset()
        runner.reset()
        over, same = False, True
        while not over:
            action = player.act(obs)
            if same and not np.array_equal(runner.act(obs), action):
                same = False
                gaps.append(gap(run, player, obs))
            steps += same
            obs, _, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
        alike += same
    env.close()
    ties = sum(g < TIE for g in gaps)
    return {"episodes": episodes, "alike": alike, "ties": ties, "steps": steps, "gaps": gaps[:20]}


def gap(run: Run, player: Player, obs: Array) -> float:
    """Return the least lead of the best action over the next: of selector and acting skill."""
    policy = run.policy
    assert isinstance(policy, HierarchyPolicy)
    acting = policy.skills.policies[int(player.memory["skill"][0])]
    found = []
    for network in (policy.selector, acting):
        best = np.sort(network.heads(obs[None])[0])[::-1]  # type: ignore[union-attr]
        found.append(float(best[0] - best[1]))
    return min(found)


def seconds(act: Callable[[Any], Any], reset: Callable[[], None], seen: list[Array]) -> float:
    """Return the seconds of one call, over all observations."""
    reset()
    started = time.perf_counter()
    for obs in seen:
        act(obs)
    return (time.perf_counter() - started) / len(seen)


def observations(run: Run, steps: int) -> list[Array]:
    """Return what the policy sees in its own episodes."""
    env: gym.Env[Any, Any] = run.declaration.spec.make()
    seen: list[Array] = []
    while len(seen) < steps:
        obs, _ = env.reset(seed=len(seen))
        run.reset()
        over = False
        while not over:
            seen.append(obs)
            obs, _, terminated, truncated, _ = env.step(run.act(obs))
            over = terminated or truncated
    env.close()
    return seen[:steps]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--scale", type=float, default=0.02, help="of the recipe's budgets")
    parser.add_argument("--recipe", default="lunar-lander")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=7, help="of the timing")
    given = parser.parse_args()
    import torch

    torch.set_num_threads(1)
    hierarchy = recipes.load(given.recipe)
    hierarchy.scale(given.scale)
    with tempfile.TemporaryDirectory() as folder:
        run = hierarchy.train(Path(folder) / "run", seed=given.seed, quiet=True)
        started = time.perf_counter()
        export = run.export(Path(folder) / "onnx")
        exporting = time.perf_counter() - started
        from skillweave.export.runner import Runner

        runner = Runner(export.path, export.functions)
        seen, times = observations(run, 2_000), []
        seconds(runner.act, runner.reset, seen)  # warm
        for _ in range(given.rounds):
            ours = seconds(run.act, run.reset, seen)
            theirs = seconds(runner.act, runner.reset, seen)
            times.append((ours, theirs, ours / theirs))
        found = agreement(run, runner, given.episodes)
    here, there, ratio = (median(t[i] for t in times) for i in range(3))
    result = found | {
        "export_s": exporting,
        "here_us": 1e6 * here,
        "runner_us": 1e6 * there,
        "ratio": ratio,
        "runner_us_best": 1e6 * min(t[1] for t in times),
    }
    row = ("episodes", "alike", "ties", "steps", "here_us", "runner_us", "ratio")
    print(table(row, [[f"{result[k]:.4g}" for k in row]]))
    report("export", result)


if __name__ == "__main__":
    main()
