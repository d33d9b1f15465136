"""Planning on logged calls: a selector for a new task, without training."""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Self

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave.calls.columns import columns_of
from skillweave.calls.log import CallLog
from skillweave.calls.neighbors import check_features
from skillweave.errors import DeclarationError, RunError
from skillweave.planning.goal import GoalTask
from skillweave.planning.graph import CallGraph, planning_states
from skillweave.planning.lacking import asks_nothing, obstacle
from skillweave.planning.machine import RewardMachine
from skillweave.planning.mission import as_task
from skillweave.policies.core import Array
from skillweave.policies.plan import Near
from skillweave.policies.planned import Planned
from skillweave.policies.spaces import space_of
from skillweave.policies.untrusted import checksum
from skillweave.schema import AtLeastOne, Check, Fraction, fitted
from skillweave.skills.goal_spaces import MOST_SHOWN, shown_goal
from skillweave.skills.selector import ReadySelector
from skillweave.skills.skill_set import SkillSet, skills_below

ALIKE = 0.1
"""The share of all goals' range below which goals are shown as one."""
MOST_NAMED = 3
"""The most goals that are named one by one."""
MOST_GOALS = 256
"""Goals whose plans are kept."""
_ToTen = Annotated[float, Check("from 0 to 10", lambda x: 0 <= x <= 10)]


@checked_names
class Planner(ReadySelector):
    """A selector that plans a task on logged calls; nothing is trained.

    ```python
    import numpy as np

    from skillweave.planning import Mission, Planner, record_calls


    def right(obs):
        return obs[:, 0] > 0.5


    def left(obs):
        return obs[:, 0] < -0.5


    def plan(run):
        log = record_calls(run.hierarchy.spec, run.policy, steps=20_000)
        return Planner(log, Mission(right, left), skills=run.policy)
    ```

    The value of a call is what it pays by the task, judged over the steps inside it, and what
    follows at its end: the best choice there, by the K nearest logged calls of each choice. At a
    decision the choice is best whose nearest calls are worth most. Calls of the running episode
    count as well, so a call that failed is not repeated forever.

    A skill with goals is called with goals of its nearest logged calls; calls count for one another
    by start and goal. Where the log has few different goals, each is as another skill would be.

    Args:
        log: calls of these skills in this environment.
        task: a ``Mission`` or its text, a ``RewardMachine``, a ``GoalTask``, a predicate, or a
            function of a ``Step`` that returns the reward.
        predicates: by name, for a text.
        skills: a policy with the skills, or its ``SkillSet``; the log is compared with them. None:
            nothing is compared, and initiation sets are those that were recorded.
        features: by what calls are near one another: places in the flat observation, or a function
            of observations (n, …) to (n, F); or a dict of these by skill. None: what each skill
            sees, and what changes in most steps, without numbers that never change within an
            episode, if they do not help to predict where calls end and the task does not read them;
            ``compared`` has the places. They are standardised by the log.
        neighbors: K.
        gamma: γ of one step.
        caution: the share by which a value falls, about, where the nearest call is as far as the
            last of the ``neighbors`` usually is.
        temperature: choices are sampled by exp(Q / (temperature · the largest |Q|)); 0: the best is
            chosen.

    Raises:
        DeclarationError: an argument is wrong, or features are constant or not finite.
        RunError: the log is of other skills, has too few calls, or no step of it does what the task
            needs; the message says which skill comes nearest.
    """

    kind = "planner"

    def __init__(
        self,
        log: CallLog,
        task: Any,
        *,
        predicates: Mapping[str, Any] | None = None,
        skills: Any = None,
        features: Any = None,
        neighbors: int = 5,
        gamma: float = 0.999,
        caution: float = 0.03,
        temperature: float = 0.0,
    ) -> None:
        super().__init__("planner")
        check_features(features, "Planner")
        self.log = fitted(CallLog, log, "Planner: log")
        self.task = as_task(task, predicates)
        self.skills, self.lengths = log.skills, log.lengths
        if isinstance(self.task, RewardMachine) and not self.task.pays:
            raise DeclarationError(
                "the RewardMachine pays nothing, so there is nothing to plan: give a transition a "
                "reward, {('from', 'to'): (event, 1.0)}, or name accepting states, which then pay 1"
            )
        self.graph = CallGraph(
            log,
            features,
            fitted(AtLeastOne, neighbors, "Planner: neighbors"),
            _skill_set(log, skills),
            self.task if isinstance(self.task, RewardMachine) else None,
        )
        self.gamma = fitted(Fraction, gamma, "Planner: gamma")
        self.caution = fitted(_ToTen, caution, "Planner: caution")
        self.temperature = fitted(_ToTen, temperature, "Planner: temperature")
        self._plans: OrderedDict[bytes, Array] = OrderedDict()
        self.observed: GoalTask | None = None
        """The task, where each observation has a goal of its own."""
        if isinstance(self.task, GoalTask) and self.task.columns is not None:
            self.observed = self.task
        self.over = _over(self.observed, self.graph)
        """(E,) bool, the ends of calls after which nothing follows."""
        self.machine = self.task.at(None) if isinstance(self.task, GoalTask) else self.task
        self.states = planning_states(self.machine)
        for i, name in enumerate(log.skills):
            if not (self.graph.log.skill == i).any():
                notice(f"the log has no call of {name!r}, so the planner never calls it")
        if any(log.recurrent):
            names = ", ".join(n for n, r in zip(log.skills, log.recurrent, strict=True) if r)
            notice(
                f"these skills have a memory: {names}. The planner compares their calls by "
                "observations alone"
            )
        self.plan: Array = np.zeros((0, 0), np.float32)
        """(P, M) float32, the worth of each piece of a logged call from each planning state; empty
        where each observation has a goal of its own."""
        self.obstacle = ""
        """Why no order of logged steps does the task; empty: one does, or it has no end."""
        self.already = asks_nothing(self.machine, log)
        """A sentence on words of the task that hold before anything is done; empty: none does."""
        if isinstance(self.task, RewardMachine):
            self.plan = self._solve(self.task)
            self.obstacle = obstacle(self.task, log)
        elif self.observed is None:
            self.plan = self._solve(self.task.at(self.task.goal))

    def check_environment(self, spec: Any) -> None:
        """Give a notice where the log is of another environment, or the environment has changed."""
        self.log.check_environment(spec)

    @cached_property
    def in_place(self) -> Planned:  # type: ignore[override]
        """The plan as data, which acts in many environments at once."""
        graph = self.graph
        states = self.states
        worth = self.plan
        kind: type[Planned] = Planned
        if self.observed is not None:
            kind = _OfObserved
            worth = np.zeros((len(graph.pieces.call), states.count), np.float32)
        acts = kind(
            *self._rule_of,
            tuple(each.acting for each in graph.maps),
            graph.options,
            self.machine.acts,
            states,
            worth,
            self.gamma,
            self.caution,
            self.temperature,
            {name: graph.log.goals[name] for name in self.goal_spaces},
        )
        if isinstance(acts, _OfObserved):
            acts.planner = self
        return acts

    # Planning

    def _solve(self, task: RewardMachine, near: Near | None = None, may: Any = None) -> Array:
        """Return the plan of a task; ``near`` and ``may`` as for ``CallGraph.solve``."""
        graph = self.graph
        near, may = (graph.after, graph.may) if near is None else (near, may)
        return graph.solve(task, self.gamma, self.over, near, may, caution=self.caution)

    def _plan_of(self, task: GoalTask, goal: Array) -> Array:
        """Return the plan of a goal (G,), solved when it is first needed."""
        key = goal.tobytes()
        if key in self._plans:
            self._plans.move_to_end(key)
        else:
            self._plans[key] = self._solve(task.at(goal), *self.graph.for_goal(task, goal))
            if len(self._plans) > MOST_GOALS:
                self._plans.popitem(last=False)
        return self._plans[key]

    def values(self, obs: Array, state: Array | None = None) -> Array:
        """Return the value of each choice in observations, (n, choices) float32.

        Args:
            obs: (n, *obs_shape).
            state: (n, 1 + H) of the task; None: its start.

        Returns:
            Values, of a skill with goals that of its best goal; −infinity for choices of which the
            log has no call.
        """
        state = self.machine.start(len(obs)) if state is None else state
        values = self.in_place.valued(self.graph.near(obs), obs, self.states.corners(state))
        first = np.searchsorted(self.graph.choice_of, np.arange(self.log.choices))
        best: Array = np.maximum.reduceat(values, first, axis=1)
        return best

    def choices(self, obs: Array, state: Array, may: Array) -> tuple[Array, Array]:
        """Return the best choices in observations, without what an episode has tried.

        Args:
            obs: (n, *obs_shape).
            state: (n, 1 + H) of the task.
            may: (n, choices) bool, what may be chosen.

        Returns:
            The choices (n,), and the calls of the graph whose goals they have, (n,); −1: none.
        """
        option, near = self.options(obs, state, may)
        return self.graph.choice_of[option], near.goal[np.arange(len(obs)), option]

    def options(
        self, obs: Array, state: Array, may: Array, rng: np.random.Generator | None = None
    ) -> tuple[Array, Near]:
        """Return the best options of the graph, (n,), and the nearest calls; see ``choices``."""
        near = self.graph.near(obs)
        q = self.in_place.valued(near, obs, self.states.corners(state))
        return self.in_place.choose(q, may, rng), near

    def shown_goals(self, skill: int, calls: Array) -> str:
        """Return the goals of some calls of a skill in a few words; empty: it has none.

        Goals of numbers are shown by the middle 80 % of each; others are counted.

        Args:
            skill: its place.
            calls: (n,) calls of the graph whose goals they are; −1: none.
        """
        goals = self.graph.log.goals.get(self.log.skills[skill])
        if goals is None or (calls < 0).any():
            return ""
        mine = goals[calls]
        space = None
        if self.graph.skills is not None:
            space = self.graph.skills.skills[skill].goal_space
        if goals.shape[1] > MOST_SHOWN:
            return f"({goals.shape[1]} numbers)"
        if space is None or (isinstance(space, gym.spaces.Box) and space.dtype.kind == "f"):
            spread = np.ptp(goals[self.graph.log.skill == skill], 0)
            low, high = np.quantile(mine, (0.1, 0.9), axis=0)
            each = [
                f"{a:.3g} to {b:.3g}" if b - a > ALIKE * whole else f"{m:.3g}"
                for a, b, m, whole in zip(low, high, np.median(mine, 0), spread, strict=True)
            ]
            return f"({', '.join(each)})"
        unique, counts = np.unique(mine, axis=0, return_counts=True)
        often = unique[np.argsort(-counts, kind="stable")][:MOST_NAMED]
        names = [shown_goal(one) for one in space_of(space).of_numbers(often)]
        return " or ".join([*names, *["others"] * (len(unique) > MOST_NAMED)])

    @property
    def compared(self) -> dict[str, list[int] | None]:
        """The places in the flat observation that count, by skill; None: a function does."""
        places = (each.places for each in self.graph.maps)
        return dict(zip(self.log.skills, places, strict=True))

    def situations(self, count: int, goals: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw logged observations, and states of the task that is not over in them.

        Args:
            count: the most observations.
            goals: the most goals that they have, where observations hold goals.
            rng: the source of chance.

        Returns:
            (n, *obs_shape), half of them where calls start or end, and (n, 1 + H).
        """
        log, machine = self.log, self.machine
        ends = np.concatenate([log.start, log.end])
        inside = rng.integers(log.steps, size=count // 2)
        at_ends = rng.integers(len(ends), size=count - len(inside))
        obs: Array = np.concatenate([log.next_obs[inside], ends[at_ends]])
        if (task := self.observed) is not None:
            known = np.unique(task.of(log.start), axis=0)
            known = known[rng.permutation(len(known))[:goals]]
            for goal, rows in zip(
                known, np.array_split(np.arange(len(obs)), len(known)), strict=True
            ):
                obs[rows] = task.put(obs[rows], goal)
        state = np.zeros((len(obs), 1 + machine.slots), np.int64)
        goes_on = np.flatnonzero(~(machine.accepting | machine.failing))
        state[:, 0] = rng.choice(goes_on, len(obs))
        steps = machine.counter_steps[state[:, 0]]
        used = steps < np.iinfo(np.int64).max
        counted = rng.integers(np.where(used, steps, 1)) * (rng.random(steps.shape) < 0.5)
        state[:, 1:] = counted
        return obs, state

    # A ready selector

    def among(self, skills: tuple[str, ...]) -> Self:
        """Return a copy that chooses among the skills of these names.

        Raises:
            RunError: the log is of other skills.
        """
        if tuple(skills) != self.log.skills:
            raise RunError(
                f"the planner's log is of the skills {', '.join(self.log.skills)}, but the "
                f"hierarchy has {', '.join(skills)}; record a log of these skills"
            )
        return super().among(skills)

    def bind(
        self, observation_space: gym.Space[Any], action_space: gym.Space[Any], who: str
    ) -> Self:
        """Return a copy for these spaces; ``who`` begins messages.

        Raises:
            RunError: the log has other observations, or other goals.
            DeclarationError: it would guide a selector of one skill with goals.
        """
        self.log.check_spaces(observation_space, self.log.action_space)
        bound = super().bind(observation_space, action_space, who)
        sizes = {name: goals.shape[1] for name, goals in self.log.goals.items()}
        spaces = bound.goal_spaces
        if not spaces and sizes and self.log.choices == 1:
            raise DeclarationError(
                f"{who}: the hierarchy has one skill, {self.log.skills[0]!r}, and a guide says "
                "nothing about goals, so this planner would guide nothing: use it as the selector"
            )
        own = {name: space_of(space).size for name, space in spaces.items()}
        if spaces and own != sizes:
            raise RunError(
                f"{who}: the planner's log has goals of {_shown_sizes(sizes)}, but the hierarchy's "
                f"skills have goals of {_shown_sizes(own)}; record a log of these skills"
            )
        return bound

    def source(self) -> dict[str, Any]:
        """Return the checksum of its log, with the names of its task's states."""
        digest = [
            checksum(np.ascontiguousarray(x).tobytes()) for x in columns_of(self.log).values()
        ]
        about = [digest, self.machine.state_names, self.gamma, self.caution, self.temperature]
        whole = json.dumps(about)
        return {"kind": self.kind, "name": self.name, "sha256": checksum(whole.encode())}


class _OfObserved(Planned):
    """A plan for the goals that observations hold, each solved when it is first observed."""

    planner: Planner

    def worths(self, obs: Array) -> Iterator[tuple[Any, Array]]:
        """Yield rows of observations with one goal, and the worth of pieces for it."""
        task = self.planner.observed
        assert task is not None
        unique, which = np.unique(task.of(obs), axis=0, return_inverse=True)
        for i, goal in enumerate(unique):
            yield np.flatnonzero(which.reshape(-1) == i), self.planner._plan_of(task, goal)


def _shown_sizes(sizes: Mapping[str, int]) -> str:
    """Return the numbers of goals by skill for messages."""
    each = [f"{name} ({size} number{'s' * (size != 1)})" for name, size in sizes.items()]
    return ", ".join(each) or "no skill"


def _skill_set(log: CallLog, skills: Any) -> SkillSet | None:
    """Return the skills, compared with the log; None: none were given."""
    if skills is None:
        return None
    skill_set = skills if isinstance(skills, SkillSet) else skills_below(skills)
    if skill_set is None:
        raise DeclarationError(
            f"Planner: skills is {short(skills)}; give a policy with skills: run.policy"
        )
    log.check_skills(skill_set)
    return skill_set


def _over(observed: GoalTask | None, graph: CallGraph) -> Array:
    """Return the ends after which nothing follows, (E,) bool: where the episode terminated.

    An episode that ended at its own goal would go on there for another one.
    """
    over: Array = graph.terminated.copy()
    if observed is not None:
        rows = np.flatnonzero(over)
        own = observed.of(graph.log.start[graph.end_call[rows]])
        over[rows] = ~observed.holds(graph.end[rows], own)
    return over
