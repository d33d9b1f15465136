"""Combinators around a policy: its part of observations and actions, goals, reflexes, and more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import prod
from typing import Any

import numpy as np

from .acting_errors import PolicyError, SkillError
from .core import Around, Array, Memory, RowPolicy, Step, Turn, World, call_plainly, code, observed
from .mapped import Input, Outputs, check_places
from .spaces import Space, allows_each, at

OBSERVATION, GOAL = "observation", "goal"
"""The parts of what a skill with a goal observes."""
OWN_GOAL, LAST_ACTION, ACTED = "_goal", "_last_action", "_acted"
"""Names under which ``Given`` and ``Remembers`` remember, beside those of their policy."""


@dataclass(eq=False)
class Joined(Around):
    """The policy observes the goal of its call beside the observation, as one record."""

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions for observations with their goals."""
        assert turn.goal is not None
        beside = Turn(turn.world, turn.mask, None, turn.greedy)
        return self.policy.act(memory, rows, joined(obs, turn.goal), beside)

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that it fits observations with goals."""
        if goal is None:
            raise PolicyError(f"{where} observes a goal, but its skill has none")
        self.policy.check(with_goal(sees, goal), acts, goal, where)


def with_goal(sees: Space, goal: Space) -> Space:
    """Return the space of observations beside goals."""
    return Space("Dict", parts={OBSERVATION: sees, GOAL: goal})


def joined(obs: Array, goal: Array, axes: int = 1) -> Array:
    """Return records of observations and goals, as a policy for goals sees them.

    Args:
        obs: (…, *obs_shape).
        goal: (…, *goal_shape).
        axes: the number of the first axes, ``…``.
    """
    # Zeros, because the bytes between parts are written to files.
    joint = np.zeros(
        goal.shape[:axes], joint_dtype(obs.dtype, obs.shape[axes:], goal.dtype, goal.shape[axes:])
    )
    joint[OBSERVATION] = obs
    joint[GOAL] = goal
    return joint


@lru_cache(64)
def joint_dtype(
    obs: np.dtype[Any], shape: tuple[int, ...], goal: np.dtype[Any], goal_shape: tuple[int, ...]
) -> np.dtype[Any]:
    """Return the dtype of observations with goals, as ``obs_dtype`` of ``with_goal`` has it."""
    return np.dtype([(OBSERVATION, obs, shape), (GOAL, goal, goal_shape)], align=True)


@dataclass(eq=False)
class Correction:
    """Numbers that a policy adds to the actions of a ready one."""

    step: Array
    """(…) the largest correction of each number."""
    space: Space
    """The space of the corrected actions."""

    def apply(self, base: Array, learnt: Array) -> Array:
        """Return actions (n, …) of those of the ready policy and of what was learnt, (n, …)."""
        both = np.clip(base + self.step * learnt, *self.space.bounds)
        return np.asarray(both, self.space.dtype)


@dataclass(eq=False)
class Corrects(Around):
    """A policy whose actions are added to those of another one, which is ready."""

    base: RowPolicy
    correction: Correction

    def __post_init__(self) -> None:
        super().__post_init__()
        self.watches = self.policy.watches or self.base.watches
        self.holds = self.policy.holds or self.base.holds
        self.forgets = self.policy.forgets or self.base.forgets

    def start(self, n: int) -> Memory:
        """Return the memories of both."""
        return {"own": self.policy.start(n), "base": self.base.start(n)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return corrected actions; the base policy acts greedily, and without a mask."""
        own = self.policy.act(memory["own"], rows, obs, turn)
        world = turn.world
        beside = World(world.rng, world.age, world.last_action, world.acted)
        alone = Turn(beside, None, turn.goal)
        return self.correction.apply(self.base.act(memory["base"], rows, obs, alone), own)

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that both fit."""
        step = self.correction.step
        space = self.correction.space
        if space.kind != "Box" or step.shape != acts.shape or not space.is_like(acts):
            raise PolicyError(
                f"{where}: step has shape {step.shape} for {space}, but actions are of {acts}"
            )
        own = Space("Box", "float32", acts.shape, np.asarray(-1.0), np.asarray(1.0))
        self.policy.check(sees, own, goal, f"{where}.policy")
        self.base.check(sees, acts, goal, f"{where}.base")

    def again(self, memory: Memory, rows: Array) -> None:
        """Let both begin anew what is not to outlast a call."""
        self.policy.again(memory["own"], rows)
        self.base.again(memory["base"], rows)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let both notice a step."""
        self.policy.observe(memory["own"], rows, step)
        self.base.observe(memory["base"], rows, step)


@dataclass(eq=False)
class Slice:
    """The part of observations and actions that is an acting skill's, as data of its policy.

    Raises:
        PolicyError: its fields contradict each other.
    """

    space: Space
    """The space of the environment's actions."""
    own: Space
    """The space of the skill's own actions."""
    inputs: dict[str, Input] | None = None
    """The inputs of the skill's policy, by name; "": alone. None: the whole observation."""
    sees: Space | None = None
    """The space of the skill's own observations, where it has ``inputs``."""
    axes: int = 0
    """The number of axes of an observation of the environment."""
    places: tuple[int, ...] | None = None
    """Indices of the skill's numbers in the flat action; of one choice, the number, from 0, of each
    option that is its own."""
    paths: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = ()
    """Leaves of an action with parts that the skill writes: the names that lead to each in the
    action, and in its own one. Without these and ``places`` it writes all."""
    fixed: Array | None = None
    """(1, …) the action where it writes nothing; None: nothing is left."""
    held: tuple[tuple[tuple[str, ...], Array], ...] = ()
    """The names that lead to a leaf of the action, and (…) bool: these numbers keep the value of
    the last action where it writes nothing."""
    view: Callable[[Array], Array] | None = None
    """Returns the environment's observations of larger ones; None: they are not larger."""
    outputs: Outputs | None = None
    """The skill's own actions are the outputs of a file's network, and this is their meaning as
    actions. None: they are actions."""
    who: str = "the skill"
    """Begins messages."""

    def __post_init__(self) -> None:
        space = self.space
        own = self.own
        places = self.places
        if (self.inputs is None) != (self.sees is None):
            raise PolicyError("Part.inputs and Part.sees must be given together")
        self._computes = any(
            take.function is not None for one in (self.inputs or {}).values() for take in one.takes
        )
        if self.inputs is not None and self.sees is not None:
            shapes = {k: leaf.shape for k, leaf in self.sees.leaves.items()}
            if [prod(x.shape) for x in self.inputs.values()] != [*map(prod, shapes.values())]:
                raise PolicyError(f"Part.sees is {self.sees}, which does not fit Part.inputs")
        self._all = places is None and not self.paths
        outputs = self.outputs
        if outputs is not None and (
            not self._all or not outputs.space.is_like(space) or (outputs.count,) != own.shape
        ):
            raise PolicyError(f"Part.outputs are of {outputs.space}, not of {own} as {space}")
        self._one = space.kind == "Discrete"
        if places is not None:
            size = sum(space.counts) if self._one else prod(space.shape)
            check_places(places, size, "Part.places", once=True)
            mine = sum(own.counts) if self._one else prod(own.shape)
            if own.parts is not None or mine != len(places):
                raise PolicyError(f"Part.own is {own}, but Part.places are {len(places)}")
        whole, inner = (x.leaves for x in (space, own))
        for path, inside in self.paths:
            if path not in whole or inside not in inner or not whole[path].is_like(inner[inside]):
                raise PolicyError(f"Part.paths has {path} and {inside}, which are not alike")
        if (self.fixed is None) != (self._all or self._one):
            raise PolicyError(f"Part.fixed is {self.fixed} for a part of {space}")
        if self.fixed is not None:
            if self.fixed.shape != (1, *space.shape) or self.fixed.dtype != space.record:
                raise PolicyError(
                    f"Part.fixed is {self.fixed.dtype} {self.fixed.shape}, which does not fit "
                    f"{space}"
                )
            for path, held in self.held:
                if path not in whole or held.shape != whole[path].shape:
                    raise PolicyError(f"Part.held has {path}, which does not fit {space}")
        self._places = None if places is None else np.array(places)
        self._choices, self._columns = self._own_choices()

    def _own_choices(self) -> tuple[Array, Array | None]:
        """Return the places of its choices among all, and its numbers of a mask; None: none."""
        counts = self.space.counts
        places = self._places
        if places is None:
            numbers = iter(range(len(counts)))
            of = {k: [next(numbers) for _ in x.counts] for k, x in self.space.leaves.items()}
            places = np.array([i for path, _ in self.paths for i in of[path]], np.int64)
        if self._one or not counts or not len(places):
            return places[:0], places if self._one else None
        starts = np.cumsum([0, *counts])
        return places, np.concatenate([np.arange(starts[i], starts[i + 1]) for i in places])

    @property
    def holds(self) -> bool:
        """The last action counts."""
        return bool(self.held)

    def see(self, obs: Array) -> Array:
        """Return the skill's own observations, of those of the environment (…, *obs_shape)."""
        obs = obs if self.view is None else self.view(obs)
        space = self.sees
        if self.inputs is None or space is None:
            return obs
        lead = obs.shape[: obs.ndim - self.axes]
        flat = obs if len(lead) == 1 else obs.reshape(-1, *obs.shape[len(lead) :])
        seen = {name: one(flat) for name, one in self.inputs.items()}
        for value in seen.values() if self._computes else ():
            if not (finite := np.isfinite(value)).all():
                row = int(np.argwhere(~finite)[0, 0])
                raise SkillError(
                    f"{self.who}: sees gives {observed(value[row])}, which is not finite, for the "
                    f"observation {observed(flat[row])}: let its functions return finite numbers"
                )
        if "" in seen:
            alone: Array = np.ascontiguousarray(seen[""], space.dtype)
            return alone.reshape(*lead, *space.shape)
        # Zeros, because the bytes between parts are written to files.
        joint = np.zeros(len(flat), space.record)
        for name, value in seen.items():
            joint[name] = value.reshape(joint[name].shape)
        return joint.reshape(lead)

    def mask(self, mask: Array | None) -> Array | None:
        """Return which of its own choices a mask (…, A) allows; all where it allows none."""
        if mask is None or self._all:
            return mask
        if self._columns is None:  # real numbers alone, which a mask is not for
            return None
        own = mask[..., self._columns]
        free = allows_each(own, self.own.counts)
        return own if free.all() else own | ~free[..., None]

    def check_mask(self, mask: Array | None, action: Array) -> None:
        """Raise a SkillError where a mask (n, A) leaves it no choice, or forbids the rest.

        Args:
            action: (n, …), the whole actions.
        """
        if mask is None or self._all:
            return
        if (
            self._columns is not None
            and not allows_each(mask[:, self._columns], self.own.counts).all()
        ):
            raise SkillError(
                f"{self.who}: the environment's action mask allows none of the choices that it "
                "owns (acts): let it start only where one is allowed, or let it own more"
            )
        if self._one:
            return
        choice = self.space.choices_in(action)
        first = np.cumsum([0, *self.space.counts[:-1]]) if choice.size else np.zeros(0, np.int64)
        allowed = np.take_along_axis(mask, first + choice, axis=1)
        allowed[:, self._choices] = True
        if not allowed.all():
            row, place = np.argwhere(~allowed)[0].tolist()
            where = "choice" if self.space.parts is not None else "place"
            raise SkillError(
                f"{self.who}: the environment's action mask forbids the value "
                f"{int(choice[row, place])} at {where} {place} of the action, which rest leaves it "
                f"at: give the hierarchy another rest, or let the skill own this {where} (acts)"
            )

    def filled(self, n: int, last: Array | None) -> Array:
        """Return n whole actions that a skill's policy writes its part into: the rest is held.

        Args:
            last: (n, …), the last actions; None: nothing is held.
        """
        assert self.fixed is not None
        action = self.fixed.repeat(n, axis=0)
        if last is not None:
            for path, held in self.held:
                into = at(action, path)
                into[...] = np.where(held, at(last, path), into)
        return action

    def write(self, own: Array, last: Array | None) -> Array:
        """Write the skill's own actions (n, …) into whole actions (n, …), and return these.

        Args:
            last: (n, …), the last actions; needed only where it ``holds``.
        """
        space = self.space
        if self.outputs is not None:
            return self.outputs(own, len(own), None, Turn(World()))[0]
        if self._all:
            return own
        if self._one:
            assert self._places is not None
            return np.asarray(self._places[own] + space.bounds[0], space.dtype)
        action = self.filled(len(own), last)
        if self._places is not None:
            action.reshape(len(own), -1)[:, self._places] = own.reshape(len(own), -1)
        for path, inside in self.paths:
            at(action, path)[...] = at(own, inside)
        return action

    def read(self, action: Array) -> Array:
        """Return its part of whole actions (n, …); outputs that lead to them."""
        if self.outputs is not None:
            return self.outputs.read(action)
        if self._all:
            return action
        if self._one:
            chosen = (action - self.space.bounds[0])[:, None] == self._places
            # 0 where a reflex chose another.
            return np.asarray(chosen.argmax(axis=1), self.own.dtype)
        if self._places is not None:
            mine = action.reshape(len(action), -1)[:, self._places]
            return mine.reshape(len(action), *self.own.shape)
        if self.own.parts is None:
            return at(action, self.paths[0][0])
        own = np.zeros(len(action), self.own.record)
        for path, inside in self.paths:
            at(own, inside)[...] = at(action, path)
        return own

    def own_step(self, step: Step) -> Step:
        """Return a step as its policy sees it: its part of observations and of the action."""
        obs, next_obs = self.see(step.obs), self.see(step.next_obs)
        return replace(step, obs=obs, next_obs=next_obs, action=self.read(step.action))


@dataclass(eq=False)
class PartOf(Around):
    """A policy that sees and writes a part."""

    part: Slice

    def __post_init__(self) -> None:
        super().__post_init__()
        self.holds = self.holds or self.part.holds

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return whole actions (k, …)."""
        part = self.part
        last = turn.world.last_action
        world = turn.world
        if last is not None and self.policy.holds:
            world = replace(world, last_action=part.read(last))
        own = Turn(world, part.mask(turn.mask), turn.goal, turn.greedy)
        actions = self.policy.act(memory, rows, part.see(obs), own)
        actions = part.write(actions, None if last is None else last[rows])
        part.check_mask(turn.mask, actions)
        return actions

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice its part of a step."""
        if self.watches:
            self.policy.observe(memory, rows, self.part.own_step(step))

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that the part fits, and the policy fits the part."""
        part = self.part
        for name, one in (part.inputs or {}).items():
            one.check(sees, f"{where}.part.inputs[{name!r}]")
        if not part.space.is_like(acts):
            raise PolicyError(f"{where}.part.space is {part.space}, not {acts}")
        if part.axes != len(sees.shape):
            raise PolicyError(f"{where}.part.axes is {part.axes}, but observations are of {sees}")
        self.policy.check(part.sees or sees, part.own, goal, f"{where}.policy")


@dataclass(eq=False)
class Viewed(Around):
    """A policy that sees what ``view`` makes of observations (…, *obs_shape)."""

    view: Callable[[Array], Array]

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions for what it sees."""
        return self.policy.act(memory, rows, self.view(obs), turn)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice what it sees of a step."""
        if self.watches:
            self.policy.observe(memory, rows, self.seen(step))

    def seen(self, step: Step) -> Step:
        """Return a step with the observations that the policy sees."""
        return replace(step, obs=self.view(step.obs), next_obs=self.view(step.next_obs))


@dataclass(eq=False)
class Override:
    """An action that an acting policy takes where a condition holds."""

    name: str
    condition: Callable[..., Any] = code("observations (n, ...) to (n,) bool", "condition")
    action: Callable[..., Any] | Array = code("observations (n, ...) to actions (n, ...)", "action")
    """A function, or one action (1, …)."""

    def apply(self, obs: Array, action: Array, space: Space) -> tuple[Array, Array]:
        """Return actions (k, …) with it; (k,) bool: where it acted."""
        holds = call_plainly(self.condition, obs, np.arange(len(obs)), self.name, "condition")
        if holds.any():
            given = self.action(obs[holds]) if callable(self.action) else self.action
            action = action.copy()
            if callable(self.action):
                given = space.actions(given, holds.sum(), f"reflex {self.name!r}: action()")
            action[holds] = given
        return action, holds


@dataclass(eq=False)
class Reflexes(Around):
    """Rules that override the policy's action; the last one whose condition holds acts."""

    reflexes: tuple[Override, ...]
    space: Space
    """The space of the actions."""

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions, or those of a reflex."""
        action, holds = self.over(obs, self.policy.act(memory, rows, obs, turn))
        if turn.world.overridden is not None:
            turn.world.overridden[rows] |= holds
        return action

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that fixed actions are actions, and the policy fits."""
        for i, one in enumerate(self.reflexes):
            fixed = one.action
            if callable(fixed):
                continue
            fits = fixed.dtype == acts.record and fixed.shape == (1, *acts.shape)
            if not fits or not acts.holds(fixed).all():
                raise PolicyError(f"{where}.reflexes[{i}].action is {fixed}, no action of {acts}")
        if not self.space.is_like(acts):
            raise PolicyError(f"{where}.space is {self.space}, not {acts}")
        self.policy.check(sees, acts, goal, where)

    def over(self, obs: Array, action: Array) -> tuple[Array, Array]:
        """Return actions (k, …) with those of reflexes in place, and (k,) bool: where one acted."""
        overridden = np.zeros(len(obs), bool)
        for reflex in self.reflexes:
            action, holds = reflex.apply(obs, action, self.space)
            overridden |= holds
        return action, overridden


@dataclass(eq=False)
class Given(Around):
    """A skill with goals that acts alone: who starts an episode sets its goal in the memory."""

    goals: Any
    """``start`` goals."""

    def start(self, n: int) -> Memory:
        """Return the policy's memory with goals."""
        return self.policy.start(n) | {OWN_GOAL: self.goals.start(n)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions for these goals."""
        own = Turn(turn.world, turn.mask, memory[OWN_GOAL][rows], turn.greedy)
        return self.policy.act(memory, rows, obs, own)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice a step with its goals."""
        if self.watches:
            self.policy.observe(memory, rows, replace(step, goal=memory[OWN_GOAL][rows]))


@dataclass(eq=False)
class Remembers(Around):
    """The outermost policy where the last action counts for a skill: it is remembered for all."""

    space: Space
    """The space of the actions; its ``start`` stands for the last ones where an episode starts."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.watches = True
        self.holds = False

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that it remembers the actions, and the policy fits."""
        if not self.space.is_like(acts):
            raise PolicyError(f"{where}.space is {self.space}, not {acts}")
        self.policy.check(sees, acts, goal, f"{where}.policy")

    def start(self, n: int) -> Memory:
        """Return the policy's memory with a last action."""
        return self.policy.start(n) | {LAST_ACTION: self.space.start(n), ACTED: np.zeros(n, bool)}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions; who needs the last ones finds them in the world."""
        turn.world.last_action = memory[LAST_ACTION]
        turn.world.acted = memory[ACTED]
        return self.policy.act(memory, rows, obs, turn)

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Remember the actions of a step."""
        memory[LAST_ACTION][rows] = step.action
        memory[ACTED][rows] = True
        self.policy.observe(memory, rows, step)
