"""Every field of every settings class refuses wrong values by its name, and takes NumPy's numbers.

The tables say what each field must be. They are written by hand, so that an annotation which is
lost or loosened fails here.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave._internal.public import HOMES
from skillweave.algorithms import OnPolicy
from skillweave.algorithms.config import (
    ActorCritic,
    OffPolicy,
    SkillCritic,
    config_from_json,
    config_to_json,
)
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution import Evolution, Mutations, Range, Tournament, Truncation
from skillweave.schema import described, fitted

if TYPE_CHECKING:
    from fractions import Fraction as Unknown

NAN, INF = float("nan"), float("inf")
HUGE = 10**400
NOT_A_NUMBER: tuple[Any, ...] = (True, "x", None, NAN, [1], {}, HUGE)


class Kind(NamedTuple):
    """What a field must be."""

    refused: tuple[Any, ...]
    taken: tuple[Any, ...]


def number(low: float | None = None, high: float | None = None, *, zero: bool = True) -> Kind:
    """A number from ``low`` to ``high``, both included but for 0 where ``zero`` is False."""
    below = () if low is None else (low - 0.5, -INF) if zero or low else (-0.5, 0.0, 0, -INF)
    above = (INF, 1e39) if high is None else (high + 0.5, INF)
    one = 0.5 if high is None or high >= 0.5 else high
    edges = tuple(x for x in (low, high) if x is not None and (zero or x))
    return Kind((*NOT_A_NUMBER, *below, *above), (one, np.float32(one), np.float64(one), *edges))


def whole(low: int, high: int | None = None) -> Kind:
    """A whole number from ``low`` to ``high``."""
    most = 2**63 if high is None else high + 1
    one = max(low, 8) if high is None else min(max(low, 8), high)
    return Kind((*NOT_A_NUMBER, INF, 2.5, 8.0, low - 1, most), (one, np.int64(one), np.int32(one)))


def word(*known: str) -> Kind:
    """One of some texts."""
    return Kind(("x", 1, True, None, [], b"x"), (*known, np.str_(known[0])))


def listed(each: Kind, *refused: Any, some: tuple[Any, ...]) -> Kind:
    """A tuple or a list of some kind."""
    wrong = tuple((*some, one) for one in each.refused)
    numbers = np.asarray(some)
    return Kind((5, "x", True, None, *refused, *wrong), (some, list(some), tuple(numbers)))


def or_none(kind: Kind) -> Kind:
    """The same, or None."""
    refused = tuple(x for x in kind.refused if x is not None)
    return Kind(refused, (*kind.taken, None))


def settings(*taken: Any) -> Kind:
    """Other settings, and no class of them."""
    return Kind((5, "x", True, None, [], {"x": 1}, type(taken[0])), taken)


POSITIVE, NON_NEGATIVE, FRACTION, ANY = number(0, zero=False), number(0), number(0, 1), number()
SHARE = number(0, 1, zero=False)
AT_LEAST_ONE, COUNT = whole(1), whole(0)
FLAG = Kind((0, 1, "x", None, NAN, []), (True, False, np.bool_(True)))
COMPILE = Kind((0, 1, "x", None, [True]), (True, False, "auto", np.bool_(False)))
DEVICE = word("cpu", "cuda", "auto")
WIDTHS = listed(whole(1, 65_536), some=(16, 8, 8))
NETWORK = settings(sw.Network((8,)), {"hidden": [8]})
RATE = Kind(
    (*NOT_A_NUMBER, 0, -1.0, INF, (1, 2), {"start": 1}, {"start": 1, "end": -1}),
    (0.5, np.float64(0.5), 1, sw.algorithms.Linear(1e-3, 0), {"start": 1e-3, "end": 0.0}),
)
LIMITS = Kind(
    (5, "x", None, (1,), (1, 2, 3), (0, 2), (True, 2), (1, 2.5), (3, 2)),
    ((1, 2), [1, 2], (np.int64(1), np.int64(2))),
)
SEES = Kind(
    (
        1.5,
        -1,
        True,
        "",
        (),
        (1, 1),
        (0, -1),
        (0, True),
        (0, None),
        slice(0, None),
        slice(-2, 3),
        slice(0, 0),
        range(0),
        np.array([0.5]),
        {"x": 1},
    ),
    ((0, 1, 4), [0, 1, 4], ("x", 1, "y.z")),
)
NUMBERS = Kind(
    (True, "x", {}, NAN, INF, [], [NAN], [[0.5]], HUGE), (0.5, np.float64(0.5), [0.5, 1.0])
)
RANGE = Kind((5, "x", True, [], (1.0,), (1.0, -1.0), (0.0, INF)), ([-1.0, 1.0], None))
PLACES = Kind(
    (0.5, "x", "1:y", True, [], [-1], [0.5], [[0]], {}, slice(0.5), range(0), np.array(0.5)),
    ([0, 2], slice(0, 3), None),
)
SCALING = {"scale": NUMBERS, "offset": NUMBERS, "clip": RANGE}
ALGORITHM = settings(sw.PPO(), sw.DQN())
INFO_KEYS = Kind((5, "x", None, {"x": 1}, [5], [""], [None]), (["x"], ("x", "y"), []))
ENV = Kind((5, True, None, [], {}, gym.Env()), ("CartPole-v1", sw.EnvSpec("CartPole-v1")))

MILLION, THREADS = whole(1, 1_000_000), whole(1, 1024)
ON_POLICY = {
    "num_envs": MILLION, "n_steps": MILLION, "learning_rate": RATE, "gamma": FRACTION,
    "normalize_obs": FLAG, "network": NETWORK, "overlap": FLAG, "threads": THREADS,
    "device": DEVICE,
}  # fmt: skip
PPO = ON_POLICY | {
    "batch_size": AT_LEAST_ONE, "update_epochs": MILLION,
    "learning_rate_schedule": word("constant", "linear"), "adam_eps": POSITIVE,
    "gae_lambda": FRACTION, "clip_coef": POSITIVE, "clip_value": or_none(POSITIVE),
    "ent_coef": NON_NEGATIVE, "ent_coef_final": or_none(NON_NEGATIVE), "epsilon": FRACTION,
    "epsilon_final": or_none(FRACTION), "epsilon_fraction": FRACTION, "vf_coef": NON_NEGATIVE,
    "max_grad_norm": POSITIVE, "target_kl": or_none(POSITIVE), "normalize_advantage": FLAG,
    "min_advantage_std": NON_NEGATIVE, "normalize_returns": FLAG, "action_std_init": POSITIVE,
    "action_std": word("parameter", "state"), "squash_actions": FLAG, "critic": or_none(NETWORK),
    "compile": COMPILE,
}  # fmt: skip
OFF_POLICY = {
    "num_envs": Kind(MILLION.refused, (8, np.int64(8))), "train_freq": AT_LEAST_ONE,
    "update_ratio": POSITIVE,
    "buffer_size": Kind(whole(1, 10**9).refused, (1000, np.int64(1000))), "learning_starts": COUNT,
    "batch_size": whole(1, 1_000_000), "n_step": MILLION, "prioritized": FLAG,
    "priority_alpha": FRACTION, "priority_beta": FRACTION, "learning_rate": RATE,
    "learning_rate_schedule": word("constant", "linear"), "adam_eps": POSITIVE, "gamma": FRACTION,
    "tau": FRACTION, "max_grad_norm": or_none(POSITIVE), "normalize_obs": FLAG,
    "normalize_rewards": FLAG, "network": NETWORK, "save_buffer": FLAG, "overlap": FLAG,
    "action_repeat": FRACTION, "action_repeat_steps": MILLION, "threads": THREADS,
    "compile": COMPILE, "device": DEVICE,
}  # fmt: skip
ACTOR_CRITIC = OFF_POLICY | {"critic": or_none(NETWORK)}
TABLE: dict[type[Any], dict[str, Kind]] = {
    OnPolicy: ON_POLICY,
    sw.PPO: PPO,
    sw.algorithms.SelfImitationPPO: PPO | {
        "imitation_rows": whole(1, 10**9), "imitation_steps": MILLION,
        "imitation_coef": NON_NEGATIVE, "imitation_vf_coef": NON_NEGATIVE,
    },
    SkillCritic: ON_POLICY | {
        "batch_size": AT_LEAST_ONE, "update_epochs": MILLION, "gae_lambda": FRACTION,
        "adam_eps": POSITIVE, "max_grad_norm": POSITIVE, "deciding": FLAG, "sees_goals": FLAG,
        "min_advantage_std": NON_NEGATIVE, "epsilon": FRACTION, "epsilon_final": or_none(FRACTION),
        "epsilon_fraction": FRACTION,
    },
    OffPolicy: OFF_POLICY,
    ActorCritic: ACTOR_CRITIC,
    sw.DQN: OFF_POLICY | {
        "double": FLAG, "dueling": FLAG, "noisy": FLAG, "distributional": FLAG,
        "n_atoms": whole(2, 100_000), "v_min": or_none(ANY), "v_max": or_none(ANY),
        "exploration_fraction": FRACTION, "exploration_initial_eps": FRACTION,
        "exploration_final_eps": FRACTION, "target_update_interval": AT_LEAST_ONE,
        "loss": word("huber", "mse"),
    },
    sw.TD3: ACTOR_CRITIC | {
        "exploration_noise": NON_NEGATIVE, "policy_delay": AT_LEAST_ONE,
        "target_noise": NON_NEGATIVE, "target_noise_clip": NON_NEGATIVE, "twin": FLAG,
        "actor_rate": POSITIVE, "action_l2": NON_NEGATIVE,
    },
    sw.SAC: ACTOR_CRITIC | {
        "ent_coef": POSITIVE, "learn_ent_coef": FLAG, "target_entropy": or_none(ANY),
        "policy_delay": AT_LEAST_ONE,
    },
    sw.algorithms.Linear: {"start": NON_NEGATIVE, "end": NON_NEGATIVE},
    sw.algorithms.CNN: {
        "kind": word("plain", "impala"), "channels": WIDTHS, "kernels": WIDTHS, "strides": WIDTHS,
    },
    sw.algorithms.RNN: {"kind": word("lstm", "gru"), "size": whole(1, 65_536)},
    sw.Network: {
        "hidden": WIDTHS, "activation": word("tanh", "relu", "elu", "silu", "gelu"),
        "layer_norm": FLAG, "cnn": or_none(settings(sw.algorithms.CNN(), {"kind": "impala"})),
        "rnn": or_none(settings(sw.algorithms.RNN(), {"size": 4})),
        "encoder": or_none(Kind((5, True, None, [], NAN), ("cells",))),
        "sees": or_none(SEES),
        "planes": or_none(word("first", "last")),
    },
    sw.Part: SCALING | {
        "key": Kind((5, True, None, []), ("x",)), "places": PLACES, "one_hot": FLAG,
    },
    sw.Goal: SCALING | {"low": or_none(NUMBERS), "high": or_none(NUMBERS)},
    sw.LastAction: SCALING,
    sw.Acts: SCALING | {"to": PLACES, "rest": or_none(NUMBERS)},
    sw.Apart: {
        "skill_steps": or_none(AT_LEAST_ONE), "selector_steps": or_none(AT_LEAST_ONE),
        "start_calls": or_none(AT_LEAST_ONE), "search_steps": or_none(AT_LEAST_ONE),
        "episode_calls": AT_LEAST_ONE,
    },
    sw.Together: {
        "steps": or_none(AT_LEAST_ONE), "interrupt": FLAG, "task_weight": NON_NEGATIVE,
        "epsilon": FRACTION, "epsilon_final": FRACTION, "epsilon_fraction": FRACTION,
        "margin": NON_NEGATIVE, "reference_kl": or_none(POSITIVE), "quota": FRACTION,
    },
    sw.Selection: {
        "call_cost": NON_NEGATIVE, "greedy_skills": or_none(FLAG), "greedy_selector": or_none(FLAG),
        "target_return": or_none(ANY),
    },
    sw.Guide: {
        "selector": Kind((5, "x", True, None, []), (np.sign,)), "restrict": FLAG,
        "target_kl": or_none(POSITIVE),
    },
    sw.TrainDefaults: {
        "eval_every": or_none(AT_LEAST_ONE), "eval_episodes": AT_LEAST_ONE,
        "checkpoint_every": AT_LEAST_ONE, "keep": word("last", "best"),
        "log_info": INFO_KEYS,
        "log_calls": or_none(AT_LEAST_ONE),
        "log_calls_info": INFO_KEYS,
        "flat": or_none(ALGORITHM),
    },
    Range: {"low": ANY, "high": ANY, "scale": word("linear", "log")},
    Mutations: {
        **dict.fromkeys(("none", "hyperparameters", "parameters", "architecture", "activation"),
                        Kind(FRACTION.refused, ())),
        "ranges": or_none(Kind((5, "x", True, None, [], {"gamma": 3}, {5: Range(1, 2)}),
                               ({"gamma": Range(0.5, 0.9)}, {}))),
        "strength": NON_NEGATIVE, "share": FRACTION, "step": FRACTION, "layer_share": FRACTION,
        "layers": LIMITS, "units": LIMITS, "channels": LIMITS, "kernels": LIMITS,
        "activations": Kind((5, "x", None, (), ("x",), (1,)), (("tanh",), ["relu", "elu"])),
    },
    Tournament: {"size": AT_LEAST_ONE, "elitism": FLAG},
    Truncation: {"share": number(0, 0.5, zero=False)},
    Evolution: {
        "population": AT_LEAST_ONE, "generations": AT_LEAST_ONE, "episodes": AT_LEAST_ONE,
        "target": or_none(ANY), "start": word("config", "random"),
        "selection": Kind((5, "x", None, []), (Truncation(), Tournament(3))),
        "mutations": settings(Mutations()),
    },
    sw.workers.Ray: {
        "collectors": or_none(AT_LEAST_ONE),
        "address": or_none(Kind((5, True, None, []), ("auto",))), "cpus": POSITIVE,
        "patience": NON_NEGATIVE,
    },
    sw.EnvSpec: {
        "env": Kind((5, True, None, [], {}, gym.Env()), ("CartPole-v1", gym.Env)),
        "kwargs": Kind((5, "x", None, [], {5: 1}), ({"x": 1}, {})),
        "wrappers": Kind((5, "x", None, ("x",), (None,)), ((gym.Wrapper,), [gym.Wrapper])),
        "engine": word("auto", "envpool", "sync"), "workers": or_none(AT_LEAST_ONE),
        "pool": or_none(Kind((5, "x", None, []), (sw.envs.envpool,))),
        "obs_names": or_none(Kind((5, "x", None, [5], {"x": "y"}, {"x": [5]}),
                                  (["x", "y"], {"x": ["y"]}))),
        "check_seed": FLAG,
    },
    sw.Agent: {
        "env": ENV,
        "algorithm": ALGORITHM, "steps": AT_LEAST_ONE, "target_return": or_none(ANY),
        "target_success": or_none(SHARE), "train_defaults": settings(sw.TrainDefaults()),
    },
    sw.Hierarchy: {
        "env": ENV,
        "call_steps": or_none(Kind(AT_LEAST_ONE.refused, (*AT_LEAST_ONE.taken, sw.Lengths(1, 2)))),
        "steps": or_none(AT_LEAST_ONE), "learn": word("together", "apart", "apart, then together"),
        "algorithm": ALGORITHM, "selector": settings(sw.PPO(), np.sign),
        "apart": settings(sw.Apart()), "together": settings(sw.Together()),
        "selection": settings(sw.Selection()), "guide": or_none(Kind((5, "x", None, []), ())),
        "train_defaults": settings(sw.TrainDefaults()),
        "name": Kind((5, None, True, []), ("walk",)),
    },
}  # fmt: skip
"""By class and field, what is refused and what is taken."""
IN_PARTS = {sw.Hierarchy: {"skills", "reflexes", "predicates", "features", "rest"}}
"""Fields that have tests of their own."""


class Stay(sw.Skill):
    max_steps = 3


NEEDED: dict[type[Any], dict[str, Any]] = {
    sw.algorithms.Linear: {"start": 1.0, "end": 0.0},
    Range: {"low": 0.25, "high": 4.0, "scale": "linear"},
    sw.Guide: {"selector": np.sign, "target_kl": 0.1},
    sw.EnvSpec: {"env": "CartPole-v1"},
    sw.Agent: {"env": "CartPole-v1", "algorithm": sw.PPO(), "steps": 8},
    sw.Hierarchy: {"env": "CartPole-v1", "skills": [Stay()]},
}
"""Arguments without which a class cannot be made, or that let one field be changed alone."""
BESIDE: dict[tuple[type[Any], str], dict[str, Any]] = {
    (sw.DQN, "v_min"): {"v_max": 9.0},
    (sw.DQN, "v_max"): {"v_min": -9.0},
    (Range, "low"): {"high": 2.0},
    (sw.Hierarchy, "selector"): {"learn": "apart"},
}
"""Fields without which another field cannot be set."""


def make(kind: type[Any], name: str, value: Any) -> Any:
    """Return settings of which one field has a value."""
    return kind(**(NEEDED.get(kind, {}) | BESIDE.get((kind, name), {}) | {name: value}))


FIELDS = [(kind, name) for kind, table in TABLE.items() for name in table]


def ids(part: Any) -> str:
    return part.__name__ if isinstance(part, type) else str(part)


@pytest.mark.parametrize("kind", TABLE, ids=ids)
def test_the_table_has_every_field(kind):
    assert set(TABLE[kind]) | IN_PARTS.get(kind, set()) == {f.name for f in fields(kind) if f.init}


def test_the_table_has_every_public_class_of_settings():
    public = [getattr(import_module(m), name) for m, homes in HOMES.items() for name in homes]
    checked = {k for k in public if isinstance(k, type) and hasattr(k, "_checks_fields")}
    assert len(checked) > 20
    assert checked <= set(TABLE)


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=ids)
def test_a_wrong_value_is_named_with_its_class_and_field(kind, name):
    for value in TABLE[kind][name].refused:
        with pytest.raises(DeclarationError) as caught:
            make(kind, name, value)
        said = str(caught.value)
        assert said.startswith(f"{kind.__name__}.{name}"), (value, said)
        assert len(said) < 400, said


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=ids)
def test_a_right_value_is_kept_as_plain_python(kind, name):
    for value in TABLE[kind][name].taken:
        if value is None and BESIDE.get((kind, name)) and name.startswith("v_"):
            continue  # the other bound needs it
        found = getattr(make(kind, name, value), name)
        plain = value.item() if isinstance(value, np.generic) else value
        if isinstance(value, list | tuple):
            parts = [x.item() if isinstance(x, np.generic) else x for x in value]
            assert list(found) == parts
            assert [type(x) for x in found] == [type(x) for x in parts]
        elif not isinstance(value, dict) or name in ("ranges", "kwargs", "obs_names"):
            assert found == plain
            assert type(found) is type(plain)
        else:
            assert is_dataclass(found)


def test_a_changed_attribute_is_checked_before_training():
    for made in (make(sw.Agent, "steps", 8), make(sw.Hierarchy, "steps", 8)):
        made.steps = np.int64(9)
        made.validate()
        assert type(made.steps) is int
        made.steps = 2.5
        with pytest.raises(DeclarationError, match=rf"{type(made).__name__}\.steps is 2\.5; it"):
            made.validate()


@pytest.mark.parametrize("kind", [k for k in TABLE if issubclass(k, OnPolicy | OffPolicy)])
def test_a_file_is_held_against_the_same_checks(kind):
    if kind in (OnPolicy, OffPolicy, ActorCritic):
        return  # none is read from files
    data = config_to_json(kind())
    for name, field_kind in TABLE[kind].items():
        for value in field_kind.refused:
            if isinstance(value, type):
                continue
            with pytest.raises(RunError) as caught:
                config_from_json(data | {name: value}, "run.json", "stages[0].algorithm")
            said = str(caught.value)
            assert said.startswith("run.json"), value
            assert f"stages[0].algorithm.{name}" in said, value


SKILL = {
    "max_steps": or_none(AT_LEAST_ONE), "call_steps": or_none(AT_LEAST_ONE),
    "steps": or_none(AT_LEAST_ONE), "task_weight": or_none(NON_NEGATIVE),
    "target_return": or_none(ANY), "target_success": or_none(SHARE),
    "algorithm": or_none(ALGORITHM),
}  # fmt: skip
"""What the class attributes of a skill must be."""


@pytest.mark.parametrize("name", SKILL)
def test_a_skills_wrong_attribute_is_named_with_the_skill(name):
    for value in SKILL[name].refused:
        odd = type("Odd", (sw.Skill,), {name: value})()
        with pytest.raises(DeclarationError, match=rf"^skill 'odd'.*: {name} is "):
            sw.Hierarchy("CartPole-v1", [odd])
    for value in SKILL[name].taken:
        right = type("Right", (Stay,), {name: value, "success": Stay.termination})()
        sw.Hierarchy("CartPole-v1", [right])
        plain = value.item() if isinstance(value, np.generic) else value
        assert getattr(right, name) == plain
        assert type(getattr(right, name)) is type(plain)


# Messages


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: sw.PPO(gamma="x"), "PPO.gamma is 'x'; it must be a number, between 0 and 1"),
        (
            lambda: sw.PPO(target_kl=0),
            "PPO.target_kl is 0; it must be positive and finite, or None",
        ),
        (lambda: sw.PPO(compile=1), "PPO.compile is 1; it must be True, False or auto"),
        (lambda: sw.PPO(network=5), "PPO.network is 5; it must be Network()"),
        (
            lambda: sw.PPO(network={"hiden": [4]}),
            "PPO.network: Network has no setting 'hiden': is 'hidden' meant?",
        ),
        (
            lambda: sw.Network((8, 0)),
            "Network.hidden[1] is 0; it must be at least 1 and at most 65,536",
        ),
        (
            lambda: make(sw.Hierarchy, "apart", {"start_calls": 5}),
            "Hierarchy.apart is {'start_calls': 5}; it must be Apart() "
            "(write Apart(start_calls=5))",
        ),
        (
            lambda: make(sw.Hierarchy, "apart", {"start_call": 5}),
            "Hierarchy.apart is {'start_call': 5}; it must be Apart() "
            "(Apart has no setting 'start_call': is 'start_calls' meant?)",
        ),
    ],
)
def test_a_message_says_what_to_do(make, says):
    with pytest.raises(DeclarationError) as caught:
        make()
    assert str(caught.value) == says


# A user's own settings


@dataclass(frozen=True)
class Own(OnPolicy):
    """Settings of a user's algorithm: a field of its own, and one that it inherits."""

    n_steps: int = 5
    rows: int = 3
    mode: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = ()
    others: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Odd(OnPolicy):
    """A field whose type only a type checker knows."""

    share: Unknown | None = None


def test_the_fields_of_a_users_settings_are_checked_by_their_annotations():
    found: Any = Own(rows=np.int64(4), sizes=[1, 2], others={"x": np.float64(0.5)})
    assert (type(found.rows), found.sizes, found.others) == (int, (1, 2), {"x": 0.5})
    for name, value in (
        ("rows", 2.5), ("rows", None), ("mode", "c"), ("sizes", (1, "x")), ("others", {"x": "y"}),
        ("n_steps", 0),
    ):  # fmt: skip
        with pytest.raises(DeclarationError, match=rf"^Own\.{name}"):
            Own(**{name: value})


def test_a_type_that_only_a_type_checker_knows_does_no_harm():
    assert Odd(share=5).share == 5
    with pytest.raises(DeclarationError, match=r"Odd\.gamma is 2"):
        Odd(gamma=2)


# Kinds


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (list, [1, "x"]),
        (typing.List, [1, "x"]),  # noqa: UP006
        (typing.Tuple, (1, "x")),  # noqa: UP006
        (typing.Dict, {"x": 1}),  # noqa: UP006
        (typing.TypeVar("T"), object),
        (type[int], int),
        (Any, [np.int64(1)]),
        (gym.Env | None, None),
    ],
)
def test_a_kind_that_says_nothing_of_its_parts_takes_any(kind, value):
    assert fitted(kind, value, "x") is value


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (int, "a whole number"),
        (float, "a finite number"),
        (bool, "True or False"),
        (float | None, "a finite number or None"),
        (Literal["a", "b"], "one of a, b"),
        (bool | Literal["auto"] | None, "True, False, auto or None"),
        (tuple[int, ...], "a list, each entry a whole number"),
        (tuple[int, int], "a list of 2"),
        (list[Any], "a list"),
        (list, "a list"),
        (typing.List, "a list"),  # noqa: UP006
        (typing.Tuple, "a list"),  # noqa: UP006
        (typing.Dict, "a dict with texts as keys"),  # noqa: UP006
        (dict[str, int], "a dict with texts as keys"),
        (sw.PPO | sw.DQN, "PPO() or DQN()"),
        (Callable[[], int], "a function"),
    ],
)
def test_a_kind_is_described_in_words(kind, says):
    assert described(kind) == says
    with pytest.raises(DeclarationError, match=r"x is <object .*; it must be "):
        fitted(kind, object(), "x")
