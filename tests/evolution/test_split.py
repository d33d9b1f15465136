"""Populations in parts: the same wherever parts train, whatever becomes of their workers."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from populations import assert_same_population
from small_runs import interrupt_at_checkpoint

from skillweave import DQN, PPO, Agent, EnvSpec, Network, SkillweaveError
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import RNN
from skillweave.errors import DeclarationError
from skillweave.evolution import Evolution, Mutations
from skillweave.evolution.population import Population
from skillweave.evolution.shard import FitnessEnvs
from skillweave.evolution.split import Parts
from skillweave.training.learning_task import skill_task
from skillweave.training.role import agent_role
from skillweave.workers import Ray
from skillweave.workers.host import LocalWorker, Workers
from skillweave.workers.placement import Placement, make_collectors

SMALL = PPO(num_envs=2, n_steps=16, batch_size=16, update_epochs=1, network=Network((8, 6)))
EVERYTHING = Mutations(0.1, 0.3, 0.2, 0.3, 0.1, units=(4, 16), layers=(1, 3), layer_share=0.5)
EVOLVE = Evolution(5, 3, 2, mutations=EVERYTHING)
DRIVER = os.getpid()


class Walk(gym.Env[Any, Any]):
    """Seven steps; where ``fatal`` is a file, the process that removes it dies at once."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, fatal: Path | None = None) -> None:
        self.fatal = fatal

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._obs(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        if self.t == 3 and self.fatal is not None and os.getpid() != DRIVER:
            try:
                self.fatal.unlink()
            except FileNotFoundError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        reward = float(action == (self.obs[0] > 0))
        return self._obs(), reward, False, self.t == 7, {}

    def _obs(self) -> Any:
        self.obs = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.obs


def workers_here(make: Any, count: int, name: str) -> Workers:
    return Workers([LocalWorker(make, 1, i) for i in range(count)], name)


@pytest.fixture
def in_this_thread(monkeypatch):
    here = Placement(make_collectors, workers_here)
    monkeypatch.setattr("skillweave.api.running.LOCAL", here)


def agent(workers: int | None = 2, fatal: Path | None = None, config: Any = SMALL) -> Agent:
    spec = EnvSpec(partial(Walk, fatal), engine="sync", workers=workers)
    return Agent(spec, config, 240)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A population in two parts, trained in this thread."""
    path = tmp_path_factory.mktemp("split") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        in_this_thread.__wrapped__(patch)
        agent().train(path, quiet=True, evolve=EVOLVE)
    return path


@pytest.mark.slow
def test_parts_in_processes_find_the_same_though_one_is_killed(whole, tmp_path):
    fatal = tmp_path / "fatal"
    fatal.touch()
    run = agent(fatal=fatal).train(tmp_path / "run", quiet=True, evolve=EVOLVE)
    assert not fatal.exists(), "nobody was killed"
    assert_same_population(run.path, whole)
    (entry,) = run.info()["stages"]
    assert entry["workers"] == 2
    ticks = [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]
    # Fitness is counted: 5 members, and the best of before, have 2 episodes of 7 steps each.
    assert entry["steps"] == ticks[-1]["steps"] + 6 * 2 * 7


@pytest.mark.slow
def test_a_split_population_goes_on_from_its_last_generation(whole, tmp_path, monkeypatch):
    interrupt_at_checkpoint(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        agent().train(tmp_path / "run", quiet=True, evolve=EVOLVE)
    monkeypatch.undo()
    agent(workers=None).resume(tmp_path / "run", quiet=True)  # the run keeps their number
    assert_same_population(tmp_path / "run", whole)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("network", [Network((8, 6)), Network((8,), rnn=RNN("gru", 4))])
def test_one_part_is_the_population_itself(network):
    config, learning_task = (
        replace(SMALL, network=network),
        skill_task(agent_role(EnvSpec(Walk, engine="sync"))),
    )
    evolution, seeds = replace(EVOLVE, start="random"), Seeds(3)
    parts = Parts(workers_here, learning_task, config, seeds, 5, 1, 2)
    split = Population.fresh(config, evolution, learning_task, seeds, parts)
    plain = Population.fresh(config, evolution, learning_task, seeds)
    eval_envs = FitnessEnvs(learning_task, 2, 2)
    for generation in range(3):
        told: tuple[list[Any], list[Any]] = [], []
        found = []
        for population, ticks in zip((split, plain), told, strict=True):
            until = population.steps // 5 + 40
            population.train(until, 200, seeds / generation, partial(_add, ticks))
            found.append(population.fitness(eval_envs, seeds / "fitness" / generation))
            population.part.state()
            population.evolve(found[-1], seeds / "evolve" / generation)
        np.testing.assert_array_equal(*found)
        assert told[0] == told[1]
        for ours, theirs in zip(split.members, plain.members, strict=True):
            assert (ours.number, ours.config, ours.steps) == (
                theirs.number, theirs.config, theirs.steps
            )  # fmt: skip
            for name, value in vars(theirs.state).items():
                assert torch.equal(getattr(ours.state, name), value)
    assert parts.steps_elsewhere == eval_envs.steps_made == 3 * 5 * 2 * 7
    eval_envs.close()
    split.part.close()
    plain.part.close()


def _add(ticks: list[Any], steps: int, metrics: dict[str, float]) -> None:
    ticks.append((steps, dict(metrics)))


def test_there_are_no_more_parts_than_members(in_this_thread, tmp_path):
    run = agent(workers=9).train(tmp_path / "run", quiet=True, evolve=Evolution(3, 1, 2))
    assert run.info()["stages"][0]["workers"] == 3


class Cursed(Walk):
    """Dies wherever it is."""

    def step(self, action: Any) -> Any:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_part_that_dies_again_and_again_is_told(tmp_path):
    cursed = Agent(EnvSpec(Cursed, engine="sync", workers=2), SMALL, 240)
    says = r"Cursed.*worker 0 died by signal 9.*, and again when it was made again"
    with pytest.raises(SkillweaveError, match=says):
        cursed.train(tmp_path / "run", quiet=True, evolve=EVOLVE)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (
            DQN(num_envs=2, buffer_size=400, learning_starts=20),
            "stage 'agent': it evolves, and all members of DQN learn from one replay buffer, so "
            "they cannot be split into 2 parts. Have one collector",
        ),
        (replace(SMALL, device="cuda"), "learn on processors alone: set device='cpu'"),
    ],
)
@pytest.mark.parametrize("cluster", [None, Ray(collectors=2)])
def test_what_cannot_be_split_is_refused(config, says, cluster, tmp_path, monkeypatch):
    monkeypatch.setattr("skillweave.training.stage.resolve_device", lambda device: device)
    with pytest.raises(DeclarationError, match=says):
        agent(None if cluster else 2, config=config).train(
            tmp_path / "run", quiet=True, evolve=EVOLVE, cluster=cluster
        )
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning")
@pytest.mark.filterwarnings("ignore:the code of the environment has changed")
def test_a_run_goes_on_on_ray_and_ends_the_same_though_an_actor_is_killed(
    whole, tmp_path, monkeypatch, capsys
):
    ray = pytest.importorskip("ray")
    fatal = tmp_path / "fatal"
    interrupt_at_checkpoint(monkeypatch, 1)
    with pytest.raises(KeyboardInterrupt):
        agent(fatal=fatal).train(tmp_path / "run", quiet=True, evolve=EVOLVE)
    monkeypatch.undo()
    fatal.touch()
    ray.init(
        "local", num_cpus=2, include_dashboard=False, logging_level="ERROR", log_to_driver=False
    )
    try:
        with pytest.raises(
            SkillweaveError, match="started with 2 collectors, and continues with as"
        ):
            agent().resume(tmp_path / "run", quiet=True, cluster=Ray(collectors=3))
        agent(None, fatal).resume(tmp_path / "run", cluster=Ray(patience=60.0))
        assert "died; it is made again" in capsys.readouterr().err
        assert not fatal.exists(), "nobody was killed"
        assert_same_population(tmp_path / "run", whole)

        agent(None).train(tmp_path / "alone", evolve=Evolution(2, 1, 1), cluster=Ray())
        assert "agent: the population trains in this process" in capsys.readouterr().err
    finally:
        ray.shutdown()
