"""The table of a hierarchy's levels and roles."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np

from skillweave import DQN, PPO, Apart, Guide, Hierarchy, Lengths, Selection, Skill, Together
from skillweave.hierarchy.declaration import with_roles
from skillweave.hierarchy.roles import roles_of


class Near(Skill):
    """Learns by an algorithm of its own."""

    algorithm = DQN()
    max_steps = 9


class Far(Skill):
    """Learns by the hierarchy's algorithm."""


class Ready(Skill):
    """Needs no training."""

    policy = staticmethod(lambda obs: np.zeros(len(obs), int))


def three(env="CartPole-v1") -> Hierarchy:
    """Three levels; the deepest has a guide, and a selector that chooses lengths."""
    guide = Guide(lambda obs: np.zeros(len(obs), int), restrict=False, target_kl=0.3)
    deep = Hierarchy(
        env, [Far(), Ready()], name="deep", call_steps=Lengths(2, 4), guide=guide, algorithm=PPO()
    )
    middle = Hierarchy(
        env, [deep, Near()], name="middle", together=Together(interrupt=True, margin=0.7)
    )
    selection = Selection(greedy_skills=False, greedy_selector=True)
    skills = [Near(), middle.as_skill(max_steps=20)]
    return Hierarchy(env, skills, call_steps=None, selection=selection)


PATHS = [
    "near",
    "middle",
    "middle/deep",
    "middle/deep/far",
    "middle/deep/ready",
    "middle/deep/selector",
    "middle/deep/skill_critic",
    "middle/near",
    "middle/selector",
    "middle/skill_critic",
    "selector",
    "skill_critic",
]


def test_all_parts_have_a_role_by_their_path():
    roles = roles_of(three())
    assert list(roles.by_path) == PATHS
    assert list(roles.levels) == ["", "middle", "middle/deep"]
    assert list(roles.skills) == [p for p in PATHS if "selector" not in p and "critic" not in p]
    assert {role.level for role in roles.by_path.values()} == set(roles.levels)
    learners = {path: type(r.config) for path, r in roles.by_path.items() if r.config is not None}
    assert learners == {
        "near": DQN,
        "middle/deep/far": PPO,
        "middle/deep/selector": PPO,
        "middle/near": DQN,
        "middle/selector": PPO,
        "selector": PPO,
    }
    assert roles["middle/skill_critic"].margin == 0.7
    assert roles["skill_critic"].margin is None
    assert (roles["middle/deep/selector"].guide_kl, roles["selector"].guide_kl) == (0.3, None)
    assert (roles["near"].greedy, roles["selector"].greedy) == (False, True)
    assert roles["middle/deep/selector"].row_steps == 3
    assert (roles["near"].row_steps, roles["selector"].row_steps) == (1, 16)


def test_each_role_has_spaces_of_its_own_and_one_environment_is_made_to_read_them():
    made = []

    def env() -> gym.Env:
        made.append(gym.make("CartPole-v1"))
        return made[-1]

    roles = roles_of(three(env))
    assert made == []
    spaces = {path: role.action_space for path, role in roles.by_path.items()}
    seen = {str(role.observation_space) for role in roles.by_path.values()}
    assert len(made) == 1
    assert seen == {str(made[0].observation_space)}
    assert spaces["near"] == spaces["middle"] == gym.spaces.Discrete(2)
    assert spaces["selector"] == gym.spaces.Discrete(2)
    assert spaces["middle/deep/selector"] == gym.spaces.Discrete(4), "skills times lengths"
    assert spaces["middle/deep/skill_critic"] == gym.spaces.Discrete(2)


def test_a_selector_chooses_the_goals_that_its_critic_observes():
    reach = gym.spaces.Box(-1, 1, (2,), np.float32)
    goes = type("Go", (Skill,), {"goal_space": reach, "reward": lambda self, step: step.goal[:, 0]})
    roles = roles_of(Hierarchy("CartPole-v1", [goes(), Near()]))
    selector, critic = roles["selector"], roles["skill_critic"]
    assert (selector.chosen_goals, selector.observed_goals) == ({"go": reach}, {})
    assert (critic.chosen_goals, critic.observed_goals) == ({}, {"go": reach})
    assert selector.action_space.goal_spaces == {"go": reach}
    assert critic.observation_space["goal"] == gym.spaces.Dict(go=reach)
    assert selector.observation_space == roles.spec.spaces.observation


def test_a_table_is_written_into_a_copy_of_the_declaration_at_all_levels():
    declared = three()
    kept = roles_of(declared)
    declared.call_steps = 5
    assert kept.outermost.call_steps is None, "a table keeps what was declared when it was made"
    assert roles_of(declared).outermost.call_steps == 5
    declared.call_steps = None
    roles = roles_of(declared).changed(
        lambda level: replace(level, call_steps=len(level.path) + 1, apart=Apart(start_calls=3))
    )
    copy = with_roles(declared, roles)
    inside = roles_of(copy)
    assert [x.call_steps for x in inside.levels.values()] == [1, 7, 12]
    assert {x.apart.start_calls for x in inside.levels.values()} == {3}
    assert type(copy) is Hierarchy
    assert roles_of(declared).outermost.call_steps is None, "the declaration is as it was"
    assert roles_of(declared).levels["middle"].call_steps == 40
    copy.skill("middle/near").max_steps = 1
    assert declared.skill("middle/near").max_steps == 9


def test_levels_that_train_by_themselves_stand_in_the_order_of_training():
    declared = three()
    assert [x.path for x in roles_of(declared).trained] == [""]
    declared.learn = "apart, then together"
    assert [x.path for x in roles_of(declared).trained] == ["middle", ""]
    declared.skill("middle").policy.learn = "apart"
    assert [x.path for x in roles_of(declared).trained] == ["middle/deep", "middle", ""]
