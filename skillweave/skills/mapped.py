"""Policies behind a mapping: memory between steps, and calls of the model.

``MappedPolicy`` is the base of the kinds of policies from elsewhere, which only call their models.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple

from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.messages import short
from skillweave.notices import notice
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.skills.foreign_policy import SEES, Foreign
from skillweave.skills.goal_spaces import with_goal, without_goal
from skillweave.skills.goals import Goals
from skillweave.skills.mapping import Goal, PolicyMapping
from skillweave.skills.plan import Plan, Shapes
from skillweave.types import Array, Memory


class MappedPolicy(Foreign):
    """A policy from elsewhere behind a mapping; a subclass calls its model.

    Its memory has, where the mapping needs them: ``state.0`` and following, the recurrent state;
    ``last``, the last output; ``phase``, the steps since the last inference; ``held``, its actions.
    """

    maps = True
    logits = True
    """Outputs that are no whole numbers are logits of choices."""

    def __init__(
        self,
        name: str,
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        super().__init__(name, observation_space, action_space)
        self.mapping = mapping or PolicyMapping()
        self._plan: Plan | None = None
        self._goals: Goals | None = None

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))  # with the same model, which is not loaded again
        vars(twin).update(vars(self))
        return twin

    def call(
        self,
        inputs: Any,
        state: tuple[Array, ...],
        mask: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Call the model.

        Args:
            inputs: arrays by the names of inputs; observations (n, *obs_shape) where no ``sees`` is
                declared.
            state: the recurrent state, each array with the environments first.
            mask: (n, A) bool, allowed actions; None: all. Logits are masked afterwards.
            deterministic: act greedily; else sample with ``rng``.

        Returns:
            The outputs (n, ...), and the next state.
        """
        raise NotImplementedError

    def expected(self) -> Shapes:
        """Return the shapes of the model's inputs for one environment, by name; {}: unknown."""
        return {}

    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """Return the shapes of the recurrent state of one environment, and their types."""
        return ()

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces, with its mapping fitted to them.

        Raises:
            PolicyError: the mapping does not fit; the message names the field.
        """
        bound = super().bind(observation_space, action_space, who)
        bound.fit_mapping()
        return bound

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an input of it."""
        return self.mapping.takes_goal

    def bind_with_goals(
        self, observation_space: Space[Any], action_space: Space[Any], who: str, goals: Goals
    ) -> Self:
        """Return a copy as of ``bind``, as the policy of a skill that has goals.

        It observes ``with_goal``.

        Raises:
            PolicyError: the goal is no input of it, or its mapping does not fit.
        """
        bound = super().bind(observation_space, action_space, who)
        if not self.takes_goal:
            raise PolicyError(f"{bound._who} takes no goal, but its skill has goals: {self.advice}")
        bound._check_range(goals)
        bound._goals = goals
        bound.observation_space = with_goal(bound.observation_space, goals.space)
        bound.fit_mapping()
        return bound

    def _check_range(self, goals: Goals) -> None:
        """Give a notice where the skill has goals beyond the range of the policy's ``Goal``."""
        if not isinstance(goals.space, Box):
            return
        lowest, highest = goals.space.low.reshape(-1), goals.space.high.reshape(-1)
        for place in self.mapping.sources():
            if not isinstance(place, Goal):
                continue
            low = -np.inf if place.low is None else np.array(place.low)
            high = np.inf if place.high is None else np.array(place.high)
            fits = {np.size(low), np.size(high)} <= {1, len(lowest)}  # else refused later
            if fits and ((lowest < low - 1e-6).any() or (highest > high + 1e-6).any()):
                notice(
                    f"{self._who}: goal_space is {short(goals.space, 200)}, but Goal.low is "
                    f"{short(place.low)} and Goal.high {short(place.high)}, the range for which "
                    "the policy was made. It gets other goals clipped, and step.goal has them as "
                    "they are: give goal_space that range"
                )

    @property
    def has_goals(self) -> bool:
        """Return whether it is the policy of a skill with goals, and takes them by itself."""
        return self._goals is not None

    @property
    def given(self) -> str:
        """Return the inputs that ``sees`` gives, or the observations, for messages."""
        inputs = None if self._plan is None else self._plan.inputs
        if inputs is None:
            return super().given
        named = (f"{name}: {x.described}" if name else x.described for name, x in inputs.items())
        return f"the inputs that sees gives, {'; '.join(named)}"

    def _advice_on(self, error: BaseException) -> str:
        """Return advice where an argument is missing, or whole observations are given."""
        if not self.mapping.state and "required positional argument" in str(error):
            return "; one with a recurrent state needs state=, the shape of this state"
        whole = self.mapping.sees is None and isinstance(self.observation_space, Dict | Tuple)
        return f"; {SEES}" if whole else ""

    advice = "write Goal() at its place in sees"
    """How the policy is given the goal, for messages."""

    def fit_mapping(self) -> None:
        """Fit the mapping to the spaces, which are known."""
        seen, size = self.observation_space, None
        if self._goals is not None:
            seen, size = without_goal(seen), self._goals.size
        spaces = seen, self.action_space
        self._plan = Plan(self.mapping, *spaces, self.expected(), self._who, self.states(), size)

    @property
    def plan(self) -> Plan:
        """Return the mapping fitted to the spaces; a PolicyError where these are not known."""
        if self._plan is None:
            if self.mapping.sees is not None and self.observation_space is None:
                raise PolicyError(f"{self._who} has no spaces yet: bind() it to an environment's")
            self.must_be_bound()
            self.fit_mapping()
            assert self._plan is not None
        return self._plan

    def start(self, n: int) -> Memory:
        """Return the memory of n environments in which it has not acted yet."""
        if self._plan is None and not self.remembers():
            return {}
        return self.plan.start(n)

    def split(self, obs: Array) -> tuple[Array, Array | None]:
        """Return observations, and goals (n, G), of what a skill with goals observes."""
        assert self._goals is not None
        return obs[OBSERVATION], self._goals.flat(obs[GOAL])

    def remembers(self) -> bool:
        """Return whether it has a memory."""
        return bool(self.mapping.state) or self.mapping.remembers_output or self.mapping.period > 1

    def act(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None = None,
        *,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
        goal: Array | None = None,
    ) -> tuple[Array, Memory]:
        """Return actions; logits are sampled with ``rng`` if not ``deterministic``.

        ``goal`` (n, G) replaces the mapping's own goal. The policy of a skill with goals finds them
        in ``obs``.
        """
        plan = self._plan or self.plan
        if self._goals is not None:
            obs, goal = self.split(obs)
        if plan.remembers_nothing:
            inputs = obs if plan.inputs is None else plan.read(obs, None, goal)
            output, _ = self.call(inputs, (), mask, deterministic, rng)
            act = plan.outputs
            return act(output, len(obs), self.logits, mask, deterministic, rng)[0], memory
        period = plan.mapping.period
        how: Any = {"deterministic": deterministic, "rng": rng}
        if period == 1:
            actions, after = self._infer(memory, obs, mask, goal=goal, **how)
            return actions[0], after
        phase = memory["phase"]
        held = memory["held"]
        due = np.flatnonzero(phase == 0)
        after = dict(memory)
        if len(due):
            every = len(due) == len(obs)

            def some(rows: Any) -> Any:
                return rows if every or rows is None else rows[due]

            before = {k: some(v) for k, v in memory.items()}
            chosen, remembered = self._infer(before, some(obs), some(mask), goal=some(goal), **how)
            remembered["held"] = held = plan.held(chosen)
            for k, v in remembered.items():
                if every:
                    after[k] = v
                elif v is not before[k]:
                    after[k] = memory[k].copy()
                    after[k][due] = v
            held = after["held"]
        after["phase"] = (phase + 1) % period
        return plan.of_held(held, phase // plan.mapping.every), after

    def _infer(
        self,
        memory: Memory,
        obs: Array,
        mask: Array | None,
        *,
        goal: Array | None,
        deterministic: bool,
        rng: np.random.Generator | None,
    ) -> tuple[list[Array], Memory]:
        """Return the next actions, (n, ...) each, and the memory after them."""
        plan = self.plan
        chunk = self.plan.mapping.chunk
        n = len(obs)
        inputs = obs if plan.inputs is None else plan.read(obs, memory.get("last"), goal)
        output, state = self.call(
            inputs, tuple(memory[k] for k in plan.state_keys), mask, deterministic, rng
        )
        outputs = [output]
        if chunk is not None:
            several = plan.outputs.count > 1 and (
                self.logits or isinstance(plan.outputs.space, Box)
            )
            if output.ndim < 2 + several or output.shape[1] < chunk:
                raise PolicyError(
                    f"{self._who} returned shape {output.shape}, but chunk={chunk} needs "
                    f"(n, {chunk}, ...): {chunk} actions for each environment"
                )
            outputs = [output[:, i] for i in range(chunk)]
        actions = []
        last = None
        for i, one in enumerate(outputs):
            now = mask if i == 0 else None
            action, last = plan.outputs(one, n, self.logits, now, deterministic, rng)
            actions.append(action)
        after = dict(memory)
        for key, value in zip(plan.state_keys, state, strict=True):
            if value.shape != memory[key].shape:
                raise PolicyError(
                    f"{self._who} returned a state of shape {value.shape}, but it was given "
                    f"{memory[key].shape}"
                )
            after[key] = value
        if "last" in memory:
            assert last is not None
            # A copy, as all that is remembered.
            after["last"] = last.reshape(n, -1).astype(np.float64)
        return actions, after

    def source(self) -> dict[str, Any]:
        """Return its source as JSON, with its mapping."""
        found = super().source()
        return found if self.mapping.is_identity else found | {"mapping": self.mapping.to_json()}

    def remapped(self, data: dict[str, Any] | None, where: str) -> Self:
        """Return a copy with the recorded mapping ``data``.

        Raises:
            RunError: it cannot be read, or needs a function that this policy does not have.
        """
        policy = copy.copy(self)
        try:
            policy.mapping = PolicyMapping.from_json(data or {}, self.mapping.functions())
        except DeclarationError as error:
            raise RunError(
                f"{where}: its policy had another mapping, which cannot be restored: {error}"
            ) from error
        if self._plan is not None:
            policy.fit_mapping()
        return policy


def invoke(function: Any, inputs: dict[str, Any], state: Sequence[Any], single: bool) -> Any:
    """Call a function or a module with inputs by name, or with the only one, and its state.

    Args:
        single: the state is one array; else a tuple.
    """
    states = [state[0] if single else tuple(state)] if state else []
    if "" in inputs:
        return function(inputs[""], *states)
    return function(**inputs, **({"state": states[0]} if states else {}))


def parted(value: Any, mapping: PolicyMapping, who: str) -> tuple[Any, Sequence[Any]]:
    """Return the output and the next state of what a function or a module has returned.

    Raises:
        PolicyError: with a state, it is not a pair.
    """
    if not mapping.state:
        return value, ()
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise PolicyError(
            f"{who} returned a {type(value).__name__}; with a state it must return two values: the "
            "output, and the next state"
        )
    after = value[1]
    if mapping.single_state:
        return value[0], (after,)
    if not isinstance(after, tuple | list):
        raise PolicyError(f"{who} returned a {type(after).__name__} as its state, not a tuple")
    return value[0], after


def model_state(state: tuple[Array, ...], shapes: tuple[Any, ...]) -> list[Array]:
    """Return a state, environments first, with the environments where ``shapes`` have None."""
    return [np.moveaxis(x, 0, s.index(None)) for x, s in zip(state, shapes, strict=True)]


def rows_first(state: Sequence[Array], shapes: tuple[Any, ...], who: str) -> tuple[Array, ...]:
    """Return a model's state with the environments first; undo ``model_state``."""
    if len(state) != len(shapes):
        raise PolicyError(f"{who} returned {len(state)} arrays of state, but takes {len(shapes)}")
    for x, s in zip(state, shapes, strict=True):
        if x.ndim != len(s):
            raise PolicyError(f"{who} returned a state of shape {x.shape}, but takes {s}")
    return tuple(np.moveaxis(x, s.index(None), 0) for x, s in zip(state, shapes, strict=True))


def state_shapes(mapping: PolicyMapping, dtype: Any) -> list[tuple[tuple[int, ...], Any]]:
    """Return the shapes of a state that was declared by shapes, for one environment."""
    return [(tuple(n for n in shape if n is not None), dtype) for shape in mapping.state]
