"""Action masks where people keep them: in info, in the observation, in ``action_masks()``."""

import re

import gymnasium as gym
import numpy as np
import pytest
from timed import SMALL

import skillweave as sw
from skillweave.errors import DeclarationError, EnvError
from skillweave.export.runner import Runner

ILLEGAL: list[int] = []
"""Forbidden actions that were taken."""


class Slots(gym.Env):
    """Each step a few of six slots are free; whoever takes another is written down."""

    def __init__(self, where: str, several: bool = False) -> None:
        self.where, self.several = where, several
        self.action_space = gym.spaces.MultiDiscrete([6, 6]) if several else gym.spaces.Discrete(6)
        self.size = 12 if several else 6
        board = gym.spaces.Box(0, 1, (self.size,), np.int8)
        if where == "observation":
            self.observation_space = gym.spaces.Dict(action_mask=board, observation=board)
        else:
            self.observation_space = board
        if where == "method":
            self.action_masks = lambda: self.free.astype(bool)
        if where == "another method":
            self.get_action_mask = lambda: self.free.astype(bool)

    def deal(self):
        self.free = np.zeros(self.size, np.int8)
        for first in range(0, self.size, 6):
            self.free[first + self.np_random.choice(6, 2, replace=False)] = 1
        info = {}
        if self.where == "info":
            info["action_mask"] = self.free.copy()
        if self.where == "another key":
            info["legal_actions"] = np.flatnonzero(self.free)
        board = np.zeros(self.size, np.int8)
        if self.where == "observation":
            return {"observation": board, "action_mask": self.free.copy()}, info
        return board, info

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.deal()

    def step(self, action):
        self.t += 1
        chosen = np.atleast_1d(action) + np.arange(0, self.size, 6)
        ILLEGAL.extend(int(a) for a in chosen if not self.free[a])
        obs, info = self.deal()
        return obs, 1.0, False, self.t == 10, info


class Any(sw.Skill):
    max_steps = 3

    def reward(self, step):
        return np.ones(len(step.reward))


def spec(where, several=False) -> sw.EnvSpec:
    return sw.EnvSpec(lambda: Slots(where, several), workers=1)


@pytest.mark.parametrize("several", [False, True], ids=["discrete", "multidiscrete"])
@pytest.mark.parametrize("where", ["info", "observation", "method"])
def test_a_mask_is_used_wherever_it_is(where, several):
    ILLEGAL.clear()
    hierarchy = sw.Hierarchy(
        spec(where, several), [Any()], steps=256, algorithm=SMALL, selector=SMALL
    )
    run = hierarchy.train(quiet=True)
    run.evaluate(5, deterministic=False)
    env, player = Slots(where, several), run.player(deterministic=False)
    obs, info = env.reset(seed=1)
    player.reset()
    for _ in range(20):
        if where == "method":
            action = player.act(obs, mask=env.action_masks())
        else:
            action = player.act(obs, info=info)
        obs, *_, info = env.step(action)
    assert not ILLEGAL


@pytest.mark.slow
def test_an_export_reads_the_mask_of_the_observation(tmp_path):
    pytest.importorskip("onnx", reason="onnx is not installed")
    run = sw.train_agent(spec("observation"), SMALL, 256, tmp_path / "run", quiet=True)
    export = run.export(tmp_path / "export")
    runner = Runner(export.path)
    env = Slots("observation")
    ILLEGAL.clear()
    obs, _ = env.reset(seed=3)
    for _ in range(20):
        obs, *_ = env.step(runner.act(obs))
    assert not ILLEGAL


@pytest.mark.parametrize(
    ("where", "says"),
    [("another key", r"info\['legal_actions'\]"), ("another method", "its get_action_mask")],
)
def test_what_looks_like_a_mask_and_is_not_used_is_said_once(where, says, capsys):
    sw.train_agent(spec(where), SMALL, 256)
    said = capsys.readouterr().err
    assert re.search(f"{says} looks like an action mask", said)
    assert said.count("looks like an action mask") == 1


class Own(Slots):
    """Gives masks in its own way."""

    def __init__(self, mask, action_space=None):
        super().__init__("none")
        self.mask, self.over = mask, False
        self.action_space = action_space or self.action_space

    def reset(self, *, seed=None, options=None):
        self.over = False
        return super().reset(seed=seed)

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.over = truncated
        return obs, reward, terminated, truncated, info


class Told(Own):
    def deal(self):
        obs, info = super().deal()
        return obs, info | {"action_mask": self.mask(self)}


class Asked(Own):
    def action_masks(self):
        assert not self.over, "the episode is over"
        return self.mask(self)


MASKS = {
    "a list": lambda env: [int(x) for x in env.free],
    "bool": lambda env: env.free.astype(bool),
    "a column": lambda env: env.free[:, None],
    "None, for all": lambda env: None if env.t % 2 else env.free,
}


@pytest.mark.parametrize("kind", [Told, Asked])
@pytest.mark.parametrize("mask", MASKS.values(), ids=MASKS)
def test_masks_may_be_given_in_many_ways(kind, mask):
    ILLEGAL.clear()
    spec = sw.EnvSpec(lambda: kind(mask), workers=1)
    run = sw.train_agent(spec, SMALL, 256, quiet=True)
    run.evaluate(3)
    assert mask is MASKS["None, for all"] or not ILLEGAL


@pytest.mark.parametrize("kind", [Told, Asked])
@pytest.mark.parametrize("mask", [[1, 0], "all", np.ones(7)])
def test_a_mask_that_is_none_names_environment_and_step(kind, mask):
    spec = sw.EnvSpec(lambda: kind(lambda env: mask), workers=1)
    with pytest.raises(EnvError, match=r"environment 0, step 0 .*6 in all"):
        sw.train_agent(spec, SMALL, 256, quiet=True)


def test_where_nothing_is_chosen_masks_are_not_asked_for():
    def fails(env):
        raise NotImplementedError

    box = gym.spaces.Box(-1, 1, (1,), np.float32)

    class Moves(Asked):
        def step(self, action):
            return super().step(0)

    spec = sw.EnvSpec(lambda: Moves(fails, box), workers=1)
    sw.train_agent(spec, SMALL, 64, quiet=True)


@pytest.mark.parametrize("mask", [[1, 0], "all", np.zeros(6)])
def test_a_player_is_not_given_a_wrong_mask(mask):
    policy = sw.from_function(
        lambda obs: np.zeros(len(obs), int),
        observation_space=Slots("none").observation_space,
        action_space=Slots("none").action_space,
    )
    with pytest.raises(DeclarationError, match="action_mask"):
        sw.Player(policy).act(np.zeros(6, np.int8), mask=mask)


@pytest.mark.parametrize("where", ["info", "observation", "method"])
def test_forbidden_actions_are_not_tried_either_to_measure_speed(where):
    class Strict(Slots):
        def step(self, action):
            if not self.free[action]:
                raise ValueError("forbidden")
            return super().step(action)

    sw.train_agent(lambda: Strict(where), SMALL, 64, quiet=True)
