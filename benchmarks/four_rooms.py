"""Four rooms: what selectors learn against exact semi-MDP values, and curves against flat.

    python -m benchmarks.four_rooms [--seeds 0 1 2 3 4] [--processes 1] [--only values|curves]
        [--goals G1 G2] [--steps 10000]

After Sutton, Precup & Singh 1999, sec. 2 and 3: skills are the eight hallway skills (H), the four
moves (A), or both (A+H). Errors are shares of the range of the exact values. Exact values come
from ``semi_mdp``, and those of counts from the same equations, with a model counted from the
decisions of the library's collector: they show what this number of decisions can reveal.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.common import median, report, table, workers
from benchmarks.semi_mdp import Model, Option, Process, model_of, optimal, value_of
from examples.four_rooms import (
    AFTER,
    CORNER,
    EAST,
    G1,
    G2,
    NORTH,
    PLACES,
    SOUTH,
    WEST,
    FourRooms,
    Move,
    hallway_skills,
    moves,
)
from skillweave import (
    DQN,
    PPO,
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Network,
    Skill,
    TrainDefaults,
)
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.envs.engine import RawStep
from skillweave.experience.acting import Acting, Request
from skillweave.experience.collector import Collector
from skillweave.experience.group import Collectors
from skillweave.experience.learners import Calling
from skillweave.hierarchy.roles import CALL
from skillweave.skills import ready_policy
from skillweave.skills.skill_set import SkillSet
from skillweave.training.episodes import Episodes
from skillweave.training.learner import Stack
from skillweave.training.loop import Loop
from skillweave.training.stack_learner import learner_of
from skillweave.types import Array

GAMMA, GOALS = 0.9, {"G1": G1, "G2": G2}
SETS: dict[str, Callable[[], list[Skill]]] = {
    "H": hallway_skills,
    "A": moves,
    "A+H": lambda: [*moves(), *hallway_skills()],
}
# One weight for each state and skill, and only random choices. The learning rate is small enough
# for its end to average over many samples: with 0.01 the largest error was 1.6 times that of the
# counts (H, 6M steps, seed 0), with 5e-4 it is nearly theirs. More steps mend what is left.
VALUES = DQN(
    num_envs=512,
    gamma=GAMMA,
    network=Network(()),
    exploration_final_eps=1.0,
    loss="mse",
    learning_rate=5e-4,
    learning_rate_schedule="linear",
    batch_size=1024,
    update_ratio=1 / 64,
    tau=0.02,
    buffer_size=4_000_000,
)
JUDGED = PPO(
    num_envs=512,
    n_steps=16,
    gamma=GAMMA,
    network=Network(()),
    normalize_obs=False,
    learning_rate=3e-3,
    batch_size=256,
    update_epochs=4,
    gae_lambda=0.98,
)
CURVE: dict[str, Any] = {
    "num_envs": 1,
    "gamma": GAMMA,
    "network": Network(()),
    "learning_rate": 0.01,
    "loss": "mse",
    "learning_starts": 500,
    "exploration_fraction": 0.02,
    "exploration_final_eps": 0.1,
    "batch_size": 128,
    "update_ratio": 0.25,
    "buffer_size": 100_000,
}
HALLWAYS = (NORTH, WEST, EAST, SOUTH)
SHOWN = (1, 2, 3, 5, 10, 20, 50, 100, 200, 500, 1_000)


# The task as the exact equations see it ------------------------------------------------------


def process_of(goal: int) -> Process:
    """Return the moves of the environment, from its plan alone; nothing follows the goal."""
    states = np.arange(len(PLACES))
    chance = np.zeros((len(PLACES), 4, len(PLACES)))
    for action, move in itertools.product(range(4), range(4)):
        chance[states, action, AFTER[:, move]] += 6 / 9 if action == move else 1 / 9
    reward = chance[:, :, goal].copy()
    chance[:, :, goal] = 0.0
    return Process(chance, reward)


def option_of(skill: Any) -> Option:
    everywhere = np.ones(len(PLACES), bool)
    if isinstance(skill, Move):
        return Option(np.full(len(PLACES), skill.action), everywhere, ~everywhere)
    return Option(skill.moves, skill.starts, skill.room)


def exact(goal: int, skills: list[Skill], gamma: float = GAMMA) -> Model:
    """Return the exact model of skills."""
    return model_of(process_of(goal), [option_of(s) for s in skills], gamma)


class ManyRooms:
    """N four rooms as one NumPy engine: begun anywhere, cut in hallways, where calls end anyway.

    So every cell is as often where a call begins, and the value of what follows is bootstrapped. A
    quarter begins in hallways, since all other values rest on theirs.
    """

    observation_space, action_space = FourRooms.observation_space, FourRooms.action_space

    def __init__(self, goal: int, num_envs: int) -> None:
        self.goal, self.num_envs, self.steps_made = goal, num_envs, 0
        self.time_limit = None
        doors = [h for h in HALLWAYS if h != goal]
        self.first = np.full(len(PLACES), 0.75 / (len(PLACES) - 1))
        self.first[goal] = 0.0
        self.first[doors] += 0.25 / len(doors)

    def reset(self, seed: int) -> Array:
        self.rng = np.random.default_rng(seed)
        self.cell = np.zeros(self.num_envs, np.int64)
        self.reset_some(np.arange(self.num_envs))
        return self.cell

    def reset_some(self, ids: Array, seeds: Any = None) -> Array:
        self.cell = self.cell.copy()
        self.cell[ids] = self.rng.choice(len(PLACES), len(ids), p=self.first)
        found: Array = self.cell[ids]
        return found

    def step(self, action: Array, ids: Array | None = None) -> RawStep:
        drawn = self.rng.integers(9, size=self.num_envs)
        move = np.where(drawn < 6, action, (action + drawn - 5) % 4)
        self.cell = AFTER[self.cell, move]
        self.steps_made += self.num_envs
        there = self.cell == self.goal
        cut = np.isin(self.cell, HALLWAYS) & ~there
        return RawStep(self.cell, there.astype(np.float32), there, cut, {})

    def mask(self) -> Array | None:
        return None

    def close(self) -> None:
        pass


# The library ---------------------------------------------------------------------------------


def collector_of(
    skills: list[Skill], config: AlgorithmConfig, goal: int, state: Any = None
) -> tuple[Collector, Stack]:
    """Return a selector over skills in environments that begin anywhere, and its fresh learner."""
    policies: Any = tuple(ready_policy(s) for s in skills)
    space = FourRooms.observation_space
    choices: Any = type(space)(len(skills))
    algorithm = make_algorithm(config, space, choices)
    engine: Any = ManyRooms(goal, config.num_envs)
    acting = Acting([(algorithm, 1)], config.num_envs)
    collector = Collector(engine, acting, Calling(SkillSet(tuple(skills), policies)))
    return collector, Stack(algorithm, state)


class Counted:
    """A model counted from the decisions of experiences."""

    def __init__(self, skills: int, gamma: float = GAMMA) -> None:
        n = len(PLACES)
        self.gamma, self.calls = gamma, np.zeros((n, skills))
        self.reward, self.after = np.zeros((n, skills)), np.zeros((n, skills, n))

    def add(self, found: Batch) -> None:
        some = np.ones_like(found["terminated"]) if found.get("valid") is None else found["valid"]
        on = some & ~found["terminated"]
        power = self.gamma ** found["steps"].astype(np.float64)
        obs, action = found["obs"], found["action"]
        np.add.at(self.calls, (obs[some], action[some]), 1.0)
        np.add.at(self.reward, (obs[some], action[some]), found["reward"][some])
        np.add.at(self.after, (obs[on], action[on], found["next_obs"][on]), power[on])

    def model(self) -> Model:
        calls = np.maximum(self.calls, 1.0)
        return Model(self.reward / calls, self.after / calls[..., None], self.calls > 0)


class Counting(Collectors):
    """Collectors that count what they find."""

    counted: Counted

    def collect(self, request: Request) -> Any:
        found = super().collect(request)
        self.counted.add(found.batches[""])
        return found


def learnt(skills: list[Skill], config: Any, goal: int, steps: int, seed: int) -> Any:
    """Train a selector for ``steps``; return its algorithm, its state and the counts."""
    seeds = Seeds(seed)
    collector, stack = collector_of(skills, config, goal)
    stack.state = stack.algorithm.init([seeds / "member"])
    collectors = Counting([collector], 1)
    collectors.counted = Counted(len(skills))
    learner = learner_of(stack, config.num_envs, seeds / "learner", row_steps=CALL)
    try:
        Loop(learner, collectors, Episodes(), seeds, steps).run()
    finally:
        collectors.close()
    return stack.algorithm, stack.state, collectors.counted


# Values --------------------------------------------------------------------------------------


def errors(found: Array, right: Array) -> dict[str, float]:
    """Largest and mean error as shares of the range of what is right."""
    wrong = np.abs(found - right) / np.ptp(right)
    return {"largest": float(wrong.max()), "mean": float(wrong.mean())}


def outputs(algorithm: Any, state: Any, model: Model) -> tuple[Array, Array]:
    """Return a learner's outputs for all cells: values or logits (S, O), and V (S,), in float64."""
    obs = torch.arange(len(PLACES))[None]
    mask = torch.from_numpy(model.allowed)[None]
    with torch.inference_mode():
        _, head, _ = algorithm.act(algorithm.acting_params(state), obs, mask, None)
        value = algorithm.value(state, obs, mask)
    return head[0].double().numpy(), value[0].double().numpy()


def values(kind: str, goal: str, which: str, steps: int, seed: int) -> list[dict[str, Any]]:
    """Return the errors of a DQN's Q* and of the counted model's, or of PPO's value."""
    started, skills = time.perf_counter(), SETS[which]()
    config: Any = VALUES if kind == "DQN" else JUDGED
    model = exact(GOALS[goal], skills)
    algorithm, state, counted = learnt(skills, config, GOALS[goal], steps, seed)
    head, value = outputs(algorithm, state, model)
    here = np.arange(len(PLACES)) != GOALS[goal]
    known = model.allowed & here[:, None]
    about = {"goal": goal, "skills": which, "steps": steps, "seed": seed}
    about |= {"seconds": time.perf_counter() - started}
    if kind == "DQN":
        right, by_counts = optimal(model), optimal(counted.model())
        return [
            about | {"what": "DQN: Q*"} | errors(head[known], right[known]),
            about | {"what": "DQN: V*"} | errors(head.max(1)[here], right.max(1)[here]),
            about | {"what": "counts: Q*"} | errors(by_counts[known], right[known]),
        ]
    chance = np.exp(head - head.max(1, keepdims=True)) * model.allowed
    chance /= chance.sum(1, keepdims=True)
    right = value_of(model, chance)
    best = optimal(model).max(1)
    return [
        about | {"what": "PPO: V of its policy"} | errors(value[here], right[here]),
        about | {"what": "PPO: V* less V of its policy"} | errors(right[here], best[here]),
    ]


# Curves --------------------------------------------------------------------------------------


class Noted(FourRooms):
    """Notes how long each episode is."""

    def __init__(self, lengths: list[int], goal: int) -> None:
        super().__init__(goal, CORNER)
        self.lengths, self.steps = lengths, 0

    def step(self, action: int) -> Any:
        found = super().step(action)
        self.steps += 1
        if found[2]:
            self.lengths.append(self.steps)
            self.steps = 0
        return found


def curve(which: str, goal: str, steps: int, seed: int) -> list[int]:
    """Return the steps of each episode while the library's DQN learns; "flat" is without skills."""
    lengths: list[int] = []
    env = EnvSpec(partial(Noted, lengths, GOALS[goal]), engine="sync", workers=1)
    declared: Any
    if which == "flat":
        # As many steps between updates as a selector has whose calls end by themselves.
        declared = Agent(env, DQN(**CURVE, train_freq=CALL), steps)
    else:
        declared = Hierarchy(
            env,
            SETS[which](),
            call_steps=None,
            selector=DQN(**CURVE),
            apart=Apart(selector_steps=steps),
            train_defaults=TrainDefaults(checkpoint_every=10**9),
        )
    with tempfile.TemporaryDirectory() as folder:
        declared.train(Path(folder) / "run", seed=seed, quiet=True)
    return lengths


def tabular(which: str, goal: str, episodes: int, seed: int, rate: float = 0.25) -> list[int]:
    """Run the paper's semi-MDP Q-learning on a table (eq. 11), ε = 0.1; with A it is flat."""
    rng = np.random.default_rng(seed)
    options = [option_of(s) for s in SETS[which]()]
    q = np.where(np.stack([o.starts for o in options], 1), 0.0, -np.inf)
    env, lengths = FourRooms(GOALS[goal]), []
    env.reset(seed=seed)
    for _ in range(episodes):
        cell, there, length = env.reset()[0], False, 0
        while not there:
            best = q[cell] == q[cell].max() if rng.random() >= 0.1 else np.isfinite(q[cell])
            choice = int(rng.choice(np.flatnonzero(best)))
            option, at, paid, power = options[choice], cell, 0.0, 1.0
            while True:
                at, reward, there, *_ = env.step(int(option.action[at]))
                paid, power, length = paid + power * reward, power * GAMMA, length + 1
                if there or not option.goes_on[at]:
                    break
            target = paid + (0.0 if there else power * q[at].max())
            q[cell, choice] += rate * (target - q[cell, choice])
            cell = at
        lengths.append(length)
    return lengths


def shown(lengths: list[list[int]]) -> list[str]:
    """Mean steps of episodes 1, 2, ... over the seeds that came so far."""
    found = []
    for number in SHOWN:
        first = max(1, number - number // 10)  # of later episodes, the mean of some before
        part = [np.mean(each[first - 1 : number]) for each in lengths if len(each) >= number]
        found.append(f"{np.mean(part):.0f}" if len(part) == len(lengths) else "")
    return found


# Everything ----------------------------------------------------------------------------------

JOBS = [
    ("DQN", "G1", "H", 16_000_000),
    ("DQN", "G2", "A+H", 8_000_000),
    ("PPO", "G1", "H", 4_000_000),
]


def run_values(pool: Any, seeds: list[int]) -> list[dict[str, Any]]:
    asked = [(*job, seed) for job in JOBS for seed in seeds]
    found = [row for job in [pool.submit(values, *a) for a in asked] for row in job.result()]
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in found:
        groups.setdefault((row["what"], row["goal"], row["skills"]), []).append(row)
    rows = []
    for name, rs in groups.items():
        largest, mean = ([r[k] for r in rs] for k in ("largest", "mean"))
        cells = (median(largest), max(largest), median(mean), max(mean))
        seconds = f"{median(r['seconds'] for r in rs):.0f}"
        rows.append([*name, f"{rs[0]['steps']:,}", seconds, *(f"{c:.2%}" for c in cells)])
    header = ["what", "goal", "skills", "steps", "seconds"]
    header += ["largest error", "of the worst seed", "mean error", "of the worst seed"]
    print(table(header, rows), flush=True)
    return found


def run_curves(pool: Any, seeds: list[int], goals: list[str], steps: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for goal in goals:
        asked = {f"DQN, {w}": partial(curve, w, goal, steps) for w in ("H", "A+H", "flat")}
        if goal == "G2":  # with hallway skills alone, this goal is met by chance
            asked.pop("DQN, H")
        named = {"H": "H", "A+H": "A+H", "flat": "A"}
        asked |= {f"table, {k}": partial(tabular, w, goal, 1_000) for k, w in named.items()}
        jobs = {name: [pool.submit(job, seed) for seed in seeds] for name, job in asked.items()}
        lengths = {name: [job.result() for job in each] for name, each in jobs.items()}
        rows = [[name, *shown(each)] for name, each in lengths.items()]
        print(f"{goal}: steps of episode", flush=True)
        print(table(["learner", *map(str, SHOWN)], rows), flush=True)
        found[goal] = {row[0]: row[1:] for row in rows}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--only", choices=["values", "curves"])
    parser.add_argument("--goals", nargs="+", choices=list(GOALS), default=list(GOALS))
    parser.add_argument("--steps", type=int, default=10_000, help="of each learning curve")
    given = parser.parse_args()
    result: dict[str, Any] = {"seeds": given.seeds}
    with workers(given.processes) as pool:
        if given.only != "curves":
            result["values"] = run_values(pool, given.seeds)
        if given.only != "values":
            result["curves"] = run_curves(pool, given.seeds, given.goals, given.steps)
    report("four_rooms", result)


if __name__ == "__main__":
    main()
