"""Decisions equal a scalar loop, call for call, though no environment waits for another."""

import itertools

import numpy as np
import pytest
from reference_calls import (
    Counter,
    Left,
    Right,
    Scalar,
    Walk,
    Zigzag,
    seeds_of,
    shy,
)
from toy_acting import Again, Choices, requests

from skillweave.collecting.calls import SkillSet
from skillweave.collecting.decisions import DecisionCollector
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.seeding import Seeds
from skillweave.skills import Skill
from skillweave.types import SkillweaveError

N, ALL = 4, (Left, Right, Zigzag, Counter)


def skill_set(*kinds, call_steps=5, **how):
    skills = tuple(kind() for kind in kinds)
    return SkillSet(skills, tuple(s.policy for s in skills), call_steps=call_steps, **how)


def collector_of(skills, n=N, keep_rewards=False, env=Walk):
    engine = make_engine(EnvSpec(env, engine="sync"), n)
    found = DecisionCollector(engine, Choices(n, len(skills.skills)), skills, keep_rewards)
    found.start(Seeds(7))
    return found


def scalars_of(skills, call_steps, n=N, gamma=0.97, reflexes=()):
    found = [Scalar(Walk(), skills, call_steps, gamma, reflexes) for _ in range(n)]
    seed = (Seeds(7) / "env").integer()
    for scalar, seeds in zip(found, seeds_of(seed, n), strict=True):
        scalar.reset(seeds)
    return found


def compare(experience, scalars, gamma=0.97):
    """Every decision is the scalar loop's next one; how many steps each column's calls took."""
    valid = experience.valid
    valid = np.ones(experience.reward.shape, bool) if valid is None else valid
    assert (valid[:-1] | ~valid[1:]).all(), "a gap within a column"
    steps = np.zeros(len(scalars), int)
    for t, n in zip(*np.nonzero(valid), strict=True):
        scalar = scalars[n]
        allowed, obs = scalar.allowed(), scalar.obs
        np.testing.assert_array_equal(experience.obs[t, n], obs)
        if experience.obs_mask is not None:
            assert experience.obs_mask[t, n].tolist() == allowed
        want = scalar.call(int(experience.action[t, n]))
        assert experience.steps[t, n] == want.steps
        assert experience.reward[t, n] == pytest.approx(want.reward, abs=1e-6)
        assert experience.terminated[t, n] == want.terminated
        assert experience.truncated[t, n] == (want.truncated and not want.terminated)
        np.testing.assert_array_equal(experience.next_obs[t, n], want.next_obs)
        assert experience.head[t, n, 0] == experience.action[t, n]
        if experience.rewards is not None:
            each = experience.rewards[t, n]
            total = (each * gamma ** np.arange(len(each))).sum()
            assert total == pytest.approx(want.reward, abs=1e-5)
        steps[n] += want.steps
    return steps


@pytest.mark.parametrize("call_steps", [1, 2, 5, 40])
@pytest.mark.parametrize("rows", [1, 7, 64])
def test_every_decision_is_that_of_a_scalar_loop(call_steps, rows):
    skills = skill_set(*ALL, call_steps=call_steps, reflexes=(shy(),))
    collector = collector_of(skills, keep_rewards=True)
    scalars = scalars_of(skills.skills, call_steps, reflexes=(shy(),))
    taken, ticks, ended = np.zeros(N, int), 0, 0
    for request in itertools.islice(requests(rows), -(-200 // rows)):
        collected = collector.collect(request)
        taken += compare(collected.experience, scalars)
        ticks, ended = ticks + rows, ended + len(collected.episodes)
        assert collected.experience.spent == rows * N
    # What is not in a decision yet is in an open call: no step is lost, none invented.
    open_calls = np.where(collector.kept["over"], 0, collector.kept["tau"])
    np.testing.assert_array_equal(taken + open_calls, ticks)
    assert ended > 20


def test_calls_of_different_lengths_do_not_wait_for_each_other():
    class Long(Skill):
        max_steps = 50
        policy = Zigzag.policy

    class Short(Skill):
        max_steps = 1
        policy = Zigzag.policy

    collector = collector_of(skill_set(Long, Short, call_steps=None))
    counts = np.zeros(N, int)
    for request in itertools.islice(requests(32), 6):
        experience = collector.collect(request).experience
        counts += experience.valid.sum(0) if experience.valid is not None else len(experience.obs)
    assert counts.max() > counts.min(), "columns are not ragged"


def test_masks_of_successors_are_those_of_the_next_decision():
    collector = collector_of(skill_set(*ALL))
    experience = collector.collect(next(requests(128))).experience
    valid, checked = experience.valid, 0
    for n in range(N):
        rows = np.flatnonzero(valid[:, n]) if valid is not None else np.arange(len(experience.obs))
        for now, then in itertools.pairwise(rows):
            mask = experience.next_obs_mask[now, n]
            if experience.terminated[now, n]:
                assert mask.all()
            elif not experience.truncated[now, n]:
                assert mask.tolist() == experience.obs_mask[then, n].tolist()
                checked += 1
    assert checked > 20


def test_where_no_skill_may_start_it_says_so():
    collector = collector_of(skill_set(Right, call_steps=3))
    with pytest.raises(SkillweaveError, match="no skill may start in observation"):
        collector.collect(next(requests(256)))


@pytest.mark.parametrize("rows", [3, 64])
def test_restored_it_goes_on_as_if_it_had_not_been_stopped(rows):
    def fresh():
        return collector_of(skill_set(*ALL), keep_rewards=True, env=Again)

    first, asked = fresh(), requests(rows)
    for _ in range(3):
        first.collect(next(asked))
    first.cut(Seeds(1))
    again = fresh()
    assert not len(again.restore(first.state()))
    for request in [next(asked) for _ in range(3)]:
        one, two = first.collect(request), again.collect(request)
        for name in ("obs", "action", "reward", "steps", "terminated", "next_obs", "rewards"):
            np.testing.assert_array_equal(
                getattr(one.experience, name), getattr(two.experience, name)
            )
        np.testing.assert_array_equal(one.episodes, two.episodes)
