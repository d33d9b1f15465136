"""Goals that pay where they are reached, with and without hindsight.

    python -m benchmarks.hindsight [reach push maze maze-skill …] [--seeds 0 1] [--without]

Environments of Gymnasium-Robotics with their sparse rewards; a plain agent, and in ``maze-skill``
a skill ``go_to`` that is trained apart and scored alone. A score is over 100 episodes after
training. rl-zoo3's TQC with hindsight, tuned, has −1.66 on reach and −8.8 on push (1M steps).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import report, table, workers
from skillweave import SAC, EnvSpec, Hierarchy, Network, Skill, Step, train_agent
from skillweave.types import Array

EPISODES = 100
MAZE = "PointMaze_UMaze-v3"
CELLS = np.array([(-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1)])
"""The middles of the maze's free cells, in metres."""
THERE = 0.45
"""Metres from the goal at which it is reached."""


@dataclass(frozen=True)
class Case:
    """What is trained, and for how many steps."""

    env: str
    steps: int
    algorithm: SAC
    skill: bool = False


CASES = {
    "reach": Case("FetchReach-v4", 20_000, SAC()),
    "push": Case(
        "FetchPush-v4", 500_000, SAC(gamma=0.95, tau=0.05, network=Network((256, 256), "relu"))
    ),
    "maze": Case(MAZE, 300_000, SAC()),
    "maze-skill": Case(MAZE, 300_000, SAC(), skill=True),
}


def robotics(env_id: str) -> gym.Env[Any, Any]:
    """Make an environment of Gymnasium-Robotics, which importing it registers."""
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    return gym.make(env_id)


class GoTo(Skill):
    """Roll to a point anywhere in the maze: −1 for each step until it is there."""

    goal_space = gym.spaces.Box(-1.5, 1.5, (2,), np.float64)
    max_steps = 300

    def goals(self, obs: Array, rng: np.random.Generator) -> Array:
        """Return points in free cells."""
        n = len(obs)
        return CELLS[rng.integers(len(CELLS), size=n)] + rng.uniform(-0.4, 0.4, (n, 2))

    def near(self, step: Step) -> Array:
        """Return where the point is reached."""
        away = np.linalg.norm(step.next_obs["achieved_goal"] - step.goal, axis=1)
        found: Array = away < THERE
        return found

    def reward(self, step: Step) -> Array:
        """Return −1, and 0 where the point is reached."""
        return self.near(step) - 1.0

    def termination(self, step: Step) -> Array:
        """Return where the point is reached."""
        return self.near(step)

    def success(self, step: Step) -> Array:
        """Return where the point is reached."""
        return self.near(step)

    def achieved_goal(self, obs: Array) -> Array:
        """Return where the ball is."""
        reached: Array = obs["achieved_goal"]
        return reached


class Stay(Skill):
    """Push nowhere."""

    max_steps = 1

    def policy(self, obs: Array) -> Array:
        """Return no force."""
        return np.zeros((len(obs), 2), np.float32)


def to_goal(obs: Array) -> tuple[Array, Array]:
    """Return the skill and its goal: the environment's."""
    return np.full(len(obs), "go_to"), obs["desired_goal"]


def score(name: str, seed: int, hindsight: bool) -> dict[str, Any]:
    """Train a case; return its mean return, the share that succeeds, and minutes of processor."""
    case = CASES[name]
    algorithm = replace(case.algorithm, hindsight=hindsight)
    spec = EnvSpec(robotics, kwargs={"env_id": case.env}, workers=1)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        if case.skill:
            skill = GoTo()
            skill.algorithm = algorithm
            hierarchy = Hierarchy(
                spec, [skill, Stay()], selector=to_goal, learn="apart", steps=case.steps
            )
            found = hierarchy.train(path, seed=seed, quiet=True).evaluate(
                EPISODES, skill="go_to", seed=1, quiet=True
            )
            called = found.skills["go_to"]
            share = (called.succeeded or 0) / called.calls
            mean = (called.return_sum or 0.0) / called.calls
        else:
            agent = train_agent(spec, algorithm, case.steps, path, seed=seed, quiet=True)
            found = agent.evaluate(EPISODES, seed=1, quiet=True)
            once = found.succeeded_once if case.env == MAZE else found.succeeded
            share, mean = (once or 0) / EPISODES, found.mean
    minutes = (time.process_time() - began) / 60
    return {
        "case": name,
        "seed": seed,
        "hindsight": hindsight,
        "success": round(share, 2),
        "return": round(mean, 2),
        "minutes": round(minutes, 1),
    }


def main() -> None:
    """Train the cases of the command line, and print their scores."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("cases", nargs="*", default=["reach"], choices=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--without", action="store_true", help="without hindsight")
    asked = parser.parse_args()
    jobs = [(case, seed, not asked.without) for case in asked.cases for seed in asked.seeds]
    found = []
    with workers(2) as pool:
        for row in [pool.submit(score, *job) for job in jobs]:
            found.append(row.result())
            print(found[-1], flush=True)
    print(table(list(found[0]), [list(row.values()) for row in found]))
    report("hindsight", {"scores": found})


if __name__ == "__main__":
    main()
