"""A selector that acts by a solved plan: no training, and no search but for the nearest calls.

The calls of a running episode count beside the logged ones: a call that failed would else be chosen
again and again, as it is not in the log. ``tried`` remembers the latest of them. Each has the
choice, its goal, the features of its start and its end (for every skill), its steps, what it paid,
γ^τ, the task's planning states before and after it, and what the log says of each option at its
end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .acting_errors import PolicyError
from .core import LIMIT, Array, LastCall, Memory, Step, Turn, own_step
from .plan import SOFT, Features, Levels, Machine, Near, Options, Readings, check, nearest_corner
from .selectors import Rule
from .spaces import Space

LATEST = 16
"""The calls of an episode that are remembered."""
TRUST = 20.0
"""Logged calls for which one of the episode counts at the same distance: it says what happens here,
while logged calls may have started behind a wall."""
SLACK = 0.03
"""A call of the episode counts where it is nearer than any logged one, but for so much."""


@dataclass(eq=False)
class Planned(Rule):
    """A selector that acts by a plan: its choice is that whose nearest calls are worth most.

    Raises:
        PolicyError: the parts of the plan contradict one another.
    """

    features: tuple[Features, ...]
    """The features of each skill's calls."""
    options: Options
    task: Machine
    levels: Levels
    worth: Array
    """(P, M) float32, of each piece of a logged call from each planning state."""
    gamma: float
    caution: float
    temperature: float = 0.0
    """Choices are sampled by exp(Q / (temperature · the largest |Q|)); 0: the best is chosen."""
    numbers: dict[str, Array] = field(default_factory=dict)
    """By the names of ``goals``, (C, G) float64, the goals of all calls."""
    advice = "the log has no call of {0!r}, so record some"

    def __post_init__(self) -> None:
        options = self.options
        count = len(self.skills)
        if not len(self.features) == len(options.aims) == count:
            raise PolicyError(
                f"a plan of the skills {self.skills} has features of {len(self.features)}, and "
                f"options of {len(options.aims)}"
            )
        check("worth", self.worth, "f", (None, None))
        states = len(self.task.each), self.task.slots
        if self.levels.levels.shape != states or self.levels.count > self.worth.shape[1]:
            raise PolicyError(
                f"a plan's task has (states, counters) {states}, but levels of "
                f"{self.levels.levels.shape}, and values of {self.worth.shape[1]} planning states"
            )
        for group in options.groups:
            features = self.features[options.skill_of[group.choice]]
            check("rows", group.rows, "iu", (None,), 0, len(self.worth))
            if len(group.rows):
                check("starts", group.starts, "f", (None, len(features.places)))
        all_aims = dict(zip(self.skills, options.aims, strict=True))
        for name, space in self.goals.items():
            if (aims := all_aims.get(name)) is None:
                raise PolicyError(f"a plan has goals of {name!r}, but no skill {name!r} with goals")
            size = space.size
            check("numbers", self.numbers.get(name), "f", (len(aims), size))
        self._aimed = np.array([aims is not None for aims in options.aims])
        self._aim = max((aims.shape[1] for aims in options.aims if aims is not None), default=1)
        self._calls = (count, max(len(each.places) for each in self.features))
        super().__post_init__()

    @property
    def count(self) -> int:  # type: ignore[override]
        """The number of its choices."""
        return self.options.choices

    def start(self, n: int) -> Memory:
        """Return the memory of ``n`` environments: the task's state, and no call so far."""
        state = self.task.start(n)
        calls = (n, LATEST)
        options = len(self.options.choice_of)
        shapes = {
            "start": self._calls,
            "end": self._calls,
            "q": (options,),
            "total": (options,),
            "far": (options,),
            "goal": (self._aim,),
            "goals": (options, self._aim),
        }
        numbers = {"choice": -1, "steps": 0, "reward": 0.0, "discount": 1.0, "from": -1, "to": -1}
        tried: Memory = {name: np.full(calls, number) for name, number in numbers.items()}
        tried |= {k: np.zeros((*calls, *shape), np.float32) for k, shape in shapes.items()}
        tried |= {"may": np.zeros((*calls, options), bool), "count": np.zeros(n, np.int64)}
        return {"state": state[:, 0].copy(), "counters": state[:, 1:].copy(), "tried": tried}

    def check(self, sees: Space, acts: Space, goal: Space | None, where: str) -> None:
        """Check that it compares numbers which observations have, and makes these choices."""
        size = 0 if sees.parts else int(np.prod(sees.shape))
        places = [each.places.max(initial=-1) for each in self.features if each.function is None]
        if max(places, default=-1) >= size:
            raise PolicyError(f"{where}.features has place {max(places)}, but it sees {sees}")
        same = self._choices.is_like(acts)
        # A guide may leave lengths to the selector.
        if not same and (self.goals or acts.parts or sum(acts.counts) % self.count):
            raise PolicyError(f"{where} makes choices of {self._choices}, but is used for {acts}")

    def act(self, memory: Memory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return choices (k,); where it has ``goals``, they have goals."""
        option, near = self.decide(memory, rows, obs, turn, bool(self.goals))
        call = near.goal[np.arange(len(rows)), option]
        return self.record(self.options.choice_of[option], call, obs)

    def decide(
        self, memory: Memory, rows: Array, obs: Array, turn: Turn, with_goals: bool
    ) -> tuple[Array, Near]:
        """Return options (k,), with the nearest calls; remember the calls that begin.

        Args:
            with_goals: these calls have the goals of their options; a guide does not say which.
        """
        features = [own(obs) for own in self.features]
        each = np.arange(len(rows))
        tried = memory["tried"]
        near = self.options.near(features)
        corners = self.levels.corners(self.state_of(memory, rows))
        may = turn.mask
        may = np.ones((len(rows), self.count), bool) if may is None else may
        now = {
            "end": self._padded(features),
            "to": nearest_corner(*corners),
            "q": self.valued(near, obs, corners),
            "total": near.total,
            "far": near.distance,
            "may": may[:, self.options.choice_of],
            "goals": self._aims(near),
        }
        ended = np.flatnonzero(tried["count"][rows] > 0)
        _put(tried, rows[ended], -1, {name: value[ended] for name, value in now.items()})
        option = self.choose(self._corrected(tried, rows, now), may, turn.world.rng)
        # A call whose goal is unknown counts for none.
        call = near.goal[each, option]
        unknown = np.where(call < 0, np.float32(0.0), np.float32(np.nan))[:, None]
        new = {
            "choice": self.options.choice_of[option],
            "steps": 0,
            "start": now["end"],
            "goal": now["goals"][each, option] if with_goals else unknown,
            "reward": 0.0,
            "discount": 1.0,
            "from": now["to"],
            "to": -1,
        }
        _put(tried, rows, 0, new)
        tried["count"][rows] += 1
        return option, near

    def watch(self, memory: Memory, rows: Array, step: Step, last: LastCall) -> None:
        """Move the task's state on, and add the step's rewards to the running calls.

        A planner that only guides did not make the choices: they are those of the selector beside
        it.
        """
        self.follow(memory, rows, self.task.read(own_step(step)), last)

    def follow(self, memory: Memory, rows: Array, read: Readings, last: LastCall) -> None:
        """Do what ``watch`` does, with what the task has read of the step."""
        after, reward = self.task.advance(self.state_of(memory, rows), read)
        memory["state"][rows] = after[:, 0]
        memory["counters"][rows] = after[:, 1:]
        tried = memory["tried"]
        latest = rows, (tried["count"][rows] - 1) % LATEST
        discount = tried["discount"][latest]
        tried["reward"][latest] += discount * reward
        tried["discount"][latest] = discount * self.gamma
        tried["steps"][latest] += 1
        choice, steps = tried["choice"][latest], tried["steps"][latest]
        other = self.options.skill_of[np.maximum(choice, 0)] != last.skill
        tried["choice"][latest] = self._called(choice, steps, other, last)
        lost = other & self._aimed[last.skill]
        _put(tried, rows[lost], -1, {"goal": np.nan})

    def _called(self, choice: Array, steps: Array, other: Array, last: LastCall) -> Array:
        """Return the choices (k,) that the calls are of, after this number of their steps."""
        count = len(self.options.lengths)
        if not count:
            return np.where(other, last.skill, choice)
        # Which length another selector has chosen is known where the call has reached it.
        at = np.searchsorted(self.options.lengths, steps)
        length = np.where(other | (last.why == LIMIT), at, choice % count)
        called: Array = last.skill * count + np.minimum(length, count - 1)
        return called

    def state_of(self, memory: Memory, rows: Array) -> Array:
        """Return the task's state in a memory, (k, 1 + H)."""
        return np.concatenate([memory["state"][rows, None], memory["counters"][rows]], 1)

    # Values

    def worths(self, obs: Array) -> Iterator[tuple[Any, Array]]:
        """Yield rows of observations (n, …), and the ``worth`` of pieces for these."""
        yield slice(None), self.worth

    def valued(self, near: Near, obs: Array, corners: tuple[Array, Array]) -> Array:
        """Return the value of each option by the log, (n, O) float32; −infinity: it has no call.

        Args:
            near: the nearest pieces to observations ``obs`` (n, …).
            corners: of the task's states, see ``Levels.corners``.
        """
        place, share = corners
        q = np.empty(near.distance.shape, np.float32)
        for rows, each in self.worths(obs):
            # (n, O, K, J): the worth of each neighbor at each corner.
            worth = each[near.pieces[rows][..., None], place[rows][:, None, None, :]]
            q[rows] = ((worth * share[rows][:, None, None, :]).sum(3) * near.weights[rows]).sum(2)
        q = np.where(q > 0, q * self.options.trust(near.distance, self.caution), q)
        return np.where(np.isfinite(near.distance), q, -np.inf).astype(np.float32)

    def choose(self, q: Array, may: Array, rng: np.random.Generator | None) -> Array:
        """Return the best options of values (n, O), or samples; ``may``: (n, choices) bool."""
        may = may[:, self.options.choice_of]
        score = np.where(may, np.maximum(q, -1e30), -np.inf)  # one without a call comes last
        if self.temperature:
            largest = np.abs(np.where(may & np.isfinite(q), q, 0.0)).max(1, keepdims=True)
            score = score / (self.temperature * np.maximum(largest, 1e-12))
            score = score + (rng or np.random.default_rng()).gumbel(size=q.shape)
        option: Array = score.argmax(1)
        return option

    def record(self, choice: Array, call: Array, obs: Array) -> Array:
        """Return choices (n,) as a ``CallAndReturn`` takes them, with the goals of calls.

        Args:
            choice: (n,) numbers.
            call: (n,) the calls that have the goals; −1: none.
            obs: (n, …), for messages.

        Raises:
            SkillError: a skill with goals has none.
        """
        found = []
        skill = self.options.skill_of[choice]
        for name, space in self.goals.items():
            mine = np.flatnonzero((skill == self.number(name)) & (call >= 0))
            found.append((name, mine, space.of_numbers(self.numbers[name][call[mine]])))
        return self._with_goals(choice, found, obs)

    def _padded(self, features: list[Array]) -> Array:
        """Return the features of each skill, (n, F) each, as one array (n, S, F)."""
        whole = np.zeros((len(features[0]), *self._calls), np.float32)
        for skill, some in enumerate(features):
            whole[:, skill, : some.shape[1]] = some
        return whole

    def _aims(self, near: Near) -> Array:
        """Return the standardised goals of options, (n, O, G).

        They are 0 for skills without goals, and NaN for an option that lacks a call.
        """
        found = np.zeros((*near.goal.shape, self._aim), np.float32)
        for skill, aims in enumerate(self.options.aims):
            if aims is not None:
                mine = self.options.skills == skill
                call = near.goal[:, mine]
                found[:, mine, : aims.shape[1]] = np.where(call[..., None] >= 0, aims[call], np.nan)
        return found

    # The calls of the episode

    def _corrected(self, tried: Memory, rows: Array, now: Mapping[str, Array]) -> Array:
        """Return values (k, O) for which the episode's own calls count as logged ones.

        Args:
            now: the worth by the log in the present state.
        """
        corrected = now["q"].copy()
        names: tuple[str, ...] = ("choice", "start", "from", "goal")
        calls = {name: tried[name][rows] for name in names}
        count = self._counts(calls, {name: value[:, None] for name, value in now.items()})[1]
        at = np.flatnonzero(count.any((1, 2, 3)))
        if not len(at):
            return corrected
        # Ends of calls, and last the present: there values are wanted.
        names = (*names, *now, "reward", "discount")
        calls = {name: tried[name][rows[at]] for name in names}
        ends = {k: np.concatenate([calls[k], v[at, None]], 1) for k, v in now.items()}
        far, counts = self._counts(calls, ends)
        weight = np.where(counts, TRUST / (far + SOFT), 0.0)
        own = weight.sum(2)
        logged = ends["q"]
        known = np.isfinite(logged)
        total = np.where(known, ends["total"], 0.0)
        base = np.where(known, logged, 0.0) * total
        both = np.where(known | (own > 0), np.maximum(total + own, 1e-12), np.inf)
        missing = ~known & (own <= 0)
        # From what was not tried: a call that led back to its start would else be worth itself.
        value = _best(np.where(own > 0, -np.inf, logged)[:, :-1], calls["may"])
        for _ in range(LATEST):
            y = calls["reward"] + calls["discount"] * value
            q = (base + np.einsum("neco,nc->neo", weight, y)) / both
            q = np.where(missing, -np.inf, q)
            value = _best(q[:, :-1], calls["may"])
        corrected[at] = q[:, -1]
        return corrected

    def _counts(self, calls: Memory, ends: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return how far calls of the episode started from E ends, and where they count there.

        Args:
            calls: (k, C, …) each.
            ends: (k, E, …) each.

        Returns:
            (k, E, C, O) float32, or (k, E, C, 1) where no skill has goals; and (k, E, C, O) bool.
        """
        choice = calls["choice"]
        each = np.arange(len(calls["choice"]))[:, None]
        skill = self.options.skill_of[np.maximum(choice, 0)]
        to = ends["end"][each, :, skill].swapaxes(1, 2)  # (k, E, C, F)
        start = calls["start"][each, np.arange(LATEST), skill]
        far = np.sqrt(np.square(to - start[:, None]).sum(3))[..., None]
        if self._aimed.any():  # an option counts by its goal, too
            off = ends["goals"][:, :, None] - calls["goal"][:, None, :, None]
            far = np.sqrt(far**2 + np.square(off).sum(4))
        same = (ends["to"][:, :, None] == calls["from"][:, None]) & (choice >= 0)[:, None]
        of = choice[:, None, :, None] == self.options.choice_of
        return far, same[..., None] & of & (far <= ends["far"][:, :, None] + SLACK)


def _best(q: Array, may: Array) -> Array:
    """Return the largest value among what may be chosen, (n, calls); 0 where nothing is known."""
    best = np.where(may, q, -np.inf).max(-1)
    return np.where(np.isfinite(best), best, 0.0)


def _put(tried: Memory, rows: Array, call: int, values: Mapping[str, Any]) -> None:
    """Write values (k, …) of the latest calls (−1), or of the next ones (0), in place."""
    slot = (tried["count"][rows] + call) % LATEST
    for name, value in values.items():
        tried[name][rows, slot] = value
