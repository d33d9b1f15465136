"""Each field of each settings class refuses what its annotation does not allow, by its name.

Values outside are drawn from the annotations: numbers beside the bounds that a check states in
words, and values of other kinds. What an annotation allows is decided by ``takes``, beside the
library's own ``fitted``.
"""

from __future__ import annotations

import random
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib import import_module
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import gymnasium as gym
import numpy as np
import pytest
from installed import HOMES

import skillweave as sw
from skillweave.algorithms import OnPolicy
from skillweave.algorithms.config import (
    ActorCritic,
    OffPolicy,
    SkillCritic,
    config_from_json,
    config_to_json,
)
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution import Evolution, Mutations, Range, Tournament
from skillweave.schema import (
    Amount,
    AtLeastOne,
    Check,
    Count,
    Fraction,
    NonNegative,
    Positive,
    Share,
    Threads,
    annotations_of,
    described,
    fitted,
)

if TYPE_CHECKING:
    from fractions import Fraction as Unknown

NAN, INF = float("nan"), float("inf")


class Stay(sw.Skill):
    max_steps = 3


PUBLIC = [getattr(import_module(m), name) for m, homes in HOMES.items() for name in homes]
CHECKED = [k for k in PUBLIC if isinstance(k, type) and hasattr(k, "_checks_fields")]
NEEDED: dict[type[Any], dict[str, Any]] = {
    sw.algorithms.Linear: {"start": 1.0, "end": 0.0},
    Range: {"low": 0.25, "high": 4.0, "scale": "linear"},
    sw.Guide: {"selector": np.sign, "target_kl": 0.1},
    sw.EnvSpec: {"env": "CartPole-v1"},
    sw.Table: {"file": [[1.0, 2.0, 3.0]]},
    sw.Agent: {"env": "CartPole-v1", "algorithm": sw.PPO(), "steps": 8},
    sw.Hierarchy: {"env": "CartPole-v1", "skills": [Stay()]},
}
"""Arguments without which a class cannot be made."""
KINDS = list(dict.fromkeys([*CHECKED, *NEEDED, OffPolicy, ActorCritic, SkillCritic, Mutations]))
OWN_TESTS = {"skills", "reflexes", "predicates", "features", "rest", "file"}
"""Fields of a hierarchy, or of a table, that have tests of their own."""
FIELDS = [
    (kind, f.name)
    for kind in KINDS
    for f in fields(kind)
    if f.init and not (kind in (sw.Hierarchy, sw.Table) and f.name in OWN_TESTS)
]

ODD: tuple[Any, ...] = (
    *(True, False, 0, 1, 5, -1, 0.5, 2.5, 8.0, -1.0, NAN, INF, -INF, 1e39, 2**63, 10**400),
    *("x", "", b"x", None, [], [1], ["x", 5], (), {}, {"x": 1}, {5: 1}, object(), gym.Env()),
)
"""Values of all kinds."""
_NUMBERS: tuple[Any, ...] = (True, "x", {}, NAN, INF, [], [NAN], [[0.5]], 10**400)
_PLACES: tuple[Any, ...] = (
    *(0.5, "x", "1:y", True, [], [-1], [0.5], [[0]], {}, slice(0.5), range(0), np.array(0.5)),
)
_SEES: tuple[Any, ...] = (
    *(1.5, -1, True, "", (), (1, 1), (0, -1), (0, True), (0, None), range(0), np.array([0.5])),
    *(slice(0, None), slice(-2, 3), slice(0, 0), {"x": 1}),
)
_LIMITS: tuple[Any, ...] = ((1,), (1, 2, 3), (0, 2), (True, 2), (1, 2.5), (3, 2))
BY_RULE: dict[tuple[Any, str], tuple[Any, ...]] = {
    (sw.Network, "sees"): _SEES,
    **{(sw.Part, name): _NUMBERS for name in ("scale", "offset")},
    **{(sw.Goal, name): _NUMBERS for name in ("low", "high")},
    (sw.Acts, "rest"): _NUMBERS,
    (sw.LastAction, "clip"): (5, "x", True, [], (1.0,), (1.0, -1.0), (0.0, INF)),
    (sw.Part, "places"): _PLACES,
    (sw.Acts, "to"): _PLACES,
    (sw.Table, "columns"): _PLACES,
    (sw.Elapsed, "first"): _NUMBERS,
    **{(Mutations, name): _LIMITS for name in ("layers", "units", "channels", "kernels")},
    (Mutations, "ranges"): (5, "x", True, [], {"gamma": 3}, {5: Range(1, 2)}),
    (Evolution, "selection"): (5, "x", None, []),
    (sw.PPO, "learning_rate"): (0, -1.0, (1, 2), {"start": 1}, {"start": 1, "end": -1}),
    (sw.PPO, "network"): (sw.Network,),
    (sw.SAC, "hindsight"): ("future", 4, None, {"n_sampled_goal": 0}),
    (sw.Hierarchy, "algorithm"): (sw.PPO,),
    (sw.EnvSpec, "obs_names"): ([5], {"x": "y"}, {"x": [5]}),
}
"""Wrong values of fields whose rule is a function, or stands beside the annotation."""
UNBOUNDED = {
    *((sw.DQN, "v_min"), (sw.DQN, "v_max"), (sw.CQL, "v_min"), (sw.CQL, "v_max")),
    *((Range, "low"), (Range, "high")),
    *((sw.SAC, "target_entropy"), (Evolution, "target")),
    *((sw.Selection, "target_return"), (sw.Agent, "target_return"), (sw.Table, "start")),
}
"""Numbers that may be any."""
BESIDE: dict[tuple[type[Any], str], dict[str, Any]] = {
    (sw.DQN, "v_min"): {"v_max": 9.0},
    (sw.DQN, "v_max"): {"v_min": -9.0},
    (sw.CQL, "v_min"): {"v_max": 9.0},
    (sw.CQL, "v_max"): {"v_min": -9.0},
    (sw.Hierarchy, "selector"): {"learn": "apart"},
    (sw.Elapsed, "wave"): {"period": 4.0},
}
"""Fields without which another field cannot be set."""


def make(kind: type[Any], name: str, value: Any) -> Any:
    """Return settings of which one field has a value."""
    return kind(**(NEEDED.get(kind, {}) | BESIDE.get((kind, name), {}) | {name: value}))


def ids(part: Any) -> str:
    return part.__name__ if isinstance(part, type) else str(part)


def notes(kind: Any) -> list[Check]:
    """The checks of an annotation, not of those inside."""
    return [x for x in get_args(kind)[1:] if isinstance(x, Check)] if is_annotated(kind) else []


def is_annotated(kind: Any) -> bool:
    return get_origin(kind) is Annotated


def inside(kind: Any) -> tuple[Any, ...]:
    """The annotation's own kind, and all that it is made of."""
    return (kind, *(x for part in get_args(kind) for x in inside(part)))


def bounds(kind: Any) -> list[tuple[float, int, bool]]:
    """The bounds that checks of numbers state in words.

    Returns:
        Of each: the number, on which side of it values are wrong, and whether it is itself right.
    """
    found = []
    for text in (check.text for part in inside(kind) for check in notes(part)):
        for words, number in re.findall(r"(at least|at most|more than) ([\d,.]*\d)", text):
            found.append(
                (float(number.replace(",", "")), 1 if words == "at most" else -1, "at" in words)
            )
        if text == "positive and finite":
            found.append((0.0, -1, False))
        if text == "between 0 and 1":
            found += [(0.0, -1, True), (1.0, 1, True)]
    return found


def takes(kind: Any, value: Any) -> bool:
    """Whether an annotation allows a value. True where it cannot be told."""
    if is_annotated(kind):
        try:
            for check in notes(kind):
                value = check.convert(value)
            return takes(get_args(kind)[0], value) and all(c.holds(value) for c in notes(kind))
        except (TypeError, ValueError, IndexError, OverflowError, DeclarationError):
            return False
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(takes(option, value) for option in inner)
    if kind in (int, float):
        number = type(value) in (int, kind)
        return number and abs(value) < (2**63 if type(value) is int else 3.4e38)
    if kind in (bool, str, NoneType):
        return type(value) is kind
    if origin is Literal:
        return any(type(value) is type(word) and value == word for word in inner)
    if origin in (list, tuple, Sequence):
        same = isinstance(value, list | tuple)
        several = origin is not tuple or Ellipsis in inner
        each = [inner[0]] * len(value) if same and several else inner
        return same and len(each) == len(value) and all(map(takes, each, value))
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(takes(inner[0], k) for k in value)
    if kind is Any:
        return True
    if origin is not None or not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return callable(value) or "Callable" not in str(kind)
    return isinstance(value, kind) or (is_dataclass(kind) and value == {})


def outside(kind: type[Any], name: str) -> list[Any]:
    """Values that a field does not allow."""
    hint, found = annotations_of(kind)[name], list(BY_RULE.get((kind, name), ()))
    beside = [b + side * step for b, side, _ in bounds(hint) for step in (1, 0.5, 1e-9 * (1 + b))]
    edges = [b for b, _, right in bounds(hint) if not right]
    numbers = [int(x) if x == int(x) else x for x in (*beside, *edges)]
    if any(get_origin(part) is tuple for part in inside(hint)):
        numbers = [(8, x) for x in numbers]
    return found + [x for x in (*ODD, *numbers) if not takes(hint, x)]


def test_every_public_class_of_settings_is_tested():
    assert len(CHECKED) > 20
    assert {name for _, name in FIELDS} >= {"gamma", "hidden", "places", "start_calls", "learn"}


def test_every_number_has_bounds_but_those_that_may_be_any():
    for kind, name in FIELDS:
        hint = annotations_of(kind)[name]
        if any(part in (int, float) for part in inside(hint)) and not bounds(hint):
            assert (kind, name) in UNBOUNDED, (kind, name, hint)


RANGES: dict[Any, str] = {
    Fraction: (
        "action_repeat activation architecture epsilon epsilon_final epsilon_fraction expectile "
        "exploration_final_eps exploration_fraction exploration_initial_eps gae_lambda gamma "
        "hyperparameters layer_share none online parameters priority_alpha priority_beta quota "
        "share shared_replay step tau"
    ),
    Share: ("target_success"),
    Positive: (
        "action_std_init actor_rate adam_eps clip_coef clip_value cpus ent_coef max_grad_norm "
        "period rate reference_kl target_kl update_ratio"
    ),
    NonNegative: (
        "action_l2 beta cql_alpha deliberation_cost end ent_coef ent_coef_final exploration_noise "
        "imitation_coef imitation_vf_coef margin min_advantage_std patience start strength "
        "target_noise target_noise_clip task_weight vf_coef"
    ),
    AtLeastOne: (
        "batch_size checkpoint_every collectors episode_calls episodes eval_episodes "
        "eval_every generations log_calls n_sampled_goal policy_delay population search_steps "
        "selector_steps size skill_steps start_calls steps target_update_interval train_freq"
    ),
    Count: ("learning_starts ramp"),
    Amount: (
        "action_repeat_steps batch_size imitation_steps n_step n_steps num_envs update_epochs"
    ),
    Threads: ("threads workers"),
    bool: (
        "check_seed compile deciding distributional double dueling elitism greedy_selector "
        "greedy_skills interrupt layer_norm learn_ent_coef noisy normalize_advantage "
        "normalize_obs normalize_returns normalize_rewards one_hot overlap prioritized "
        "restrict save_buffer sees_goals squash_actions twin"
    ),
}
"""The names of fields by what they hold, so that one kind is not taken for another."""
WORDS: dict[str, set[tuple[str, ...]]] = {
    "action_std": {("parameter", "state")},
    "activation": {("tanh", "relu", "elu", "silu", "gelu")},
    "compile": {("auto",)},
    "device": {("cpu", "cuda", "auto")},
    "engine": {("auto", "envpool", "sync")},
    "fill": {("first", "zeros")},
    "goal_selection_strategy": {("future", "final", "episode")},
    "keep": {("last", "best")},
    "kind": {("lstm", "gru"), ("plain", "impala")},
    "layout": {("term", "step")},
    "learn": {("together", "apart", "apart, then together")},
    "learning_rate_schedule": {("constant", "linear"), ("constant", "linear", "kl")},
    "loss": {("huber", "mse")},
    "order": {("oldest", "newest")},
    "planes": {("first", "last")},
    "scale": {("linear", "log", "complement")},
    "start": {("config", "random")},
    "wave": {("sin", "cos")},
}
"""The words that fields take, by name; PPO has one more schedule than the others."""


def options_of(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def named(holds: Callable[[Any], bool]) -> set[str]:
    """The names of fields of which one option holds."""
    return {
        name for kind, name in FIELDS if any(map(holds, options_of(annotations_of(kind)[name])))
    }


@pytest.mark.parametrize("kind", RANGES, ids=described)
def test_a_field_holds_what_its_name_says(kind):
    assert named(lambda option: option == kind) == set(RANGES[kind].split())


@pytest.mark.parametrize("name", WORDS)
def test_a_field_takes_these_words(name):
    hints = [option for k, n in FIELDS if n == name for option in options_of(annotations_of(k)[n])]
    assert {get_args(x) for x in hints if get_origin(x) is Literal} == WORDS[name]
    assert named(lambda option: get_origin(option) is Literal) == set(WORDS)


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=ids)
def test_a_value_outside_is_named_with_its_class_and_field(kind, name):
    for value in outside(kind, name):
        with pytest.raises(DeclarationError) as caught:
            make(kind, name, value)
        said = str(caught.value)
        assert said.startswith(f"{kind.__name__}.{name}"), (value, said)
        assert len(said) < 400, said


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=ids)
def test_values_at_the_bounds_are_kept_as_plain_python(kind, name):
    hint = annotations_of(kind)[name]
    if any(get_origin(part) is tuple for part in inside(hint)):
        return
    for number in (b for b, _, right in bounds(hint) if right):
        whole = int in inside(hint)
        given = np.int64(number) if whole else np.float64(number)
        kept = fitted(hint, given, name)
        assert (kept, type(kept)) == (number, int if whole else float)


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=ids)
def test_a_default_is_kept_as_plain_python_where_it_is_numpys(kind, name):
    of = next(f for f in fields(kind) if f.name == name)
    if of.default is MISSING or (kind, name) in BESIDE:
        return
    given = of.default
    if isinstance(given, bool | int | float | str):
        given = np.asarray(given)[()]
    elif isinstance(given, tuple):
        given = [np.asarray(x)[()] for x in given]
    kept = getattr(make(kind, name, given), name)
    assert kept == of.default
    assert type(kept) is type(of.default)
    if isinstance(kept, tuple):
        assert list(map(type, kept)) == list(map(type, of.default))


TAKEN: dict[tuple[type[Any], str], tuple[Any, ...]] = {
    (sw.Network, "sees"): ((0, 1, 4), [0, 1, 4], ("x", 1, "y.z")),
    (sw.Network, "cnn"): (sw.algorithms.CNN(), {"kind": "impala"}),
    (sw.Network, "encoder"): ("cells",),
    (sw.Part, "scale"): (0.5, [0.5, 1.0]),
    (sw.Part, "places"): ([0, 2], slice(0, 3)),
    (sw.Part, "clip"): ([-1.0, 1.0],),
    (sw.PPO, "learning_rate"): (1, sw.algorithms.Linear(1e-3, 0), {"start": 1e-3, "end": 0.0}),
    (sw.PPO, "compile"): (True, "auto"),
    (Mutations, "ranges"): ({"gamma": Range(0.5, 0.9)}, {}),
    (Mutations, "units"): ((1, 2), [np.int64(1), 2]),
    (Mutations, "activations"): (["relu", "elu"],),
    (Evolution, "selection"): (Tournament(3),),
    (sw.Hierarchy, "call_steps"): (sw.Lengths(1, 2), 5),
    (sw.Hierarchy, "selector"): (sw.PPO(), np.sign),
    (sw.Hierarchy, "env"): (sw.EnvSpec("CartPole-v1"),),
    (sw.EnvSpec, "env"): (gym.Env,),
    (sw.EnvSpec, "kwargs"): ({"x": 1},),
    (sw.EnvSpec, "wrappers"): ([gym.Wrapper],),
    (sw.EnvSpec, "pool"): (sw.envs.envpool,),
    (sw.EnvSpec, "obs_names"): (["x", "y"], {"x": ["y"]}),
    (sw.TrainDefaults, "log_info"): (["x"], ("x", "y"), []),
}


@pytest.mark.parametrize(("kind", "name"), TAKEN, ids=ids)
def test_unusual_right_values_are_taken(kind, name):
    for value in TAKEN[kind, name]:
        kept = getattr(make(kind, name, value), name)
        if isinstance(value, dict) and is_dataclass(kept):
            assert all(getattr(kept, key) == given for key, given in value.items())
        else:
            assert list(kept) == list(value) if isinstance(value, list) else kept == value


def test_a_changed_attribute_is_checked_before_training():
    for made in (make(sw.Agent, "steps", 8), make(sw.Hierarchy, "steps", 8)):
        made.steps = np.int64(9)
        made.validate()
        assert type(made.steps) is int
        made.steps = 2.5
        with pytest.raises(DeclarationError, match=rf"{type(made).__name__}\.steps is 2\.5; it"):
            made.validate()


@pytest.mark.parametrize(
    "kind", [sw.PPO, sw.algorithms.SelfImitationPPO, SkillCritic, sw.DQN, sw.TD3, sw.SAC]
)
def test_a_file_is_held_against_the_same_checks(kind):
    data = config_to_json(kind())
    for name in (name for k, name in FIELDS if k is kind):
        values = [x for x in outside(kind, name) if not isinstance(x, type)]
        for value in random.Random(name).sample(values, 5):
            with pytest.raises(RunError) as caught:
                config_from_json(data | {name: value}, "run.json", "stages[0].algorithm")
            said = str(caught.value)
            assert said.startswith("run.json"), value
            assert f"stages[0].algorithm.{name}" in said, value


OF_SKILLS = (
    *("max_steps", "call_steps", "steps", "task_weight", "target_return", "target_success"),
    "algorithm",
)


@pytest.mark.parametrize("name", OF_SKILLS)
def test_a_skills_wrong_attribute_is_named_with_the_skill(name):
    for value in outside(sw.Skill, name):
        odd = type("Odd", (sw.Skill,), {name: value})()
        with pytest.raises(DeclarationError, match=rf"^skill 'odd'.*: {name} is "):
            sw.Hierarchy("CartPole-v1", [odd])
    for value in (sw.PPO(), None) if name == "algorithm" else (np.float64(1), np.int64(1), None):
        if name.endswith("steps") and isinstance(value, float):
            continue
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
