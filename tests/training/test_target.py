"""A stage that ends early at a target."""

from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from skillweave import (
    DQN,
    PPO,
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Network,
    Selection,
    Skill,
    SkillweaveError,
    Step,
    TrainDefaults,
    train_agent,
)
from skillweave.cli import main
from skillweave.evolution import Evolution
from skillweave.evolution.evolving import plan
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.training.periodic import PeriodicEvaluation
from skillweave.training.replay_learner import ReplayLearner
from skillweave.training.stage import Target
from skillweave.types import Array

NET = Network((8,))
SMALL = PPO(num_envs=2, n_steps=8, batch_size=16, update_epochs=1, network=NET)
REPLAY = DQN(num_envs=2, learning_starts=20, batch_size=8, update_ratio=0.1, network=NET)


class Walk(gym.Env[Any, Any]):
    """Episodes of 10 steps, each paying 1; ``info["success"]`` at the end of every other one."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.lucky = 0, bool(self.np_random.random() < 0.5)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        info = {"success": self.t == 10 and self.lucky}
        return np.array([self.t / 10], np.float32), 1.0, self.t == 10, False, info


class Start(Skill):
    """Succeeds where it stops after three steps."""

    max_steps = 3

    def success(self, step: Step) -> Array:
        return step.timed_out


WALK = EnvSpec(Walk, engine="sync")


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [SMALL, REPLAY])
def test_training_ends_at_the_first_evaluation_that_is_good_enough(tmp_path, algorithm, made):
    run = train_agent(
        WALK, algorithm, 2_000, tmp_path / "run", target_return=10.0, eval_every=200,
        eval_episodes=3, quiet=True,
    )  # fmt: skip
    (entry,) = run.info()["stages"]
    assert entry["target"] == {"of": "return", "at_least": 10.0}
    assert entry["reached"] == {"steps": entry["steps"], "value": 10.0}
    assert entry["status"] == "done"
    lines = list(RunDirectory.open(run.path).metrics())
    assert [line["eval_return"] for line in lines if "eval_return" in line] == [10.0]
    assert 200 <= lines[-1]["steps"] <= entry["steps"] <= lines[-1]["steps"] + 16
    # Every step is counted, that of a rollout from which nothing was learnt included.
    assert entry["steps"] + entry["evaluation_steps"] == made[0]
    assert run.evaluate(2).mean == 10.0


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [SMALL, REPLAY])
def test_evaluations_and_a_target_that_is_not_reached_change_nothing(tmp_path, algorithm):
    weights = []
    for target, every in ((None, None), (11.0, 100)):
        run = train_agent(
            WALK, algorithm, 400, tmp_path / str(target), target_return=target, eval_every=every,
            eval_episodes=2, quiet=True,
        )  # fmt: skip
        (entry,) = run.info()["stages"]
        assert "reached" not in entry
        assert entry["steps"] == 400
        weights.append(read_tensors(run.path / "policies" / "agent.safetensors")[0])
    assert all(torch.equal(v, weights[1][k]) for k, v in weights[0].items())


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [SMALL, REPLAY])
@pytest.mark.parametrize("where", ["an evaluation before", "the target", "its policy"])
def test_a_run_stopped_on_its_way_to_the_target_ends_as_if_it_had_not_been(
    tmp_path, monkeypatch, algorithm, where
):
    # Evaluations every 100 steps tell 1, 2, 3, …; each falls together with a checkpoint.
    def due(self, since: int, steps: int, policy, **how) -> dict[str, float]:
        return {"eval_return": float(steps // 100)} if steps // 100 > since // 100 else {}

    monkeypatch.setattr(PeriodicEvaluation, "due", due)
    monkeypatch.setattr(ReplayLearner, "report_every", 100)
    agent = Agent(WALK, algorithm, 2_000, target_return=4.0)
    often = {"eval_every": 100, "checkpoint_every": 100}
    whole = agent.train(tmp_path / "whole", quiet=True, **often)
    reached = whole.info()["stages"][0]["reached"]
    assert reached["value"] == 4.0

    with monkeypatch.context() as patch:
        if where == "its policy":
            patch.setattr(RunDirectory, "save_policies", lambda *_: 1 / 0)
        else:
            at, reached_at = [0], Target.reached

            def dies(self, metrics, stage: str):
                at[0] = max(at[0], int(metrics.get("eval_return", 0)))
                if at[0] == (2 if where == "an evaluation before" else 4):
                    raise ZeroDivisionError
                return reached_at(self, metrics, stage)

            patch.setattr(Target, "reached", dies)
        with pytest.raises(ZeroDivisionError):
            agent.train(tmp_path / "run", quiet=True, **often)
    assert not RunDirectory.open(tmp_path / "run").finished
    again = agent.resume(tmp_path / "run", quiet=True)
    ours, theirs = again.info()["stages"][0], whole.info()["stages"][0]
    assert (ours["reached"], ours["steps"]) == (theirs["reached"], theirs["steps"])
    for key, value in whole.policy.weights.items():
        assert torch.equal(value, again.policy.weights[key]), key
    records = (list(RunDirectory.open(r.path).metrics()) for r in (whole, again))
    for a, b in zip(*records, strict=True):
        assert {**a, "seconds": 0} == {**b, "seconds": 0}


def test_skills_and_selector_have_targets_of_their_own(tmp_path, capsys):
    kinds = {"max_steps": 3, "target_return": 3.0}
    quick = type("Quick", (Skill,), kinds)()
    sure = type("Sure", (Start,), {"target_success": 1.0})()
    plain = type("Plain", (Skill,), {"max_steps": 3})()
    h = Hierarchy(
        WALK,
        [quick, sure, plain],
        call_steps=3,
        algorithm=SMALL,
        selector=SMALL,
        apart=Apart(skill_steps=320, selector_steps=320),
        selection=Selection(target_return=10.0),
        train_defaults=TrainDefaults(eval_every=50, eval_episodes=2),
        learn="apart",
    )
    run = h.train(tmp_path / "run")
    found = {s["name"]: s for s in run.info()["stages"]}
    assert {k: v["reached"]["value"] for k, v in found.items() if "reached" in v} == {
        "quick": 3.0, "sure": 1.0, "selector": 10.0,
    }  # fmt: skip
    assert found["plain"]["steps"] == 320
    assert all(found[k]["steps"] < 200 for k in ("quick", "sure", "selector"))
    said = capsys.readouterr().err
    assert "sure: target reached after" in said
    assert "success 1, the target is 1" in said


def test_the_success_of_an_agent_is_what_its_environment_tells(tmp_path):
    agent = Agent(WALK, SMALL, 640, target_success=0.99)
    run = agent.train(tmp_path / "run", quiet=True, eval_every=100, eval_episodes=20)
    (entry,) = run.info()["stages"]
    assert "reached" not in entry, "about half of the episodes succeed"
    told = [m["eval_success"] for m in RunDirectory.open(run.path).metrics() if "eval_return" in m]
    assert told
    assert all(0.1 < x < 0.9 for x in told)


def test_a_population_ends_at_its_stages_target(tmp_path):
    how = {"evolve": Evolution(2, 5, 1), "quiet": True}
    run = train_agent(WALK, SMALL, 500, tmp_path / "run", target_return=10.0, **how)
    (entry,) = run.info()["stages"]
    assert entry["winner"]["generations"] == 1
    assert entry["reached"]["value"] == 10.0


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"target_return": 1.0}, "stage 'agent': it has a target_return, .*set eval_every"),
        (
            {"target_success": 0.5, "target_return": 1.0, "eval_every": 9},
            "target_return or target_success, not both",
        ),
        (
            {"target_success": 0.5, "eval_every": 9, "evolve": Evolution(2, 2, 1)},
            "it evolves.*must be target_return",
        ),
    ],
)
def test_a_target_that_cannot_be_is_refused_before_anything_is_written(tmp_path, settings, says):
    with pytest.raises(SkillweaveError, match=says):
        train_agent(WALK, SMALL, 100, tmp_path / "run", quiet=True, **settings)
    assert not (tmp_path / "run").exists()


# The stage itself


def test_a_stage_that_evolves_is_not_trained_by_one_agent(tmp_path):
    h = Hierarchy(WALK, [Start()], algorithm=SMALL, selector=SMALL, learn="apart")
    content = training.manifest(h, seed=0, flat=True)
    plan(content.stages, Evolution(2, 2, 1))
    run = RunDirectory.create(tmp_path / "run", content)
    try:
        with pytest.raises(SkillweaveError, match="'agent' evolves: it needs a population"):
            training.train(h, run)
    finally:
        run.close()


def test_a_stage_says_who_learns_and_who_decides(tmp_path):
    h = Hierarchy(WALK, [Start()], algorithm=SMALL, selector=SMALL, learn="apart")
    entries = training.manifest(h, seed=0, flat=False).stages
    assert [(e.name, e.kind, e.learns, e.decides) for e in entries] == [
        ("start", "skill", ["start"], None),
        ("selector", "selector", ["selector"], "selector"),
    ]
    told = training.manifest(h, seed=0, flat=True)
    assert told.kind == "agent"
    assert not told.skills
    assert [(e.name, e.kind, e.learns, e.decides) for e in told.stages] == [
        ("agent", "agent", ["agent"], None)
    ]


def test_an_agent_is_loaded_without_a_hierarchy(tmp_path, capsys):
    agent = Agent("CartPole-v1", SMALL, 64)
    run = agent.train(tmp_path / "run", seed=2, quiet=True)
    again = agent.load(run.path)
    assert isinstance(again.declaration, Agent)
    assert again.evaluate(3).returns == run.evaluate(3).returns
    file = run.save_weights(tmp_path / "a.safetensors")
    assert Agent.from_weights(file).evaluate(3).returns == run.evaluate(3).returns
    for path in (run.path, file):
        assert main(["evaluate", str(path), "--episodes", "3", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["mean"] == run.evaluate(3).mean
    for what in (lambda: run.hierarchy, lambda: run.evaluate(1, skill="x")):
        with pytest.raises(SkillweaveError, match="plain agent"):
            what()
    flat = Hierarchy("CartPole-v1", [Start()], algorithm=SMALL, learn="apart").load(run.path)
    assert isinstance(flat.declaration, Agent)
    json.dumps(run.info())
