"""Calls that end by themselves in the last step of an episode are done wherever they count."""

from __future__ import annotations

import numpy as np
from reference_calls import T, Walk, scripted

import skillweave as sw
from skillweave.types import Array, Step


class First(sw.Skill):
    policy = scripted(0)

    def termination(self, step: Step) -> Array:
        return step.next_obs[:, T] >= 2


class Last(First):
    def termination(self, step: Step) -> Array:
        return step.terminated | step.truncated


def test_a_call_that_ends_by_itself_with_the_episode_is_done():
    env = sw.EnvSpec(Walk, engine="sync", workers=1)
    choose = lambda obs: np.where(obs[:, T] < 2, "first", "last")  # noqa: E731
    hierarchy = sw.Hierarchy(env, [First(), Last()], call_steps=None, selector=choose)
    run = hierarchy.train(quiet=True)
    for alone in (None, "last"):
        report = run.evaluate(4, skill=alone, quiet=True).skills["last"]
        assert (report.ended["own"], report.own_with_episode, report.calls) == (4, 4, 4)
    # An evaluation's step limit ends the episode, too.
    cut = run.evaluate(4, max_steps=2, quiet=True)
    assert (cut.cut, cut.skills["first"].own_with_episode) == (4, 4)
    log = run.log_calls(1_000)
    last = log.of("last")
    assert 0 < last.terminated.sum() < len(last)
    matrix = log.handover()
    assert matrix.of("last", after="first")[0] == matrix.of("last", after="start")[0] == 1.0
    ends = log.call_ends("last")
    assert ends.reasons["own"] == ends.own_with_episode == len(last)
