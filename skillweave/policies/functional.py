"""Policies as ``skillweave.types.Policy`` says, which return their memory, from and to others."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from .acting_errors import PolicyError
from .core import Array, Memory, RowPolicy, Step, Turn, World, flat, nested
from .parts import GOAL, OBSERVATION


class Functional:
    """A policy as ``skillweave.types.Policy`` says, over one whose memory is changed in place.

    Args:
        in_place: the same policy.
        sees: its ``observation_space``.
        acts: its ``action_space``.
        joins: it observes its goal beside the observation.
    """

    labels: tuple[str, ...] = ()
    joins = False

    def __init__(self, in_place: RowPolicy, sees: Any, acts: Any, *, joins: bool = False) -> None:
        self.in_place = in_place
        self.observation_space = sees
        self.action_space = acts
        self.joins = joins

    @cached_property
    def _like(self) -> Memory:
        return self.in_place.start(1)

    def _copied(self, memory: Memory) -> tuple[Memory, Memory]:
        """Return a copy of a memory, and its arrays as ``in_place`` has them."""
        memory = {k: v.copy() for k, v in memory.items()}
        return memory, nested(self._like, memory)

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments whose episodes start."""
        return flat(self.in_place.start(n))

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
        """Return actions (n, ...) for ``obs`` (n, ...), among those that ``mask`` (n, A) allows.

        ``memory`` is of n environments; ``rng`` is the source of random numbers for sampling;
        ``goal`` (n, G) replaces a goal of the policy's own.

        ``deterministic`` sets how the selector acts, ``SkillSet.greedy`` how the skills act. A
        selector that is to sample (not ``SkillSet.greedy_selector``) samples in any case.
        """
        memory, own = self._copied(memory)
        if self.joins:
            obs, goal = obs[OBSERVATION], obs[GOAL]
        turn = Turn(World(rng), mask, goal, deterministic)
        rows = np.arange(len(obs))
        return self.in_place.act(own, rows, obs, turn), memory

    def observe(self, memory: Memory, step: Step) -> Memory:
        """Return the ``memory`` after a ``step``; calls that are over end in it."""
        memory, own = self._copied(memory)
        self.in_place.observe(own, np.arange(len(step.reward)), step)
        return memory

    def acting(self, memory: Memory) -> Array | None:
        """Return the running skills in a ``memory``, (n,) int64; None: it has no skills."""
        inside = getattr(self, "policy", self)  # of a skill that acts alone
        if isinstance(inside, Functional):
            return memory["skill"] if self.labels else None
        found: Array | None = inside.acting(memory)
        return found

    @property
    def is_plain(self) -> bool:
        """True if no subclass changes ``start``, ``act`` or ``observe``: ``in_place`` may act."""
        kind = type(self)
        return (
            kind.start is Functional.start
            and kind.act is Functional.act
            and kind.observe is Functional.observe
        )


class Returns(RowPolicy):
    """A policy of ``skillweave.types.Policy``: it is given its own rows, and returns its memory.

    Args:
        who: begins messages: "skill 'x': its policy's act()".
        blame: raises an error of the policy's ``act`` with the words of ``who``.
        watches: its ``observe`` has something to notice.
    """

    def __init__(
        self,
        policy: Any,
        who: str,
        blame: Callable[[BaseException, str], NoReturn],
        *,
        watches: bool = False,
    ) -> None:
        self.policy = policy
        self.watches = watches
        self.who = who.removesuffix("'s act()")
        """Whose policy it is, for messages."""
        self._acting = who
        self._blame = blame
        self._names: frozenset[str] = frozenset()

    def start(self, n: int) -> Memory:
        """Return a copy of the policy's fresh memory."""
        memory = {name: np.array(value) for name, value in self.policy.start(n).items()}
        self._names = frozenset(memory)
        return memory

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return the policy's actions."""
        how: Any = {"deterministic": turn.greedy, "rng": turn.world.rng}
        try:
            action, after = self.policy.act(self._of(memory, rows), obs, turn.mask, **how)
        except (Exception, SystemExit) as error:
            self._blame(error, self._acting)
        self._keep(memory, rows, after)
        found: Array = action
        return found

    def observe(self, memory: Memory, rows: Array, step: Step) -> None:
        """Let the policy notice a step."""
        self._keep(memory, rows, self.policy.observe(self._of(memory, rows), step))

    def _of(self, memory: Memory, rows: Array) -> Memory:
        """Return a copy of what the policy remembers in ``rows`` (k,), without what others do."""
        return {name: memory[name][rows] for name in self._names}

    def _keep(self, memory: Memory, rows: Array, after: Memory) -> None:
        """Write what the policy remembers in ``rows`` (k,).

        Raises:
            PolicyError: it has other names, shapes or types than in the beginning.
        """
        if after.keys() != self._names:
            raise PolicyError(
                f"{self.who}: the memory has {sorted(after)}, but start() gave "
                f"{sorted(self._names)}: return arrays of the same names"
            )
        for name, value in after.items():
            old = memory[name]
            new = np.asarray(value)
            fits = new.dtype == old.dtype or np.can_cast(new.dtype, old.dtype, "same_kind")
            if new.shape != (len(rows), *old.shape[1:]) or not fits:
                raise PolicyError(
                    f"{self.who}: the memory {name!r} is {new.dtype} {new.shape}, but by start() "
                    f"it would be {old.dtype} {(len(rows), *old.shape[1:])}: let start() return "
                    "arrays of the type and shape that they keep"
                )
            old[rows] = new
