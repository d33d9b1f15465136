"""``sw.inputs``: what a policy from elsewhere is shown, and which part of it is far off."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import aligned, short
from skillweave._internal.notebooks import table
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience.play import SeededEpisodes, play
from skillweave.policies.core import Array, Turn
from skillweave.policies.mapped import Input, Mapped, Model, Outputs, Shapes
from skillweave.robots.chains import OpenRobot, Robot
from skillweave.robots.trial import robots_of
from skillweave.robots.variation import Variation, with_settings
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills.mapped import MappedPolicy
from skillweave.skills.ready import as_policy

EARLY = 10
"""The first steps of an episode: what is wrong later may follow from what was wrong then."""
FAR = 4.0
"""A number is far if it is so many deviations of the training from its mean there."""
SHIFTED = 1.5
"""It is also far if it begins, and is in play, on average so many deviations from its mean."""
SURE = 3.0
"""The standard errors by which starts of episodes may be off by chance."""
VARIES = 0.05
"""What varies less than so many deviations in play is a constant: a command, for example."""
SMALL = 0.4
"""A part is too small if it varies at most so much as the other parts do, in deviations."""
MOVES = 0.1
"""The least that the others have to vary, in deviations, to say so."""
FEW_PARTS = 3
"""The fewest parts of which one is compared with the others."""
PULSE = 3
"""The steps in which an output is changed, to see which number follows it."""
OTHERS = 0.2
"""The share of outputs that other numbers follow, from which the order is said to be wrong."""
LEAST_OUTPUTS = 4
"""The fewest outputs of which the order is looked at: a part of two or three numbers may be a place
or a direction, and no joints."""
CLEARLY = 2.0
"""Another number follows an output where it moves so many times as far as that of its place."""
OF_THEIR_OWN = 0.8
"""The share of outputs that a number of its own has to follow, to say so."""
UNIT = 0.02
"""A part is a direction if its length differs so little from 1."""
TURNS, ELSEWHERE = 0.8, 0.5
"""The share of a direction's motion that a turn explains: in some frame, at most in this one."""
AGAINST = 0.6
"""The share of outputs against which their numbers move, from which the sign is."""
MOST_PULSES = 64
"""The most outputs that are tried."""
OF_TIME = ("Elapsed()", "Table()")
"""Parts that count steps."""
NOT_OBSERVED = ("Goal()", "LastAction()", *OF_TIME)
"""Parts that are no observation: what the user wants, what the policy did, and time."""
AT_LIMIT = 0.2
"""The share of steps at the limit of the action from which an output is named."""


@dataclass(frozen=True)
class InputPart:
    """A part of what a policy is shown, as its model gets it: after offset, scale and clip.

    Attributes:
        name: its source: a key of the observation, ``Goal()``, ``LastAction()``, a function.
        numbers: how many.
        reset: (numbers,) the mean at the starts of episodes.
        low: (numbers,) the lowest in play.
        high: (numbers,) the highest.
        mean: (numbers,) of the training, that the model carries; None: it carries none.
        deviation: (numbers,) the same.
        distance: (numbers,) from that mean, in these deviations: the root mean square of the first
            steps, or of all, if that is less, as a start may be unlike the rest; None: unknown.
        spread: (numbers,) the standard deviation in play, in deviations of the training; None.
        shift: (numbers,) how far the starts of episodes, and also play, are from the mean, in these
            deviations; 0 of what does not vary, or where starts differ too much to say; None.
        why: what is far off, in words; empty: nothing is.
    """

    name: str
    numbers: int
    reset: Array
    low: Array
    high: Array
    mean: Array | None = None
    deviation: Array | None = None
    distance: Array | None = None
    spread: Array | None = None
    shift: Array | None = None
    why: str = ""


@dataclass(frozen=True)
class OutputLimits:
    """The actions of a policy beside the limits of the environment's.

    Attributes:
        low: the lowest of each number of the flat action in play.
        high: the highest.
        at_limit: the share of steps in which each is at a limit; of what the policy writes.
    """

    low: Array
    high: Array
    at_limit: Array


@dataclass(frozen=True)
class InputSheet:
    """Every part of what a policy is shown, and which are far off."""

    name: str
    """The policy's."""
    parts: tuple[InputPart, ...]
    """In the order of the inputs."""
    outputs: OutputLimits | None
    """None: actions are choices."""
    steps: float
    """The mean length of the episodes, which end where the environment ends them."""
    asked: int
    """The most steps of an episode."""

    @property
    def far(self) -> tuple[InputPart, ...]:
        """The parts that are far off, the farthest first."""
        found = [part for part in self.parts if part.why]
        return tuple(sorted(found, key=lambda part: -_most(part.distance)))

    def to_json(self) -> dict[str, Any]:
        """Return it as plain JSON."""

        def plain(value: Any) -> Any:
            return value.tolist() if isinstance(value, np.ndarray) else value

        outputs = self.outputs
        return {
            "policy": self.name,
            "steps": self.steps,
            "asked": self.asked,
            "parts": [{k: plain(v) for k, v in vars(part).items()} for part in self.parts],
            "far": [part.name for part in self.far],
            "outputs": None if outputs is None else {k: plain(v) for k, v in vars(outputs).items()},
        }

    def sentences(self) -> list[str]:
        """Return what is far off, and what is at the limits."""
        found = [f"{part.name}: {part.why}" for part in self.far]
        if self.outputs is not None:
            often = np.flatnonzero(self.outputs.at_limit > AT_LIMIT)
            if len(often):
                found.append(
                    f"{len(often)} of {len(self.outputs.low)} numbers of the action are at its "
                    f"limit in more than {AT_LIMIT:.0%} of the steps: {short(often.tolist())}. "
                    "Look at the scale of acts"
                )
        if all(part.mean is None for part in self.parts):
            found.append(
                "The model carries no mean and deviation of its inputs, so values are not compared"
            )
        if self.steps < self.asked:
            found.append(f"Episodes end after {self.steps:.0f} of {self.asked} steps on average")
        return found

    def __str__(self) -> str:
        return "\n\n".join([aligned([list(_HEAD), *self._rows()], left=1), *self._notes()])

    def _repr_html_(self) -> str:
        notes = table((), [[sentence] for sentence in self._notes()])
        return f"{table(_HEAD, self._rows())}{notes}"

    def _notes(self) -> list[str]:
        """Return what is far off, and before it the range of actions."""
        if self.outputs is None:
            return self.sentences()
        most = float(self.outputs.at_limit.max())
        span = _span(self.outputs.low, self.outputs.high)
        return [f"Actions: {span}, at a limit in at most {most:.0%} of steps", *self.sentences()]

    def _rows(self) -> list[list[str]]:
        return [
            [
                part.name,
                str(part.numbers),
                _span(part.reset, part.reset),
                _span(part.low, part.high),
                "-" if part.mean is None else _span(part.mean, part.mean),
                "-" if part.deviation is None else _span(part.deviation, part.deviation),
                "-" if part.distance is None else f"{_most(part.distance):.1f}",
                "far off" if part.why else "",
            ]
            for part in self.parts
        ]


_HEAD = (
    "part", "numbers", "at reset", "in play", "mean in training", "deviation", "far by", "",
)  # fmt: skip


def _most(values: Array | None) -> float:
    return 0.0 if values is None else float(values.max(initial=0.0))


def _span(low: Array, high: Array) -> str:
    first, last = f"{low.min():.3g}", f"{high.max():.3g}"
    return first if first == last else f"{first} to {last}"


@checked_names
def inputs(
    policy: Any,
    env: Any,
    *,
    steps: int = 100,
    episodes: int = 10,
    vary: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> InputSheet:
    """Show every part of what a policy from elsewhere is given, and name those that are far off.

    The policy plays, and its inputs are compared with the mean and deviation that its model carries
    from training, where it has them: a graph that begins with Sub and Div, rsl_rl's normalization,
    Stable-Baselines3's ``VecNormalize``. A part is far off if a number is more than four deviations
    from its mean, in the first ten steps and in all; if it begins, and is on average, 1.5
    deviations from it; or if the part varies less than 0.4 times as much as the others do. Each
    output is also changed for a moment: a part with a number for each of four or more outputs is
    far off if other numbers follow these, or move against them. So is a gyro that does not turn as
    gravity does.

    Args:
        policy: one with ``sees``, of ``from_onnx``, ``from_torch``, ``from_function`` or
            ``from_sb3``, or the path of an ONNX file.
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        steps: the most steps of an episode.
        episodes: how many are played.
        vary: keywords of the environment that are drawn for each episode; see ``handovers``.
        seed: of the episodes.

    Raises:
        DeclarationError: an argument is wrong, or the policy declares no inputs.
        PolicyError: it does not fit the environment.
        EnvError: the environment cannot be made.
    """
    steps, episodes = fitted(AtLeastOne, steps, "steps"), fitted(AtLeastOne, episodes, "episodes")
    found = as_policy(policy, "inputs(): policy")
    if not isinstance(found, MappedPolicy):
        raise DeclarationError(
            f"inputs() looks at policies from elsewhere, not at {short(found)}: give one of "
            "from_onnx, from_torch, from_function or from_sb3"
        )
    variation = Variation({} if vary is None else vary)
    robots = robots_of(variation, fitted(int, seed, "seed"))
    first = next(robots)
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    spaces = with_settings(spec, first.settings).spaces
    bound = found.bind(spaces.observation, spaces.action, "inputs()")
    if found.mapping.sees is None and spaces.observation.shape is None:
        raise DeclarationError(
            "inputs() looks at the parts that sees= declares, and this policy is given whole "
            "observations of a Dict or Tuple"
        )
    seen = _Seen(bound)
    with OpenRobot(spec) as where:
        for number, robot in enumerate([first, *(next(robots) for _ in range(episodes - 1))]):
            seen.play(where, robot, steps)
            if number == 0:
                moved = _follows(seen, where, robot)
    return seen.sheet(bound, _turns(seen) | moved, steps)


class _Shown(Model):
    """A model that keeps what it is shown, and whose outputs may be changed for a moment."""

    def __init__(self, model: Model, numbers: bool) -> None:
        self.model = model
        self.numbers = numbers
        """Its outputs are numbers of an action; else choices, or a dict."""
        self.inputs: list[dict[str, Array]] = []
        self.outputs: list[Array] = []
        self.pulse: tuple[int, float] | None = None
        """The place of an output, and what is added to it in the first steps."""

    @property
    def expected(self) -> Shapes:
        """The model's."""
        return self.model.expected

    @property
    def states(self) -> Sequence[tuple[tuple[int, ...], Any]]:
        """The model's."""
        return self.model.states

    def call(
        self, inputs: dict[str, Array], state: tuple[Array, ...], turn: Turn
    ) -> tuple[Any, Sequence[Array]]:
        """Call the model."""
        self.inputs.append({name: np.array(x) for name, x in inputs.items()})
        output, after = self.model.call(inputs, state, turn)
        if self.pulse is not None and len(self.inputs) <= PULSE:
            place, size = self.pulse
            output = np.array(output, np.float64)
            flat = output.reshape(len(output), -1)
            flat[:, place] += size
        if self.numbers:
            self.outputs.append(np.asarray(output, np.float64).reshape(-1))
        return output, after


class _Seen:
    """What a policy is shown in episodes, and what it does."""

    def __init__(self, policy: MappedPolicy) -> None:
        acting = policy.in_place
        assert isinstance(acting, Mapped)
        self.model = _Shown(acting.model, acting.outputs.space.kind == "Box")
        self.acting = replace(acting, model=self.model, warn=None)
        self.columns = list(_columns(acting.inputs, policy.observation_space))
        self.episodes: list[Array] = []
        """(T, K) each, what was shown."""
        self.outputs: list[Array] = []
        self.actions: list[Array] = []

    def play(self, where: OpenRobot, robot: Robot, steps: int, keep: bool = True) -> Array:
        """Play an episode; return what was shown, (T, K)."""
        self.model.inputs.clear()
        self.model.outputs.clear()
        seeds = Seeds(robot.seed) / "chain"
        with global_generators(seeds):
            episodes = SeededEpisodes(where.engine(robot), [robot.seed], steps)
            for now in play(self.acting, episodes, rng=seeds.numpy()):
                if keep and self.model.numbers:
                    self.actions.append(np.array(now.step.action[0]))
        shown = np.array([_flat(one, self.columns) for one in self.model.inputs])
        if keep:
            self.episodes.append(shown)
            self.outputs.append(np.array(self.model.outputs, np.float64))
        return shown

    def sheet(self, policy: MappedPolicy, moved: Mapping[int, str], steps: int) -> InputSheet:
        """Return the sheet of what was seen.

        Args:
            moved: by the number of a part, what is wrong with the order or the sign of its numbers.
        """
        every = np.concatenate(self.episodes)
        early = np.concatenate([one[:EARLY] for one in self.episodes])
        starts = np.array([one[0] for one in self.episodes])
        reset, doubt = starts.mean(0), starts.std(0) / math.sqrt(len(starts))
        inside = policy.normalized()
        parts = []
        for column in self.columns:
            shown = every[:, column.own]
            low, high = shown.min(0), shown.max(0)
            part = InputPart(column.source, shown.shape[1], reset[column.own], low, high)
            known = inside.get(column.input)
            if known is not None and len(known[0]) in (1, self._width(column.input)):
                mean, deviation = (_at(x, column.places) for x in known)
                parts.append(
                    _beside(part, mean, deviation, early[:, column.own], shown, doubt[column.own])
                )
            else:
                parts.append(part)
        parts = _named(parts, moved, declared=policy.mapping.sees is not None)
        lasted = float(np.mean([len(one) for one in self.episodes])) * self.acting.period
        limits = _limits(np.array(self.actions), self.acting.outputs)
        return InputSheet(policy.name, tuple(parts), limits, min(lasted, float(steps)), steps)

    def _width(self, name: str) -> int:
        inputs = self.acting.inputs
        if inputs is None:
            return sum(len(one.places) for one in self.columns)
        return math.prod(inputs[name].shape)


def _beside(
    part: InputPart, mean: Array, deviation: Array, early: Array, every: Array, doubt: Array
) -> InputPart:
    """Return a part with how it stands beside the mean and deviation of the training.

    Args:
        early: (T, numbers) of the first steps.
        every: (T, numbers) of all.
        doubt: (numbers,) the standard error of ``part.reset``.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        first, whole = (
            np.sqrt((((shown - mean) / deviation) ** 2).mean(0)) for shown in (early, every)
        )
        spread = every.std(0) / deviation
        off = np.minimum(np.abs(part.reset - mean) - SURE * doubt, np.abs(every.mean(0) - mean))
        shift = np.where(spread > VARIES, off / deviation, 0.0)
    return replace(
        part,
        mean=mean,
        deviation=deviation,
        distance=np.minimum(first, whole),
        spread=spread,
        shift=shift,
    )


@dataclass(frozen=True)
class ShownPart:
    """The numbers of a part among all that a policy is shown."""

    input: str
    """The name of the input."""
    source: str
    """What it is made of, for people."""
    places: Array
    """In the flat input."""
    own: slice
    """Among the numbers of all parts."""


def _columns(inputs: Mapping[str, Input] | None, observation_space: Any) -> Iterator[ShownPart]:
    """Yield the parts of what a policy is shown, in their order."""
    if inputs is None:
        size = math.prod(observation_space.shape or (1,))
        yield ShownPart("", "the observation", np.arange(size), slice(0, size))
        return
    start = 0
    for name, one in inputs.items():
        first = 0
        for take in one.takes:
            places = np.arange(first, first + take.size)
            if one.past is not None:  # of its history, what is now
                now = np.flatnonzero(one.past.ages == 0)
                places = now[np.argsort(one.past.columns[now])][places]
            yield ShownPart(
                name, take.name + _places(take.places), places, slice(start, start + take.size)
            )
            first += take.size
            start += take.size


def _places(places: tuple[int, ...] | None) -> str:
    """Return places of a part in words, as Python writes them; empty: it takes all."""
    if places is None:
        return ""
    first, last = places[0], places[-1]
    if places == tuple(range(first, last + 1)):
        return f"[{first}:{last + 1}]"
    return f"[{', '.join(map(str, places[:3]))}{', ...' * (len(places) > 3)}]"


def _flat(shown: Mapping[str, Array], columns: Sequence[ShownPart]) -> Array:
    """Return the numbers of one environment, in the order of the parts."""
    return np.concatenate(
        [np.float64(shown[one.input][0]).reshape(-1)[one.places] for one in columns]
    )


def _at(values: Array, places: Array) -> Array:
    return np.broadcast_to(values, len(places)) if len(values) == 1 else values[places]


def _named(
    parts: Sequence[InputPart], moved: Mapping[int, str], *, declared: bool
) -> list[InputPart]:
    """Return the parts with what is far off about them.

    Args:
        moved: see ``_Seen.sheet``.
        declared: ``sees`` says what they are; else nothing can be a little wrong.
    """
    # Of a clock or a table these steps are no sample of those in the training.
    far = [_most(part.distance) * (part.name not in OF_TIME) for part in parts]
    # A goal is what the user wants, and the last action is 0 at the start.
    own = [part.name not in NOT_OBSERVED for part in parts]
    shifts = [_most(part.shift) * mine for part, mine in zip(parts, own, strict=True)]
    found = []
    for k, part in enumerate(parts):
        why = moved.get(k, "")
        if far[k] > FAR and far[k] >= max(far) / 2:
            assert part.distance is not None
            why = _off(part, int(part.distance.argmax()))
        elif declared and max(far) <= FAR and not why:
            if part.shift is not None and shifts[k] > SHIFTED:
                why = _off(part, int(part.shift.argmax()))
            elif max(shifts) <= SHIFTED and (times := _times_smaller(parts, k)):
                why = f"it varies {times:.0f} times less than the other parts do: look at its scale"
        found.append(replace(part, why=why))
    return found


def _off(part: InputPart, place: int) -> str:
    """Return a sentence on a number that is far from its mean in training."""
    assert part.mean is not None
    return (
        f"its number {place} is {part.reset[place]:.3g} at reset, and the model was trained on "
        f"{part.mean[place]:.3g} +- {_deviation(part, place):.3g}: look at its place among the "
        "inputs, its sign, offset and scale, and at how the robot begins"
    )


def _deviation(part: InputPart, place: int) -> float:
    assert part.deviation is not None
    return float(part.deviation[place])


def _times_smaller(parts: Sequence[InputPart], k: int) -> float:
    """Return how many times less a part varies than the others, in deviations; 0: it does not."""
    apart = "Goal()", *OF_TIME
    moving = {
        i: (float(np.median(part.distance)), float(np.median(part.spread)))
        for i, part in enumerate(parts)
        if part.distance is not None and part.spread is not None and part.name not in apart
    }
    if k not in moving or len(moving) < FEW_PARTS:
        return 0.0
    ratios = []
    for which in (0, 1):
        others = float(np.median([pair[which] for i, pair in moving.items() if i != k]))
        ratios.append(moving[k][which] / others if others > MOVES else 1.0)
    most = max(ratios)
    return 1 / max(most, 1e-9) if most < SMALL else 0.0


def _follows(seen: _Seen, where: OpenRobot, robot: Robot) -> dict[int, str]:
    """Return, by part, what is wrong with its order or its sign: which number follows an output.

    Each output is changed in the first steps of the same episode. Of a part with as many numbers
    as there are outputs, the one of the same place moves most, where the part is of the joints.
    """
    outputs = seen.acting.outputs
    count = outputs.count
    same = {
        k: column.own
        for k, column in enumerate(seen.columns)
        if len(column.places) == count and column.source not in NOT_OBSERVED
    }
    period, chunk = seen.acting.period, seen.acting.chunk
    looked = outputs.space.kind == "Box" and LEAST_OUTPUTS <= count <= MOST_PULSES
    if not looked or not same or period > 1 or chunk is not None:
        return {}
    sizes = np.maximum(seen.outputs[0].std(0), 0.1)
    length = PULSE + 2
    plain = seen.play(where, robot, length, keep=False)
    direct = {k: np.zeros((count, count)) for k in same}
    for place in range(count):
        seen.model.pulse = place, float(sizes[place])
        shown = seen.play(where, robot, length, keep=False)
        seen.model.pulse = None
        if len(shown) != len(plain):
            return {}
        for k, own in same.items():
            direct[k][place] = (shown - plain)[1:, own].sum(0)
    scale = np.ones(count) if outputs.scale is None else np.broadcast_to(outputs.scale, count)
    return {k: why for k in same if (why := _order(direct[k], np.sign(scale)))}


def _order(moved: Array, sign: Array) -> str:
    """Return what is wrong with numbers (K,) that move by ``moved`` (K, K) where outputs do."""
    count = len(moved)
    size = np.abs(moved)
    if not (size.max(1) > 0).all():
        return ""
    follows = size.argmax(1)
    other = np.flatnonzero(size.max(1) > CLEARLY * np.diag(size))
    own = len(set(follows.tolist())) >= OF_THEIR_OWN * count
    if own and len(other) >= OTHERS * count:
        first = int(other[0])
        return (
            f"if it is of the joints, its order is another one than that of the outputs, in "
            f"{len(other)} of {count}: output {first} moves its number {int(follows[first])}"
        )
    against = np.diag(moved) * sign < 0
    if len(other) < OTHERS * count and against.mean() > AGAINST:
        return (
            f"if it is of the joints, its sign is wrong: {int(against.sum())} of its {count} "
            "numbers move against the outputs"
        )
    return ""


def _turns(seen: _Seen) -> dict[int, str]:
    """Return, by part, that a gyro is in another frame than a direction, or has another sign.

    A direction b (3,), gravity for example, that is seen in a body's frame turns by
    Δb = c b × w, where w (3,) is the body's angular velocity in the same frame.
    """
    threes = {k: one for k, one in enumerate(seen.columns) if len(one.places) == 3}
    found = dict[int, str]()
    for k, direction in threes.items():
        b = [one[:, direction.own] for one in seen.episodes]
        if any(abs(np.linalg.norm(one, axis=1) - 1).max() > UNIT for one in b):
            continue
        moved = np.concatenate([np.diff(one, axis=0) for one in b])
        middle = _middles(b)
        if not len(moved) or not moved.any():
            continue
        fits = dict[int, tuple[float, float, float]]()
        for other, column in threes.items():
            if other != k and column.source not in NOT_OBSERVED:
                w = _middles([one[:, column.own] for one in seen.episodes])
                fits[other] = _explained(moved, middle, w)
        if any(here > TURNS and factor > 0 for here, factor, _ in fits.values()):
            continue  # it is the gyro
        name = direction.source
        for other, (here, factor, anywhere) in fits.items():
            if here > TURNS and factor < 0:
                found[other] = f"it turns against {name}: its sign"
            elif anywhere > TURNS and here < ELSEWHERE:
                found[other] = f"it does not turn as {name} does: it is in another frame"
    return found


def _middles(episodes: Sequence[Array]) -> Array:
    """Return the means of each two steps that follow one another, of all episodes."""
    return np.concatenate([(one[1:] + one[:-1]) / 2 for one in episodes])


def _explained(moved: Array, b: Array, w: Array) -> tuple[float, float, float]:
    """Return how well ``moved`` is c b × w, this c, and how well it is b × (M w) for any M (3, 3).

    Args:
        moved, b, w: (T, 3).
    """
    total = float((moved**2).sum())
    cross = np.cross(b, w)
    size = float((cross**2).sum())
    factor = float((moved * cross).sum()) / size if size > 0 else 0.0
    here = 1 - float(((moved - factor * cross) ** 2).sum()) / total
    # Each column of M and each number of w has its own cross product with b.
    basis = [np.cross(b, axis) * w[:, [i]] for axis in np.eye(3) for i in range(3)]
    design = np.stack([one.reshape(-1) for one in basis], axis=1)
    solved, *_ = np.linalg.lstsq(design, moved.reshape(-1), rcond=None)
    left = moved.reshape(-1) - design @ solved
    return here, factor, 1 - float((left**2).sum()) / total


def _limits(actions: Array, outputs: Outputs) -> OutputLimits | None:
    """Return actions (T, …) beside the limits of their space; None: they are choices."""
    space = outputs.space
    if space.kind != "Box":
        return None
    flat = actions.reshape(len(actions), -1).astype(np.float64)
    low, high = (
        np.broadcast_to(bound, space.shape).reshape(-1).astype(np.float64) for bound in space.bounds
    )
    at = ((flat <= low) | (flat >= high)).mean(0)
    if outputs.to is not None:  # the others rest where they are put
        at[np.setdiff1d(np.arange(len(at)), outputs.to)] = 0.0
    return OutputLimits(flat.min(0), flat.max(0), at)
