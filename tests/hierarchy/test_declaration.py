"""Declarations: what is wrong is said; settings change them; files carry their weights."""

import dataclasses
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from declaring import plainly, skills_with
from gymnasium.spaces import Box, Discrete
from small_runs import acts, stage_entry
from toys import network_of

from skillweave import (
    DQN,
    PPO,
    SAC,
    Apart,
    EnvSpec,
    Hierarchy,
    Reflex,
    Skill,
    SkillweaveError,
    recipes,
)
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.api import Run
from skillweave.cli.overrides import apply_overrides, list_settings
from skillweave.errors import DeclarationError
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import roles_of
from skillweave.hierarchy.weights import open_weights, read_weights, write_weights
from skillweave.networks.config import CNN, Network
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.training.stage import check_stages

torch.set_num_threads(1)
OBS, ACTION = gym.make("CartPole-v1").observation_space, Discrete(2)


def zeros(obs):
    return np.zeros(len(obs), np.int64)


class Center(Skill):
    max_steps = 30


class Lean(Skill):
    max_steps = 20
    steps = 5_000


class Ready(Skill):
    max_steps = 10
    policy = ScriptedPolicy(zeros, OBS, ACTION)


def declare(*skills, env="CartPole-v1", **more) -> Hierarchy:
    return Hierarchy(env, skills or [Center(), Lean()], **plainly(more))


def named(name: str, **attributes) -> Skill:
    return type("Custom", (Skill,), {"name": name, **attributes})()


# What is wrong -------------------------------------------------------------------------------


def test_a_right_declaration_passes_and_skills_may_stop_in_any_way():
    declare().check_spaces()
    stops = named("stops", termination=lambda self, step: step.terminated)
    declare(Center(), Ready(), stops, call_steps=None).check_spaces()
    declare(reflexes=[Reflex(lambda obs: obs[:, 0] > 1, 0)]).check_spaces()


@pytest.mark.parametrize(
    ("kind", "space"),
    [
        ("observation_space", Box(-1, 1, (3,))),
        ("action_space", Discrete(3)),
    ],
)
def test_a_policy_for_other_spaces_names_the_skill_and_both_spaces(kind, space):
    own = {"observation_space": OBS, "action_space": ACTION}
    spaces = {**own, kind: space}
    skill = named("foreign", policy=ScriptedPolicy(zeros, **spaces))
    with pytest.raises(SkillweaveError) as raised:
        declare(Center(), skill).check_spaces()
    for word in (
        "'foreign'",
        kind,
        str(space),
        "CartPole-v1",
        str(own[kind]),
    ):
        assert word in str(raised.value)


@pytest.mark.parametrize("name", [[], {"a": 1}, None, "middle"], ids=str)
def test_a_skill_that_is_not_there_is_answered_with_those_that_are(name):
    with pytest.raises(SkillweaveError, match=r"no skill .*center, lean"):
        declare().skill(name)


@pytest.mark.parametrize(
    ("make", "is_data"),
    [
        (declare, True),
        (lambda: declare(Ready()), False),
        (lambda: declare(named("x", initiation=lambda self, obs: zeros(obs) == 0)), False),
        (lambda: declare(named("x", termination=lambda self, step: step.terminated)), False),
        (lambda: declare(reflexes=[Reflex(zeros, 0)]), False),
        (lambda: declare(env=lambda: gym.make("CartPole-v1")), False),
        (lambda: declare(env=EnvSpec("CartPole-v1", kwargs={"sutton_barto_reward": True})), True),
        (lambda: declare(env=EnvSpec("CartPole-v1", wrappers=(gym.Wrapper,))), False),
    ],
)
def test_a_declaration_is_data_where_acting_needs_no_code_of_the_users(make, is_data):
    assert roles_of(make()).is_data is is_data


# Settings ------------------------------------------------------------------------------------

SETTINGS = {
    "call_steps=20": lambda d: d.call_steps == 20,
    "call_steps=none": lambda d: d.call_steps is None,
    "apart.skill_steps=1e6": lambda d: d.apart.skill_steps == 1_000_000,
    "apart.selector_steps=1_000": lambda d: d.apart.selector_steps == 1000,
    "selection.greedy_skills=false": lambda d: d.selection.greedy_skills is False,
    "steps=7e5": lambda d: abs(d.total_steps - 700_000) < 5,
    "learn=together": lambda d: d.learn == "together",
    "together.epsilon=0.5": lambda d: d.together.epsilon == 0.5,
    "train.eval_every=1e4": lambda d: d.train_defaults.eval_every == 10_000,
    "skills.center.task_weight=0": lambda d: d.skill("center").task_weight == 0.0,
    "algorithm.gamma=0.5": lambda d: d.algorithm.gamma == 0.5 and d.selector.gamma == PPO().gamma,
    "selector.gamma=1": lambda d: d.selector.gamma == 1.0 and isinstance(d.selector.gamma, float),
    "selector.n_steps = 16": lambda d: d.selector.n_steps == 16,
    "selector.clip_value=0.2": lambda d: d.selector.clip_value == 0.2,
    "selector.network.hidden=(32, 16)": lambda d: d.selector.network.hidden == (32, 16),
    "selector.network.hidden=32,16": lambda d: d.selector.network.hidden == (32, 16),
    "selector.network.hidden=32": lambda d: d.selector.network.hidden == (32,),
    "selector.network.activation=relu": lambda d: d.selector.network.activation == "relu",
    "selector.learning_rate_schedule=constant": (
        lambda d: d.selector.learning_rate_schedule == "constant"
    ),
    "selection.target_return=200": lambda d: d.selection.target_return == 200.0,
    "skills.center.target_return=1e1": lambda d: d.skill("center").target_return == 10.0,
    "flat.learning_rate=1e-4": (
        lambda d: (
            (flat := d.train_defaults.flat)
            and (flat.learning_rate, d.algorithm.learning_rate) == (1e-4, 3e-3)
        )
    ),
    "skills.center.steps=2e4": lambda d: d.budgets()["center"] == 20_000,
    "skills.lean.gamma=0.9": (
        lambda d: (
            (config := d.skill("lean").algorithm)
            and (config.gamma, d.skill("center").algorithm) == (0.9, None)
        )
    ),
    "skills.lean.network.layer_norm=true": (
        lambda d: (config := d.skill("lean").algorithm) and config.network.layer_norm
    ),
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_setting_is_changed_by_its_dotted_name(setting):
    d = declare()
    before = declare()
    assert not SETTINGS[setting](before)
    apply_overrides(d, [setting])
    assert SETTINGS[setting](d)
    changed = {f.name for f in dataclasses.fields(d) if f.name != "skills"}
    same = {name for name in changed if getattr(d, name) == getattr(before, name)}
    assert len(changed - same) == (0 if setting.startswith("skills.") else 1)


def test_settings_apply_in_order_and_the_skills_class_is_left_alone():
    d = declare()
    apply_overrides(d, ["selector.gamma=0.5", "selector.gamma=0.6", "skills.lean.steps=9"])
    assert (d.selector.gamma, d.skill("lean").steps, Lean.steps) == (0.6, 9, 5_000)
    apply_overrides(d, ["selector.critic.hidden=(128,)"])  # so far it is as the actor's
    assert d.selector.critic == dataclasses.replace(d.selector.network, hidden=(128,))


KNOWN = "PPO, SelfImitationPPO, DQN, CQL, TD3, SAC, IQL"
WRONG_SETTINGS = {
    "call_steps": "name=value",
    "call_step=4": "call_step'.*is 'call_steps' meant",
    "selector.gama=0.9": "selector.gama.*is 'selector.gamma",
    "selector.network.hiden=3": "hiden.*is 'selector.network.hidden",
    "skills.centre.gamma=1": "'centre'.*is 'center' meant",
    "selector=4": f"selector=4: no algorithm '4'; there are: {KNOWN}, .*Rainbow, DDPG",
    "skills.nobody=DQN": "no skill 'nobody'",
    "selector.gamma.x=4": "gamma has no parts",
    "call_steps=": "call_steps=: expected a whole number",
    "selection.greedy_skills=1": "selection.greedy_skills=1: expected True, False or None",
    "together.interrupt=none": "together.interrupt=none: expected True or False",
    "selector.gamma=nan": "selector.gamma=nan: expected a number, between 0 and 1",
    "selector.network.activation=sine": "activation=sine: expected.*tanh",
    "call_steps=0": "call_steps is 0",
    "skills.lean.steps=-4": "'lean'.*steps is -4",
    "skills.center.learning_rate=-1": "learning_rate is -1.0.*positive",
    "selector.batch_size=100000": "batch_size is 100000.*num_envs",
    "selector.learning_rate_schedule=kl": "target_kl",
}


def test_a_setting_of_an_agents_name_alone_takes_another_algorithm_then_the_rest_applies():
    declaration = declare()
    declaration.algorithm = PPO(num_envs=4, n_steps=8, batch_size=32)
    settings = ["selector.gamma=0.9", "selector=dqn", "selector.network.cnn.kernels=(3,)"]
    settings += ["selector.network.cnn.channels=(4,)", "selector.network.cnn.strides=(1,)"]
    apply_overrides(declaration, [*settings, "skills.center=Rainbow", "algorithm=SAC"])
    cnn = CNN("plain", (4,), (3,), (1,))
    expected = DQN(gamma=0.9, network=Network((256, 256), "relu", cnn=cnn))
    assert declaration.selector == expected
    assert declaration.skill("center").algorithm == DQN.rainbow()
    assert declaration.algorithm == SAC()


@pytest.mark.parametrize("setting", WRONG_SETTINGS)
def test_a_wrong_setting_is_named(setting):
    with pytest.raises(DeclarationError, match=WRONG_SETTINGS[setting]):
        apply_overrides(declare(), [setting])


@pytest.mark.parametrize("make", [declare, lambda: recipes.load("lunar-lander")])
def test_what_is_listed_can_be_set(make):
    listed = list_settings(make())
    assert len(listed) > 50
    d = make()
    apply_overrides(d, [f"{name}={value}" for name, value in listed.items()])
    assert list_settings(d) == listed


def test_changes_show_in_the_list_and_carry_over_to_another_declaration():
    d, other = declare(), declare()
    changes = [
        "call_steps=7", "skills.center.gamma=0.9", "skills.center.network.hidden=(8, 4)",
        "skills.lean.steps=77", "selector.target_kl=0.02", "selector.learning_rate_schedule=kl",
        "selector.normalize_obs=true", "selection.greedy_skills=false",
    ]  # fmt: skip
    apply_overrides(d, changes)
    listed = list_settings(d)
    assert listed != list_settings(other)
    assert not [k for k in list_settings(declare(Center(), Ready())) if "ready" in k]
    assert (listed["call_steps"], listed["skills.center.network.hidden"]) == (7, (8, 4))
    first = ("selector.target_kl",)  # the schedule 'kl' asks for it
    names = sorted(listed, key=lambda name: name not in first)
    apply_overrides(other, [f"{name}={listed[name]}" for name in names])
    assert list_settings(other) == listed


# Weights -------------------------------------------------------------------------------------


def agent(seed: int, actions: int = 2, **settings) -> AgentPolicy:
    return network_of(OBS, Discrete(actions), seed, network=Network((8, 8)), **settings)


def trained(d: Hierarchy) -> HierarchyPolicy:
    policies = [s.policy or agent(i, normalize_obs=i == 0) for i, s in enumerate(d.skills)]
    return HierarchyPolicy(agent(9, len(policies)), skills_with(d, policies))


def read(d: Hierarchy, path: Path) -> HierarchyPolicy:
    return read_weights(roles_of(d), *open_weights(path), path)[1]


@pytest.mark.parametrize("skills", [(Center, Lean), (Center, Ready, Lean)])
def test_weights_written_and_read_act_the_same(tmp_path, skills):
    d = declare(*(kind() for kind in skills), call_steps=6, greedy_skills=True)
    policy = trained(d)
    path = Run(d, tmp_path, policy).save_weights(tmp_path / "weights.safetensors")
    other = declare(*(kind() for kind in skills), call_steps=40)
    run = other.load_weights(path)
    assert acts(run.policy) == acts(policy)
    assert len({a for actions, _ in acts(policy) for a in actions}) == 2
    assert len({s for _, acting in acts(policy) for s in acting}) == len(skills)
    assert (run.hierarchy.call_steps, run.policy.skills.call_steps) == (6, 6)
    assert other.call_steps == 40, "what is loaded changes nothing of the user's own"


def test_the_file_says_how_long_calls_last_and_whether_skills_are_greedy(tmp_path):
    d = declare(call_steps=None, greedy_skills=False)
    write_weights(tmp_path / "w", roles_of(d), trained(d))
    skills = read(declare(), tmp_path / "w").skills
    assert (skills.call_steps, skills.greedy) == (None, False)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: declare(Center()), "center, lean on CartPole-v1.*center on CartPole-v1"),
        (lambda: declare(Lean(), Center()), "center, lean on.*lean, center on"),
        (lambda: declare(env="Acrobot-v1"), "on CartPole-v1.*on Acrobot-v1"),
    ],
)
def test_weights_of_another_hierarchy_say_whose_they_are(tmp_path, make, says):
    d = declare()
    path = tmp_path / "weights.safetensors"
    write_weights(path, roles_of(d), trained(d))
    other = make()
    before = other.call_steps
    with pytest.raises(SkillweaveError, match=says) as raised:
        read(other, path)
    assert str(path) in str(raised.value)
    assert other.call_steps == before


def test_weights_without_a_skill_that_is_to_be_trained_say_which(tmp_path):
    class Center(Ready):
        pass

    d = declare(Center(), Lean())
    write_weights(tmp_path / "w", roles_of(d), trained(d))
    with pytest.raises(SkillweaveError, match="no weights of 'center'"):
        read(declare(), tmp_path / "w")


@pytest.mark.parametrize("change", ["missing", "shape", "kind"])
def test_a_file_that_does_not_hold_what_it_says_is_named(tmp_path, change):
    d, path = declare(), tmp_path / "weights.safetensors"
    write_weights(path, roles_of(d), trained(d))
    tensors, header = read_tensors(path)
    name = next(k for k in tensors if k.startswith("lean/actor"))
    if change == "missing":
        del tensors[name]
    elif change == "shape":
        tensors[name] = tensors[name][..., :1].clone()
    else:
        header["kind"] = "agent"
    write_tensors(path, tensors, header)
    says = "holds something of kind 'agent'" if change == "kind" else name.removeprefix("lean/")
    with pytest.raises(SkillweaveError, match=says) as raised:
        read(declare(), path)
    assert str(path) in str(raised.value)
    assert change == "kind" or "lean" in str(raised.value)
    with pytest.raises(SkillweaveError, match="nowhere"):
        read(declare(), tmp_path / "nowhere")


# A hierarchy as a skill -----------------------------------------------------------------------


def test_a_whole_hierarchy_is_a_skill_of_another(tmp_path):
    inner = declare()
    skill = Run(inner, tmp_path, trained(inner)).as_skill("stand", max_steps=12)
    assert (skill.name, skill.max_steps, skill.policy.labels) == ("stand", 12, ("center", "lean"))
    outer = declare(skill, Center())
    outer.check_spaces()
    assert (list(outer.budgets()), roles_of(outer).is_data) == (["center", "selector"], False)
    policy = trained(outer)
    assert policy.labels == ("stand", "center")
    write_weights(tmp_path / "w", roles_of(outer), policy)
    again = read(declare(skill, Center()), tmp_path / "w")
    assert acts(again) == acts(policy)


def test_a_hierarchy_as_a_skill_may_be_told_where_it_starts_and_stops(tmp_path):
    inner = declare()
    skill = Run(inner, tmp_path, trained(inner)).as_skill(
        "stand", initiation=lambda self, obs: obs[:, 0] > 0, color=(1, 2, 3)
    )
    assert skill.initiation(np.array([[1.0], [-1.0]])).tolist() == [True, False]
    assert skill.color == (1, 2, 3)
    assert not skill.defines("termination")
    with pytest.raises(SkillweaveError, match=r"'stand'.*observation_space.*Acrobot-v1"):
        declare(skill, env="Acrobot-v1").check_spaces()
    for name in ("selector", "a b", ""):
        with pytest.raises(SkillweaveError, match="name"):
            declare(Run(inner, tmp_path, trained(inner)).as_skill(name))


# What cannot be learnt ---------------------------------------------------------------------------


@pytest.mark.parametrize("flat", [True, False])
def test_a_budget_that_ends_before_learning_begins_is_refused(tmp_path, flat):
    late = DQN(learning_starts=500)
    h = Hierarchy(
        "CartPole-v1",
        [Plain()],
        algorithm=late,
        apart=Apart(skill_steps=499, selector_steps=1),
        learn="apart",
    )
    name, budget = ("agent", 500) if flat else ("plain", 499)
    says = f"stage '{name}': its budget is {budget} steps, but it begins to learn only after 500"
    with pytest.raises(SkillweaveError, match=says):
        h.train(tmp_path / "run", flat=flat)
    assert not (tmp_path / "run").exists()


def test_each_members_budget_counts_not_the_populations(tmp_path):
    stage = stage_entry("x")
    stage.algorithm["learning_starts"] = 1_000
    check_stages([stage], None)
    says = "'x'.*1,000 steps for each member, but it begins to learn only after 1,000"
    with pytest.raises(SkillweaveError, match=says):
        check_stages([dataclasses.replace(stage, evolution={"population": 4})], None)
    check_stages([dataclasses.replace(stage, budget=1, algorithm={})], None)


class Plain(Skill):
    """The task itself."""
