"""Where a stage learns: which environments, and what learners do in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym

from skillweave.collecting.acting import Acting
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.collector import Collector
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.guide import AskedElsewhere, Guide
from skillweave.collecting.skill_rows import SkillCollector
from skillweave.collecting.woven import WovenCollector
from skillweave.envs.engine import Engine
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.skills import Reflex, Skill

CALL = 16
"""Environment steps of a call, about, where nothing says how long it lasts."""


class MakeCollector(Protocol):
    """Makes a collector of a scene."""

    def __call__(
        self, num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        """A collector of ``num_envs`` environments.

        Args:
            acting: the learners; None where they come later.
            first: the number of the first environment, for messages.
            shared: several learn from what each does, with a γ of their own.
        """
        ...


@dataclass(frozen=True)
class Scene:
    """Environments, and what learners see and choose in them."""

    name: str
    """What messages call the environment."""
    observation_space: gym.Space[Any]
    action_space: gym.Space[Any]
    """The learner's: a selector chooses among skills."""
    collector: MakeCollector
    row_steps: int = 1
    """Environment steps of a row of experience, about."""


def skill_scene(
    spec: EnvSpec,
    skill: Skill | None = None,
    reflexes: Sequence[Reflex] = (),
    starters: SkillSet | None = None,
    start_calls: int = 0,
) -> Scene:
    """The environments seen through a skill; None: as they are.

    Args:
        starters: skills that can act already: they lead to where the skill may start.
        start_calls: an episode begins after up to so many calls of theirs.
    """

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return SkillCollector(engine, acting, skill, tuple(reflexes), starters, start_calls)

    return Scene(spec.name, *_spaces(spec), collector)


def selector_scene(spec: EnvSpec, skills: SkillSet, guide: Guide | None = None) -> Scene:
    """The environments in which a selector calls skills, perhaps guided by a ready one."""

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return DecisionCollector(engine, acting, skills, keep_rewards=shared, guide=guide)

    observation_space, _ = _spaces(spec)
    choices = gym.spaces.Discrete(skills.choices)
    return Scene(spec.name, observation_space, choices, collector, skills.usual_steps or CALL)


@dataclass(frozen=True)
class WovenScene(Scene):
    """Environments in which a selector calls skills, and some of these learn too."""

    skills: SkillSet = field(kw_only=True)
    """Those that learn have any policy."""
    learners: tuple[int, ...] = field(kw_only=True)
    """The numbers of those that learn."""
    skill_space: gym.Space[Any] = field(kw_only=True)
    """What skills choose from."""
    spec: EnvSpec = field(kw_only=True)
    guide: Guide | None = field(default=None, kw_only=True)
    """A ready selector, which is asked wherever the selector decides, or decides itself."""

    def woven(
        self,
        engine: Engine,
        acting: Acting | None,
        learners: Sequence[Acting],
        critic: Acting | None = None,
        margin: float | None = None,
    ) -> WovenCollector:
        """A collector of these environments.

        Args:
            acting: the selector; None: the guide decides.
            learners: the skills that learn, in their order.
            critic, margin: as of ``WovenCollector``.
        """
        by_number = dict(zip(self.learners, learners, strict=True))
        decides: Any = acting or AskedElsewhere(engine.num_envs)
        return WovenCollector(engine, decides, self.skills, by_number, critic, margin, self.guide)


def woven_scene(
    spec: EnvSpec, skills: SkillSet, learners: tuple[int, ...], guide: Guide | None = None
) -> WovenScene:
    """The environments in which a selector calls skills, and those of ``learners`` learn too."""
    plain = skill_scene(spec)
    return WovenScene(
        spec.name, plain.observation_space, gym.spaces.Discrete(skills.choices), plain.collector,
        skills.usual_steps or CALL, skills=skills, learners=learners,
        skill_space=plain.action_space, spec=spec, guide=guide,
    )  # fmt: skip


def _spaces(spec: EnvSpec) -> tuple[gym.Space[Any], gym.Space[Any]]:
    env = spec.make()
    try:
        return env.observation_space, env.action_space
    finally:
        env.close()
