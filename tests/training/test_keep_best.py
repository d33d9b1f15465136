"""``train(keep="best")``: a stage ends with the weights of its best periodic evaluation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest
import torch
from small_runs import (
    OFF,
    ON,
    Balance,
    Heard,
    Left,
    Push,
    assert_same,
    interrupt_at_checkpoint,
    interrupted,
    lines,
    new_run,
    policies,
)

from skillweave import (
    Agent,
    Apart,
    EnvSpec,
    Hierarchy,
    Skill,
    SkillweaveError,
    Together,
    TrainDefaults,
    train_agent,
)
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.evolution import Evolution
from skillweave.hierarchy import select_best, training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.runs.manifest import Best
from skillweave.training.keep_best import KeepBest

SYNC = EnvSpec("CartPole-v1", engine="sync", workers=1)
WILD = replace(ON, learning_rate=0.05)
"""So that the last weights are seldom the best."""
REPLAY = replace(OFF, update_ratio=0.25)
BEST = {
    "eval_every": 100,
    "eval_episodes": 3,
    "checkpoint_every": 150,
    "keep": "best",
    "quiet": True,
}


def agent(steps: int = 960, algorithm=WILD) -> Agent:
    return Agent(SYNC, algorithm, steps)


def hierarchy(learn: str, algorithm=WILD) -> Hierarchy:
    return Hierarchy(
        SYNC,
        [Left(), Balance(), Push()],
        algorithm=algorithm,
        selector=WILD,
        call_steps=6,
        learn=learn,
        apart=Apart(skill_steps=320, selector_steps=480),
        together=Together(steps=640),
    )


def evaluations(path: Path, stage: str) -> dict[int, float]:
    return {
        x["steps"]: x["eval_return"]
        for x in lines(path)
        if x["stage"] == stage and "eval_return" in x
    }


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [WILD, replace(REPLAY, overlap=True)], ids=["ppo", "dqn"])
def test_a_stage_ends_with_the_weights_of_its_best_evaluation(algorithm, tmp_path):
    budget = 960 if algorithm is WILD else 2_400
    how = BEST | {"eval_every": budget // 6}
    run = agent(budget, algorithm).train(tmp_path / "best", **how)
    (entry,) = run.info()["stages"]
    found = evaluations(run.path, "agent")
    best = max(found, key=lambda steps: (found[steps], steps))
    assert entry["best"] == {"steps": best, "of": "return", "value": found[best]}
    assert entry["final"]["eval_return"] == found[best]
    assert best < entry["steps"], "else this test says nothing: choose another seed"
    # The same training that ends there by itself.
    other = agent(budget, algorithm).train(
        tmp_path / "there", **how | {"keep": "last"}, callback=lambda e: e.steps < best
    )
    mine, theirs = policies(run.path), policies(other.path)
    assert [x[1] for x in mine.values()] == [x[1] for x in theirs.values()]


def test_the_last_weights_are_evaluated_too(tmp_path):
    run = agent(320).train(tmp_path / "run", **BEST | {"eval_every": 10_000})
    assert list(evaluations(run.path, "agent")) == [320]
    assert run.info()["stages"][0]["best"]["steps"] == 320
    last = agent(320).train(tmp_path / "last", **BEST | {"keep": "last", "eval_every": 10_000})
    assert evaluations(last.path, "agent") == {}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("learn", ["together", "apart, then together"])
def test_every_stage_keeps_its_best_and_says_so(learn, tmp_path, monkeypatch):
    judged = []
    scores = select_best._scores

    def noted(roles, level, run, before, after, *more):
        judged.append((run, after))
        return scores(roles, level, run, before, after, *more)

    monkeypatch.setattr(select_best, "_scores", noted)
    heard = Heard()
    defaults = TrainDefaults(eval_every=100, eval_episodes=3, keep="best")
    run = new_run(hierarchy(learn), tmp_path / "run", how=defaults)
    training.train(hierarchy(learn), run, (heard,))
    run.close()
    for entry in run.manifest.stages:
        found = evaluations(run.path, entry.name)
        best = max(found, key=lambda steps: (found[steps], steps))
        assert entry.best == Best(best, "return", found[best])
        said = f"{entry.name}: kept the weights of step {best:,}, whose evaluation was best"
        assert sum(text.startswith(said) for text in heard.said) == 1
    for judged_run, after in judged:  # those that are kept, and no others
        for name, policy in judged_run.load_policies("together").items():
            for key, weight in policy.weights.items():
                assert torch.equal(after[name].weights[key], weight)
    assert judged


KINDS = {
    "ppo": agent,
    "without overlap": lambda: agent(960, replace(WILD, overlap=False)),
    "dqn": lambda: agent(1_500, replace(REPLAY, overlap=True)),
    "together, from replay": lambda: hierarchy("together", REPLAY),
    "apart, then together": lambda: hierarchy("apart, then together"),
}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_keeps_the_same(kind, tmp_path, monkeypatch):
    KINDS[kind]().train(tmp_path / "whole", **BEST)
    stops = 0
    while True:
        with monkeypatch.context() as patch:
            interrupt_at_checkpoint(patch, 3 if kind == "apart, then together" else 2)
            try:
                if (tmp_path / "run").exists():
                    KINDS[kind]().resume(tmp_path / "run", quiet=True)
                else:
                    KINDS[kind]().train(tmp_path / "run", **BEST)
                break
            except KeyboardInterrupt:
                stops += 1
    assert stops >= 2
    assert_same(tmp_path / "run", tmp_path / "whole")
    runs = [RunDirectory.open(tmp_path / name) for name in ("run", "whole")]
    kept = [[entry.best for entry in run.manifest.stages] for run in runs]
    assert kept[0] == kept[1]


def test_the_best_is_in_the_checkpoint_once(tmp_path):
    with interrupted(4):
        agent().train(tmp_path / "run", **BEST)
    tensors, header = read_tensors(tmp_path / "run" / "checkpoint.safetensors")
    found = evaluations(tmp_path / "run", "agent")
    best = max(found, key=lambda steps: (found[steps], steps))
    assert header["kept_best"]["steps"] == best
    assert header["kept_best"]["metrics"]["eval_return"] == found[best]
    size = sum(v.nbytes for k, v in tensors.items() if k.startswith("best."))
    state = sum(v.nbytes for k, v in tensors.items() if k.startswith("state."))
    assert size == state > 0
    assert not list((tmp_path / "run").glob("*best*"))


class Long(gym.Wrapper):
    """Success is an episode of ten steps or more."""

    def reset(self, **how):
        self.steps = 0
        return self.env.reset(**how)

    def step(self, action):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        return obs, reward, terminated, truncated, info | {"success": self.steps >= 14}


def test_the_target_of_the_stage_decides_what_is_best_and_is_so_where_it_is_reached(tmp_path):
    run = train_agent(
        EnvSpec(lambda: Long(gym.make("CartPole-v1")), workers=1), WILD, 640, tmp_path / "run",
        target_success=1.0, **BEST | {"eval_episodes": 5},
    )  # fmt: skip
    (entry,) = run.info()["stages"]
    assert entry["best"]["of"] == "success"
    shares = [x["eval_success"] for x in lines(run.path) if "eval_success" in x]
    assert entry["best"]["value"] == max(shares)
    run = train_agent(SYNC, ON, 3_000, tmp_path / "reached", target_return=9.0, **BEST)
    (entry,) = run.info()["stages"]
    assert entry["reached"]["value"] == entry["best"]["value"]


def test_a_callback_that_stops_leaves_the_best_so_far(tmp_path):
    run = agent().train(tmp_path / "run", **BEST, callback=lambda e: e.steps < 480)
    (entry,) = run.info()["stages"]
    found = evaluations(run.path, "agent")
    assert entry["best"]["value"] == max(found.values())
    early = agent().train(tmp_path / "early", **BEST, callback=lambda e: e.steps < 60)
    assert "best" not in early.info()["stages"][0], "nothing was evaluated: the last ones count"


def ranked(of, *found: tuple[float, float]) -> int:
    """Steps of the best of evaluations (return, success)."""
    best = KeepBest(of)
    state = make_algorithm(ON, gym.spaces.Box(-1, 1, (2,)), gym.spaces.Discrete(2)).init([Seeds(0)])
    for steps, (value, success) in enumerate(found, 1):
        best.see({"eval_return": value, "eval_success": success}, steps, lambda: {"a": state})
        best.see({}, 99, dict)
    assert best.found is not None
    return best.found.steps


def test_of_equal_evaluations_the_latest_is_best():
    assert ranked("return", (1.0, 0.0), (3.0, 0.0), (3.0, 0.0), (2.0, 1.0)) == 3
    assert ranked("success", (1.0, 0.5), (3.0, 0.4), (0.5, 0.5), (-1.0, 0.2)) == 1
    assert ranked("return", (float("nan"), 0.0), (1.0, 0.0)) == 2


def test_populations_end_with_their_best_member_in_any_case(tmp_path, capsys):
    evolve = Evolution(2, 2, 2)
    run = agent(1_200, ON).train(tmp_path / "a", keep="best", evolve=evolve)
    assert "agent: a population always ends with its best member" in capsys.readouterr().err
    other = agent(1_200, ON).train(tmp_path / "b", evolve=evolve, quiet=True)
    assert [x[1] for x in policies(run.path).values()] == [
        x[1] for x in policies(other.path).values()
    ]
    with pytest.raises(SkillweaveError, match="keep is 'best', but nothing is evaluated"):
        hierarchy("apart").train(tmp_path / "c", keep="best", evolve={"left": evolve})


@pytest.mark.parametrize("flat", [False, True])
def test_keep_without_evaluations_is_refused_before_training(flat, tmp_path):
    says = "keep is 'best', but nothing is evaluated while it trains: set eval_every to the"
    with pytest.raises(SkillweaveError, match=says):
        hierarchy("together").train(tmp_path / "run", keep="best", flat=flat)
    with pytest.raises(SkillweaveError, match=says):
        agent().train(tmp_path / "run", keep="best")
    assert not (tmp_path / "run").exists()


def test_a_recipe_may_say_what_is_kept(tmp_path):
    class Up(Skill):
        def reward(self, step):
            return 1.0 - abs(step.next_obs[:, 2])

    defaults = TrainDefaults(eval_every=100, eval_episodes=2, keep="best", log_info=["x"])
    declared = Hierarchy(
        SYNC, [Up(), Left()], algorithm=ON, selector=ON, call_steps=5, steps=320,
        train_defaults=defaults,
    )  # fmt: skip
    run = declared.train(tmp_path / "run", quiet=True)
    assert run.info()["keep"] == "best"
    assert run.info()["log_info"] == ["x"]
    last = declared.train(tmp_path / "last", quiet=True, keep="last", log_info=())
    assert last.info()["keep"] == "last"
    assert last.info()["log_info"] == []
    assert "best" not in last.info()["stages"][0]


def test_the_start_from_another_run_is_the_first_evaluation(tmp_path):
    good = agent(9_600, replace(ON, num_envs=8)).train(tmp_path / "good", quiet=True)
    wild = replace(ON, learning_rate=1.0)
    how = {"start_from": good, **BEST, "eval_episodes": 10}
    run = agent(320, wild).train(tmp_path / "run", **how)
    (stage,) = run.info()["stages"]
    assert stage["best"]["steps"] == 0
    (kept,), (first,) = policies(run.path).values(), policies(good.path).values()
    assert kept[1] == first[1]
    found = evaluations(run.path, "agent")
    assert stage["best"]["value"] == found[0] == max(found.values())
    new = agent(320, wild).train(tmp_path / "new", **BEST)
    assert 0 not in evaluations(new.path, "agent")


def test_a_run_that_began_elsewhere_repeats_its_best_after_an_interrupt(tmp_path):
    good = agent(3_200, ON).train(tmp_path / "good", quiet=True)
    wild = replace(ON, learning_rate=1.0)
    whole = agent(640, wild).train(tmp_path / "whole", start_from=good, **BEST)
    with interrupted(1):
        agent(640, wild).train(tmp_path / "parts", start_from=good, **BEST)
    parts = agent(640, wild).train(tmp_path / "parts", start_from=good, resume=True, **BEST)
    assert_same(parts.path, whole.path)
    assert evaluations(parts.path, "agent") == evaluations(whole.path, "agent")
