"""A plain agent, the base case: one environment, one algorithm, one stage."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from skillweave._internal.arguments import checked_names
from skillweave._internal.paths import AGENT
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.algorithms.base import read_by
from skillweave.algorithms.config import AlgorithmSettings, check_spaces
from skillweave.envs.make import EnvSpec, Spaces
from skillweave.runs.command_words import Caller
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Manifest
from skillweave.runs.user_code import environment_texts
from skillweave.schema import AtLeastOne, Share, check_fields
from skillweave.spaces import action_codec
from skillweave.training.defaults import AGENT_DEFAULTS, TrainDefaults
from skillweave.training.env_check import EnvValue, check_env, check_rollout
from skillweave.training.learning_task import skill_task
from skillweave.training.role import agent_role
from skillweave.training.stage import Stage, target_of


class Declared(ABC):
    """The declaration of a hierarchy, or of a plain agent."""

    env: EnvValue
    train_defaults: TrainDefaults
    _caller: ClassVar[Caller]
    """The entry point in lines of Python that messages print."""
    recipe: str | None = None
    """The place of the declaration: a shipped recipe's name or a file; written into runs."""
    recorded = False
    """True for a run that was loaded without its code; some of what was declared is missing."""
    _spec: EnvSpec | None = None
    _starts: Callable[[], Any] | None = None
    """Function that returns the policies with which learners start, by name; None: no function."""

    def __post_init__(self) -> None:
        self.validate()

    @abstractmethod
    def validate(self) -> None:
        """Check every setting; training and loading call it again, as attributes may be set.

        Raises:
            DeclarationError: a setting is wrong; the message names it.
        """

    @property
    def spec(self) -> EnvSpec:
        """The environment, fully specified; the same object while ``env`` does not change."""
        if isinstance(self.env, EnvSpec):
            return self.env
        if self._spec is None or self._spec.env is not self.env:
            self._spec = EnvSpec(self.env)
        return self._spec

    @abstractmethod
    def check_spaces(self) -> Spaces:
        """Make the declared environment once, and return its spaces.

        Raises:
            DeclarationError: a space, a setting or a policy does not fit.
        """

    @abstractmethod
    def stages(self) -> list[Stage]:
        """Return all stages of training, in their order."""


@checked_names
@dataclass
class PlainAgent(Declared):
    """An agent that learns an environment's own reward, with a budget in environment steps.

    Raises:
        DeclarationError: a setting is wrong; the message names it.
    """

    env: EnvValue
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec`` for more."""
    algorithm: AlgorithmSettings
    """The algorithm's settings."""
    steps: AtLeastOne
    """Training budget in environment steps."""
    target_return: float | None = None
    """Training ends early at this mean return of the periodic evaluation; None: no target."""
    target_success: Share | None = None
    """Training ends early at this share of successful episodes (``info["success"]``)."""
    train_defaults: TrainDefaults = field(default_factory=TrainDefaults)
    """Values for arguments of ``train`` that its caller leaves out."""
    _caller = "agent"

    def validate(self) -> None:
        """Check every setting; training and loading call it again, as attributes may be set.

        Raises:
            DeclarationError: a setting is wrong; the message names it.
        """
        check_env(self.env)
        check_fields(self)
        target_of(self.target_return, self.target_success, AGENT)

    def check_spaces(self) -> Spaces:
        """Make the declared environment once, and return its spaces.

        Raises:
            DeclarationError: the algorithm does not fit the spaces.
        """
        spaces = self.spec.read_spaces()
        action_codec(spaces.action)
        check_spaces(self.algorithm, spaces.action, f"{AGENT}: ")
        read_by(self.algorithm, spaces.observation)
        check_rollout(self.algorithm, spaces.observation)
        return spaces

    def stages(self) -> list[Stage]:
        """Return the agent's only stage of training."""
        target = target_of(self.target_return, self.target_success, AGENT)
        spec = self.spec
        return [
            Stage(
                AGENT,
                "agent",
                self.algorithm,
                self.steps,
                lambda _: skill_task(agent_role(spec)),
                target,
            )
        ]

    def manifest(self, seed: int, how: TrainDefaults | None = None) -> Manifest:
        """Return the content of a new run's ``run.json``, for this ``seed``.

        ``how``: evaluation and checkpoints; None: ``train_defaults``.
        """
        how = how or self.train_defaults
        (stage,) = self.stages()
        code = stage.acts_by_code or not self.spec.is_data
        return Manifest(
            env=self.spec.name,
            env_kwargs=self.spec.json_kwargs,
            code=environment_texts(self.spec),
            seed=seed,
            stages=[stage.entry()],
            needs_recipe=code,
            resume_needs_recipe=code or stage.learns_by_code or self.spec.engine != "auto",
            **how.entries(AGENT_DEFAULTS),
        )


def load_agent_of(run: RunDirectory) -> AgentPolicy:
    """Return the policy of a finished run of a plain agent."""
    return run.load_policy(run.manifest.stages[0].name)
