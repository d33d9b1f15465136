"""A skill is repaired where another one ends; what comes out is kept only if it is better."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from small_runs import assert_same, stage_entry

import skillweave as sw
from skillweave.algorithms import ppo
from skillweave.api import Run
from skillweave.calls import Handover, held, record_calls
from skillweave.calls.record import RandomChoice
from skillweave.errors import DeclarationError, Interrupted, RunError
from skillweave.experience.collector import Collector
from skillweave.hierarchy.roles import roles_of
from skillweave.planning import Mission
from skillweave.repair import repair_stage as repair, repairing
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Matrix, RepairEntry


class Buttons(gym.Env[Any, Any]):
    """Three presses of the right button are the goal: button 2, or button 0 once button 1 flipped.

    Observations: 1, or 2 once it is flipped; the number of right presses, which a flip sets to 0.
    """

    observation_space = gym.spaces.Box(-1, 3, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.side, self.count, self.t = 1, 0, 0
        return self._obs(), {}

    def step(self, action: int) -> Any:
        self.t += 1
        if action == 1:
            self.side, self.count = -1, 0
        elif action == 1 + self.side:
            self.count = min(3, self.count + 1)
        return self._obs(), 0.0, False, self.t == 60, {}

    def _obs(self) -> Any:
        return np.array([1.5 - self.side / 2, self.count], np.float32)


SPEC = sw.EnvSpec(Buttons, engine="sync", workers=1)


def at_goal(obs: Any) -> Any:
    return obs[:, 1] == 3


class Press(sw.Skill):
    """Learns to press the right button before the flip alone."""

    max_steps = 8

    def reward(self, step: Any) -> Any:
        flipped = step.next_obs[:, 0] > step.obs[:, 0]
        return step.next_obs[:, 1] - step.obs[:, 1] - 2.0 * flipped

    def success(self, step: Any) -> Any:
        return at_goal(step.next_obs)

    def termination(self, step: Any) -> Any:
        return at_goal(step.next_obs)


class Wrong(Press):
    """Its reward is for the wrong button: it cannot learn what ``success`` says."""

    name = "press"

    def reward(self, step: Any) -> Any:
        return step.obs[:, 1] - step.next_obs[:, 1] - 0.1 * (step.action == 1)


class Flip(sw.Skill):
    """Presses the button that flips."""

    max_steps = 5

    def policy(self, obs: Any) -> Any:
        return np.ones(len(obs), np.int64)

    def success(self, step: Any) -> Any:
        return step.next_obs[:, 0] == 2

    def termination(self, step: Any) -> Any:
        return step.next_obs[:, 0] == 2


class Never(Flip):
    """May never start."""

    def initiation(self, obs: Any) -> Any:
        return obs[:, 1] > 5


ON = sw.PPO(
    num_envs=16, n_steps=16, batch_size=64, update_epochs=4, learning_rate=5e-3,
    normalize_obs=False, gamma=0.9, ent_coef=0.05, network=sw.Network(hidden=(16,)), overlap=False,
)  # fmt: skip
STEPS = 2_048


def declare(*skills: sw.Skill, algorithm: Any = ON, steps: int = STEPS, **how: Any) -> sw.Hierarchy:
    skills = skills or (Press(), Flip())
    first = skills[0].name
    settings = {"call_steps": None, "learn": "apart", "selector": lambda obs: [first] * len(obs)}
    settings |= {"apart": sw.Apart(skill_steps=steps)}
    return sw.Hierarchy(SPEC, skills, algorithm=algorithm, **settings | how)


@pytest.fixture(autouse=True, scope="module")
def _small() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(repair, "CHUNK", 1_500)
        patch.setattr(repair, "ENOUGH_STEPS", 3_000)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return declare().train(tmp_path_factory.mktemp("runs") / "buttons", quiet=True)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of a skill that cannot become better."""
    folder = tmp_path_factory.mktemp("runs")
    return declare(Wrong(), Flip(), steps=512).train(folder / "wrong", quiet=True)


def repaired(run: Run, path: Path | None, **how: Any) -> Run:
    steps = {} if how.get("resume") else {"steps": 5_120}
    settings = {"after": "flip", "calls": 20, "quiet": True, **steps} | how
    return run.repair(settings.pop("skill", "press"), run_dir=path, **settings)


def weights(run: Run) -> dict[str, Any]:
    """The weights of the first skill, for comparison."""
    return {k: v.tolist() for k, v in run.policy.skills.policies[0].weights.items()}


def test_a_skill_learns_to_go_on_from_where_the_other_ends(run, tmp_path):
    new = repaired(run, tmp_path / "new")
    (result,) = new.repairs
    assert result.before.of("press", "flip")[0] < 0.2
    assert result.later.of("press", "flip")[0] > 0.9
    assert result.later.of("press")[0] > 0.9, "nothing is forgotten"
    assert min(result.before.of("press", "flip")[1], result.later.of("press", "flip")[1]) >= 20
    assert result.kept
    assert result.sentence.endswith("so the repaired weights are kept")
    assert "itself has to work from there" in result.blame
    assert result.sentence in str(result)
    assert weights(run) != weights(new)
    again = sw.load(new.path, declare())
    assert weights(again) == weights(new)
    assert again.repairs[0].sentence == result.sentence
    manifest = json.loads((new.path / "run.json").read_text())
    *_, entry = manifest["stages"]
    assert (entry["name"], entry["learns"]) == ("press-repair", ["press"])
    assert entry["repair"]["after"] == "flip"
    assert not run.repairs, "the run itself stays as it is"
    assert sw.load(run.path, declare()).info()["stages"] == run.info()["stages"]
    with pytest.raises(DeclarationError, match="there is nothing to repair"):
        repaired(new, tmp_path / "newer")


@pytest.mark.slow
@pytest.mark.parametrize("rehearses", [True, False])
def test_a_repaired_skill_keeps_its_other_starts_by_rehearsal(
    run, tmp_path, monkeypatch, rehearses
):
    # All episodes start after the other skill, so nothing else keeps what was learnt at the start.
    monkeypatch.setattr(repair, "REHEARSED_SHARE", 1.0)
    if not rehearses:
        monkeypatch.setattr(ppo, "REHEARSAL_COST", 0.0)
    (result,) = repaired(run, tmp_path / "new", steps=10_240).repairs
    assert result.later.of("press", "flip")[0] > 0.9
    assert result.before.of("press")[0] > 0.9
    kept = result.later.of("press")[0]
    assert kept > 0.9 if rehearses else kept < 0.5


def test_observations_of_done_calls_are_rehearsed(run):
    log = record_calls(SPEC, run.policy, 600, num_envs=4)
    skill = run.hierarchy.skill("press")
    obs = repair.rehearsed_obs(log, skill, None, "flip", None)
    assert obs is not None
    assert (obs[:, 0] == 1).all(), "after the flip no call is done"
    done = log.succeeded & (log.skill == 0)
    assert len(obs) == log.tau[done].sum()
    assert repair.rehearsed_obs(log, skill, None, "press", None) is not None
    failed = log.take(np.flatnonzero(~log.succeeded))
    assert repair.rehearsed_obs(failed, skill, None, "flip", None) is None


class Swapped(Press):
    """Sees its numbers the other way round."""

    name, sees = "press", (1, 0)


def test_what_a_skill_rehearses_is_its_part(tmp_path):
    first = declare(Swapped(), Flip(), steps=512).train(tmp_path / "run", quiet=True)
    done = {"press": lambda obs: obs[:, 1] >= 0}
    log = record_calls(SPEC, first.policy, 600, num_envs=4)
    seen, swapped = (
        repair.rehearsed_obs(log, h.skill("press"), roles_of(h)["press"].part, "flip", done)
        for h in (declare(), declare(Swapped(), Flip()))
    )
    assert seen is not None
    assert swapped is not None
    assert len(np.unique(seen, axis=0)) > 1
    assert np.array_equal(swapped, seen[:, ::-1])
    new = repaired(first, tmp_path / "new", **SHORT)
    assert new.repairs


class Stay(sw.Skill):
    """Has neither a reward nor an end of its own."""

    name = "remain"

    def success(self, step: Any) -> Any:
        return at_goal(step.next_obs)


def steps_to(*counts: int) -> sw.Step:
    """Steps to these counts; the last one ends the episode."""
    n = len(counts)
    obs = np.array([[1, 0]] * n, np.float32)
    last = np.arange(n) == n - 1
    return sw.Step(
        obs=obs, action=np.zeros(n, np.int64), reward=np.full(n, 0.5, np.float32),
        next_obs=np.array([[1, c] for c in counts], np.float32), terminated=last,
        truncated=np.zeros(n, bool), timed_out=np.zeros(n, bool), elapsed=np.ones(n, np.int64),
        info={},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("skill", "rewards"),
    [(Stay(), [0.5, 2.5, 2.5, 10.5]), (Press(), [2.0, 13.0, 13.0, 13.0])],
    ids=["goes on", "ends by it"],
)
def test_an_eager_skill_is_paid_while_its_event_holds(skill, rewards):
    holds = repair.event_of(skill, None)
    assert holds is not None
    twin = repair.eager(skill, holds, bonus=2.0, rest=10.0)
    np.testing.assert_allclose(twin.reward(steps_to(2, 3, 3, 3)), rewards)
    assert twin.defines("reward")
    assert twin.name == skill.name
    assert skill.defines("reward") == isinstance(skill, Press), "the skill itself stays as it is"


def test_the_event_of_a_repair_is_the_callers_or_success():
    step = steps_to(1, 3)
    for event in (held(lambda obs: obs[:, 1] == 1, 50), lambda obs: obs[:, 1] == 1):
        holds = repair.event_of(Press(), {"press": event})
        assert holds is not None
        assert holds(step).tolist() == [True, False]
    holds = repair.event_of(Press(), {"flip": at_goal})
    assert holds is not None
    assert holds(step).tolist() == [False, True]


def test_calls_of_a_repair_have_the_selectors_limit():
    roles = roles_of(declare(Press(), Flip(), call_steps=5))
    policies = {name: RandomChoice(3) for name in roles.skills}
    entry = stage_entry("r")
    entry.repair = RepairEntry("press", "flip", 20, [], "", Matrix([], [], [], [], []))
    stage = repair.repair_stage(roles, entry, None)
    collector = stage.learning_task(policies).collector(2, None)
    assert isinstance(collector, Collector)
    assert collector.limit == 5, "of 8 by itself"


def test_what_is_not_better_is_not_kept_and_measuring_stops(wrong, tmp_path, monkeypatch):
    monkeypatch.setattr(repair, "MOST_STEPS", 4_000)
    new = repaired(wrong, tmp_path / "new", **SHORT | {"calls": 100_000})
    (result,) = new.repairs
    assert not result.kept
    assert weights(wrong) == weights(new) == weights(sw.load(new.path, declare(Wrong(), Flip())))
    stopped = (
        r"Measuring stopped after 4,\d+ steps: 100,000 calls of press after flip were wanted, and "
        r"there were \d+; flip was done in [\d,]+ of [\d,]+ calls\.$"
    )
    assert re.search(stopped, result.blame)
    assert re.search(r"so the earlier weights are kept\. " + stopped, result.sentence)


def test_a_pair_that_is_seldom_called_is_given_up(run, tmp_path, monkeypatch):
    monkeypatch.setattr(repair, "LARGEST_CHUNK", 1_500)
    monkeypatch.setattr(repair, "FEWEST", 50_000)
    monkeypatch.setattr(repairing, "FEWEST", 50_000)
    says = (
        r"'press' was called only \d+ times after a call of 'flip' that was done, too few.*: let "
        r"'flip' be done more often first\. Measuring stopped after [3-4],\d+ steps"
    )
    with pytest.raises(DeclarationError, match=says):
        repaired(run, tmp_path / "new", calls=100_000)
    assert not (tmp_path / "new").exists()


def matrix(*rows: tuple[float, float]) -> Handover:
    """Rates of the skills a and b after start, a and b, from 100 calls each."""
    done = np.rint(100 * np.array(rows)).astype(np.int64)
    return Handover(("a", "b"), np.full((3, 2), 100), done, np.zeros((3, 2), np.int64))


@pytest.mark.parametrize(
    ("later", "kept", "says"),
    [
        (((0.9, 0.9), (0.9, 0.8), (0.9, 0.9)), True, "no other pair is clearly worse"),
        (((0.9, 0.9), (0.9, 0.3), (0.9, 0.9)), False, "b after a: 20% of 100 calls"),
        (((0.9, 0.9), (0.9, 0.0), (0.9, 0.9)), False, "not clearly better"),
        (((0.9, 0.6), (0.9, 0.8), (0.9, 0.9)), False, "b after start: 90% of 100 calls"),
        (((0.9, 0.9), (0.9, 0.8), (0.6, 0.9)), False, "a after b: 90% of 100 calls"),
        (((0.9, 0.85), (0.9, 0.8), (0.9, 0.9)), True, "b after a: 20%"),
    ],
)
def test_a_repair_is_kept_if_the_pair_is_better_and_no_other_worse(later, kept, says):
    before = matrix((0.9, 0.9), (0.9, 0.2), (0.9, 0.9))
    found, sentence = repair.verdict(before, matrix(*later), "b", "a")
    assert found == kept
    assert says in sentence


def test_a_few_calls_suffice_to_see_that_all_is_forgotten_and_without_one_nothing_is_known():
    before = matrix((0.9, 0.9), (0.9, 0.2), (0.9, 0.9))
    later = matrix((0.1, 0.9), (0.9, 0.9), (0.9, 0.9))
    before.calls[0, 0] = before.done[0, 0] = 8
    assert "a after start: 100% of 8 calls" in repair.verdict(before, later, "b", "a")[1]
    before.calls[0, 0] = before.done[0, 0] = 0
    assert repair.verdict(before, later, "b", "a")[0]


SHORT = {"steps": 1_024, "calls": 5}
"""Too few steps to become better."""


def stop(event: Any) -> None:
    if event.steps >= 512:
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def whole(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A repair that was not stopped."""
    return repaired(run, tmp_path_factory.mktemp("runs") / "whole", **SHORT)


@pytest.mark.parametrize("by", ["hierarchy", "repair"])
def test_a_stopped_repair_ends_with_the_same_weights(run, whole, tmp_path, by):
    with pytest.raises(Interrupted, match=r'run\.repair\("press", after="flip", run_dir='):
        repaired(run, tmp_path / "part", callback=stop, **SHORT)
    assert not RunDirectory.open(tmp_path / "part").finished
    if by == "repair":
        new = repaired(run, tmp_path / "part", resume=True)
    else:
        new = declare().resume(tmp_path / "part", quiet=True)
    assert_same(new.path, whole.path)
    assert new.repairs[0].sentence == whole.repairs[0].sentence


def test_a_repair_that_was_stopped_while_it_was_measured_goes_on(run, whole, tmp_path, monkeypatch):
    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(repair, "verdict", stopped)
        with pytest.raises(Interrupted):
            repaired(run, tmp_path / "part", **SHORT)
    stages = RunDirectory.open(tmp_path / "part").manifest.stages
    assert all(entry.done for entry in stages)
    with pytest.raises(RunError, match=r"run\.repair"):
        sw.load(tmp_path / "part", declare())
    assert_same(declare().resume(tmp_path / "part", quiet=True).path, whole.path)


def test_events_of_the_caller_judge_and_are_needed_again(run, tmp_path):
    done = {"press": lambda obs: obs[:, 1] >= 0}
    with pytest.raises(DeclarationError, match="nothing to repair"):
        repaired(run, tmp_path / "a", done=done)
    done = {"press": at_goal}
    with pytest.raises(Interrupted, match=r"done=\.\.\."):
        repaired(run, tmp_path / "b", done=done, callback=stop, **SHORT)
    with pytest.raises(RunError, match=r"is judged by done= of press, which is code: continue"):
        declare().resume(tmp_path / "b", quiet=True)
    assert len(repaired(run, tmp_path / "b", done=done, resume=True).repairs) == 1
    with pytest.raises(DeclarationError, match="no skill 'zero'"):
        repaired(run, tmp_path / "c", done={"zero": at_goal})


def test_a_weights_file_is_repaired_and_a_repaired_run_again(run, tmp_path):
    run.save_weights(tmp_path / "buttons.safetensors")
    loaded = declare().load_weights(tmp_path / "buttons.safetensors")
    first = repaired(loaded, tmp_path / "first", **SHORT | {"steps": 256})
    assert len(first.repairs) == 1
    assert weights(sw.load(tmp_path / "first", declare())) == weights(first)
    assert not loaded.repairs
    second = repaired(first, tmp_path / "second", **SHORT)
    assert [r.kept for r in second.repairs] == [False, False]
    names = [entry["name"] for entry in second.info()["stages"]]
    assert names == ["press", "press-repair", "press-repair-2"]


@pytest.mark.slow
def test_a_skill_of_dqn_is_repaired_too(tmp_path):
    off = sw.DQN(
        num_envs=4, batch_size=32, learning_starts=200, buffer_size=4_000, gamma=0.9,
        learning_rate=3e-3, update_ratio=0.25, exploration_fraction=0.4,
        network=sw.Network(hidden=(16,)),
    )  # fmt: skip
    first = declare(algorithm=off, steps=1_000).train(tmp_path / "run", quiet=True)
    new = repaired(first, tmp_path / "new", **SHORT)
    assert len(new.repairs) == 1
    again = sw.load(new.path, declare(algorithm=off))
    assert again.repairs[0].sentence == new.repairs[0].sentence


def test_a_skill_inside_another_hierarchy_is_repaired(tmp_path):
    def nested() -> sw.Hierarchy:
        inner = declare().as_skill("inner", max_steps=60)
        outer = declare(Flip())
        return sw.Hierarchy(
            SPEC, [inner, Flip()], call_steps=None, learn="apart", algorithm=ON,
            selector=lambda obs: ["inner"] * len(obs), apart=outer.apart,
        )  # fmt: skip

    first = nested().train(tmp_path / "run", quiet=True)
    new = repaired(first, tmp_path / "new", skill="inner/press", **SHORT)
    assert new.repairs[0].skill == "inner/press"
    assert new.repairs[0].after == "inner/flip"
    with pytest.raises(DeclarationError, match="is a hierarchy: repair a skill of it"):
        repaired(first, tmp_path / "newer", skill="inner")
    with pytest.raises(DeclarationError, match="that the same selector calls: flip"):
        repaired(first, tmp_path / "newer", skill="inner/press", after="to_zer")


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"skill": "zero"}, "skill is 'zero'; it must be the name of a skill: press, flip"),
        ({"after": "lft"}, "after is 'lft'; it must be a skill that the same selector calls: flip"),
        ({"after": 3}, "after is 3"),
        ({"after": "press"}, "cannot be repaired after itself"),
        ({"skill": "flip", "after": "press"}, "is ready: its policy was given"),
        ({"steps": 100}, "learns for the first time after 256"),
        ({"steps": 0}, "steps is 0"),
        ({"calls": 0}, "calls is 0"),
        ({"resume": True}, "resume=True continues a repair, so name its directory"),
    ],
)
def test_what_cannot_be_repaired_is_said(run, how, says):
    with pytest.raises(DeclarationError, match=says):
        repaired(run, None, **how)


def test_runs_that_cannot_be_repaired(run, tmp_path):
    planned = run.plan(Mission(at_goal), run.log_calls(500))
    with pytest.raises(RunError, match="was planned"):
        repaired(planned, tmp_path / "a")
    agent = sw.Agent(SPEC, ON, 256).train(tmp_path / "agent", quiet=True)
    with pytest.raises(DeclarationError, match="plain agent"):
        repaired(agent, tmp_path / "a")
    with pytest.raises(RunError, match="holds a run: name a new directory"):
        repaired(run, run.path)
    with pytest.raises(RunError, match="holds no repair of 'press' after 'flip'"):
        repaired(run, run.path, resume=True)
    never = declare(Press(), Never(), steps=512).train(tmp_path / "never", quiet=True)
    with pytest.raises(DeclarationError, match=r"never called after 'never'.*Measuring stopped"):
        repaired(never, tmp_path / "a", after="never")


def test_start_calls_by_name_are_checked_and_recorded(tmp_path):
    with pytest.raises(DeclarationError, match="start_calls names 'flop', which is no skill here"):
        declare(apart=sw.Apart(start_calls=("flop",)))
    for wrong in ((), "flip", ("flip", 3)):
        with pytest.raises(DeclarationError, match="start_calls"):
            sw.Apart(start_calls=wrong)
    apart = sw.Apart(skill_steps=1_024, start_calls=["flip"])
    assert apart.start_calls == ("flip",)
    run = declare(apart=apart).train(tmp_path / "run", quiet=True)
    assert run.info()["hierarchy"]["start_calls"] == ["flip"]
    assert sw.load(run.path, declare()).hierarchy.apart.start_calls == ("flip",)
