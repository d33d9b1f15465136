"""Policies behind a mapping, fitted to spaces; ``policies.mapped`` acts.

``MappedPolicy`` is the base of the kinds of policies from elsewhere, which only make their models.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from gymnasium import Space
from gymnasium.spaces import Box, Dict, Tuple

from skillweave._internal.messages import short
from skillweave._internal.notices import notice
from skillweave._internal.policy_protocol import Memoryless
from skillweave.errors import DeclarationError, PolicyError, RunError
from skillweave.policies.core import Array, RowPolicy, Turn, World
from skillweave.policies.functional import Functional
from skillweave.policies.mapped import Function, Input, Mapped, Model, numbers_of
from skillweave.policies.parts import GOAL, OBSERVATION
from skillweave.policies.spaces import Space as Data, space_of
from skillweave.skills.fit_mapping import described, fitted_inputs, fitted_outputs, for_model
from skillweave.skills.foreign_policy import EXAMPLES, SEES, Foreign, made_up
from skillweave.skills.function_state import FunctionState, examples
from skillweave.skills.goal_spaces import with_goal, without_goal
from skillweave.skills.goals import Goals
from skillweave.skills.mapping import LastAction, PolicyMapping
from skillweave.skills.outputs import Wrapped, of_numbers
from skillweave.skills.probing import MOST_BYTES
from skillweave.skills.rows import largest_difference, other_rows, parts_of, shown

ROUNDING = 0.03
"""The largest difference of outputs, relative to their size, that is rounding: that of 8 bits."""


class MappedPolicy(Functional, Foreign, Model):
    """A policy from elsewhere behind a mapping; a subclass makes its model."""

    logits = True
    """Outputs that are no whole numbers are logits of choices."""
    acting = Memoryless.acting

    def __init__(
        self,
        name: str,
        observation_space: Any = None,
        action_space: Any = None,
        mapping: PolicyMapping | None = None,
    ) -> None:
        Foreign.__init__(self, name, observation_space, action_space)
        self.mapping = mapping or PolicyMapping()
        self._goals: Goals | None = None

    def __copy__(self) -> Self:
        twin = object.__new__(type(self))  # with the same model, which is not loaded again
        twin.__dict__ |= {k: v for k, v in vars(self).items() if k not in ("in_place", "_like")}
        return twin

    @property
    def model(self) -> Model:
        """Its model, for the spaces that it has."""
        return self

    @cached_property
    def in_place(self) -> RowPolicy:  # type: ignore[override]
        """The policy that acts, with the mapping fitted to the spaces.

        Raises:
            PolicyError: these are not known, or it does not fit; the message names the field.
        """
        self.must_be_bound()
        who = self._who
        mapping = self.mapping
        model = self.model
        seen = self.observation_space
        goal_space: Data | None = None
        goal: Array | Wrapped | None = None
        if self._goals is not None:
            seen = without_goal(seen)
            goal_space = self._goals.space
        elif callable(mapping.goal):
            goal = of_numbers(mapping.goal, f"{who}: goal()")
        elif mapping.goal is not None:
            goal = np.array(mapping.goal)
        outputs = fitted_outputs(mapping.acts, self.action_space, who, self.logits)
        inputs: dict[str, Input] | None = None
        if mapping.sees is not None:
            last = any(isinstance(source, LastAction) for source in mapping.sources())
            if last and outputs.space.kind != "Box":
                raise PolicyError(
                    f"{who}: sees has LastAction(), which needs actions of a Box, not "
                    f"{self.action_space}"
                )
            own = {"last_action": (outputs.count,)}
            if goal_space is not None:
                own["goal"] = (goal_space.size,)
            elif isinstance(goal, Wrapped):
                with examples(goal.bare):
                    goals = numbers_of(goal, made_up(seen, 2), f"{who}: goal()")
                own["goal"] = goals.shape[1:]
                if len(own["goal"]) != 1:
                    raise PolicyError(f"{who}: goal() must return (n, numbers)")
            elif goal is not None:
                own["goal"] = goal.shape
            inputs = for_model(fitted_inputs(mapping, seen, who, own), model.expected, who)
        ramp = 0 if mapping.acts is None else mapping.acts.ramp
        takes = [take for given in (inputs or {}).values() for take in given.takes]
        entered = space_of(seen) if any(take.takes_call for take in takes) else None
        how = mapping.every, mapping.chunk, goal, goal_space, ramp, mapping.anew, mapping.entry
        return Mapped(model, outputs, inputs, *how, entered, who, notice)

    def try_out(self) -> None:
        """Act once on two example observations, and look at a model's outputs.

        Raises:
            PolicyError: it failed, or its outputs for an observation depend on something else.
        """
        super().try_out()
        if not isinstance(self.model, Function):
            look_at_outputs(self)

    def twin(self) -> Self:
        """Return a copy whose calls leave no traces in this policy."""
        return copy.copy(self)

    def outputs(self, obs: Array) -> dict[str, Array]:
        """Return the model's outputs for observations, with a fresh memory.

        Raises:
            PolicyError: it failed.
        """
        acting = self.in_place
        goal = None
        n = len(obs)
        assert isinstance(acting, Mapped)
        if self.joins:
            obs, goal = obs[OBSERVATION], obs[GOAL]
        turn = Turn(World(np.random.default_rng(0)), None, goal)
        return parts_of(acting.infer(acting.start(n), np.arange(n), obs, turn)[0])

    def tensors(self) -> dict[str, Any]:
        """Return copies of the tensors that its module may write, by name."""
        return {}

    def must_be_bound(self) -> None:
        """Raise a PolicyError if it has not the spaces that it needs yet."""
        unseen = self.mapping.sees is not None and self.observation_space is None
        if unseen or self.action_space is None:
            raise PolicyError(f"{self._who} has no spaces yet: bind() it to an environment's")

    def bind(self, observation_space: Space[Any], action_space: Space[Any], who: str) -> Self:
        """Return a copy for these spaces, with its mapping fitted to them.

        Raises:
            PolicyError: the mapping does not fit; the message names the field.
        """
        bound = super().bind(observation_space, action_space, who)
        _ = bound.in_place
        return bound

    @property
    def takes_goal(self) -> bool:
        """Return whether the goal of a skill is an input of it."""
        return bool(self.mapping.goal_places)

    def normalized(self) -> dict[str, tuple[Array, Array]]:
        """Return means and deviations by which its model normalizes inputs, flat, by their names.

        They are of the observations on which it was trained. An input without them is left out.
        """
        names = self.mapping.scaling  # of ``VecNormalize``, which is applied already
        return {name: (np.zeros(1), np.ones(1)) for name in names}

    def with_goal(self, goal: Any) -> Self:
        """Return a copy with another goal: numbers, or a function of observations.

        Raises:
            DeclarationError: it takes none, or the goal is out of its range.
        """
        aimed = copy.copy(self)
        try:
            aimed.mapping = replace(self.mapping, goal=goal)
        except DeclarationError as error:
            raise DeclarationError(f"with_goal(): {self.name}: {error}") from None
        return aimed

    def bind_with_goals(
        self, observation_space: Space[Any], action_space: Space[Any], who: str, goals: Goals
    ) -> Self:
        """Return a copy as of ``bind``, as the policy of a skill that has goals.

        It observes ``with_goal``.

        Raises:
            PolicyError: the goal is no input of it, or its mapping does not fit.
        """
        if not self.takes_goal:
            raise PolicyError(
                f"{who}: {self.name} takes no goal, but its skill has goals: {self.advice}"
            )
        check_range(goals, self.mapping.goal_places, f"{who}: {self.name}")
        aimed = copy.copy(self)
        seen = observation_space if self._open[0] else self.observation_space
        aimed._goals = goals
        aimed.joins = True
        aimed.observation_space = with_goal(seen, goals.goal_space)
        return aimed.bind(aimed.observation_space, action_space, who)

    @property
    def given(self) -> str:
        """Return the inputs that ``sees`` gives, or the observations, for messages."""
        inputs = getattr(self.in_place, "inputs", None)
        if inputs is None:
            return super().given
        named = (f"{k}: {described(x)}" if k else described(x) for k, x in inputs.items())
        return f"the inputs that sees gives, {'; '.join(named)}"

    def _advice_on(self, error: BaseException) -> str:
        """Return advice where an argument is missing, or whole observations are given."""
        if not self.mapping.state and "required positional argument" in str(error):
            return "; one with a recurrent state needs state=, the shape of this state"
        whole = self.mapping.sees is None and isinstance(self.observation_space, Dict | Tuple)
        return f"; {SEES}" if whole else ""

    advice = "write Goal() at its place in sees"
    """Advice on giving the policy its goal, for messages."""

    def source(self) -> dict[str, Any]:
        """Return its source as JSON, with its mapping."""
        mapping = self.mapping.to_json()
        return super().source() | ({"mapping": mapping} if mapping else {})

    def remapped(self, data: dict[str, Any] | None, where: str) -> Self:
        """Return a copy with the recorded mapping ``data``.

        Raises:
            RunError: it cannot be read, or needs a function that this policy does not have.
        """
        policy = copy.copy(self)
        try:
            mine = self.mapping
            policy.mapping = PolicyMapping.from_json(data or {}, mine.functions(), mine.tables())
        except DeclarationError as error:
            raise RunError(
                f"{where}: its policy had another mapping, which cannot be restored: {error}"
            ) from error
        if "in_place" in vars(self):
            _ = policy.in_place
        return policy


def look_at_outputs(policy: MappedPolicy) -> None:
    """Compare the outputs of a model for examples with those for the same beside others.

    A notice says that they are random, or not logits but probabilities.

    Raises:
        PolicyError: they depend on a hidden state, or on the other observations.
    """
    who, space = policy._who, policy.observation_space
    size = max(made_up(space, 1).nbytes, 1)
    obs = made_up(space, int(np.clip(MOST_BYTES // size, 4, EXAMPLES)))
    every = np.arange(len(obs))
    twin = policy.twin()
    before = twin.tensors()
    with examples(None), np.errstate(all="ignore"):
        state = FunctionState(None)
        first = twin.outputs(obs)
        if not first or any(x.shape[:1] != every.shape for x in first.values()):
            return  # it is an error where it acts
        now = twin.tensors()
        written = [k for k, x in now.items() if k not in before or not np.array_equal(x, before[k])]
        named = [*getattr(policy, "buffers", ()), *written]
        hidden = f"{who} {hidden_state(named if written else [])}"
        if largest_difference(first, twin.outputs(obs), every):
            state.prepare()
            # With the same random numbers, only a state makes the module of the twin differ again.
            runs_on = policy.kind == "torch" and largest_difference(first, twin.outputs(obs), every)
            if written or runs_on:
                raise PolicyError(hidden)
            if all(x.dtype.kind == "f" for x in first.values()):
                notice(
                    f"{who} answers otherwise when it is asked about the same observations again, "
                    "as it draws random numbers (dropout that is always on, for example): its "
                    "actions are random, also with deterministic=True. Let it return what is most "
                    "likely, or logits, without random numbers"
                )
            return
        sizes = {len(obs), *(n for x in (obs, *first.values()) for n in x.shape[1:])}
        rows = other_rows(first, len(obs), sizes, len(obs), 0)
        other = twin.outputs(obs[rows])
        differs = largest_difference(first, other, rows, ROUNDING, ROUNDING)
        if written:
            fresh = largest_difference(
                first, policy.twin().outputs(obs[rows]), rows, ROUNDING, ROUNDING
            )
            if (fresh is None) != (differs is None):
                raise PolicyError(hidden)
        if differs:
            raise PolicyError(
                f"{who} answers {shown(differs[0])} for an observation, but {shown(differs[1])} "
                "for the same one beside other observations, so an environment's action depends on "
                "the other environments: let the model use no statistics over the batch (mean(0), "
                "batch normalization in training mode)"
            )
    _note_probabilities(policy, first)


def hidden_state(written: Sequence[str]) -> str:
    """Return a clause about the tensors that a module writes, and by which it answers."""
    named = f"; or, if these are its buffers, name them: state={tuple(written)}" if written else ""
    return (
        f"keeps a hidden state, {', '.join(map(repr, written[:3])) or 'an attribute'}, which would "
        "run on from one episode into the next, and which all environments would share: let "
        "forward(obs, state) return the output and the next state, and give the shape of the "
        "state, from_torch(module, state=(None, 64))" + named
    )


def _note_probabilities(policy: MappedPolicy, outputs: dict[str, Array]) -> None:
    """Let a policy give a notice where its outputs for examples are probabilities, not logits."""
    acting = policy.in_place
    assert isinstance(acting, Mapped)
    meaning = acting.outputs
    output = outputs.get("")
    if not meaning.logits or output is None or output.dtype.kind != "f":
        return
    width = sum(meaning.choices)
    if not width or output.shape[-1] != width or (output < 0).any():
        return
    ends = np.cumsum(meaning.choices)[:-1]
    sums = [part.sum(-1) for part in np.split(output, ends, axis=-1)]
    if np.allclose(sums, 1.0, atol=1e-3):
        acting.on_sample = (
            f"{policy._who} returns numbers that are at least 0 and sum to 1, so probabilities, "
            "but is sampled as if they were logits: leave out the network's last Softmax, or use "
            "LogSoftmax"
        )


def check_range(goals: Goals, places: Sequence[Any], who: str) -> None:
    """Give a notice where a skill has goals beyond the range of a policy's ``Goal``.

    Args:
        places: of the goal among the policy's inputs.
        who: begins the message.
    """
    if not isinstance(goals.goal_space, Box):
        return
    lowest, highest = goals.goal_space.low.reshape(-1), goals.goal_space.high.reshape(-1)
    for place in places:
        low = -np.inf if place.low is None else np.array(place.low)
        high = np.inf if place.high is None else np.array(place.high)
        fits = {np.size(low), np.size(high)} <= {1, len(lowest)}  # else refused later
        if fits and ((lowest < low - 1e-6).any() or (highest > high + 1e-6).any()):
            notice(
                f"{who}: goal_space is {short(goals.goal_space, 200)}, but Goal.low is "
                f"{short(place.low)} and Goal.high {short(place.high)}, the range for which the "
                "policy was made. It gets other goals clipped, and step.goal has them as they are: "
                "give goal_space that range"
            )
