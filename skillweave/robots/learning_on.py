"""Repair of a pair of ready policies: the second learns a correction, where the first ends."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.config import config_from_json
from skillweave.api import Hierarchy, Run, run_of
from skillweave.api.running import start_run
from skillweave.api.train_options import TrainOptions
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.hierarchy import training
from skillweave.hierarchy.roles import roles_of
from skillweave.policies.core import Array, Step
from skillweave.robots.aims import Aim
from skillweave.robots.trial import RobotTrial
from skillweave.robots.variation import Variation, with_settings
from skillweave.runs.directory import RunDirectory
from skillweave.skills import Residual, Skill

KINDS = 16
"""The robots among which an episode of training chooses."""


class Varied(gym.Env[Any, Any]):
    """An environment whose episodes are each of another robot, of a few that were drawn.

    Args:
        spec: of the environment, without what is drawn.
        variation: what is drawn.
    """

    def __init__(self, spec: EnvSpec, variation: Variation) -> None:
        self._spec = spec
        self._variation = variation
        self._kinds: dict[int, gym.Env[Any, Any]] = {}
        self._now = self._of(0)
        self.observation_space = self._now.observation_space
        self.action_space = self._now.action_space

    def _of(self, number: int) -> gym.Env[Any, Any]:
        """Return the environment of a robot; it is made when it is first needed."""
        if number not in self._kinds:
            drawn = self._variation.draw(np.random.default_rng([number]))
            self._kinds[number] = with_settings(self._spec, drawn).make()
        return self._kinds[number]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Draw a robot, and start its episode."""
        super().reset(seed=seed)
        number, own = self.np_random.integers((KINDS, 2**31)).tolist()
        self._now = self._of(number)
        return self._now.reset(seed=own, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the robot."""
        return self._now.step(action)

    def close(self) -> None:
        """Close all robots' environments."""
        for env in self._kinds.values():
            env.close()


def learn_on(
    trial: RobotTrial,
    skill: str,
    after: str,
    reward: Callable[[Step], Any],
    scale: Any,
    steps: int,
    calls: int,
    run_dir: str | Path | None,
    seed: int,
    *,
    quiet: bool,
) -> Run:
    """Return a run whose skill has learnt a correction; see ``MeasuredHandovers.repair``."""
    if not callable(reward):
        raise DeclarationError(
            f"repair(): reward is {short(reward)}; give a function of a Step that returns (n,) "
            "numbers, what the skill is to maximise"
        )
    if any(part is not None for part in trial.skills.parts):
        raise DeclarationError("repair() corrects whole actions: leave out acts and sees of skills")
    skills = [
        declared(aim, policy, scale if aim.skill.name == skill else None, reward, max(most, cut))
        for aim, policy, most, (_, cut) in zip(
            trial.aims, trial.skills.policies, trial.steps, trial.cuts, strict=True
        )
    ]
    spec = trial.spec
    if trial.variation.ranges:

        def varied() -> Varied:
            """Return an environment of robots that vary."""
            return Varied(trial.spec, trial.variation)

        varied.__name__ = f"varied_{trial.spec.name}"
        spec = EnvSpec(varied, engine="sync", check_seed=False)
    hierarchy = Hierarchy(
        spec,
        skills,
        selector=lambda obs: [skill] * len(obs),
        learn="apart",
        steps=1,
        name=f"{skill}-after-{after}",
    )
    begun = untrained(hierarchy, skill, run_dir, seed)
    repaired = None if run_dir is None else f"{run_dir}-repaired"
    return begun.repair(
        skill, after=after, steps=steps, calls=calls, run_dir=repaired, seed=seed, quiet=quiet
    )


def untrained(hierarchy: Hierarchy, skill: str, run_dir: str | Path | None, seed: int) -> Run:
    """Return a run in which a skill's correction is exactly zero: it acts as what it corrects."""
    content = training.manifest(hierarchy, seed=seed)
    (stage,) = content.stages
    stage.status, stage.steps, stage.seconds = "done", 0, 0.0
    role = roles_of(hierarchy)[skill]
    algorithm: Any = make_algorithm(config_from_json(stage.algorithm), *role.spaces)
    weights = algorithm.weights(algorithm.init([Seeds(seed) / skill]))
    for kind in ("weight", "bias"):
        weights[f"{algorithm.actor_net.head}.{kind}"].zero_()

    def write(run: RunDirectory) -> None:
        """Write the policy of the stage, which counts as done."""
        run.save_policies(stage.name, {skill: AgentPolicy(algorithm, weights)})

    options = TrainOptions(run_dir, seed=seed, quiet=True)
    return run_of(start_run(hierarchy, content, options, repair=write))


def declared(
    aim: Aim, policy: Any, residual: Any, reward: Callable[[Step], Any], most: int
) -> Skill:
    """Return a skill whose success is its aim; the one with a ``residual`` learns a correction.

    Args:
        most: the most steps of a call, unless the skill has such a limit.
    """
    skill = aim.skill
    events = [event for event in (aim.stays, aim.done) if event is not None]

    def success(self: Skill, step: Step) -> Array:
        """Return where the aim holds."""
        return np.asarray(np.logical_and.reduce([event.holds(step) for event in events]))

    methods: dict[str, Any] = {"success": success} if events else {}
    if residual is not None:
        methods["reward"] = lambda self, step: reward(step)
        if skill.fade is not None:
            raise DeclarationError(
                f"skill {skill.name!r} has fade, and a skill that learns acts alone: leave it out"
            )
    made = copy.copy(skill)  # with its own starts, ends and limits
    made.__class__ = type(type(skill).__name__, (type(skill),), methods | {"name": skill.name})
    made.policy = policy if residual is None else Residual(policy, scale=residual)
    if made.call_steps is None:
        made.call_steps = most
    return made
