"""An answer about an environment depends on that one alone; what else it depends on is said."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from torch import nn

import skillweave as sw
from skillweave._internal.notices import collected_notices
from skillweave.calls import Predicate
from skillweave.errors import PolicyError, SkillError, SkillweaveError
from skillweave.planning import GoalTask
from skillweave.skills import Skill, call_method
from skillweave.types import Step

DRAWS = np.random.default_rng(4)
TABLE: dict[bytes, float] = {}


def step_of(n: int, dtype: Any, low: int, high: int, seed: int) -> Step:
    """Steps with whole numbers from ``low`` to below ``high``, or with real ones."""
    rng, never = np.random.default_rng(seed), np.zeros(n, bool)
    obs, after = (rng.integers(low, high, (n, 4)).astype(dtype) for _ in range(2))
    if np.dtype(dtype).kind == "f":
        obs, after = (rng.normal(size=(n, 4)).astype(dtype) for _ in range(2))
    info = {"x": after[:, 0].copy(), "who": np.array(["a"] * n, object)}
    elapsed, action = np.arange(1, n + 1), np.zeros(n, np.int64)
    return Step(obs, action, after, np.ones(n, np.float32), never, never, never, elapsed, info)


def said(
    function: Callable[[Any], Any],
    *,
    method: str = "reward",
    n: int = 8,
    calls: int = 1,
    dtype: Any = np.float32,
    low: int = 0,
    high: int = 20,
) -> str:
    """Return the notice about a skill's method, or the error; empty: neither."""
    skill = type("It", (Skill,), {method: lambda self, about: function(about)})()
    with collected_notices() as notices:
        for seed in range(calls):
            step = step_of(n, dtype, low, high, seed)
            try:
                call_method(skill, method, step.obs if method == "initiation" else step)
            except SkillError as error:
                return f"error: {error}"
        return "".join(notices.take())


STATISTICS: dict[str, tuple[Callable[[Any], Any], dict[str, Any]]] = {
    "centred": (lambda s: s.next_obs[:, 0] - s.next_obs[:, 0].mean(), {}),
    "scaled": (lambda s: s.next_obs[:, 0] / np.abs(s.next_obs).max(), {}),
    "of info": (lambda s: s.info["x"] - s.info["x"].mean(), {}),
    "rank": (lambda s: np.argsort(np.argsort(s.next_obs[:, 0])), {}),
    "softmax": (lambda s: torch.softmax(torch.as_tensor(s.next_obs[:, 0].copy()), 0), {}),
    "order": (lambda s: np.diff(s.next_obs[:, 0], prepend=0.0), {}),
    "place": (lambda s: np.arange(len(s.obs)) % 2 == 0, {"method": "termination"}),
    "number": (lambda s: np.full(len(s.obs), len(s.obs)), {}),
    "the mean": (lambda s: np.full(len(s.obs), s.next_obs.mean()), {}),
    "median": (lambda obs: obs[:, 0] >= np.median(obs[:, 0]), {"method": "initiation"}),
    "best": (lambda s: s.next_obs[:, 0] == s.next_obs[:, 0].max(), {"method": "success"}),
    "not the worst": (lambda s: s.obs[:, 0] != s.obs[:, 0].min(), {"method": "termination"}),
    "of two": (
        lambda obs: obs[:, 0] >= obs[:, 0].mean(),
        {"method": "initiation", "n": 2, "calls": 4},
    ),
    "upper tenth": (
        lambda s: s.next_obs[:, 0] > np.quantile(s.next_obs[:, 0], 0.9),
        {"method": "termination", "n": 64},
    ),
}


@pytest.mark.parametrize("name", STATISTICS)
def test_an_answer_that_depends_on_other_environments_is_refused(name):
    function, how = STATISTICS[name]
    assert "its answer depends on the others" in said(function, **how)


BYTES: dict[str, Any] = {"dtype": np.uint8}
WRAPS: dict[str, tuple[Callable[[Any], Any], dict[str, Any]]] = {
    "a difference": (lambda s: s.obs[:, 0] - s.next_obs[:, 0], BYTES),
    "times a float": (lambda s: 0.1 * (s.obs[:, 0] - s.next_obs[:, 0]), BYTES),
    "where to start": (lambda obs: obs[:, 0] - obs[:, 1] > 3, BYTES | {"method": "initiation"}),
    "with one environment, later": (
        lambda obs: obs[:, 0] - obs[:, 1] > 3,
        BYTES | {"method": "initiation", "n": 1, "calls": 256},
    ),
    "negative": (lambda s: -s.obs[:, 0], BYTES),
    "of sums": (lambda s: s.obs.sum(1) - s.next_obs.sum(1) > 0, BYTES | {"method": "success"}),
    "double": (lambda s: s.obs[:, 0] * 2, BYTES | {"high": 256}),
    "product": (lambda s: s.obs[:, 0] * s.obs[:, 1], {"dtype": np.int8, "low": -99, "high": 99}),
    "sum": (lambda s: s.obs[:, 0] + s.obs[:, 1], {"dtype": np.int16, "low": 2**14, "high": 2**15}),
}


@pytest.mark.parametrize("name", WRAPS)
def test_numbers_that_wrap_around_are_said(name):
    function, how = WRAPS[name]
    assert "wraps around" in said(function, **how)


def compares(step: Step) -> Any:
    """Get rows of the environment alone, of observations and of info."""
    assert (step.info["x"] == step.next_obs[:, 0]).all()
    return step.reward


FINE: dict[str, tuple[Callable[[Any], Any], dict[str, Any]]] = {
    "norm": (lambda s: np.linalg.norm(s.next_obs - 1, axis=1), {"n": 2048}),
    "tiny numbers": (lambda s: np.exp(-((s.next_obs**2).sum(1)) * 100), {}),
    "chance": (lambda s: np.random.rand(len(s.obs)), {}),  # noqa: NPY002
    "a generator of the module": (lambda s: DRAWS.random(len(s.obs)), {}),
    "a list": (lambda s: [float(x[0]) for x in s.next_obs], {}),
    "any": (lambda s: (s.obs[:, 0] > 1) * 1.0 if (s.obs[:, 0] > 1).any() else s.reward * 0, {}),
    "observations and info": (lambda s: (s.info["x"] == s.next_obs[:, 0]).all() * s.reward, {}),
    "asserts": (compares, {}),
    "objects in info": (lambda s: (s.info["who"] == "a") * 1.0, {}),
    "bytes as floats": (lambda s: s.obs[:, 0].astype(float) - s.next_obs[:, 0], BYTES),
    "bytes compared": (lambda s: s.obs[:, 0] > 3, BYTES | {"method": "success"}),
    "bytes that fit": (lambda s: s.obs[:, 0] * 3 + s.obs[:, 1], BYTES | {"high": 3}),
    "meant to wrap": (lambda s: (s.obs[:, 0] - s.next_obs[:, 0]).astype(np.int8), BYTES),
    "keys of a table": (lambda s: [TABLE.get(x.tobytes(), 0.5) for x in s.obs], BYTES),
    "bits": (lambda s: np.unpackbits(s.next_obs, axis=1)[:, 0], BYTES),
    "scaled by type": (lambda s: s.obs[:, 0] / np.iinfo(s.obs.dtype).max, BYTES),
    "roots": (lambda s: np.sqrt(s.obs[:, 0]) * 3.3, BYTES),
}


@pytest.mark.parametrize("name", FINE)
def test_nothing_is_said_about_a_function_of_each_environment_alone(name):
    function, how = FINE[name]
    for n in (how.get("n", 8), 1):
        assert said(function, calls=20, **how | {"n": n}) == ""


def test_a_look_makes_two_calls_at_calls_that_become_rare():
    sizes: list[int] = []
    seen: list[int] = []

    def reward(step: Step) -> Any:
        sizes.append(len(step.reward))
        return step.next_obs[:, 0]

    skill = type("It", (Skill,), {"reward": lambda self, step: reward(step)})()
    for seed in range(20):
        call_method(skill, "reward", step_of(8, np.uint8, 0, 9, seed))
        seen.append(len(sizes))
    assert np.diff([0, *seen]).tolist() == [3 if i in (1, 4, 16) else 1 for i in range(1, 21)]


def test_predicates_and_goals_are_looked_at():
    obs = step_of(8, np.float32, 0, 1, 0).obs
    above = Predicate(lambda obs: obs[:, 0] > obs[:, 0].mean())
    with pytest.raises(SkillError, match="depends on the others"):
        (~above).at(obs)
    near = GoalTask(lambda obs, goal: (obs[:, :2] - goal)[:, 0] > obs[:, 0].mean(), goal=[0, 0])
    with pytest.raises(SkillError, match="depends on the others"):
        near.holds(obs, np.zeros((8, 2)))
    fine = GoalTask(lambda obs, goal: np.hypot(*(obs[:, :2] - goal).T) < 1, goal=[0, 3])
    square = obs[:2]  # as many environments as the goal has numbers
    for goal in (np.array([0.0, 3.0]), np.array([[0.0, 3.0], [5.0, 5.0]])):
        assert fine.holds(square, goal).shape == (2,)


# Models -----------------------------------------------------------------------------------------

SPACES = Box(-1, 1, (3,)), Discrete(4)


class Net(nn.Module):
    """A layer behind a function of the observations."""

    def __init__(self, function: Callable[[Any, Any], Any]) -> None:
        super().__init__()
        self.layer, self.function = nn.Linear(3, 4), function

    def forward(self, x):
        return self.function(self, self.layer(x))


def keeps(net: Any, x: Any) -> Any:
    net.h = x if getattr(net, "h", None) is None or len(net.h) != len(x) else 0.5 * net.h + x
    return net.h


def largest(net: Any, x: Any) -> Any:
    net.most = torch.maximum(getattr(net, "most", torch.zeros(4)), x.amax(0))
    return x - net.most


def counts(net: Any, x: Any) -> Any:
    net.calls = getattr(net, "calls", 0) + 1
    return x * net.calls


def caches(net: Any, x: Any) -> Any:
    net.features = x.detach()
    return x


MODELS: dict[str, tuple[Callable[[Any, Any], Any], str]] = {
    "centred": (lambda net, x: x - x.mean(0), "the same one beside other observations"),
    "largest": (lambda net, x: x / x.abs().max(), "the same one beside other observations"),
    "best action": (lambda net, x: (x - x.mean(0)).argmax(1), "beside other observations"),
    "state": (keeps, "a hidden state, 'h', which .*state="),
    "counter": (counts, "keeps a hidden state, an attribute"),
    "running maximum": (largest, "a hidden state, 'most'"),
    "buffer of one": (
        lambda net, x: net.layer.bias.data.mul_(0) + net.h.add_(x),
        "a hidden state, 'h', .*state=",
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_outputs_that_depend_on_more_than_the_observation_are_refused(name):
    function, says = MODELS[name]
    torch.manual_seed(0)  # with few weights the first row of examples is the largest
    net = Net(function)
    if name == "buffer of one":
        net.register_buffer("h", torch.zeros(1, 4))
    with pytest.raises(PolicyError, match=says):
        sw.from_torch(net).bind(*SPACES, "it").try_out()


def test_random_numbers_of_a_module_are_said_unless_it_samples_actions():
    def notices_of(function: Callable[[Any, Any], Any]) -> list[str]:
        with collected_notices() as notices:
            sw.from_torch(Net(function)).bind(*SPACES, "it").try_out()
            return notices.take()

    (text,) = notices_of(lambda net, x: nn.functional.dropout(x, 0.5))
    assert "draws random numbers (dropout" in text
    sample = lambda net, x: torch.distributions.Categorical(logits=x).sample()  # noqa: E731
    for fine in (sample, caches, lambda net, x: x, lambda net, x: x.argmax(1)):
        assert notices_of(fine) == []


def test_what_a_module_keeps_is_not_changed_by_looks():
    net = Net(caches).train()
    before = torch.random.get_rng_state()
    sw.from_torch(net).bind(*SPACES, "it").try_out()
    assert not hasattr(net, "features")
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize(
    ("last", "says"),
    [(nn.Softmax(-1), True), (nn.LogSoftmax(-1), False), (nn.Identity(), False)],
)
def test_probabilities_that_are_sampled_as_logits_are_said(last, says):
    policy = sw.from_torch(nn.Sequential(nn.Linear(3, 4), last)).bind(*SPACES, "it")
    with collected_notices() as notices:
        policy.try_out()
        policy.act({}, np.zeros((2, 3), np.float32))
        assert notices.take() == []
        for _ in range(2):
            policy.act({}, np.zeros((2, 3), np.float32), deterministic=False)
        assert ["LogSoftmax" in text for text in notices.take()] == [True] * says


def test_forbidden_choices_are_said_once():
    mask = np.array([[True, False, True, True]] * 3)
    for function, count in (
        (lambda obs: np.minimum(obs[:, 0].astype(int), 1), 1),
        (lambda obs: 2 * np.minimum(obs[:, 0].astype(int), 1), 0),
    ):
        policy = sw.from_function(function).bind(*SPACES, "skill 'it'")
        with collected_notices() as notices:
            for _ in range(3):
                policy.act({}, np.array([[0, 0, 0], [1, 0, 0], [1, 0, 0]], np.float32), mask)
            texts = notices.take()
        assert len(texts) == count
        assert all("'it'" in t and "action 1," in t and "2 of 3" in t for t in texts)
    with collected_notices() as notices:
        logits = sw.from_torch(nn.Linear(3, 4)).bind(*SPACES, "it")
        logits.act({}, np.eye(3, dtype=np.float32), mask)
        assert notices.take() == []


def test_a_model_whose_predict_takes_the_mask_gets_it():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    env = gym.make("CartPole-v1")
    policy = sw.from_sb3(PPO("MlpPolicy", env, n_steps=64, device="cpu"))
    bound: Any = policy.bind(env.observation_space, env.action_space, "it")
    given: list[Any] = []

    def predict(obs, deterministic=False, action_masks=None):
        given.append(action_masks)
        return action_masks.argmax(1), None

    bound.module.predict = predict
    mask = np.array([[False, True], [True, False]])
    assert bound.act({}, np.zeros((2, 4), np.float32), mask)[0].tolist() == [1, 0]
    assert given[0] is mask


def test_evaluate_takes_what_a_skill_takes_or_says_how_it_acts():
    module = nn.Linear(4, 2)
    score = sw.evaluate(module, "CartPole-v1", episodes=2)
    assert score.returns == sw.evaluate(sw.from_torch(module), "CartPole-v1", episodes=2).returns
    assert sw.evaluate(lambda obs: np.zeros(len(obs), int), "CartPole-v1", episodes=2).mean < 15
    for wrong, says in (("net.zip", r"from_sb3\('net.zip'"), (nn.Linear, "class"), (3, "act")):
        with pytest.raises(SkillweaveError, match=rf"evaluate\(\): policy is .*{says}"):
            sw.evaluate(wrong, "CartPole-v1", episodes=2)
