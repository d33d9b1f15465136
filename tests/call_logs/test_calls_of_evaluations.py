"""Logs of calls of evaluations: the same calls as ``record_calls`` records."""

from __future__ import annotations

import re

import gymnasium as gym
import numpy as np
import pytest
from ready_selectors.chain import (
    DOOR,
    KEY,
    PLACE,
    Corridor,
    GetKey,
    Leave,
    OpenDoor,
    Wait,
    bound,
    hierarchy,
)
from toys import skills_of

from skillweave import Automaton, EnvSpec, Lengths
from skillweave.calls import CallLog, record_calls
from skillweave.calls.columns import columns_of
from skillweave.errors import DeclarationError, EnvError
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.policies.core import CallEnd
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet
from skillweave.training.evaluation import episode_seeds, evaluate
from skillweave.types import Array, Step


class Fixed(Corridor):
    """The corridor, whose episodes all start at place 3."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 3
        return self._obs(), {}


SPEC = EnvSpec(Fixed, engine="sync")


def chain() -> Automaton:
    return Automaton(
        {"wait": "wait", "search": "get_key", "unlock": "open_door", "free": "leave"},
        {
            ("wait", "search"): "failure",
            ("search", "unlock"): lambda step: step.next_obs[:, KEY] == 1,
            ("unlock", "free"): "success",
        },
    )


def lengths_of(obs: Array) -> Array:
    """Choices of a skill and a length: where, and how far, by the place."""
    odd = obs[:, PLACE].astype(int) % 2
    return np.where(obs[:, KEY] == 0, 0, np.where(obs[:, DOOR] == 0, 2, 4)) + odd


def policies() -> dict[str, HierarchyPolicy]:
    skills = (GetKey(), OpenDoor(), Leave(), Wait())
    lengths = skills_of(*skills, call_steps=Lengths(1, 3))
    chooser = ScriptedPolicy(lengths_of, Fixed.observation_space, gym.spaces.Discrete(8))
    return {
        "automaton": hierarchy(chain()),
        "limits": hierarchy(chain(), call_steps=2),
        "lengths": HierarchyPolicy(chooser, lengths),
    }


def assert_same(a: CallLog, b: CallLog):
    assert (a.skills, a.lengths, a.checksums, a.sees, a.recurrent) == (
        b.skills, b.lengths, b.checksums, b.sees, b.recurrent,
    )  # fmt: skip
    assert (a.observation_space, a.action_space) == (b.observation_space, b.action_space)
    assert columns_of(a).keys() == columns_of(b).keys()
    for name, column in columns_of(a).items():
        assert column.dtype == columns_of(b)[name].dtype, name
        assert name == "seed" or np.array_equal(column, columns_of(b)[name]), name


@pytest.mark.parametrize("name", ["automaton", "limits", "lengths"])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_an_evaluation_logs_what_record_calls_does(name, num_envs):
    policy = policies()[name]
    score = evaluate(policy, SPEC, episodes=6, num_envs=num_envs, log_calls=True, info=("door",))
    log = score.calls
    assert log.steps == sum(score.lengths)
    assert (log.seed == np.array(episode_seeds(0, 6))[log.episode]).all()
    assert np.unique(log.episode).tolist() == list(range(6))
    for episode, (total, steps) in enumerate(zip(score.returns, score.lengths, strict=True)):
        rows = log.episode[log.owner] == episode
        assert (log.reward[rows].sum(), rows.sum()) == (total, steps)
    chooser = policy.selector if name == "lengths" else chain()
    same = record_calls(SPEC, policy, log.steps, choose=chooser, num_envs=num_envs, info=["door"])
    assert_same(log, same.take(np.flatnonzero(same.episode < 6)))
    counts = {k: int((log.skill == i).sum()) for i, k in enumerate(log.skills)}
    assert score.skill_calls == counts
    own = log.end_reason == CallEnd.OWN
    assert {k: v.ended["own"] for k, v in score.skills.items()} == {
        k: int((own & (log.skill == i)).sum()) for i, k in enumerate(log.skills)
    }


def test_a_call_that_the_step_limit_cut():
    score = evaluate(hierarchy(chain()), SPEC, episodes=2, max_steps=4, log_calls=True)
    assert score.cut == 2
    log = score.calls
    assert log.tau.tolist() == [2, 2] * 2 or log.tau.tolist() == [2, 2, 2, 2]
    last = log.order == 1
    assert log.was_cut[last].all()
    assert not log.was_cut[~last].any()


def test_inner_calls_have_a_log_of_their_own():
    class Inner(Skill):
        name = "inner"
        max_steps = 3
        policy = hierarchy(lambda obs: np.full(len(obs), "wait"), call_steps=2)

    outer = HierarchyPolicy(
        bound(lambda obs: np.where(obs[:, PLACE] > 1, "get_key", "inner"), ("get_key", "inner")),
        SkillSet((GetKey(), Inner()), (GetKey.policy, Inner.policy), call_steps=3),
    )
    score = evaluate(outer, SPEC, episodes=2, log_calls=True)
    assert score.calls.skills == ("get_key", "inner")
    (path,) = score.inner_calls
    log = score.inner_calls[path]
    assert (path, log.skills) == ("inner", ("get_key", "open_door", "leave", "wait"))
    # The inner calls fill the outer ones.
    within = score.calls.of("inner")
    assert log.steps == within.steps
    assert (np.sort(log.age[log.owner] + log.elapsed) == np.sort(
        within.age[within.owner] + within.elapsed)).all()  # fmt: skip


def test_an_evaluation_says_what_seldom_succeeds_after_one_skill():
    class Look(Skill):
        name, max_steps, policy = "look", 1, Wait.policy

        def success(self, step: Step) -> Array:
            return step.next_obs[:, KEY] == 1

    class Fetch(GetKey):
        name = "fetch"

    class Rest(Wait):
        name = "rest"

        def termination(self, step: Step) -> Array:
            return np.ones(len(step.reward), bool)

    skills = (Look(), Fetch(), Rest())
    turn = Automaton(
        {"a": "rest", "b": "look", "c": "fetch", "d": "look"},
        {("a", "b"): "success", ("b", "c"): "failure", ("c", "d"): "success"},
    )
    policy = hierarchy(turn, skills=skills)
    score = evaluate(policy, SPEC, episodes=30, log_calls=True)
    (sentence,) = score.calls.handover().weakest()
    assert re.match(r"'look' succeeds in 0% of \d+ calls .* after 'rest'; in 100% of", sentence)
    assert score.for_people().count(sentence) == 1
    assert sentence in score._repr_html_().replace("&#x27;", "'")
    few = evaluate(policy, SPEC, episodes=3)
    assert "elsewhere" not in few.for_people()


def test_what_cannot_be_logged_says_so():
    policy = hierarchy(chain())
    with pytest.raises(DeclarationError, match=r"no calls were logged.*log_calls=True"):
        _ = evaluate(policy, SPEC, episodes=1).calls
    with pytest.raises(DeclarationError, match="set log_calls=True, too"):
        evaluate(policy, SPEC, episodes=1, info=("door",))
    with pytest.raises(DeclarationError, match=r"info is 'door'; it must be a list"):
        evaluate(policy, SPEC, episodes=1, log_calls=True, info="door")
    with pytest.raises(EnvError, match=r"info\['window'\] is to be recorded"):
        evaluate(policy, SPEC, episodes=1, log_calls=True, info=("window",))
    with pytest.raises(DeclarationError, match="has no skills"):
        evaluate(Wait.policy, SPEC, episodes=1, log_calls=True)
    with pytest.raises(DeclarationError, match="a skill that acts alone"):
        evaluate(SkillAlone(policy.skills, "wait"), SPEC, episodes=1, log_calls=True)
