"""Wrong names of arguments and attributes: what the messages of ``checked_names`` say."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import pytest

import skillweave as sw
from skillweave._internal.arguments import checked_names
from skillweave._internal.public import HOMES
from skillweave.errors import DeclarationError


@checked_names
@dataclass(frozen=True)
class Budget:
    """A group of settings."""

    practice_steps: int | None = None
    episode_calls: int = 1


@checked_names
@dataclass(frozen=True)
class Advice:
    """A group that may be left out."""

    advisor: Any
    restrict: bool = True


@checked_names
@dataclass
class Plan:
    """A declaration."""

    env: str
    skills: list[str]
    call_steps: int | None = 40
    algorithm: sw.PPO = field(default_factory=sw.PPO)
    budget: Budget = field(default_factory=Budget)
    advice: Advice | None = None
    recipe = "a class attribute"

    @checked_names
    def train(self, run_dir: str, *, seed: int = 0, quiet: bool = False) -> str:
        """Train it."""
        return run_dir

    @checked_names
    def fail(self, value: Any) -> None:
        """Raise a TypeError of its own."""
        len(value)

    @property
    def spec(self) -> str:
        """The environment."""
        return self.env


def plan(**settings: Any) -> Plan:
    return Plan("CartPole-v1", ["left"], **settings)


WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: sw.PPO(lr=1), "PPO has no setting 'lr': is 'learning_rate' meant"),
    (lambda: sw.PPO(Gamma=1), "is 'gamma' meant"),
    (
        lambda: sw.PPO(hidden=(8,)),
        "'hidden'; it is a setting of network: write network=Network(hidden=...)",
    ),
    (lambda: sw.Network(zzzz=1), "there are: hidden, activation, layer_norm, cnn"),
    (lambda: sw.DQN.rainbow(doble=True), "DQN has no setting 'doble': is 'double' meant"),
    (lambda: dataclasses.replace(sw.SAC(), tua=1), "SAC has no setting 'tua': is 'tau' meant"),
    (lambda: sw.Reflex(print, acton=1), "Reflex() has no argument 'acton': is 'action' meant"),
    (lambda: sw.Reflex(print), "Reflex() needs action: write Reflex(condition, action)"),
    (lambda: sw.tree.Sequence("a", memry=True), "is 'memory' meant"),
    (lambda: sw.evaluate(), "evaluate() needs policy and env: write evaluate(policy, env)"),
    (lambda: sw.envs.envpool("CartPole-v1"), "envpool() needs num_envs and threads and seed"),
    # Groups of settings
    (lambda: plan(rnn=1), "write algorithm=PPO(network=Network(rnn=...))"),
    (lambda: plan(call_step=5), "Plan has no setting 'call_step': is 'call_steps' meant"),
    (lambda: plan().train("runs", gamma=1.0), "write Plan(algorithm=PPO(gamma=...))"),
    (lambda: plan().train("runs", verbose_=1), "there are: run_dir, seed, quiet"),
    # Too few and too many
    (lambda: Plan(), "Plan needs env and skills: write Plan(env, skills)"),
    (lambda: Plan("CartPole-v1"), "Plan needs skills: write Plan(env, skills)"),
    (lambda: plan().train(), "train() needs run_dir: write train(run_dir)"),
    (lambda: Plan("a", [], 1, sw.PPO(), Budget(), None, 2), "takes at most 6 of its arguments"),
    (lambda: plan(env="a"), "was given env twice"),
    # Attributes
    (lambda: setattr(plan(), "spec", 5), "Plan.spec is computed; it cannot be set"),
    (lambda: setattr(sw.PPO(), "gama", 0.9), "PPO has no setting 'gama': is 'gamma' meant"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "words"), WRONG, ids=[words[:60] for _, words in WRONG])
def test_the_message_says_what_is_meant(call, words):
    with pytest.raises(DeclarationError) as caught:
        call()
    assert words in str(caught.value)


def test_what_is_right_stays_as_it_was():
    made = plan(call_steps=5)
    made.call_steps, made.recipe = 6, "mine"
    made._cached = 1
    assert made.train("runs") == "runs"
    assert (made.call_steps, made.recipe) == (6, "mine")


def test_a_type_error_of_the_body_is_not_hidden():
    with pytest.raises(TypeError, match="has no len"):
        plan().fail(5)


def test_a_subclass_of_a_user_may_have_attributes_of_its_own():
    class Mine(Plan):
        def __init__(self) -> None:
            super().__init__("CartPole-v1", ["left"])
            self.notes = "mine"

    assert Mine().notes == "mine"
    with pytest.raises(DeclarationError, match="is 'skills' meant"):
        Mine().skils = []


@pytest.mark.parametrize("config", [sw.PPO(gamma=0.5), sw.SAC(), sw.Network((8,)), sw.EnvSpec("a")])
def test_settings_are_copied_and_described_as_before(config):
    kind = type(config)
    assert pickle.loads(pickle.dumps(config)) == config
    assert copy.deepcopy(config) == config == dataclasses.replace(config)
    names = list(inspect.signature(kind).parameters)
    assert names == [f.name for f in dataclasses.fields(kind) if f.init]


# Mathematics, types of results, and what only authors of algorithms call.
INSIDE = {
    "ActingParams", "ActionHead", "AgentState", "Algorithm", "Array", "Encoder", "Evaluation",
    "Export", "LastCall", "Layout", "Net", "OptionsEnv", "ParameterGroup",
    "ParentSelection", "Policy", "Report",
    "Rollout", "Run", "Sample", "Seeds", "Skill", "SkillweaveError", "Step", "adam_",
    "clip_grad_norm_", "gae", "mask_logits", "masked_mean", "normalize", "tree",
    *HOMES["skillweave.errors"],
}  # fmt: skip
CALLED = [(m, name) for m, homes in HOMES.items() for name in homes if name not in INSIDE]


@pytest.mark.parametrize(("module", "name"), CALLED)
def test_every_public_name_refuses_an_unknown_argument(module, name):
    with pytest.raises(DeclarationError, match=r"no (setting|argument) 'quxx'|needs "):
        getattr(import_module(module), name)(quxx=1)


@pytest.mark.parametrize("name", [n for n in vars(sw.Run) if not n.startswith("_")])
def test_every_method_of_a_run_refuses_an_unknown_argument(name):
    method = vars(sw.Run)[name]
    if isinstance(method, property):
        return
    with pytest.raises(DeclarationError, match=r"no argument 'quxx'|needs "):
        method(object(), quxx=1)
