"""HierarchyPolicy as a policy: its memory, its errors, and one of its skills alone."""

import functools
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from declaring import plainly, skills_with
from reference_calls import (
    EPISODE,
    POSITION,
    TAG,
    Counter,
    Counting,
    Left,
    Right,
    T,
    Walk,
    Zigzag,
    scripted,
)
from toys import skills_of

from skillweave.api import Hierarchy, Run
from skillweave.envs.make import EnvSpec
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.skills import Reflex, Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.training.evaluation import evaluate
from skillweave.types import Array, Step

torch.set_num_threads(1)
N = 6


class Chooser(ScriptedPolicy):
    """A selector: its choice among the allowed skills follows from the observation."""

    def __init__(self, count: int):
        super().__init__(None, Walk.observation_space, gym.spaces.Discrete(count))

    def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
        wish = obs[:, TAG] + 3 * obs[:, EPISODE] + 5 * obs[:, T] + 7 * obs[:, POSITION]
        mask = np.ones((len(obs), self.action_space.n), bool) if mask is None else mask
        chosen = [
            np.flatnonzero(allowed)[int(w) % allowed.sum()]
            for w, allowed in zip(wish, mask, strict=True)
        ]
        return np.array(chosen), memory


skill_set = functools.partial(skills_of, call_steps=4)


def hierarchy(*kinds, **more) -> HierarchyPolicy:
    return HierarchyPolicy(Chooser(len(kinds)), skill_set(*kinds, **more))


# A skill alone ---------------------------------------------------------------------------------


class Remote(Skill):
    """As Counter, where it may start hardly anywhere: alone it is asked nevertheless."""

    max_steps = 6
    policy = Counting()

    def initiation(self, obs: Array) -> Array:
        return obs[:, POSITION] == 99


def alone(skill: Skill, others: tuple, **more) -> Run:
    """A run of a hierarchy in which a selector never chooses ``skill``, which comes last."""
    declared = Hierarchy(Walk, [*others, skill], **plainly(more))
    skills = skills_with(declared, [s.policy for s in declared.skills])
    return Run(declared, Path("nowhere"), HierarchyPolicy(Chooser(len(skills.skills)), skills))


def always(skill: Skill, **more) -> HierarchyPolicy:
    """A selector that has no choice."""
    declared = Hierarchy(Walk, [skill], **plainly(more))
    return HierarchyPolicy(Chooser(1), skills_with(declared, [skill.policy]))


@pytest.mark.parametrize("kind", [Counter, Zigzag, "nested"])
def test_a_skill_alone_acts_as_under_a_selector_that_chooses_no_other(kind):
    on = Reflex(lambda obs: obs[:, POSITION] == 1, action=2)
    more = {"reflexes": [on], "call_steps": 3}
    inner = hierarchy(Counter, Right, Left, call_steps=2)
    skill = alone(Left(), ()).as_skill("inner") if kind == "nested" else kind()
    if kind == "nested":
        type(skill).policy = inner
    found = alone(skill, (Left(), Right()), **more).evaluate(20, skill=skill.name, num_envs=20)
    wanted = evaluate(always(skill, **more), EnvSpec(Walk), episodes=20, num_envs=20)
    assert (found.returns, found.lengths) == (wanted.returns, wanted.lengths)
    bare = evaluate(skill.policy, EnvSpec(Walk), episodes=20, num_envs=20)
    assert found.returns != bare.returns, "the reflex never acted"
    assert next(iter(found.skills)) == found.alone == skill.name


def test_a_skill_alone_does_not_ask_where_it_may_start():
    run = alone(Remote(), (Left(),))
    found = run.evaluate(3, skill="remote")
    assert found.returns == evaluate(Remote.policy, EnvSpec(Walk), episodes=3).returns


def test_a_film_of_a_skill_alone_shows_its_reflexes_too(tmp_path):
    pytest.importorskip("PIL")

    class Shown(Walk):
        def __init__(self, render_mode=None):
            super().__init__()
            self.render_mode = render_mode

        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, float(action), *rest

        def render(self):
            return np.zeros((8, 8, 3), np.uint8)

    anywhere = Reflex(lambda obs: np.ones(len(obs), bool), action=2)
    declared = Hierarchy(Shown, [Left(), Zigzag()], reflexes=[anywhere], learn="apart")
    policy = HierarchyPolicy(Chooser(2), skills_with(declared, [Left.policy, Zigzag.policy]))
    told = Run(declared, tmp_path / "run", policy).render(
        tmp_path / "a.gif", episodes=3, skill="left"
    )
    assert [e["return"] for e in told["episodes"]] == [2.0 * e["length"] for e in told["episodes"]]
    assert [e["skills"] for e in told["episodes"]] == [
        {"left": e["length"]} for e in told["episodes"]
    ]


# Memory ----------------------------------------------------------------------------------------


def in_three_levels() -> HierarchyPolicy:
    inside = hierarchy(Counter, Right, Left, call_steps=2)
    for name in ("low", "middle"):
        skill = type(name, (Skill,), {"policy": inside, "max_steps": 3})
        inside = hierarchy(skill, Zigzag, call_steps=5)
    return inside


def test_neither_act_nor_observe_changes_the_memory_given():
    policy = in_three_levels()
    obs = np.zeros((N, 4), np.float32)
    obs[:, TAG] = np.arange(N)
    memory = policy.start(N)
    for t in range(6):
        before = {k: v.copy() for k, v in memory.items()}
        action, after = policy.act(memory, obs)
        assert all((memory[k] == before[k]).all() for k in memory)
        kept = {k: v.copy() for k, v in after.items()}
        never, time = np.zeros(N, bool), np.full(N, t + 1)
        step = Step(
            obs, action, obs + 1, np.ones(N), never, never, never, time, {"t": time}
        )  # fmt: skip
        memory = policy.observe(after, step)
        assert all((after[k] == kept[k]).all() for k in after)


def test_where_no_skill_may_start_a_large_observation_is_told_in_part():
    class Never(Skill):
        def initiation(self, obs):
            return np.zeros(len(obs), bool)

    with pytest.raises(SkillweaveError, match="no skill may start") as found:
        skill_set(Never).hierarchy.mask(np.zeros((1, 7, 7, 3), np.uint8))
    assert len(str(found.value)) < 400
    assert "\n" not in str(found.value)


def test_it_has_the_spaces_of_selector_and_skills_and_names_them():
    policy = hierarchy(Left, Zigzag)
    assert policy.observation_space == Walk.observation_space
    assert policy.action_space == gym.spaces.Discrete(3)
    assert policy.labels == ("left", "zigzag")
    assert scripted(0).labels == ()
