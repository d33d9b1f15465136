"""The data of a plan: logged calls and the nearest ones, and a task as a machine.

Planning solves a plan with them, and ``planned.Planned`` acts by it, so both find the same calls.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from .acting_errors import PolicyError
from .core import Array, Step, code
from .mapped import fits_shape

BLOCK = 4_000_000
"""Distances that are computed at once."""
SOFT = 0.01
"""Distance that is added before weights are inverse distances: two equal calls count equally."""
AHEAD = 8
"""Points that are looked at for each one that is wanted: several may be of one group, or equally
near."""
FAR = 100.0
"""Deviations beyond which all values are equally far."""
FURTHER = 2.0
"""A neighbor counts only if it is at most so many times as far as the nearest, or as is usual:
where the log has few calls, others are often behind a wall, and a small chance to pass it would
grow with each call that is tried again."""
MOST_OPTIONS = 10_000
MOST_COUNTERS = 4


def check(
    name: str,
    x: Any,
    kinds: str,
    shape: tuple[int | None, ...],
    least: float = -np.inf,
    below: float = np.inf,
) -> None:
    """Raise a PolicyError where an array of a plan does not fit.

    Args:
        kinds: of NumPy's types, such as "iu".
        shape: None: any number.
        least: the lowest number that it may hold.
        below: all its numbers are below it.
    """
    fits = isinstance(x, np.ndarray) and x.dtype.kind in kinds and fits_shape(x.shape, shape)
    # A NaN is neither at least the one, nor below the other.
    if fits and (not x.size or (least <= x.min() and x.max() < below)):
        return
    sizes = ", ".join("any" if size is None else str(size) for size in shape)
    raise PolicyError(
        f"{name} of a plan must be an array ({sizes}) of numbers from {least:g} to below {below:g},"
        f" but is {type(x).__name__} {getattr(x, 'dtype', '')} {np.shape(x)}"
    )


# Logged calls -----------------------------------------------------------------------------------


@dataclass(eq=False)
class Features:
    """Standardised numbers of observations, by which an acting plan compares a skill's calls."""

    places: Array
    """(F,) int64, which numbers of the flat observation, or of the function's answer."""
    mean: Array
    """(F,) float64."""
    scale: Array
    """(F,) float64, by which differences from the mean are multiplied."""
    function: Callable[..., Any] | None = code(
        "observations (n, ...) to features (n, F)", "features", needed=False
    )
    look: Callable[[Array], None] | None = field(default=None, metadata={"written": False})
    """A function that checks raw numbers (n, R), and may refuse them; None: no check."""

    def __post_init__(self) -> None:
        check("places", self.places, "iu", (None,), 0)
        check("mean", self.mean, "f", self.places.shape)
        check("scale", self.scale, "f", self.places.shape)

    def __call__(self, obs: Array) -> Array:
        """Return the features of observations (n, …), (n, F) float32."""
        # A network sees the numbers of an observation in this type, too.
        seen = obs.astype(np.float32) if self.function is None else np.asarray(self.function(obs))
        raw = seen.reshape(len(obs), -1)
        if self.look is not None:
            self.look(raw)
        raw = raw[:, self.places].astype(np.float64)
        found: Array = ((raw - self.mean) * self.scale).clip(-FAR, FAR).astype(np.float32)
        return found


@dataclass(frozen=True)
class Near:
    """The nearest pieces of each option of a plan to n observations, each of another call.

    An option is a choice; of a skill with goals, a choice with one of the logged goals.
    """

    pieces: Array
    """(n, O, K) int64."""
    weights: Array
    """(n, O, K) float32, they add up to 1 for each option."""
    distance: Array
    """(n, O) float32, to the nearest."""
    total: Array
    """(n, O) float32, the sum of the weights before they were normalised."""
    goal: Array
    """(n, O) int64, the call whose goal the option has; −1: it has none."""


@dataclass(eq=False)
class OptionGroup:
    """Options of a plan's choice whose calls count for one another: one, or the nearest goals."""

    choice: int
    options: int
    """The number of options; of several, each has the goal of one of the nearest calls."""
    rows: Array
    """(m,) int64, the pieces of their calls; of equally near ones the first count."""
    starts: Array
    """(m, F) float32, the features of their starts."""
    call: Array
    """(m,) int64, the call of each."""
    goal: Array
    """(m,) int64, the call whose goal an option has if the piece is its nearest; −1: none."""
    usual: float
    """The usual distance of a start's k-th neighbor among others."""

    def __post_init__(self) -> None:
        if not 1 <= self.options <= MOST_OPTIONS or not self.usual >= 0:
            raise PolicyError(
                f"a group of a plan has {self.options} options and the usual distance {self.usual}"
            )
        # Files do not keep the shape of an array without numbers.
        shape = (None, None) if np.size(self.starts) else np.shape(self.starts)
        check("starts", self.starts, "f", shape)
        for name in ("rows", "call", "goal"):
            check(name, getattr(self, name), "iu", (len(self.starts),), -1 if name == "goal" else 0)
        self._squares = np.square(self.starts).sum(-1)

    def near(
        self, to: Array, k: int, aims: Array | None, without: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Return the nearest pieces to features ``to`` (n, F), however far they are.

        Args:
            k: the number of pieces, each of another call.
            aims: (C, G) float32, the standardised goals of all calls; None: it has no goals.
            without: (n,) calls whose pieces do not count; None: all count.

        Returns:
            Pieces (n, options, k), distances (n, options, k), infinite where there are fewer; and
            the calls whose goals the options have, (n, options), −1: none.
        """
        n = len(to)
        many = k if self.options == 1 else self.options
        pieces = np.zeros((n, self.options, k), np.int64)
        far = np.full(pieces.shape, np.inf, np.float32)
        if not len(self.rows):
            return pieces, far, np.full(far.shape[:2], -1)
        near, off = self._nearest(to, many, without)
        goal = np.where(np.isfinite(off), self.goal[near], -1)[:, : self.options]
        if self.options == 1:
            pieces[:, 0] = self.rows[near]
            far[:, 0] = off
            return pieces, far, goal
        assert aims is not None
        for some in _blocks(n, many**2):
            goals = aims[self.call[near[some]]]
            apart = np.square(goals[:, :, None] - goals[:, None]).sum(3)
            both = np.sqrt(off[some, None] ** 2 + apart)  # (n, options, calls)
            least = np.argsort(both, axis=2, kind="stable")[:, :, :k]
            most = least.shape[2]
            far[some, :, :most] = np.take_along_axis(both, least, 2)
            own = np.take_along_axis(near[some, None].repeat(many, 1), least, 2)
            pieces[some, :, :most] = self.rows[own]
        far[~np.isfinite(off)] = np.inf
        return pieces, far, goal

    def _nearest(self, to: Array, count: int, without: Array | None) -> tuple[Array, Array]:
        """Return the places of the nearest pieces, (n, count), and distances (n, count)."""
        if without is None:
            return nearest(self.starts, to, count, self.call, self._squares)
        near, far = nearest(self.starts, to, count + 1, self.call, self._squares)
        far[self.call[near] == without[:, None]] = np.inf
        order = np.argsort(far, axis=1, kind="stable")[:, :count]
        return np.take_along_axis(near, order, 1), np.take_along_axis(far, order, 1)


@dataclass(eq=False)
class Options:
    """All options that an acting plan chooses among, by groups of logged calls."""

    groups: tuple[OptionGroup, ...]
    aims: tuple[Array | None, ...]
    """The standardised goals of all calls, (C, G) float32, by skill; None: it has no goals."""
    neighbors: int
    """K."""
    lengths: tuple[int, ...] = ()
    """Lengths of calls that are chosen with a skill; (): none."""

    def __post_init__(self) -> None:
        each = max(1, len(self.lengths))
        self.choices = len(self.aims) * each
        of = [group.choice for group in self.groups]
        rising = list(self.lengths) == sorted(set(self.lengths))
        whole = of and of == sorted(of) and {*of} == {*range(self.choices)}
        if not whole or not rising or self.neighbors < 1:
            raise PolicyError(
                f"a plan with {len(self.aims)} skills, the lengths {self.lengths} and "
                f"{self.neighbors} neighbors has options of the choices {of}"
            )
        self.skill_of = np.arange(self.choices) // each
        """(choices,) int64, the skill of each choice."""
        counts = [group.options for group in self.groups]
        self.choice_of = np.repeat(of, counts)
        """(O,) int64, the choice of each option."""
        self.skills = self.skill_of[self.choice_of]
        """(O,) int64, the skill of each option."""
        usual = np.array([group.usual for group in self.groups], np.float32)
        usual = np.where(np.isfinite(usual), np.maximum(usual, SOFT), np.float32(1.0))
        self.units = usual.repeat(counts)
        """(O,) float32, the usual distance of the K-th neighbor of each option.

        Where the log has too few calls to tell, it is 1, a standard deviation."""
        for aims in self.aims:
            if aims is not None:
                check("aims", aims, "f", (None, None))
        for group in self.groups:
            own = self.aims[self.skill_of[group.choice]]
            if own is None and group.options > 1:
                raise PolicyError("a skill of a plan has several options, but no goals")
            if own is None:
                check("goal", group.goal, "iu", (None,), -1, 0)
                continue
            for name in ("goal", "call"):
                check(name, getattr(group, name), "iu", (None,), 0, len(own))

    def of_calls(self, some: Array) -> Options:
        """Return the same options, judged by some calls alone; ``some``: (C,) bool."""
        groups = []
        for group in self.groups:
            at = some[group.call]
            columns = {k: getattr(group, k)[at] for k in ("rows", "starts", "call", "goal")}
            groups.append(replace(group, **columns))
        return replace(self, groups=tuple(groups))

    def near(self, features: Sequence[Array], without: Array | None = None) -> Near:
        """Return the nearest pieces of each option to features of each skill, (n, F) each.

        Args:
            without: (n,) calls whose pieces do not count; None: all count.
        """
        found = []
        for group in self.groups:
            skill = self.skill_of[group.choice]
            to = features[skill]
            aims = self.aims[skill]
            pieces, far, goal = group.near(to, self.neighbors, aims, without)
            limit = FURTHER * np.maximum(far[..., :1], np.float32(group.usual))
            found.append((pieces, np.where(far <= limit, far, np.float32(np.inf)), goal))
        pieces, distance, goal = (np.concatenate(part, 1) for part in zip(*found, strict=True))
        finite = np.where(np.isfinite(distance), distance, 1e9)
        total = (1.0 / (finite + SOFT)).sum(2)
        return Near(pieces, weights_of(finite), distance[:, :, 0], total, goal)

    def trust(self, distance: Array, caution: float) -> Array:
        """Return the share of a value that is left where the nearest piece is far, (n, O) float32.

        Args:
            distance: (n, O), to the nearest piece of each option; infinite: it has none.
            caution: the share by which a value falls, about, where this distance is the usual one
                of the K-th neighbor.
        """
        far = np.where(np.isfinite(distance), distance, 0.0) / self.units
        share: Array = (1.0 / (1.0 + caution * far)).astype(np.float32)
        return share


def nearest(
    points: Array, to: Array, count: int, group: Array, squares: Array | None = None
) -> tuple[Array, Array]:
    """Return the ``count`` points of a plan nearest to each row of ``to``, of other groups.

    Args:
        points: (m, F) float32.
        to: (n, F) float32.
        count: how many.
        group: (m,) the group of each point; of a group only the nearest point counts.
        squares: (m,) of the points' lengths, if they are known.

    Returns:
        Their rows (n, count) int64, the nearest first, of equally near ones the first; and
        distances (n, count) float32. Where there are fewer groups, the distance is infinite.
    """
    tries = min(len(points), count * AHEAD)
    if tries == len(points):
        near = np.broadcast_to(np.arange(tries), (len(to), tries))
    else:
        squares = np.square(points).sum(1) if squares is None else squares
        rows = []
        for some in _blocks(len(to), len(points)):
            far = to[some] @ points.T
            far *= -2.0
            far += squares
            rows.append(far.argpartition(tries - 1, axis=1)[:, :tries])
        near = np.concatenate(rows)
        near.sort(axis=1)
    # Differences again: those of squares are wrong by rounding where points are near.
    distance = np.sqrt(((points[near] - to[:, None]) ** 2).sum(2))
    groups = group[near]
    each = np.arange(len(to))[:, None]
    order = np.lexsort((distance, groups))
    groups, ordered = groups[each, order], distance[each, order]
    ordered[:, 1:][groups[:, 1:] == groups[:, :-1]] = np.inf
    distance[each, order] = ordered
    best = distance.argsort(axis=1, kind="stable")[:, :count]
    chosen = np.zeros((len(to), count), np.int64)
    far_away = np.full((len(to), count), np.inf, np.float32)
    far_away[:, :tries] = far = distance[each, best]
    chosen[:, :tries] = np.where(np.isfinite(far), near[each, best], near[:, :1])
    return chosen, far_away


def _blocks(n: int, each: int) -> list[slice]:
    """Return parts of n rows, so that ``each`` numbers per row are at most ``BLOCK``."""
    step = max(1, BLOCK // each)
    return [slice(first, first + step) for first in range(0, max(n, 1), step)]


def weights_of(distance: Array) -> Array:
    """Return weights (…, K) of neighbors at these distances; they add up to 1."""
    weights = 1.0 / (distance + SOFT)
    normalized: Array = weights / weights.sum(-1, keepdims=True)
    return normalized


# The task ---------------------------------------------------------------------------------------


@dataclass
class Readings:
    """Truths and rewards that the machine of an acting plan reads from n steps."""

    events: Array
    """(n, E + 2) bool; the last but one is never true, the last always."""
    values: Array
    """(n, F + 1) float64, 0 and the rewards that are functions of a step."""

    def take(self, rows: Any) -> Readings:
        """Return the readings of some steps."""
        return Readings(self.events[rows], self.values[rows])


@dataclass(eq=False)
class Machine:
    """The task of an acting plan as states: after every step one transition at most, by events.

    Arrays have one row for each of the Q states, with T transitions, and H counters of steps in
    which an event has been true without a gap. A number of an event is that of a function; the
    next one is never true, the next but one always, and then come the counters that are full.
    """

    first: int
    """The state at the start."""
    counted: Array
    """(Q, H) int64, the event that each counter counts."""
    counter_steps: Array
    """(Q, H) int64, the steps for which each must count; the largest number: it is not used."""
    atoms: Array
    """(Q, T, A) int64, the events that must all be true; the first such transition is taken."""
    target: Array
    """(Q, T) int64, where it leads."""
    paid: Array
    """(Q, T) float64, its reward."""
    paid_by: Array
    """(Q, T) int64, the function whose reward is added, from 1; 0: none."""
    keeps: Array
    """(Q, T, H) bool, the counters that go on counting after it."""
    each: Array
    """(Q,) float64, the reward of each step."""
    each_by: Array
    """(Q,) int64, the function whose reward is added."""
    events: tuple[tuple[Callable[..., Any], Literal["obs", "step"]], ...] = code(
        "observations (n, ...) after a step, or a Step, to (n,) bool"
    )
    """Functions, and what they read."""
    rewards: tuple[Callable[..., Any], ...] = code("a Step to (n,) numbers")

    def __post_init__(self) -> None:
        check("keeps", self.keeps, "b", (None, None, None))
        (states, most, self.slots) = self.keeps.shape
        events = len(self.events) + 2
        arrows = (states, most)
        counters = (states, self.slots)
        if not 0 <= self.first < states:
            raise PolicyError(f"a plan's task starts in state {self.first} of {states}")
        check("counted", self.counted, "iu", counters, 0, events)
        check("counter_steps", self.counter_steps, "iu", counters, 1)
        check("atoms", self.atoms, "iu", (*arrows, None), 0, events + self.slots)
        check("target", self.target, "iu", arrows, 0, states)
        check("paid", self.paid, "f", arrows)
        check("paid_by", self.paid_by, "iu", arrows, 0, len(self.rewards) + 1)
        check("each", self.each, "f", (states,))
        check("each_by", self.each_by, "iu", (states,), 0, len(self.rewards) + 1)

    def start(self, n: int) -> Array:
        """Return the state of ``n`` environments at the start of the task, (n, 1 + H) int64.

        Column 0 is the number of the machine's state, the others are its counters.
        """
        state = np.zeros((n, 1 + self.slots), np.int64)
        state[:, 0] = self.first
        return state

    def read(self, step: Step) -> Readings:
        """Evaluate all events and rewards on n steps."""
        n, last = len(step.reward), len(self.events)
        events = np.zeros((n, last + 2), bool)
        values = np.zeros((n, len(self.rewards) + 1))
        for i, (event, reads) in enumerate(self.events):
            events[:, i] = event(step.next_obs if reads == "obs" else step)
        events[:, last + 1] = True
        for i, reward in enumerate(self.rewards, 1):
            values[:, i] = reward(step)
        return Readings(events, values)

    def advance(self, state: Array, readings: Readings) -> tuple[Array, Array]:
        """Return the next states and rewards, from several states at once if wanted.

        Args:
            state: (n, …, 1 + H).
            readings: of n steps.

        Returns:
            (n, …, 1 + H), and (n, …).
        """
        q = state[..., 0]
        rows = np.arange(len(q)).reshape(-1, *(1,) * (q.ndim - 1))
        after = np.empty_like(state)
        full = np.zeros((*q.shape, self.slots), bool)
        for slot in range(self.slots):
            goes_on = readings.events[rows, self.counted[q, slot]]
            count = np.where(goes_on, state[..., 1 + slot] + 1, 0)
            full[..., slot] = count >= self.counter_steps[q, slot]
            after[..., 1 + slot] = count
        taken = np.full(q.shape, -1)
        for t in reversed(range(self.atoms.shape[1])):
            holds = self._holds(self.atoms[q, t], readings.events, rows, full)
            taken = np.where(holds, t, taken)
        arrow = np.maximum(taken, 0)
        moves = taken >= 0
        after[..., 0] = np.where(moves, self.target[q, arrow], q)
        if self.slots:
            after[..., 1:][moves[..., None] & ~self.keeps[q, arrow]] = 0
        paid = np.where(moves, self.paid[q, arrow], 0.0)
        each = self.each[q]
        reward: Array = paid + each
        if self.rewards:
            reward += np.where(moves, readings.values[rows, self.paid_by[q, arrow]], 0.0)
            reward += readings.values[rows, self.each_by[q]]
        return after, reward

    def _holds(self, atoms: Array, events: Array, rows: Array, full: Array) -> Array:
        """Return where all atoms (n, …, A) of an arrow hold, (n, …) bool."""
        plain = events.shape[1]
        holds: Array = np.ones(atoms.shape[:-1], bool)
        for a in range(atoms.shape[-1]):
            atom = atoms[..., a]
            true = events[rows, np.minimum(atom, plain - 1)]
            if self.slots:
                slot = np.clip(atom - plain, 0, self.slots - 1)
                counted = np.take_along_axis(full, slot[..., None], -1)[..., 0]
                true = np.where(atom >= plain, counted, true)
            holds &= true
        return holds


@dataclass(eq=False)
class Levels:
    """The finite states in which a plan values its task: a machine's, with levels of counters.

    Between two levels values are interpolated.
    """

    levels: Array
    """(Q, H) int64, the levels of each counter."""
    spacing: Array
    """(Q, H) float64, steps from one level to the next."""
    first: Array
    """(Q,) int64, each state's first planning state."""

    def __post_init__(self) -> None:
        check("levels", self.levels, "iu", (None, None), 1)
        check("spacing", self.spacing, "f", self.levels.shape, 1e-12)
        check("first", self.first, "iu", (len(self.levels),), 0)
        if self.levels.shape[1] > MOST_COUNTERS:
            raise PolicyError(
                f"a plan's task has {self.levels.shape[1]} counters; at most {MOST_COUNTERS} can "
                "be planned"
            )
        self.count = int((self.first + self.levels.prod(1, dtype=float)).max(initial=0))
        """M."""

    def corners(self, state: Array) -> tuple[Array, Array]:
        """Return the planning states around states of the task, and their weights.

        Args:
            state: (…, 1 + H).

        Returns:
            (…, J) int64 and (…, J) float32, J = 2^H; the weights add up to 1.
        """
        q = state[..., 0]
        level = state[..., 1:] / self.spacing[q]
        low = np.clip(np.floor(level), 0, np.maximum(self.levels[q] - 2, 0)).astype(np.int64)
        share = np.clip(level - low, 0.0, 1.0)
        share = np.where(self.levels[q] > 1, share, 0.0)
        places, weights = [], []
        for upper in itertools.product((0, 1), repeat=state.shape[-1] - 1):
            place = np.zeros(q.shape, np.int64)
            weight = np.ones(q.shape)
            for slot, up in enumerate(upper):
                at = np.minimum(low[..., slot] + up, self.levels[q, slot] - 1)
                place = place * self.levels[q, slot] + at
                weight = weight * (share[..., slot] if up else 1.0 - share[..., slot])
            places.append(self.first[q] + place)
            weights.append(weight)
        return np.stack(places, -1), np.stack(weights, -1).astype(np.float32)


def nearest_corner(places: Array, weights: Array) -> Array:
    """Return the planning state (…,) with the largest of the ``weights`` (…, J)."""
    largest = weights.argmax(-1)[..., None]
    return np.take_along_axis(places, largest, -1)[..., 0]
