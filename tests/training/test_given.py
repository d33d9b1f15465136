"""A policy that a stage was given is scored before and after, and kept where learning is worse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import EnvError
from skillweave.runs.manifest import GivenScore
from skillweave.training.given import FEWEST, compared, looks

SMALL = sw.Network((16,))
WILD = sw.PPO(num_envs=4, n_steps=32, learning_rate=0.3, ent_coef=100.0, network=SMALL)
"""Any policy becomes uniformly random."""


class Side(gym.Env[Any, Any]):
    """Ten steps, each of which pays where the action has the sign of the observation."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    made = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return self.seen(), {}

    def seen(self) -> Any:
        self.x = np.float32([self.np_random.uniform(-1, 1)])
        return self.x

    def step(self, action: Any) -> Any:
        paid = float((self.x[0] > 0) == bool(action))
        self.steps += 1
        return self.seen(), paid, False, self.steps >= 10, {}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> sw.Run:
    good = sw.PPO(num_envs=4, n_steps=32, network=SMALL, overlap=False)
    place = tmp_path_factory.mktemp("given") / "run"
    run = sw.train_agent(Side, good, 6_000, place, seed=0, quiet=True)
    assert run.evaluate(20).mean > 9.0
    return run


def learn_on(given: sw.Run, place: Path, algorithm: Any, steps: int = 4_000, **how: Any) -> Any:
    run = sw.train_agent(Side, algorithm, steps, place, start_from=given, seed=1, quiet=True, **how)
    return run, run.info()["stages"][0]


def equal(one: sw.Run, other: sw.Run) -> bool:
    return all(
        (x == other.policy.weights[k]).all()
        for k, x in one.policy.weights.items()
        if not k.startswith("obs_")
    )


def test_what_has_become_worse_is_not_kept(given: sw.Run, tmp_path: Path) -> None:
    run, stage = learn_on(given, tmp_path / "run", WILD)
    assert equal(run, given)
    assert stage["best"]["steps"] == 0
    assert stage["kept"]["given"] > 9.0
    assert run.evaluate(20).mean > 9.0


def test_keep_last_ends_with_it_and_says_so(given: sw.Run, tmp_path: Path) -> None:
    run, stage = learn_on(given, tmp_path / "run", WILD, keep="last")
    kept = stage["kept"]
    assert run.evaluate(20).mean < 9.0
    assert (kept["kept"], kept["worse"]) == ("greedy", True)
    assert kept["greedy"] < kept["given"] - 0.5
    assert kept["episodes"] >= FEWEST


def test_where_nothing_can_be_evaluated_meanwhile_the_last_score_decides(
    given: sw.Run, tmp_path: Path
) -> None:
    run, stage = learn_on(given, tmp_path / "run", WILD, steps=600)
    assert "best" not in stage or stage["best"] is None
    assert (stage["kept"]["kept"], stage["kept"]["worse"]) == ("given", True)
    assert equal(run, given)


def test_small_steps_keep_what_was_given_to_the_bit_of_a_stopped_run(
    given: sw.Run, tmp_path: Path
) -> None:
    usual = sw.PPO(num_envs=4, n_steps=32, network=SMALL)
    whole, stage = learn_on(given, tmp_path / "whole", usual)
    assert whole.evaluate(50).mean > 9.0
    assert "worse" not in stage["kept"]
    seen: list[Any] = []

    def interrupt(event: Any) -> None:
        seen.append(event)
        if len(seen) == 17:
            raise KeyboardInterrupt

    place = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        learn_on(given, place, usual, callback=interrupt, checkpoint_every=512)
    again = sw.train_agent(Side, usual, 4_000, place, resume=True, seed=1, quiet=True)
    assert equal(again, whole)
    assert again.info()["stages"][0]["kept"] == stage["kept"]


def test_more_steps_of_a_run_that_became_better_are_small(tmp_path: Path) -> None:
    usual = sw.PPO(num_envs=4, n_steps=32, network=SMALL)
    how: Any = {"eval_every": 1_000, "seed": 0, "quiet": True}
    sw.train_agent(Side, usual, 4_000, tmp_path / "run", **how)
    run = sw.train_agent(Side, usual, 6_000, tmp_path / "run", resume=True, **how)
    stage = run.info()["stages"][0]
    assert stage["careful"]
    rates = [line["learning_rate"] for line in _lines(run) if line["steps"] > 4_096]
    assert rates[0] == pytest.approx(1e-4)
    assert max(rates) <= 1e-3 + 1e-9


def _lines(run: sw.Run) -> list[dict[str, Any]]:
    import json

    lines = (run.path / "metrics.jsonl").read_text().splitlines()
    return [line for line in map(json.loads, lines) if "learning_rate" in line]


class Single(Side):
    """Only five of it may exist at once."""

    open = 0

    def __init__(self) -> None:
        if Single.open >= 5:
            raise RuntimeError("the simulator is in use")
        Single.open += 1

    def close(self) -> None:
        Single.open -= 1


def test_an_environment_that_cannot_be_made_again_is_no_obstacle(
    given: sw.Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    usual = sw.PPO(num_envs=4, n_steps=32, network=SMALL)
    env = sw.EnvSpec(Single, check_seed=False, workers=1)
    with pytest.raises(EnvError, match="in use"):
        sw.train_agent(env, usual, 600, tmp_path / "a", eval_every=100, seed=1, quiet=True)
    Single.open = 0
    run = sw.train_agent(env, usual, 600, tmp_path / "b", start_from=given, seed=1)
    assert "is not scored" in capsys.readouterr().err
    assert run.info()["stages"][0].get("kept") is None


def score(returns: list[float], sampled: list[float] = [], success: list[float] = []) -> GivenScore:  # noqa: B006
    return GivenScore(1, 10, returns, success, sampled, 10.0)


def test_worse_is_said_only_where_it_is_clear() -> None:
    rng = np.random.default_rng(0)
    wrong = 0
    for _ in range(500):
        one, other = rng.normal(0, 1, (2, 8)).tolist()
        wrong += compared(score(one), score(other), False).is_worse
    assert wrong <= 12  # 1 % one-sided, near Student's t
    assert compared(score([1.0] * 5), score([0.0] * 5), True).kept == "given"
    assert compared(score([1.0] * 5), score([1.0] * 5), True).kept == "greedy"
    by_success = compared(
        score([1.0] * 6, success=[1.0] * 6), score([1.0] * 6, success=[0.0] * 6), False
    )
    assert by_success.is_worse
    assert "success 100% as it was given, 0% now" in str(by_success)
    sampling = compared(score([5.0] * 6), score([1.0] * 6, [4.0, 5.0, 5.0, 4.0, 5.0, 4.0]), False)
    assert "deterministic=False" in str(sampling)


def test_evaluations_that_nobody_asked_for_cost_a_tenth_at_most() -> None:
    every, episodes = looks(score([1.0]), 10_000)
    assert (every, episodes) == (2_500, 20)
    assert looks(score([1.0]), 1_999) == (0, 0)  # five episodes of ten steps, four times


class Follow(sw.Skill):
    """Does what pays."""

    max_steps = 5


class Against(sw.Skill):
    """Does what does not."""

    max_steps = 5

    def reward(self, step: sw.Step) -> Any:
        return -step.reward


def test_a_hierarchy_that_was_given_whole_is_kept_and_can_be_given_again(tmp_path: Path) -> None:
    good = sw.PPO(num_envs=4, n_steps=32, network=SMALL)

    def declare(algorithm: Any, steps: int) -> sw.Hierarchy:
        skills = [Follow(), Against()]
        how: Any = {"algorithm": algorithm, "selector": algorithm, "learn": "together"}
        return sw.Hierarchy(Side, skills, steps=steps, call_steps=5, **how)

    first = declare(good, 16_000).train(tmp_path / "first", seed=0, quiet=True)
    assert first.evaluate(20).mean > 8.5
    how: Any = {"seed": 1, "quiet": True}
    wild = declare(WILD, 6_000).train(tmp_path / "wild", start_from=first, **how)
    (stage,) = wild.info()["stages"]
    assert stage["kept"]["kept"] == "given"
    assert not (tmp_path / "wild" / "starts").exists()
    assert wild.evaluate(20).mean > 8.5
    loaded = sw.load(tmp_path / "wild", declare(WILD, 6_000))
    assert loaded.evaluate(20).mean == wild.evaluate(20).mean
    again = declare(good, 1_000).train(tmp_path / "again", start_from=wild, **how)
    assert again.info()["stages"][0]["kept"]["before"] == pytest.approx(
        stage["kept"]["before"], abs=1.0
    )
    last = declare(WILD, 6_000).train(tmp_path / "last", start_from=first, keep="last", **how)
    assert last.evaluate(20).mean < 8.5
