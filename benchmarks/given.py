"""What was given is kept: clones that learn on, and SAC where the end alone pays.

    python -m benchmarks.given [lander cartpole cup chain half ends] [--seeds 10 11 12 13 14]

lander, cartpole, cup, chain: a clone of a controller learns on for 50,000 steps by the defaults,
evaluated each 5,000 (50 episodes, the weights of that time): start, lowest, last. half: clones of
few, noisy episodes, by the defaults and with ``PPO(learning_rate=3e-4, target_kl=0.02,
ent_coef=0.0)``. ends: SAC with hindsight, and with demonstrations, where the goal pays 1 and ends
the episode, beside -1 for each step until there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.common import report, workers
from skillweave import PPO, SAC, Dataset, Hierarchy, Network, Skill, record, train_agent
from skillweave.types import Array, Step

STEPS, EVERY, EPISODES = 50_000, 5_000, 50
PLATE = (-20, 35)
BY_HAND = PPO(learning_rate=3e-4, target_kl=0.02, ent_coef=0.0)


class Cup(gym.Env[Any, Any]):
    """A hand fetches a cup and puts it on a plate; that pays 1 and ends the episode."""

    observation_space = gym.spaces.Box(-99, 99, (5,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    cost = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.hand = self.np_random.uniform(-40, 0, 2)
        self.cup = self.np_random.uniform(0, 40, 2)
        self.holds, self.steps = False, 0
        return self.seen(), {}

    def seen(self) -> Array:
        return np.array([*self.hand, *self.cup, self.holds], np.float32)

    def step(self, action: Array) -> Any:
        self.hand = np.clip(self.hand + 6 * np.asarray(action[:2]), -50, 50)
        if not self.holds and action[2] > 0.3 and np.linalg.norm(self.hand - self.cup) < 4:
            self.holds = True
        elif self.holds and action[2] < -0.3:
            self.holds = False
        self.cup = self.hand.copy() if self.holds else self.cup
        self.steps += 1
        won = not self.holds and bool(np.linalg.norm(self.cup - PLATE) < 5)
        return self.seen(), float(won) - self.cost, won, self.steps >= 120, {"success": won}


class CostlyCup(Cup):
    """The same; each step until there pays -1."""

    cost = 1.0


class Line(gym.Env[Any, Any]):
    """Go to a place on a line, which pays 1 and ends the episode."""

    _box = gym.spaces.Box(-1, 1, (1,), np.float32)
    observation_space = gym.spaces.Dict(observation=_box, achieved_goal=_box, desired_goal=_box)
    action_space = _box
    cost = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.uniform(-1, 1, (2, 1)).astype(np.float32)
        self.steps = 0
        return self.seen(), {}

    def seen(self) -> Any:
        here = self.place.copy()
        return {"observation": here, "achieved_goal": here, "desired_goal": self.goal}

    def compute_terminated(self, achieved: Array, desired: Array, info: Any) -> Any:
        return np.abs(achieved - desired)[..., 0] < 0.25

    def compute_reward(self, achieved: Array, desired: Array, info: Any) -> Any:
        return self.compute_terminated(achieved, desired, info) * 1.0 - self.cost

    def step(self, action: Array) -> Any:
        self.place = np.clip(self.place + 0.2 * np.float32(action), -1, 1)
        self.steps += 1
        won = bool(self.compute_terminated(self.place, self.goal, {}))
        paid = float(self.compute_reward(self.place, self.goal, {}))
        return self.seen(), paid, won, self.steps >= 25, {"is_success": won}


class CostlyLine(Line):
    """The same; each step until there pays -1."""

    cost = 1.0


class ToCup(Skill):
    """Fetches the cup."""

    def initiation(self, obs: Array) -> Any:
        return obs[:, 4] == 0

    def termination(self, step: Step) -> Any:
        return step.next_obs[:, 4] == 1

    reward = success = termination


class ToPlate(Skill):
    """Brings it to the plate."""

    def initiation(self, obs: Array) -> Any:
        return obs[:, 4] == 1

    def termination(self, step: Step) -> Any:
        return step.next_obs[:, 4] == 0

    def success(self, step: Step) -> Any:
        return step.reward > 0


def person(seed: int, noise: float) -> Any:
    """Return a controller that fetches the cup, with noise on its way."""
    rng = np.random.default_rng(seed)

    def act(obs: Array) -> Any:
        holds = obs[:, 4:] > 0
        way = np.where(holds, PLATE, obs[:, 2:4]) - obs[:, :2]
        near = np.linalg.norm(way, axis=1, keepdims=True) < 3.5
        grip = np.where(holds, np.where(near, -1, 0.6), np.where(near, 1, -0.6))
        steer = np.clip(way / 6, -1, 1) + rng.normal(0, noise, way.shape)
        return np.clip(np.hstack([steer, grip]), -1, 1)

    return act


def land(obs: Array) -> Array:
    """Land, by Gymnasium's own controller."""
    from gymnasium.envs.box2d.lunar_lander import heuristic

    controller: Any = heuristic
    lander = SimpleNamespace(unwrapped=SimpleNamespace(continuous=False))
    return np.array([controller(lander, one) for one in obs])


def balance(obs: Array) -> Array:
    """Balance the pole of CartPole."""
    return (obs[:, 2] + 0.5 * obs[:, 3] > 0).astype(int)


def demonstrations(task: str, seed: int, env: Any = Cup) -> Dataset:
    """Return the episodes that are cloned."""
    if task == "lander":
        return record(land, "LunarLander-v3", episodes=50, num_envs=1, seed=seed)
    if task == "cartpole":
        return record(balance, "CartPole-v1", episodes=20, num_envs=1, seed=seed)
    if task == "half":
        return record(person(seed, 2.0), env, episodes=8, num_envs=1, seed=seed)
    return record(person(seed, 0.9), env, episodes=100, num_envs=1, seed=seed)


def curve(run: Any, key: str) -> list[float]:
    """Return the evaluations of a run."""
    lines = map(json.loads, (run.path / "metrics.jsonl").read_text().splitlines())
    return [round(line[key], 3) for line in lines if key in line]


def clone(task: str, seed: int, by_hand: bool = False) -> dict[str, Any]:
    """Clone, learn on, and return the evaluations."""
    data, place = demonstrations(task, seed), tempfile.mkdtemp() + "/run"
    ppo = BY_HAND if by_hand else PPO()
    # "best" evaluates the clone, too; each evaluation is of the weights of its time.
    how: Any = {"data": data, "seed": seed, "quiet": True, "keep": "best"}
    how |= {"eval_every": EVERY, "eval_episodes": EPISODES}
    if task == "chain":
        skills = [ToCup(), ToPlate()]
        hierarchy = Hierarchy(Cup, skills, algorithm=ppo, steps=STEPS, learn="together")
        run = hierarchy.train(place, **how)
    else:
        env = {"lander": "LunarLander-v3", "cartpole": "CartPole-v1"}.get(task, Cup)
        run = train_agent(env, ppo, STEPS, place, **how)
    start, *found = curve(run, "eval_return" if task in ("lander", "cartpole") else "eval_success")
    name = f"{task}, by hand" if by_hand else task
    return {"case": name, "seed": seed, "start": start, "lowest": min(found), "last": found[-1]}


def ends(kind: str, costs: bool, seed: int) -> dict[str, Any]:
    """Train SAC, and return the share of episodes that succeed."""
    small: Any = {"learning_starts": 500, "network": Network((64, 64), "relu")}
    place = tempfile.mkdtemp() + "/run"
    if kind == "hindsight":
        env: Any = CostlyLine if costs else Line
        run = train_agent(env, SAC(hindsight=True, **small), 5_000, place, seed=seed, quiet=True)
    else:
        env = CostlyCup if costs else Cup
        sac = SAC(shared_replay=0.5, **small)
        data = demonstrations("cup", seed, env)
        run = train_agent(env, sac, 15_000, place, data=data, seed=seed, quiet=True)
    case = f"{kind}, {'-1 until there' if costs else '1 at the end'}"
    return {"case": case, "seed": seed, "last": (run.evaluate(100).succeeded or 0) / 100}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = ("lander", "cartpole", "cup", "chain", "half", "ends")
    parser.add_argument("cases", nargs="*", choices=[*known, []], default=[*known])
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12, 13, 14])
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    rows = []
    with workers(given.processes) as pool:
        jobs = []
        for case in given.cases:
            for seed in given.seeds:
                if case == "ends":
                    kinds = [(k, c) for k in ("hindsight", "data") for c in (False, True)]
                    jobs += [pool.submit(ends, *kind, seed) for kind in kinds]
                else:
                    jobs.append(pool.submit(clone, case, seed))
                if case == "half":
                    jobs.append(pool.submit(clone, case, seed, True))
        for job in jobs:
            rows.append(job.result())
            print(rows[-1], flush=True)
    report("given", {"rows": rows})


if __name__ == "__main__":
    main()
