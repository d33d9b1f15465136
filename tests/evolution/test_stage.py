"""Populations in a run: generations, lineage, fitness, divergence, and going on after a kill."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from populations import assert_same_population
from small_runs import interrupt_at_checkpoint

from skillweave import (
    DQN,
    PPO,
    SAC,
    TD3,
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Network,
    Skill,
    train_agent,
)
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN
from skillweave.errors import DeclarationError
from skillweave.evolution import (
    Evolution,
    Heir,
    Mutations,
    Range,
    Tournament,
    Truncation,
    generations as evolving,
)
from skillweave.evolution.population import Population
from skillweave.evolution.shard import FitnessEnvs, Shard, has_diverged
from skillweave.runs.files import read_tensors
from skillweave.training.learning_task import skill_task
from skillweave.training.role import agent_role

SMALL = Network((8, 6), "relu")
REPLAY: dict[str, Any] = {
    "num_envs": 2, "batch_size": 8, "buffer_size": 400, "learning_starts": 20, "network": SMALL,
}  # fmt: skip
CONFIGS = {
    "ppo": PPO(num_envs=2, n_steps=16, batch_size=16, update_epochs=1, network=SMALL),
    "dqn": DQN(**REPLAY),
    "rainbow": DQN.rainbow(**REPLAY),
    "td3": TD3(**REPLAY),
    "sac": SAC(**REPLAY),
}
EVERYTHING = Mutations(0.1, 0.3, 0.2, 0.3, 0.1, units=(4, 16), layers=(1, 3), layer_share=0.5)


class Aim(gym.Env[Any, Any]):
    """Ten steps; the reward is how near a force comes to half the observation."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, choices: bool = False, render_mode: str | None = None) -> None:
        box = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space: Any = gym.spaces.Discrete(2) if choices else box

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._obs(), {}

    def _obs(self) -> Any:
        self.obs = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.obs

    def step(self, action: Any) -> Any:
        self.t += 1
        force = float(np.asarray(action).reshape(-1)[0])
        reward = -abs(force - 0.5 * self.obs[0])
        return self._obs(), reward, False, self.t == 10, {}


def choices(render_mode: str | None = None) -> gym.Env[Any, Any]:
    return Aim(True)


def forces(render_mode: str | None = None) -> gym.Env[Any, Any]:
    return Aim()


class Still(Skill):
    """Always the first choice, for as long as it may."""

    def policy(self, obs: Any) -> Any:
        return np.zeros(len(obs), np.int64)


class Moving(Skill):
    """The second, three times."""

    max_steps = 3

    def policy(self, obs: Any) -> Any:
        return np.ones(len(obs), np.int64)


def spec(name: str) -> EnvSpec:
    return EnvSpec(forces if name in ("td3", "sac") else choices, engine="sync")


def train(name: str, path: Path, evolution: Evolution | None = None, seed: int = 0) -> Any:
    evolution = evolution or Evolution(4, 4, 3, mutations=EVERYTHING)
    return train_agent(
        spec(name), CONFIGS[name], 256, path, seed=seed, quiet=True, evolve=evolution
    )


def lineage(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "lineage.jsonl").read_text().splitlines()]


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", CONFIGS)
def test_a_population_evolves_and_ends_with_the_best_member(name, tmp_path):
    run = train(name, tmp_path / "run")
    lines = lineage(run.path)
    assert [line["generation"] for line in lines] == [g for g in range(4) for _ in range(4)]
    best = [line for line in lines if line["best"]]
    for line in best:
        assert line["fitness"] == max(
            x["fitness"] for x in lines if x["generation"] == line["generation"]
        )
    (entry,) = run.info()["stages"]
    assert entry["winner"]["member"] == best[-1]["member"]
    assert entry["winner"]["generation"] == best[-1]["generation"]
    if best[-1]["generation"] == 3:
        assert entry["winner"]["fitness"] == best[-1]["fitness"]
    assert entry["budget"] == 4 * 256
    assert 0.75 * 4 * 256 <= entry["steps"] <= 1.25 * 4 * 256  # fitness is counted, too
    numbers = {line["member"] for line in lines}
    for line in lines:
        assert line["parent"] is None if line["generation"] == 0 else line["parent"] in numbers
        assert line["steps"] >= 16 * (line["generation"] + 1)
    # The elite goes on, under the same number.
    for g in range(3):
        now, then = ([x for x in lines if x["generation"] == h] for h in (g, g + 1))
        elite = max(now, key=lambda line: line["fitness"])["member"]
        assert [x["member"] for x in then if x["mutation"] == "goes on"] == [elite]
    assert {x["mutation"] for x in lines} >= {"start", "goes on"}


def test_the_best_so_far_must_hold_its_own_on_the_same_episodes(tmp_path, monkeypatch):
    told = iter([np.array([1.0, 3.0]), np.array([9.0, 4.0]), np.array([5.0, 6.0])])
    old = iter([9.5, 6.0])  # what the old best gets in the second and third generation
    monkeypatch.setattr(Population, "fitness", lambda *_: next(told))
    monkeypatch.setattr(FitnessEnvs, "score", lambda *_: next(old))
    by = Evolution(2, 3, 2, selection=Tournament(2), mutations=EVERYTHING)
    run = train("ppo", tmp_path / "run", by)
    flagged = [(x["generation"], x["member"]) for x in lineage(run.path) if x["best"]]
    assert [g for g, _ in flagged] == [0, 2]  # 9.5 beats 9.0; of equals the latest
    winner = run.info()["stages"][0]["winner"]
    assert (winner["generation"], winner["fitness"]) == (2, 6.0)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["ppo", "rainbow", "sac"])
def test_a_killed_population_ends_with_the_very_same_weights(name, tmp_path, monkeypatch):
    whole = train(name, tmp_path / "whole", seed=3)
    for generation in (0, 2):
        path = tmp_path / f"killed in {generation}"
        trained = Population.fitness

        def dies(
            self: Population, env: Any, seeds: Seeds, at: int = generation, trained: Any = trained
        ) -> Any:
            if seeds.path[-2] == at:
                raise KeyboardInterrupt
            return trained(self, env, seeds)

        monkeypatch.setattr(Population, "fitness", dies)
        with pytest.raises(KeyboardInterrupt):
            train(name, path, seed=3)
        monkeypatch.undo()
        whole.declaration.resume(path, quiet=True)
        assert_same_population(path, whole.path)


RECURRENT = PPO(num_envs=2, n_steps=16, batch_size=16, network=Network((6,), rnn=RNN("gru", 4)))
SCALED_RAINBOW = DQN.rainbow(**REPLAY, normalize_obs=True, normalize_rewards=True)


def of_selectors(config: Any, steps: int) -> Hierarchy:
    return Hierarchy(
        spec("ppo"),
        [Still(), Moving()],
        selector=config,
        call_steps=7,
        apart=Apart(selector_steps=steps),
        learn="apart",
    )


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("config", [CONFIGS["ppo"], RECURRENT, SCALED_RAINBOW])
def test_a_killed_population_of_selectors_ends_with_the_very_same_weights(
    config, tmp_path, monkeypatch
):
    # Generations end in the middle of calls, which are up to 7 steps long.
    hierarchy = of_selectors(config, 256)
    evolve = {"selector": Evolution(3, 4, 2, mutations=EVERYTHING)}
    whole = hierarchy.train(tmp_path / "whole", quiet=True, evolve=evolve)
    state, cuts = Shard.state, [0]

    def dies(self: Shard) -> Any:
        cuts[0] += 1
        if cuts[0] == 3:  # goes on from the second
            raise KeyboardInterrupt
        return state(self)

    monkeypatch.setattr(Shard, "state", dies)
    with pytest.raises(KeyboardInterrupt):
        hierarchy.train(tmp_path / "run", quiet=True, evolve=evolve)
    monkeypatch.undo()
    hierarchy.resume(tmp_path / "run", quiet=True)
    assert_same_population(tmp_path / "run", whole.path)
    steps = [r.info()["stages"][0]["steps"] for r in (whole, hierarchy.load(tmp_path / "run"))]
    assert steps[0] == steps[1]


@pytest.mark.slow
@pytest.mark.parametrize("checkpoint", [1, 2])
def test_who_takes_the_place_of_a_selector_that_diverges_goes_on_with_its_open_calls(
    checkpoint, tmp_path, monkeypatch
):
    hierarchy, path, joined = of_selectors(CONFIGS["ppo"], 256), tmp_path / "run", Shard._stack
    poisoned: list[int] = []

    def poison(self: Shard, group: Any) -> Any:
        stack = joined(self, group)
        if not poisoned:
            stack.state.params[1] = float("nan")
            poisoned.append(1)
        return stack

    evolve = {"selector": Evolution(3, 3, 2, mutations=EVERYTHING)}
    with monkeypatch.context() as patched:
        patched.setattr(Shard, "_stack", poison)
        interrupt_at_checkpoint(patched, checkpoint)
        with pytest.raises(KeyboardInterrupt):
            hierarchy.train(path, seed=3, quiet=True, evolve=evolve)
    heads = {k: v for k, v in read_tensors(path / "checkpoint.safetensors")[0].items()
             if k.endswith("open.dist_params")}  # fmt: skip
    assert len(heads) == 3
    assert all(bool(v.isfinite().all()) for v in heads.values())
    stages = hierarchy.resume(path, quiet=True).info()["stages"]
    assert [stage["status"] for stage in stages] == ["done"]


def test_another_seed_gives_another_lineage(tmp_path):
    first, other = (
        (train("ppo", tmp_path / str(s), seed=s).path / "lineage.jsonl").read_text() for s in (1, 2)
    )
    assert first != other


class Paid(Aim):
    """Pays in each step what its first observation was."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        obs, info = super().reset(seed=seed)
        self.start = float(obs[0])
        return obs, info

    def step(self, action: Any) -> Any:
        obs, _, *rest = super().step(action)
        return obs, self.start, *rest


def test_fitness_is_measured_on_the_same_starts_for_all(tmp_path):
    how = Evolution(4, 4, 3, mutations=EVERYTHING)
    env = EnvSpec(Paid, kwargs={"choices": True}, engine="sync")
    run = train_agent(env, CONFIGS["ppo"], 256, tmp_path / "run", quiet=True, evolve=how)
    found: dict[int, set[float]] = {}
    for line in lineage(run.path):
        found.setdefault(line["generation"], set()).add(line["fitness"])
    assert [len(fitness) for fitness in found.values()] == [1] * 4
    assert len(set.union(*found.values())) == 4  # another generation, other starts


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["ppo", "td3"])
def test_a_member_that_diverges_is_reported_and_replaced(name, tmp_path, monkeypatch):
    poisoned: list[int] = []
    trained = Population.train

    def poison(self: Population, *given: Any) -> None:
        trained(self, *given)
        if not poisoned:
            member = self.members[1]
            poisoned.append(member.number)
            member.state.params[0, 3] = float("nan")

    monkeypatch.setattr(Population, "train", poison)
    said: list[str] = []
    monkeypatch.setattr(
        "skillweave.reporting.progress.Progress.message", lambda self, text: said.append(text)
    )
    run = train(name, tmp_path / "run")
    lines = lineage(run.path)
    lost = [x for x in lines if x["diverged"]]
    assert [(x["generation"], x["member"], x["fitness"]) for x in lost] == [(0, poisoned[0], None)]
    assert all(x["parent"] != poisoned[0] for x in lines)
    assert any(f"member {poisoned[0]} diverged" in text for text in said)
    assert all(bool(v.isfinite().all()) for v in run.policy.weights.values())


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["ppo", "dqn", "sac"])
def test_a_member_that_diverges_while_it_learns_leaves_the_others_alone(name, tmp_path):
    config = replace(CONFIGS[name], max_grad_norm=1e30)
    learning_task = skill_task(agent_role(spec(name)))
    population = Population.fresh(config, Evolution(3, 1, 2), learning_task, Seeds(0))
    sick = population.members[1]
    sick.state.params.fill_(float("nan"))
    population.train(256, 256, Seeds(1), lambda steps, metrics: None)
    assert [has_diverged(m) for m in population.members] == [False, True, False]
    fitness = population.fitness(FitnessEnvs(learning_task, 2, 2), Seeds(2))
    assert np.isfinite(fitness).tolist() == [True, False, True]


def killed_at_save(name: str, path: Path, generation: int, monkeypatch: Any) -> None:
    """Train until the checkpoint after so many generations is written."""
    save = evolving.EvolvingPopulation._save

    def dies(self: Any) -> None:
        save(self)
        if self.done == generation:
            raise KeyboardInterrupt

    monkeypatch.setattr(evolving.EvolvingPopulation, "_save", dies)
    with pytest.raises(KeyboardInterrupt):
        train(name, path, Evolution(2, 2, 2))
    monkeypatch.setattr(evolving.EvolvingPopulation, "_save", save)


def test_a_member_that_diverged_in_the_last_generation_may_stand_in_a_checkpoint(
    tmp_path, monkeypatch
):
    trained, calls = Population.train, [0]

    def poison(self: Population, *given: Any) -> None:
        trained(self, *given)
        calls[0] += 1
        if calls[0] == 2:
            self.members[1].state.params[0, 3] = float("nan")

    monkeypatch.setattr(Population, "train", poison)
    killed_at_save("ppo", tmp_path / "run", 2, monkeypatch)
    run = Agent(spec("ppo"), CONFIGS["ppo"], 256).resume(tmp_path / "run", quiet=True)
    assert [x["diverged"] for x in lineage(run.path)] == [False, False, False, True]
    assert all(bool(v.isfinite().all()) for v in run.policy.weights.values())


class Patient(Skill):
    """May start late in an episode, which random acting has to find."""

    def initiation(self, obs: Any) -> Any:
        return obs[:, 0] > 0.5


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_members_go_on_with_the_open_episodes_of_their_places(name):
    # Generations of 3 steps of each environment, episodes of 10.
    evolution = Evolution(3, 4, 1, mutations=EVERYTHING)
    population = Population.fresh(
        CONFIGS[name], evolution, skill_task(agent_role(spec(name))), Seeds(0)
    )
    ages = []
    for generation in range(4):
        until = population.steps // 3 + 6
        population.train(until, 1000, Seeds(1) / generation, lambda steps, metrics: None)
        ages.append(population.part.places[0].kept["age"][0])
        population.evolve(np.arange(3.0), Seeds(2) / generation)
    rows = CONFIGS[name].n_steps if name == "ppo" else 3
    assert ages == [rows * (g + 1) % 10 for g in range(4)]
    population.part.close()


@pytest.mark.parametrize("name", ["ppo", "dqn"])
def test_the_steps_of_members_are_those_that_their_environments_made(name):
    learning_task = skill_task(replace(agent_role(spec(name)), skill=Patient()))
    evolution = Evolution(3, 3, 1, mutations=EVERYTHING)
    population, told = Population.fresh(CONFIGS[name], evolution, learning_task, Seeds(0)), []
    for generation in range(3):
        before = [place.engine.steps_made for place in population.part.places]
        were, until = population.steps, population.steps // 3 + 50
        told.clear()
        population.train(until, 1000, Seeds(1) / generation, lambda n, tick: told.append(n))
        made = sum(p.engine.steps_made for p in population.part.places) - sum(before)
        assert population.steps - were == made == told[-1]
        assert made >= 3 * 50 - 3 * 32
        population.evolve(np.arange(3.0), Seeds(2) / generation)
    population.part.close()


def test_it_ends_early_at_the_target(tmp_path):
    run = train("ppo", tmp_path / "run", Evolution(3, 9, 2, target=-1e9))
    assert run.info()["stages"][0]["winner"]["generations"] == 1
    assert len(lineage(run.path)) == 3


def test_truncation_and_random_starts(tmp_path):
    by = Evolution(5, 3, 2, start="random", selection=Truncation(0.2), mutations=EVERYTHING)
    lines = lineage(train("ppo", tmp_path / "run", by).path)
    assert len({x["settings"]["learning_rate"] for x in lines if x["generation"] == 0}) == 5
    for g in (1, 2):
        now = [x for x in lines if x["generation"] == g]
        assert sum(x["mutation"] == "goes on" for x in now) == 4


class Copycat:
    """Everybody descends from the best, unchanged."""

    def select(self, fitness: Any, rng: Any) -> list[Heir]:
        return [Heir(int(fitness.argmax()), False) for _ in fitness]


def test_a_selection_of_ones_own_is_asked_for_again_when_a_run_goes_on(tmp_path, monkeypatch):
    by = Evolution(3, 3, 2, selection=Copycat())

    def dies(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Population, "fitness", dies)
    with pytest.raises(KeyboardInterrupt):
        train("ppo", tmp_path / "run", by)
    monkeypatch.undo()
    agent = Agent(spec("ppo"), CONFIGS["ppo"], 256)
    with pytest.raises(DeclarationError, match="Copycat"):
        agent.resume(tmp_path / "run", quiet=True)
    run = agent.resume(tmp_path / "run", quiet=True, evolve=by)
    assert [x["mutation"] for x in lineage(run.path)] == ["start"] * 3 + ["goes on"] * 6
    assert len({x["member"] for x in lineage(run.path)[3:6]}) == 3


class Left(Skill):
    """Anything."""


class Right(Skill):
    """Anything else."""


def test_skills_and_selector_evolve_each_by_its_own_plan(tmp_path):
    hierarchy = Hierarchy(
        spec("ppo"),
        [Left(), Right()],
        algorithm=CONFIGS["ppo"],
        selector=CONFIGS["dqn"],
        call_steps=2,
        apart=Apart(skill_steps=64, selector_steps=96),
        learn="apart",
    )
    plan = {"right": Evolution(3, 2, 2), "selector": Evolution(2, 3, 2), "left": None}
    run = hierarchy.train(tmp_path / "run", quiet=True, evolve=plan)
    stages = {p["name"]: p for p in run.info()["stages"]}
    assert "winner" not in stages["left"]
    assert stages["right"]["budget"] == 3 * 64
    assert stages["selector"]["budget"] == 2 * 96
    seen = {(x["stage"], x["generation"]) for x in lineage(run.path)}
    assert seen == {("right", g) for g in range(2)} | {("selector", g) for g in range(3)}
    assert run.evaluate(2).mean == hierarchy.load(tmp_path / "run").evaluate(2).mean


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ({"middle": Evolution()}, "no stage 'middle' is trained; there are: left, right, selector"),
        ({"left": 3}, r"evolve\['left'\] is 3"),
        (
            Evolution(mutations=Mutations(ranges={"tau": Range(0.1, 1.0)})),
            "stage 'left': .*PPO has no setting 'tau'",
        ),
    ],
)
def test_a_plan_that_does_not_fit_is_refused_before_anything_is_written(plan, said, tmp_path):
    hierarchy = Hierarchy(spec("ppo"), [Left(), Right()], algorithm=CONFIGS["ppo"], learn="apart")
    with pytest.raises(DeclarationError, match=said):
        hierarchy.train(tmp_path / "run", quiet=True, evolve=plan)
    assert not (tmp_path / "run").exists()
