"""Learning rates that are schedules: their values, how they are recorded, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import gymnasium as gym
import pytest
import torch
from small_runs import (
    OFF,
    ON,
    Left,
    assert_same,
    lines,
    reports_every,
    stopped_again,
    stopped_run,
)

import skillweave as sw
from skillweave import DQN, PPO, SAC, TD3, Hierarchy
from skillweave._internal.seeding import Seeds
from skillweave.algorithms import Linear, SelfImitationPPO
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import SkillCritic, config_from_json, config_to_json
from skillweave.algorithms.parameters import rate_now
from skillweave.cli.overrides import apply_overrides
from skillweave.errors import DeclarationError
from skillweave.evolution import Evolution, Mutations, Range
from skillweave.runs.manifest import read_manifest
from skillweave.schema import as_json

KINDS = (PPO, SelfImitationPPO, SkillCritic, DQN, SAC, TD3)
often = reports_every(75)


def halving(remaining: float) -> float:
    return 1e-3 * 0.5 ** (4.0 * (1.0 - remaining))


def closing(start: float):
    def schedule(remaining: float) -> float:
        return start * remaining

    return schedule


@pytest.mark.parametrize("kind", KINDS)
def test_every_algorithm_follows_it_from_the_start_to_the_end_of_the_budget(kind):
    rate = torch.tensor([7.0, 7.0])
    for progress, want in ((0.0, 3e-4), (0.25, 2.5e-4), (1.0, 1e-4)):
        found = rate_now(kind(learning_rate=Linear(3e-4, 1e-4)), rate, progress)
        assert found.tolist() == pytest.approx([want, want])
        found = rate_now(kind(learning_rate=halving), rate, progress)
        assert found.tolist() == pytest.approx([halving(1.0 - progress)] * 2)
    for schedule, share in (("linear", 0.75), ("constant", 1.0)):
        if kind is not SkillCritic:  # its rate always falls
            number = kind(learning_rate=1e-3, learning_rate_schedule=schedule)
            assert rate_now(number, rate, 0.25).tolist() == [7.0 * share] * 2
    assert rate_now(SkillCritic(), rate, 0.25).tolist() == [7.0 * 0.75] * 2
    acts = gym.spaces.Box(-1, 1, (2,)) if kind is TD3 else gym.spaces.Discrete(2)
    algorithm = make_algorithm(kind(learning_rate=Linear(3e-4, 0)), gym.spaces.Discrete(2), acts)
    assert algorithm.init([Seeds(0)]).learning_rate.tolist() == pytest.approx([3e-4])


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_recorded_as_data_and_read_as_what_it_was(kind):
    line = kind(learning_rate=Linear(3e-4, 0))
    assert config_to_json(line)["learning_rate"] == {"start": 3e-4, "end": 0}
    assert config_from_json(config_to_json(line)) == line
    assert kind(learning_rate={"start": 3e-4, "end": 0}) == line
    function = kind(learning_rate=halving)
    assert config_to_json(function)["learning_rate"] == f"{__name__}:halving"
    again = config_from_json(config_to_json(function))
    assert again == function
    assert again.learning_rate(0.5) == halving(0.5)
    for made in (closing(2e-3), lambda remaining: 2e-3 * remaining):
        named = config_from_json(config_to_json(kind(learning_rate=made)))
        assert named.learning_rate(0.5) == 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_schedule_is_a_sentence(kind):
    name = kind.__name__
    for rate, says in (
        (lambda remaining: math.nan, rf"{name}\.learning_rate: .* returned nan; it must return"),
        (lambda remaining: remaining - 0.6, r"\(0\.5\) returned -0\.09"),
        (lambda remaining: 1.0 / remaining, r"\(0\) raised ZeroDivisionError.*test_schedules\.py"),
        (lambda remaining: "a", "raised ValueError"),
    ):
        with pytest.raises(DeclarationError, match=says):
            kind(learning_rate=rate)
    for values, says in (((math.inf, 0), "Linear.start is inf"), ((1e-3, -1), "Linear.end is -1")):
        with pytest.raises(DeclarationError, match=says):
            Linear(*values)


RATES = {"now": 1e-3}


def test_a_function_is_checked_each_time_it_is_used(monkeypatch):
    config = PPO(learning_rate=lambda remaining: RATES["now"])
    monkeypatch.setitem(RATES, "now", math.inf)
    with pytest.raises(DeclarationError, match=r"returned inf; it must return a finite number"):
        rate_now(config, torch.ones(1), 0.3)


def test_an_algorithm_of_the_users_own_that_does_not_follow_schedules_refuses_them(monkeypatch):
    monkeypatch.setattr("skillweave.algorithms.ppo.PPOAlgorithm.follows_schedules", False)
    spaces = gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)
    with pytest.raises(DeclarationError, match="does not follow schedules: give a number"):
        make_algorithm(PPO(learning_rate=Linear(1e-3, 0)), *spaces)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("config", "how"),
    [(ON, Linear(2e-3, 5e-4)), (ON, halving), (OFF, lambda remaining: 2e-3 * remaining)],
    ids=["ppo, a line", "ppo, a function", "dqn, a function without a name"],
)
def test_a_stopped_run_has_the_same_rates_as_one_that_was_not(tmp_path, config, how):
    def declare() -> Hierarchy:
        changed = replace(config, learning_rate=how)
        return Hierarchy(
            "CartPole-v1",
            [Left()],
            algorithm=changed,
            selector=changed,
            steps=600,
            learn="apart",
            train_defaults=sw.TrainDefaults(checkpoint_every=100),
        )

    declare().train(tmp_path / "whole", seed=3, quiet=True)
    run = stopped_run(declare(), tmp_path / "run", 3)
    stopped_again(declare(), run.path, 2)
    declare().resume(run.path, quiet=True)
    assert_same(run.path, tmp_path / "whole")
    schedule = how if callable(how) else None
    assert schedule is not None
    rates = [row["learning_rate"] for row in lines(run.path) if "learning_rate" in row]
    assert rates
    assert all(schedule(0.0) <= rate <= schedule(1.0) * 1.0001 for rate in rates)
    assert rates[0] > rates[len(rates) // 2 - 1]
    assert read_manifest(run.path).resume_needs_recipe  # of the skill in any case


def test_a_plain_agents_function_is_needed_to_resume_and_not_to_load(tmp_path, monkeypatch):
    for rate, needs in ((Linear(1e-3, 0), False), (halving, True)):
        config = replace(ON, learning_rate=rate)
        run = sw.train_agent("CartPole-v1", config, 100, tmp_path / str(needs), quiet=True)
        manifest = read_manifest(run.path)
        assert (manifest.resume_needs_recipe, manifest.needs_recipe) == (needs, False)
    monkeypatch.setattr("skillweave._internal.named._KNOWN", {})
    agent = sw.Agent.from_manifest(as_json(manifest))
    assert agent.load(run.path).policy is not None
    with pytest.raises(
        DeclarationError, match="a function of your own, and its code is not loaded"
    ):
        rate_now(agent.algorithm, torch.ones(1), 0.0)


def test_it_does_not_mutate():
    config = replace(ON, learning_rate=Linear(1e-3, 0))
    assert "learning_rate" not in Mutations().ranges_of(config)
    assert "gamma" in Mutations().ranges_of(config)
    ranges = {"learning_rate": Range(1e-4, 1e-2)}
    with pytest.raises(DeclarationError, match="learning_rate is a schedule, which cannot mutate"):
        Mutations(ranges=ranges).ranges_of(config)


def test_a_population_follows_it(tmp_path):
    config = replace(ON, learning_rate=Linear(2e-3, 1e-3))
    evolution = Evolution(population=2, generations=2, episodes=1)
    run = sw.train_agent("CartPole-v1", config, 400, tmp_path / "run", quiet=True, evolve=evolution)
    assert run.policy.algorithm.config.learning_rate == Linear(2e-3, 1e-3)


def test_the_command_line_writes_it_as_a_call():
    declared = Hierarchy("CartPole-v1", [Left()], algorithm=ON, selector=ON)
    apply_overrides(declared, ["selector.learning_rate=linear(3e-4,0)"])
    apply_overrides(declared, ["algorithm.learning_rate=1e-4"])
    assert declared.selector.learning_rate == Linear(3e-4, 0.0)
    assert declared.algorithm.learning_rate == 1e-4
    with pytest.raises(DeclarationError, match=r"selector\.learning_rate=linear"):
        apply_overrides(declared, ["selector.learning_rate=linear(3)"])
