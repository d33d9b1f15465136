"""Hostile skills, environments, reflexes, policies and calls, drawn by Hypothesis.

Each is tried out as a user would: declare, train a few steps, evaluate. It must be told in a
sentence (a SkillweaveError) that names who, or do no harm. ``run_hostile`` counts what happened.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import shutil
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from declaring import declare as small
from hypothesis import HealthCheck, Phase, given, seed, settings, strategies as st

from skillweave import PPO, EnvSpec, Hierarchy, Network, Reflex, Skill
from skillweave.errors import SkillweaveError

TINY = Network((4,))
PPO_TINY = PPO(num_envs=2, n_steps=4, batch_size=8, update_epochs=1, network=TINY)
STEPS = 16


@dataclass
class Case:
    """Something hostile: ``play`` does it, and a sentence about it must hold all of ``names``."""

    category: str
    label: str
    names: tuple[str, ...]
    play: Callable[[Path], None]

    def __repr__(self) -> str:
        return f"{self.category}: {self.label}"


class Ramp(gym.Env):
    """Pays for going right; episodes of 7 steps."""

    observation_space: Any = gym.spaces.Box(-10.0, 10.0, (2,), np.float32)
    action_space: Any = gym.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.obs(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.obs(), float(np.sum(action)), self.t == 7, False, {"t": self.t}

    def obs(self) -> Any:
        return np.array([self.t, 1.0], np.float32)


class Slope(Ramp):
    """The same with a number as the action."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)


def declare(env: Any = Ramp, **declared: Any) -> Hierarchy:
    """A hierarchy of one plain skill that trains for a few steps."""
    how: dict[str, Any] = {
        "env": env, "skills": [Plain()], "algorithm": PPO_TINY, "selector": PPO_TINY,
        "learn": "apart", "skill_steps": STEPS, "selector_steps": STEPS, "call_steps": 2,
    }  # fmt: skip
    return small(**how | declared)


def train(folder: Path, env: Any = Ramp, **declared: Any) -> None:
    """Train a hierarchy for a few steps, and evaluate it."""
    score = declare(env, **declared).train(folder / "run", quiet=True).evaluate(2)
    assert np.isfinite(score.mean), "something that is not finite was accepted"


class Plain(Skill):
    """The task itself."""


# What may stand where something else is asked for ----------------------------------------------


class Unprintable:
    """Cannot even be shown."""

    def __repr__(self) -> str:
        raise RuntimeError("no repr")


class Unspeakable(Exception):
    """An error that cannot be shown."""

    def __str__(self) -> str:
        raise RuntimeError("no str")


def _anything() -> st.SearchStrategy[Any]:
    """Values of no particular shape."""
    return st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-3, 9),
        st.floats(width=64),
        st.complex_numbers(max_magnitude=9),
        st.text(max_size=4),
        st.binary(max_size=3),
        st.sampled_from(["no", "nan", "1", "x" * 5_000]),
        st.builds(object),
        st.builds(Unprintable),
        st.lists(st.integers(0, 2), max_size=3),
        st.just({}),
        st.just({"a": 1}),
        st.just([[1], [1, 2]]),
        st.just(10**400),
        st.just(np.datetime64("2020-01-01")),
        st.just(float),
    )


DTYPES = "float32", "float64", "float16", "int64", "uint8", "bool", "complex64", "U3", "O", "M8[s]"


@st.composite
def _arrays(draw: Any) -> Callable[[int], Any]:
    """Functions from n to an array that is nearly (n,), or quite."""
    dtype, shape = draw(st.sampled_from(DTYPES)), draw(st.sampled_from(("n",) * 8 + tuple("01+t")))
    value = draw(st.sampled_from((0, 1, 1, 7, -1, np.nan, np.inf, -np.inf, 1e300)))
    every = draw(st.booleans())

    def make(n: int) -> Any:
        shapes = {"n": (n,), "0": (), "1": (n, 1), "+": (n + 1,), "t": (2, n)}
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            try:
                array = np.zeros(shapes[shape], dtype)
                array[... if every or not array.ndim else 0] = value
            except (ValueError, OverflowError, TypeError):
                array = np.full(shapes[shape], value)
        return array

    make.__name__ = f"{dtype}[{shape}]={value}{'' if every else ' once'}"
    return make


ERRORS = (
    ValueError("no"), KeyError("x"), ZeroDivisionError(), RecursionError("deep"), MemoryError(),
    AssertionError(), StopIteration(), TypeError("y" * 5_000), Unspeakable(), OSError(28, "full"),
)  # fmt: skip


def _raising(error: Exception) -> Callable[[Any], Any]:
    def fail(_: Any) -> Any:
        raise error

    fail.__name__ = f"raises {type(error).__name__}"
    return fail


def _const(value: Any) -> Callable[[Any], Any]:
    def give(_: Any) -> Any:
        return value

    try:
        give.__name__ = f"gives {value!r}"[:60]
    except RuntimeError:
        give.__name__ = "gives what cannot be shown"
    return give


def _makers() -> st.SearchStrategy[Callable[[Any], Any]]:
    """Functions from n to whatever is returned instead, or that fail."""
    return st.one_of(
        _arrays(), _arrays(), _anything().map(_const), st.sampled_from(ERRORS).map(_raising)
    )


def _spoil(name: str) -> Callable[[Any], Any]:
    """Writes into what it is given."""

    def write(about: Any) -> Any:
        array = about if isinstance(about, np.ndarray) else getattr(about, name)
        array[...] = 0
        return np.zeros(len(array))

    write.__name__ = f"writes {name}"
    return write


WRITES = ("obs", "action", "next_obs", "reward", "terminated", "truncated", "timed_out", "elapsed")


# Skills ----------------------------------------------------------------------------------------


@st.composite
def skill_cases(draw: Any) -> Case:
    """A method of a skill that returns something else, from some call on."""
    method = draw(st.sampled_from(("reward", "termination", "success", "initiation")))
    after = draw(st.integers(0, 5))
    if draw(st.integers(0, 5)) == 0:
        bad = _spoil(draw(st.sampled_from(WRITES)))
        make = None
    else:
        bad, make = None, draw(_makers())
    calls = 0

    def answer(self: Skill, about: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls <= after:
            return getattr(Skill, method)(self, about)
        if make is None:
            assert bad is not None
            return bad(about)
        return make(len(about) if isinstance(about, np.ndarray) else len(about.reward))

    # Where a skill may never start or always stops at once, training cannot go on: said as well.
    kind = type("Hostile", (Skill,), {"name": "hostile", method: answer})
    label = f"{method} {(make or bad).__name__} after {after} calls"  # type: ignore[union-attr]

    def play(folder: Path) -> None:
        always = [Plain()] if method == "initiation" else []  # so that the selector has a choice
        train(folder, skills=[*always, kind()])

    return Case(method, label, ("'hostile'", method), play)


@st.composite
def reflex_cases(draw: Any) -> Case:
    """A reflex whose condition or action is wrong."""
    env = draw(st.sampled_from((Ramp, Slope)))
    if draw(st.booleans()):
        make = draw(_makers())
        reflex: Any = lambda: Reflex(lambda obs: make(len(obs)), env.action_space.sample(), "odd")  # noqa: E731
        label = f"condition {make.__name__}"
    elif draw(st.booleans()):
        make = draw(_makers())
        reflex = lambda: Reflex(_often, lambda obs: make(len(obs)), "odd")  # noqa: E731
        label = f"action {make.__name__}"
    else:
        value = draw(_anything())
        reflex = lambda: Reflex(_often, value, "odd")  # noqa: E731
        label = f"action {_const(value).__name__}"
    return Case("reflex", label, ("'odd'",), lambda folder: train(folder, env, reflexes=[reflex()]))


def _often(obs: Any) -> Any:
    return obs[:, 0] > 1


@st.composite
def policy_cases(draw: Any) -> Case:
    """A function as a skill's policy that acts wrongly, or not at all."""
    env, make = draw(st.sampled_from((Ramp, Slope))), draw(_makers())
    if draw(st.integers(0, 3)) == 0:
        value = draw(_anything())
        kind = type("Hostile", (Skill,), {"name": "hostile", "policy": value})
        label = f"is {_const(value).__name__}"
    else:
        kind = type("Hostile", (Skill,), {"name": "hostile"})
        kind.policy = staticmethod(lambda obs: make(len(obs)))
        label = make.__name__
    return Case("policy", label, ("'hostile'",), lambda folder: train(folder, env, skills=[kind()]))


# Environments ----------------------------------------------------------------------------------

PLACES = ("obs", "reward", "terminated", "truncated", "info", "step", "reset", "first")
SPACES = (
    gym.spaces.Box(-1, 1, (2,), np.float32), gym.spaces.Discrete(3), gym.spaces.MultiBinary(3),
    gym.spaces.Box(0, 255, (2,), np.uint8), gym.spaces.MultiDiscrete([2, 3]), gym.spaces.Text(3),
    gym.spaces.Dict(a=gym.spaces.Discrete(2), b=gym.spaces.Box(-1, 1, (1,), np.float32)),
    gym.spaces.Tuple((gym.spaces.Discrete(2), gym.spaces.Discrete(2))),
    gym.spaces.MultiBinary(10**9), gym.spaces.Discrete(10**9), gym.spaces.Dict(),
    gym.spaces.MultiDiscrete([2**60, 2**62]),
    gym.spaces.Sequence(gym.spaces.Discrete(2)),
    gym.spaces.Box(-np.inf, np.inf, (0,), np.float32),
    gym.spaces.Discrete(1), gym.spaces.Box(-1, 1, (1,), np.float16), gym.spaces.Box(-1, 1, ()),
    gym.spaces.Box(-3, 3, (2,), np.int8), gym.spaces.MultiBinary((2, 2)),
)  # fmt: skip


@st.composite
def environment_cases(draw: Any) -> Case:
    """An environment that returns something else in one place, from some step on."""
    place, after = draw(st.sampled_from(PLACES)), draw(st.integers(0, 9))
    make = draw(_makers())
    scalar = place in ("reward", "terminated", "truncated") and draw(st.booleans())
    workers = 2 if draw(st.integers(0, 49)) == 0 else 1

    class Bad(Ramp):
        steps = 0

        def wrong(self) -> Any:
            found = make(2)
            return found.reshape(-1)[0] if scalar and isinstance(found, np.ndarray) else found

        def reset(self, **kwargs: Any) -> Any:
            obs, info = super().reset(**kwargs)
            if self.steps >= after and place == "reset":
                return self.wrong()
            return (self.wrong() if place == "first" and self.steps >= after else obs), info

        def step(self, action: Any) -> Any:
            self.steps += 1
            found = dict(zip(PLACES, super().step(action), strict=False))
            if self.steps > after:
                if place == "step":
                    return self.wrong()
                if place in found:
                    found[place] = self.wrong()
            return tuple(found.values())

    Bad.__name__ = "Bad"
    spec = EnvSpec(Bad, workers=workers)
    label = f"{place} {make.__name__}{' scalar' if scalar else ''} after {after} steps"
    label += f" in {workers} processes" if workers > 1 else ""
    names = ("Bad", "step")
    return Case("environment", label, names, lambda folder: train(folder, spec))


@st.composite
def space_cases(draw: Any) -> Case:
    """An environment with an odd space, or none."""
    which = draw(st.sampled_from(("observation_space", "action_space")))
    space = draw(st.one_of(st.sampled_from(SPACES), _anything()))

    class Odd(Ramp):
        def obs(self) -> Any:
            return self.observation_space.sample()

    setattr(Odd, which, space)
    if which == "observation_space" and isinstance(space, gym.spaces.MultiBinary):
        Odd.obs = lambda self: np.zeros(self.observation_space.shape, np.int8)  # type: ignore
    label = f"{which} {_const(space).__name__}"
    return Case("space", label, ("space",), lambda folder: train(folder, Odd))


@st.composite
def maker_cases(draw: Any) -> Case:
    """What is given as an environment."""
    shared = Ramp()
    value = draw(
        st.one_of(_anything(), _makers().map(lambda m: lambda: m(2)), st.just(lambda: shared))
    )
    if draw(st.booleans()):
        field = draw(st.sampled_from(("kwargs", "wrappers", "engine", "env", "workers")))
        value = {field: draw(_anything())}
        made: Any = lambda: EnvSpec(**{"env": "CartPole-v1", **value})  # noqa: E731
        return Case("maker", f"EnvSpec {field}", (), lambda folder: train(folder, made()))
    label = _const(value).__name__
    return Case("maker", label, (), lambda folder: train(folder, value))


# Calls -----------------------------------------------------------------------------------------


def _values(slow: bool = False) -> st.SearchStrategy[Any]:
    large = st.nothing() if slow else st.sampled_from((10**12, 10**30, -(10**30), 1e300))
    small = st.sampled_from((0, 1, 2, -1, 0.5, 1.0, 1.5, 0.0, -0.1, 1e-30, True, None))
    return st.one_of(small, small, _anything().filter(lambda v: not slow or v != 10**400), large)


def _few(value: Any) -> bool:
    """Whether a number is no budget that would take for ever."""
    return not isinstance(value, int) or value < 1000


@functools.cache
def _trained() -> Any:
    """A run that all share who only look at it."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder)
    return declare().train(Path(folder) / "run", quiet=True)


CALLS = {
    "evaluate": ("episodes", "seed", "skill", "max_steps"),
    "render": ("path", "episodes", "seed", "skill", "max_steps"),
    "train": ("run_dir", "seed", "track", "evolve"),
    "load": ("run_dir",),
    "load_weights": ("path",),
    "save_weights": ("path",),
}


@st.composite
def call_cases(draw: Any) -> Case:
    """One argument of what users call that is odd."""
    call = draw(st.sampled_from(sorted(CALLS)))
    field = draw(st.sampled_from(CALLS[call]))
    values = _values() if field == "seed" else _values(True).filter(_few)
    value = draw(values)

    def play(folder: Path) -> None:
        run = _trained()
        if call == "train":
            given = {"run_dir": folder / "run", "quiet": True, field: value}
            with contextlib.chdir(folder):
                declare().train(given.pop("run_dir"), **given)
        elif call in ("load", "load_weights"):
            with contextlib.chdir(folder):
                getattr(run.hierarchy, call)(value)
        else:
            first = {"evaluate": {"episodes": 1}, "render": {"path": "a.gif"}}.get(call, {})
            with contextlib.chdir(folder):
                getattr(run, call)(**{**first, field: value})

    return Case("call", f"{call} {field} {_const(value).__name__}", (), play)


def cases() -> st.SearchStrategy[Case]:
    """Any of them."""
    return st.one_of(
        skill_cases(), skill_cases(), environment_cases(), environment_cases(), space_cases(),
        maker_cases(), reflex_cases(), policy_cases(), call_cases(),
    )  # fmt: skip


# Trying them out -------------------------------------------------------------------------------


def tried(case: Case) -> tuple[str, str]:
    """What came of a case: sentence, accepted, UNNAMED (a sentence without a name), TRACEBACK."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # hostile users are warned, too
        try:
            case.play(Path(folder))
        except SkillweaveError as error:
            text = str(error)
            named = all(name in text for name in case.names) and 0 < len(text) < 2_000
            return ("sentence" if named else "UNNAMED"), text
        except Exception:
            return "TRACEBACK", traceback.format_exc()
    return "accepted", ""


def run_hostile(
    examples: int, number: int, bad: list[str] | None = None
) -> Counter[tuple[str, str]]:
    """Try ``examples`` cases out, drawn with the seed ``number``.

    Returns:
        How many there were of each (category, outcome); see ``tried``. What came of those that are
        not as they should be is appended to ``bad``.
    """
    counts: Counter[tuple[str, str]] = Counter()

    @seed(number)
    @settings(
        max_examples=examples, database=None, deadline=None, derandomize=False,
        phases=[Phase.generate], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(cases())
    def each(case: Case) -> None:
        outcome, text = tried(case)
        counts[case.category, outcome] += 1
        if outcome.isupper() and bad is not None:
            bad.append(f"{case!r}\n{text}")

    each()
    return counts
