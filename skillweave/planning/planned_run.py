"""``Run.plan``: a run's skills with a planner, in an environment that is scored by its task."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short, shown_path
from skillweave._internal.notices import notice
from skillweave._internal.paths import SELECTOR
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.config import PPO, AlgorithmConfig
from skillweave.api import Hierarchy, Run, TrainedPolicy
from skillweave.calls.log import CallLog
from skillweave.calls.predicates import WORD, successes
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError, RunError
from skillweave.experience.decisions import as_logits
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.settings import Guide, Selection
from skillweave.planning.forecast import Forecast, forecast, played
from skillweave.planning.mission import RESERVED
from skillweave.planning.planner import Planner
from skillweave.planning.task_env import OwnView, Tasked
from skillweave.planning.task_views import OwnSelector, own_skills
from skillweave.runs.initial_policies import Learnt
from skillweave.schema import AtLeastOne, Count, fitted
from skillweave.training.imitation import imitate


class PlannedRun(TrainedPolicy):
    """Skills of a run with a planner for a new task; nothing of it is written."""

    _kind = "PlannedRun of"
    _mark = "-plan"
    _forecast: Forecast | None = None

    def __getattr__(self, name: str) -> Any:
        if hasattr(Run, name):
            self._check_written()
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    @checked_names
    def with_selector(
        self,
        algorithm: AlgorithmConfig | None = None,
        *,
        steps: int = 100_000,
        target_kl: float | None = 0.05,
    ) -> Hierarchy:
        """Return the skills on the task, with a selector to train that starts from the plan.

        ```python
        def trained(planned):
            return planned.with_selector(steps=50_000).train("runs/mission")
        ```

        Before its training the selector learns to choose as the plan does, in logged observations;
        then it learns by itself, and the plan guides it. Skills are not trained. The selector also
        sees the state of the task; skills see what they saw. ``load`` of the same declaration loads
        the run later.

        Args:
            algorithm: settings of the selector, ``PPO``; None: ``PPO()``.
            steps: training steps of the selector.
            target_kl: while it learns, keep the selector within this KL of the plan; None: the plan
                is its start alone.

        Raises:
            DeclarationError: an argument is wrong, or the selector cannot start from a plan.
        """
        spec = self._own_spec()
        planner = self.hierarchy.selector
        assert isinstance(self.policy, HierarchyPolicy)
        assert isinstance(planner, Planner)
        config: Any = PPO() if algorithm is None else algorithm
        declared = Hierarchy(
            **to_train(spec, self.policy, planner, self.hierarchy.rest, config, target_kl),
            steps=fitted(AtLeastOne, steps, "with_selector(): steps"),
        )
        declared._starts = partial(start_of, planner, self.policy, declared.spec, config)
        return declared

    @checked_names
    def explain(self, *, episodes: int = 0) -> Forecast:
        """Return the calls that the plan intends, its chance and its steps.

        Printed, it is a line. Before the plan is played, episodes are simulated along the logged
        calls.

        Args:
            episodes: are played, where that may be done, and chance and steps are theirs; 0: none.

        Raises:
            RunError: the log has no start of an episode.
        """
        planner = self.hierarchy.selector
        assert isinstance(planner, Planner)
        if self._forecast is None:
            self._forecast = forecast(planner)
        if not fitted(Count, episodes, "explain(): episodes"):
            return self._forecast
        found = self.evaluate(episodes, quiet=True)
        return played(self._forecast, found.succeeded, episodes, fmean(found.lengths))

    def _own_spec(self) -> EnvSpec:
        return untasked(self.hierarchy.spec)

    def _check_logged(self) -> None:
        """Raise a DeclarationError: evaluations of a planned run cannot log calls."""
        raise DeclarationError(
            "episodes of a planned run end with its task, so the calls in them are cut there: "
            "leave out log_calls, and record whole calls with "
            "run.log_calls(choose=run.policy.selector)"
        )

    def _check_written(self) -> None:
        raise RunError(
            "this run was planned, so nothing of it is written or loaded again: use the run that "
            f"its skills are from, {shown_path(self.path)}, and plan again"
        )


def plan(
    run: TrainedPolicy,
    task: Any,
    log: CallLog | None,
    *,
    predicates: Mapping[str, Any] | None,
    features: Any,
    neighbors: int,
    gamma: float,
    caution: float,
    temperature: float,
) -> PlannedRun:
    """Return a run's skills with a planner of a task; see ``Run.plan``."""
    declared = run.hierarchy
    if log is None:
        log = run.calls
    elif isinstance(log, CallLog):
        log.check_environment(run._own_spec())
    if isinstance(task, str):
        words = {} if predicates is None else predicates
        if isinstance(words, Mapping):  # else the planner says what it is
            predicates = mission_words(declared, words)
    planner = Planner(
        log,
        task,
        predicates=predicates,
        skills=run.policy,
        features=declared.features if features is None else features,
        neighbors=neighbors,
        gamma=gamma,
        caution=caution,
        temperature=temperature,
    )
    hierarchy, policy = with_planner(declared, run.policy, planner)
    planned = PlannedRun(hierarchy, run.path, policy)
    # Each goal of its own would need a plan of its own now.
    if planner.already:
        notice(planner.already)
    if planner.plan.size and (expected := planned.explain()).reason:
        share = expected.chance
        chance = "no known chance" if share is None else f"a chance of {share:.0%}"
        notice(f"this plan has {chance}: {expected.reason}")
    return planned


def with_planner(
    declared: Hierarchy, policy: Policy, planner: Planner
) -> tuple[Hierarchy, HierarchyPolicy]:
    """Return a hierarchy and its policy with a planner in place of the outermost selector.

    Its environment has the task's reward and ends, so that evaluations, films and players are about
    the task. The selector's guide, interruption and target are left out: they belong to its
    training.
    """
    assert isinstance(policy, HierarchyPolicy)
    skills = replace(policy.skills, interruption=None)
    spaces = policy.selector.observation_space, skills.choice_space
    selector: Any = planner.among(tuple(s.name for s in skills.skills)).bind(*spaces, SELECTOR)
    hierarchy = copy.copy(declared)
    spec = untasked(declared.spec)
    hierarchy.env = tasked(spec, planner)
    hierarchy.selector = planner
    hierarchy.guide = None
    hierarchy.together = replace(declared.together, interrupt=False)
    hierarchy.selection = replace(declared.selection, target_return=None)
    return hierarchy, HierarchyPolicy(selector, skills)


def tasked(spec: EnvSpec, planner: Planner, *, observe: bool = False) -> EnvSpec:
    """Return an environment that is scored by a planner's task; see ``TaskEnv``."""
    wrapper = Tasked(planner.task, observe)
    # A pool would make the environment without its task.
    return replace(spec, wrappers=(*spec.wrappers, wrapper), engine="sync", pool=None)


def to_train(
    spec: EnvSpec,
    policy: HierarchyPolicy,
    planner: Planner,
    rest: Any,
    algorithm: Any,
    target_kl: float | None,
) -> dict[str, Any]:
    """Return arguments of a ``Hierarchy`` whose selector is trained on a planner's task.

    Args:
        spec: the environment without the task.
        policy: with the skills.
        planner: guides the selector.
        rest: the hierarchy's, of the actions that skills write a part of.
        algorithm: settings of PPO, by which the selector learns.
        target_kl: the KL within which it stays of the plan; None: without limit.
    """
    if not isinstance(algorithm, PPO):
        raise DeclarationError(
            f"with_selector(): algorithm is {short(algorithm)}; only a selector that learns by PPO "
            "can start from a plan: PPO()"
        )
    observed = tasked(spec, planner, observe=True)
    view = OwnView(spec.spaces.observation)
    skills = own_skills(replace(policy.skills, interruption=None), view, observed.spaces[0])
    guide = None
    # A guide says nothing about goals, so one of a single skill would say nothing at all.
    if target_kl is not None and (policy.skills.choices > 1 or not planner.log.goals):
        guide = Guide(OwnSelector(planner, view), restrict=False, target_kl=target_kl)
    return {
        "env": observed,
        "skills": list(skills.skills),
        "call_steps": skills.call_steps,
        "selector": algorithm,
        "rest": rest,
        "reflexes": skills.reflexes,
        "selection": Selection(
            deliberation_cost=skills.deliberation_cost, greedy_skills=skills.greedy
        ),
        "guide": guide,
    }


PAIRS = 10_000
"""The observations, each with a state of the task, by which a selector learns to act as a plan."""
GOALS = 64
"""The goals that they have, where observations hold goals."""


def start_of(
    planner: Planner, policy: HierarchyPolicy, spec: EnvSpec, config: PPO
) -> dict[str, Learnt]:
    """Return the policy with which a selector starts, by its path: it chooses as the plan does.

    It learns the plan's choices in logged observations, with states of the task drawn at random.

    Args:
        planner: with its log.
        policy: with the skills.
        spec: the environment whose observations hold the task's state.
        config: settings of the selector.
    """
    seeds = Seeds(0) / "plan"
    log = planner.log
    obs, state = planner.situations(PAIRS, GOALS, (seeds / "pairs").numpy())
    may = policy.skills.hierarchy.may_start(obs)
    may |= ~may.any(axis=1, keepdims=True)
    chosen, call = planner.choices(obs, state, may)
    chances = np.exp(as_logits(np.eye(log.choices, dtype=np.float32)[chosen], may)) * may
    view = OwnView(log.observation_space)
    seen = view.joined(obs, planner.machine.observe(state))
    with_goals = None
    if log.goals:
        space = policy.skills.choice_space
        bound = planner.among(log.skills).bind(log.observation_space, space, SELECTOR)
        with_goals = space, bound.in_place.record(chosen, call, obs)
    selector = imitate(config, seen, may, chances, spec.spaces.observation, seeds, with_goals)
    names = tuple(skill.name for skill in policy.skills.skills)
    sha256 = selector.source()["sha256"]
    of = selector, sha256, log.steps, "the plan", None, (names, log.lengths)
    return {SELECTOR: Learnt(*of, critic=False)}


def mission_words(declared: Declaration, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the predicates that a mission's text may name.

    They are the skills' successes by their names, the declaration's own, and those given, which
    replace others of their names.
    """
    own = {
        name: success
        for name, success in successes(declared.skills).items()
        if name not in RESERVED and re.fullmatch(WORD, name)
    }
    return {**own, **declared.predicates, **given}


def untasked(spec: EnvSpec) -> EnvSpec:
    """Return an environment without the score of a planned task."""
    return replace(spec, wrappers=tuple(w for w in spec.wrappers if not isinstance(w, Tasked)))
