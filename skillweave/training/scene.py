"""Where a stage learns: which environments, and what learners do in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gymnasium as gym

from skillweave.collecting.acting import Acting
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.collector import Collector
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.guide import ActiveGuide
from skillweave.collecting.levels import CRITIC, SELECTOR
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
    log_info: tuple[str, ...] = ()
    """Keys of ``info`` that collectors of learners log."""

    def learners_collector(
        self, num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        """Return a collector whose episodes are reported; arguments are as of ``collector``."""
        found = self.collector(num_envs, acting, first, shared)
        found.log_info = self.log_info
        return found


def skill_scene(
    spec: EnvSpec,
    skill: Skill | None = None,
    reflexes: Sequence[Reflex] = (),
    starters: SkillSet | None = None,
    start_calls: int = 0,
    search_steps: int | None = None,
    episode_calls: int = 1,
) -> Scene:
    """The environments seen through a skill; None: as they are.

    Args:
        starters: skills that can act already: they lead to where the skill may start.
        start_calls: an episode begins after up to so many calls of theirs.
        search_steps: an episode begins anew where it may not start after so many steps.
        episode_calls: the most calls of the skill in an episode.
    """
    search = start_calls, search_steps, episode_calls

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return SkillCollector(engine, acting, skill, tuple(reflexes), starters, *search)

    return Scene(spec.name, *spec.spaces, collector)


def selector_scene(
    spec: EnvSpec, skills: SkillSet, guide: ActiveGuide | None = None, as_skill: Skill | None = None
) -> Scene:
    """The environments in which a selector calls skills.

    Args:
        guide: a ready selector that is asked wherever it decides.
        as_skill: the skill that all of it is, in another hierarchy; None: the task itself.
    """

    def collector(
        num_envs: int, acting: Acting | None, first: int = 0, shared: bool = False
    ) -> Collector:
        engine = make_engine(spec, num_envs, first=first)
        return DecisionCollector(engine, acting, skills, shared, guide, as_skill)

    observation_space = spec.spaces.observation
    choices = gym.spaces.Discrete(skills.choices)
    return Scene(spec.name, observation_space, choices, collector, skills.usual_steps or CALL)


@dataclass(frozen=True)
class WovenScene(Scene):
    """Environments in which a selector calls skills, and some of these learn too."""

    skills: SkillSet = field(kw_only=True)
    """Those that learn have any policy, or are ``UntrainedHierarchy``."""
    skill_space: gym.Space[Any] = field(kw_only=True)
    """What skills choose from."""
    spec: EnvSpec = field(kw_only=True)
    guide: ActiveGuide | None = field(kw_only=True)
    """A ready selector, which is asked wherever the selector decides, or decides itself."""
    as_skill: Skill | None = field(kw_only=True)
    """The skill that all of it is, in another hierarchy."""
    margins: Mapping[str, float] = field(kw_only=True)
    """By the paths of critics in hierarchies below: where calls are cut there."""
    guide_kl: Mapping[str, float] = field(kw_only=True)
    """By the paths of selectors in hierarchies below: their largest KL from their guides."""

    def chooses_from(self, path: str) -> gym.Space[Any]:
        """The actions of a skill, a selector or a critic of skills, by its path."""
        *nodes, name = path.split("/")
        level = self.level(nodes)
        if name == SELECTOR:
            return gym.spaces.Discrete(level.choices)
        return gym.spaces.Discrete(len(level.skills)) if name == CRITIC else self.skill_space

    def steps_of_row(self, path: str) -> int:
        """Environment steps of a row of a learner's experience, about, by its path."""
        *nodes, name = path.split("/")
        return self.level(nodes).usual_steps or CALL if name == SELECTOR else 1

    def is_greedy(self, path: str) -> bool:
        """Whether a learner does not explore where its hierarchy is evaluated, by its path."""
        *nodes, name = path.split("/")
        level = self.level(nodes)
        return level.greedy_selector if name == SELECTOR else level.greedy

    def level(self, nodes: Sequence[str]) -> SkillSet:
        """The skills of a hierarchy below, by the names on the way to it."""
        found = self.skills
        for node in nodes:
            number = [s.name for s in found.skills].index(node)
            inner: Any = found.policies[number]
            found = inner.skills
        return found

    def woven(
        self,
        engine: Engine,
        acting: Acting | None,
        learners: Mapping[str, Acting],
        margins: Mapping[str, float],
    ) -> WovenCollector:
        """A collector of these environments.

        Args:
            acting: the selector; None: the guide decides.
            learners, margins: as of ``WovenCollector``.
        """
        return WovenCollector(
            engine, acting, self.skills, learners, margins, self.guide, self.as_skill
        )


def woven_scene(
    spec: EnvSpec,
    skills: SkillSet,
    guide: ActiveGuide | None = None,
    as_skill: Skill | None = None,
    margins: Mapping[str, float] | None = None,
    guide_kl: Mapping[str, float] | None = None,
) -> WovenScene:
    """The environments in which a selector calls skills, and some of these learn too."""
    plain = skill_scene(spec)
    return WovenScene(
        spec.name, plain.observation_space, gym.spaces.Discrete(skills.choices), plain.collector,
        skills.usual_steps or CALL, skills=skills, skill_space=plain.action_space, spec=spec,
        guide=guide, as_skill=as_skill, margins=margins or {}, guide_kl=guide_kl or {},
    )  # fmt: skip
