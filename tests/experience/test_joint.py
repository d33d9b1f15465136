"""Rows of skills that learn under a selector, worked out anew from the stream of steps."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from joint_learners import Down, Learner, N, Stay, Up, Values, asked
from reference_calls import EPISODE, Walk
from toy_acting import Choices, requests, valid_rows
from toys import calling_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acting
from skillweave.policies.core import CallEnd
from skillweave.skills.lengths import Lengths
from skillweave.skills.skill_set import SkillSet
from skillweave.types import Step


def collector_of(call_steps, margin=None, n=N):
    kinds = (Up, Down, Stay)
    skills = tuple(kind() for kind in kinds)
    policies = (None, None, Stay.policy)
    found = SkillSet(skills, policies, call_steps=call_steps)
    engine = make_engine(EnvSpec(Walk, engine="sync"), n)
    learners = {"up": Learner(n), "down": Learner(n), "skill_critic": Values(n)}
    margins = {} if margin is None else {"skill_critic": margin}
    collector = calling_in(
        engine, Choices(n, found.choices), found, learners=learners, margins=margins
    )
    collector.start(Seeds(7))
    return collector


def calls_of(experience, n):
    """(choice, steps) of the decisions of a column, in order."""
    rows = valid_rows(experience, n)
    return [(int(experience["action"][t, n]), int(experience["steps"][t, n])) for t in rows]


@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("call_steps", [1, 2, 5, Lengths(1, ..., 4)])
@pytest.mark.parametrize("margin", [None, 0.5])
def test_every_row_is_the_acting_skills_judged_by_it_alone(call_steps, margin):
    collector = collector_of(call_steps, margin)
    skills, seen = collector.who.skills, {0: 0, 1: 0}
    ended, continued = 0, 0
    for request in itertools.islice(asked(40), 5):
        runs = collector.memory["end"] == CallEnd.RUNNING
        open_steps = collector.kept["tau"] * runs
        batches = collector.collect(request).batches
        experience, stream = batches["selector"], batches["skill_critic"]
        own = batches["up"], batches["down"]
        owner = stream["action"]
        for k in (0, 1):
            np.testing.assert_array_equal(own[k]["valid"], owner == k)
            assert own[k]["obs"] is stream["obs"], "columns are shared, not copied"
        for n in range(N):
            last = np.zeros(40, bool)
            at = -int(open_steps[n])
            for choice, steps in calls_of(experience, n):
                first, at = max(0, at), at + steps
                assert (
                    owner[first:at, n] == int(skills.hierarchy.skill_of(np.array(choice)))
                ).all()
                last[at - 1] = True
            elapsed = 1 + int(open_steps[n])
            for t in range(40):
                k = int(owner[t, n])
                over = bool(last[t])
                if k == 2:
                    elapsed = 1 if over else elapsed + 1
                    continue
                skill, one = skills.skills[k], slice(n, n + 1)
                step = Step(
                    stream["obs"][t, one], owner[t, one], stream["next_obs"][t, one],
                    stream["reward"][t, one], stream["terminated"][t, one],
                    stream["truncated"][t, one],
                    np.zeros(1, bool), np.array([elapsed]), {},
                )  # fmt: skip
                row, episode = own[k], stream["terminated"][t, n] | stream["truncated"][t, n]
                assert row["reward"][t, n] == np.float32(skill.reward(step)[0])
                assert row["dist_params"][t, n, 0] == row["action"][t, n]
                stops = bool(stream["terminated"][t, n] or skill.termination(step)[0])
                assert row["terminated"][t, n] == stops
                assert over or not (stops or episode)
                timed_out = skill.max_steps is not None and elapsed >= skill.max_steps
                again = t < 39 and owner[t + 1, n] == k and not episode and not timed_out
                assert row["truncated"][t, n] == (over and not stops and not again)
                seen[k] += 1
                ended, continued = ended + stops, continued + (over and again and not stops)
                elapsed = 1 if over else elapsed + 1
    assert min(seen.values()) > 40
    assert ended > 5
    assert continued > 5 or call_steps == 5


# Of three skills; the last column, where there is one, is what deciding anew is worth.
@pytest.mark.parametrize("margin", [None, 0.5])
def test_a_critic_is_told_where_calls_begin(margin):
    collector = collector_of(5, margin)
    for request in itertools.islice(asked(40), 3):
        runs = collector.memory["end"] == CallEnd.RUNNING
        open_steps = collector.kept["tau"] * runs
        batches = collector.collect(request).batches
        experience, stream = batches["selector"], batches["skill_critic"]
        for n in range(N):
            begins = np.zeros(40, bool)
            at = -int(open_steps[n])
            for _, steps in calls_of(experience, n):
                begins[max(0, at)] |= at >= 0
                at += steps
            assert (stream["call_start"][:at, n] == begins[:at]).all()
            assert stream["call_start"][at:, n].sum() <= 1  # the call that is open at the end
            assert begins.sum() > 3


def test_a_learner_of_the_library_acts_and_its_head_is_kept():
    from skillweave.algorithms.agent_policy import make_algorithm
    from skillweave.algorithms.config import PPO

    env, n = Walk(), N
    algorithm = make_algorithm(PPO(), env.observation_space, env.action_space)
    state = algorithm.init([Seeds(0)])
    skills = SkillSet((Down(), Stay()), (None, Stay.policy), call_steps=3)
    engine = make_engine(EnvSpec(Walk, engine="sync"), n)
    collector = calling_in(
        engine, Choices(n, 2), skills, learners={"down": Acting([(algorithm, 1)], n)}
    )
    collector.start(Seeds(1))
    request = next(requests(30))
    own = replace(request, params=(algorithm.acting_params(state),))
    rows = collector.collect(replace(request, below={"down": own})).batches["down"]
    _, head, _ = algorithm.act(own.params[0], _tensor(rows["obs"][rows["valid"]]), None, None)
    np.testing.assert_allclose(rows["dist_params"][rows["valid"]], head[0].numpy(), atol=1e-5)
    assert not rows["dist_params"][~rows["valid"]].any()
    assert rows["valid"].any()
    assert not rows["valid"].all()
    assert rows["obs"][..., EPISODE].max() > 1


def _tensor(rows):
    import torch

    return torch.from_numpy(np.ascontiguousarray(rows))[None]
