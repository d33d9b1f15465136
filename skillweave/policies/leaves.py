"""Policies that contain no other: ready selectors, networks that learn, and those of exports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from .acting_errors import PolicyError
from .core import Array, LastCall, Memory, RowPolicy, Step, Turn, World
from .mapped import NUMBERS
from .sessions import open_session
from .spaces import Space, at
from .untrusted import shown


class Selector(RowPolicy):
    """A selector that is not trained: it also watches how calls end."""

    watches = True
    ends_matter = True
    """``watch`` has something to notice."""
    count: int
    """The number of its choices: skills, perhaps each with some lengths."""

    def chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        """Return the probabilities of the choices that ``may`` be made, (k, choices) float32.

        Where it chooses no lengths, all lengths of a skill are equally likely.
        """
        lengths = may.shape[1] // self.count
        chances = self._chances(memory, rows, obs, may[:, ::lengths])
        found: Array = chances.repeat(lengths, axis=1) / np.float32(lengths)
        return found

    def _chances(self, memory: Memory, rows: Array, obs: Array, may: Array) -> Array:
        """Return the probabilities of its own choices, (k, count) float32."""
        raise NotImplementedError

    def ahead(self, memory: Memory, rows: Array, may: Array) -> Array:
        """Return the choices (k, choices) that the ready selector leaves, before it sees more."""
        allowed = self.allowed(memory, rows)
        if allowed is None:
            return may
        left: Array = may & allowed.repeat(may.shape[1] // allowed.shape[1], axis=1)
        return left

    def allowed(self, memory: Memory, rows: Array) -> Array | None:
        """Return the skills that it may choose next, (k, S) bool; None: it needs observations."""
        return None

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Notice a step of environments ``rows`` (k,), and how the last calls ended."""

    def check_skills(self, names: Sequence[str], choice: Space | None, where: str) -> None:
        """Raise a PolicyError where it chooses from other skills than a hierarchy has.

        Args:
            names: of the hierarchy's skills.
            choice: the space of its choices; None: it guides another selector, which chooses.
            where: begins the message.
        """

    def redraws(self, greedy: bool) -> bool:
        """Return False: what it chooses follows from what it sees."""
        return False


class Learning(RowPolicy):
    """A network that learns; what it chooses is written where the step is recorded.

    Args:
        net: acts in some of N environments; by their numbers it knows which member acts.
        path: of the learner, before the names of its columns; "" where there is one.
        decides: it is a selector: what it decided on is written, too.
    """

    def __init__(self, net: Any, path: str, *, decides: bool = False) -> None:
        self.net = net
        names = ("action", "dist_params", "decided", "obs", "allowed", "state_before")
        path = f"{path}/" if path else ""
        self._columns = [path + name for name in (names if decides else names[:2])]

    @property
    def action_space(self) -> Any:
        """The space of its actions in the environment's units."""
        return self.net.stacks[0][0].action_space

    def start(self, n: int) -> Memory:
        """Return zeros (n, M), where the network is recurrent."""
        size = self.net.memory_size
        return {"rnn": np.zeros((n, size), np.float32)} if size else {}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …) in the environment's units, as the latest request says."""
        before = memory["rnn"][rows] if "rnn" in memory else None
        mask = turn.mask
        acted = self.net.some(rows, obs, self.net.widened(mask), before)
        if acted.recurrent_state is not None:
            memory["rnn"][rows] = acted.recurrent_state
        if turn.world.trace is not None:
            decided = np.ones(len(rows), bool)
            values = acted.action, acted.dist_params, decided, obs, mask, before
            turn.world.trace.write(rows, **dict(zip(self._columns, values, strict=False)))
        action: Array = self.net.to_env(acted.action)
        return action

    def redraws(self, greedy: bool) -> bool:
        """Return True: it explores, whatever the turn says."""
        return True


def _words(given: tuple[Any, tuple[Any, ...]] | None) -> str:
    return "nothing" if given is None else f"{given[0]} {given[1]}"


Noise: TypeAlias = tuple[Literal["gumbel", "standard_normal", "random", "logistic"], int]
"""A distribution by NumPy's name, and how many numbers of it."""


@dataclass(eq=False)
class OnnxNetwork(RowPolicy):
    """A network that Skillweave trained, as an ONNX file of one observation.

    Its inputs are the leaves of the observation, ``obs`` or ``obs.camera``, and ``mask``,
    ``memory``, ``noise.0``, …; its outputs the action, in the environment's units, and
    ``memory.after``.
    """

    file: bytes
    sees: Space
    acts: Space
    """The space of its actions; where it has parts, the file gives them as rows, ``Space.flat``."""
    choices: int = 0
    """The width of its mask; 0: it takes none."""
    memory: int = 0
    """The width of its recurrent state; 0: it has none."""
    noise: tuple[Noise, ...] = ()

    def __post_init__(self) -> None:
        names = [".".join(path) for path in self.sees.leaves]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise PolicyError(
                    f"a network sees two parts of observations as {shown(name)}: rename one"
                )

    @cached_property
    def session(self) -> Any:
        """The file, opened."""
        return open_session(self.file, "a network")

    @cached_property
    def _inputs(self) -> dict[str, tuple[str, ...]]:
        return {".".join(("obs", *path)): path for path in self.sees.leaves}

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if k != "session"}

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that its file takes what it sees, and gives actions."""
        for mine, theirs, what in ((self.sees, sees, "sees"), (self.acts, acts, "acts")):
            if not mine.is_like(theirs):
                raise PolicyError(f"{where}.{what} is {mine}, but it is used for {theirs}")
        # Of a choice with goals the mask is for the skills alone.
        masked = (self.acts.parts or {}).get("skill", self.acts)
        if self.choices not in (width := sum(self.acts.counts), sum(masked.counts)):
            raise PolicyError(f"{where}.choices is {self.choices}; for {acts} it must be {width}")
        single = np.dtype("float32")
        leaves = zip(self._inputs, self.sees.leaves.values(), strict=True)
        given = {name: (leaf.record, leaf.shape) for name, leaf in leaves}
        given |= {"mask": (np.dtype(bool), (self.choices,))} if self.choices else {}
        given |= {"memory": (single, (self.memory,))} if self.memory else {}
        given |= {f"noise.{i}": (single, (n,)) for i, (_, n) in enumerate(self.noise)}
        tried = replace(self)
        try:
            tried.session = open_session(self.file, "a network", trial=True)
            taken = {
                x.name: (np.dtype(NUMBERS.get(x.type, bool)), tuple(x.shape[1:]))
                for x in tried.session.get_inputs()
            }
            for name in given | taken:
                if given.get(name) != taken.get(name):
                    raise PolicyError(
                        f"its file takes {_words(taken.get(name))} as {name!r}, but is given "
                        f"{_words(given.get(name))}"
                    )
            rows = np.zeros(1, np.int64)
            turn = Turn(World(np.random.default_rng(0)))
            action = tried._run(self.start(1), rows, self.sees.start(1), turn)
            size = self.acts.shape if self.acts.parts is None else (self.acts.size,)
            if action.shape != (1, *size):
                raise PolicyError(f"its file gives shape {action.shape}, not {(1, *size)}")
            _ = self.session
        except PolicyError as error:
            raise PolicyError(f"{where}: {error}") from error

    def start(self, n: int) -> Memory:
        """Return zeros (n, M), where the network is recurrent."""
        return {"rnn": np.zeros((n, self.memory), np.float32)} if self.memory else {}

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return actions (k, …), or choices with goals."""
        action = self._run(memory, rows, obs, turn)
        return action if self.acts.parts is None else self.acts.of_numbers(action)

    def redraws(self, greedy: bool) -> bool:
        """Return whether it samples."""
        return bool(self.noise)

    def _run(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Run the ONNX file on observations ``obs`` of rows (k,); return its actions."""
        n = len(rows)
        feeds = {k: np.ascontiguousarray(at(obs, path)) for k, path in self._inputs.items()}
        if self.choices:
            feeds["mask"] = np.ones((n, self.choices), bool) if turn.mask is None else turn.mask
        if self.memory:
            feeds["memory"] = memory["rnn"][rows]
        rng = turn.world.rng or np.random.default_rng() if self.noise else None
        for i, (kind, width) in enumerate(self.noise):
            feeds[f"noise.{i}"] = getattr(rng, kind)(size=(n, width)).astype(np.float32)
        each = [feeds]
        if n > 1:
            each = [{k: v[i : i + 1] for k, v in feeds.items()} for i in range(n)]
        try:
            found = [self.session.run(None, one) for one in each]
        except Exception as error:  # onnxruntime's own errors have no common class
            raise PolicyError(f"a network fails: {str(error)[:200]}") from error
        if self.memory:
            memory["rnn"][rows] = np.concatenate([after for _, after, *_ in found])
        action: Array = found[0][0] if n == 1 else np.concatenate([one[0] for one in found])
        return action
