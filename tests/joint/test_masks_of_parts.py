"""Action masks of actions with several parts, and of whole numbers of a Box."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from reach import ON, SMALL, SPACES, Arm, Grip, Reach, Whole, by_hand, reach
from small_runs import goes_on, reports_every
from torch.distributions import Categorical, Normal

import skillweave as sw
from skillweave.envs.checked import CheckedEnv
from skillweave.envs.env_infos import random_actions
from skillweave.errors import DeclarationError, EnvError, SkillError
from skillweave.networks.heads import head_of
from skillweave.policies.spaces import space_of
from skillweave.spaces import action_codec, obs_dtype, obs_shape, put_observation

often = reports_every(40)
SIZES = {"dict": 2, "tuple": 2, "nested": 2 + 6 + 5 + 4, "whole": 3 + 6}


class Masked(Reach):
    """Forbids one value of each choice, another one in each step, and refuses it."""

    def __init__(self, kind: str = "dict", form: str = "parts", **how):
        super().__init__(kind, **how)
        self.form, self.space = form, space_of(self.action_space)
        self.codec = action_codec(self.action_space)
        if form == "method":
            self.action_masks = self.allowed

    def allowed(self):
        """Return a mask for each part, as lists; the bits of a MultiBinary have two numbers."""
        at = self.steps % 2
        two = [1 - at, at]
        if self.kind == "whole":
            return [1, at, 1], [at, 1, 1, 0, 1, 1]
        if self.kind == "nested":
            bits, numbers = [two, [1, 1], two], [[1 - at, at], [0, 1, at]]
            return {"grip": two, "more": (bits, {"a": numbers, "b": [at, 1, 1, 0]})}
        return {"grip": two} if self.kind == "dict" else (None, two)

    def _draw(self):
        found = super()._draw()
        if self.form == "flat":
            self.info = {"action_mask": self.space.allowed(self.allowed())}
        elif self.form == "parts":
            self.info = {"action_mask": self.allowed()}
        return found

    def step(self, action):
        mask = self.space.allowed(self.allowed())
        assert mask[self.numbers(action)].all(), (action, self.steps)
        return super().step(action)

    def numbers(self, action):
        """Return the places in a mask of the choices that an action makes."""
        packed = np.zeros((1, *obs_shape(self.action_space)), obs_dtype(self.action_space))
        put_observation(self.action_space, packed, 0, action)
        return np.cumsum([0, *self.codec.counts[:-1]]) + self.space.choices_in(packed)[0]


def masked(kind: str = "dict", form: str = "parts") -> sw.EnvSpec:
    return sw.EnvSpec(Masked, {"kind": kind, "form": form}, engine="sync", workers=1)


@pytest.mark.fast_cases(3)
@pytest.mark.parametrize("form", ["parts", "flat", "method"])
@pytest.mark.parametrize("kind", SIZES)
def test_no_one_does_what_is_forbidden(kind, form, tmp_path):
    assert sum(action_codec(SPACES[kind]).counts) == SIZES[kind]
    run = sw.train_agent(masked(kind, form), ON, 100, tmp_path / "run", quiet=True)
    run.evaluate(2, quiet=True)
    env, player = Masked(kind, form), run.player()
    obs, info = env.reset(seed=0)
    for _ in range(10):
        given = {"mask": env.allowed()} if form == "method" else {"info": info}
        obs, *_, info = env.step(player.act(obs, **given))


@pytest.mark.parametrize("kind", SIZES)
def test_random_actions_are_allowed(kind):
    rng, env = np.random.default_rng(0), Masked(kind, "method")
    env.reset(seed=0)
    mask = np.tile(env.space.allowed(env.allowed()), (20, 1))
    for action in map(env.space.unpacked, random_actions(SPACES[kind], 20, rng, mask)):
        assert SPACES[kind].contains(action)
        assert mask[0][env.numbers(action)].all()


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("name", ["PPO", "SelfImitationPPO", "recurrent"])
def test_a_stopped_run_ends_with_the_same_weights(name, tmp_path):
    algorithm = {
        "PPO": ON,
        "SelfImitationPPO": sw.algorithms.SelfImitationPPO(num_envs=4, n_steps=16, network=SMALL),
        "recurrent": replace(ON, network=sw.Network((8,), rnn=sw.algorithms.RNN("gru", 6))),
    }[name]

    class Both(sw.Skill):
        """Owns all choices."""

        acts = ("more", "grip")

    class More(sw.Skill):
        """Owns a choice within a part, and the others of these."""

        acts = ("more.1", "grip", "more.0", "arm")

    def declared() -> sw.Hierarchy:
        skills = [Both(), More(), Whole()]
        settings = sw.TrainDefaults(checkpoint_every=60)
        return reach(skills, env=masked("nested"), algorithm=algorithm, train_defaults=settings)

    goes_on(declared, tmp_path)


def test_the_rest_of_the_action_may_be_forbidden(tmp_path):
    first = type("First", (sw.Skill,), {"acts": 0})()
    whole = masked("whole")
    for skills, env, where in (
        ([Arm(), Grip()], masked(), "choice 0"),
        ([first], whole, "place 1"),
    ):
        with pytest.raises(SkillError, match=rf"forbids the value 0 at {where}.* another rest"):
            reach(skills, env=env).train(tmp_path / "run", quiet=True)
    # The middle of the first number is 0 from -1 on, and the second may be 4.
    reach([first], env=whole, rest=[0, 4], steps=64).train(tmp_path / "two", quiet=True)


def test_log_probabilities_are_those_of_the_allowed_choices():
    space = gym.spaces.Dict(
        arm=gym.spaces.Box(-2, 2, (2,), np.float32),
        more=gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.Box(5, 8, (1,), np.int64))),
    )
    head = head_of(action_codec(space))
    torch.manual_seed(0)
    params, log_std = torch.randn(1, 500, head.width), torch.tensor([[[-0.5, 0.3]]])
    mask = torch.tensor([1, 0, 1, 0, 1, 1, 1], dtype=torch.bool).expand(1, 500, 7)
    noise = head.noise([torch.Generator().manual_seed(1)], 1, 500)[0]
    action = head.act(head.masked(params, mask), log_std, noise)
    assert not (action[..., 2] == 1).any()
    assert not (action[..., 3] == 0).any()
    normal = Normal(params[..., :2], log_std.exp())
    first = Categorical(logits=params[..., 2:5].masked_fill(~mask[..., :3], -1e9))
    second = Categorical(logits=params[..., 5:].masked_fill(~mask[..., 3:], -1e9))
    log_prob, entropy = head.stats(params, log_std, mask, action)
    expected = normal.log_prob(action[..., :2]).sum(-1)
    expected = expected + first.log_prob(action[..., 2]) + second.log_prob(action[..., 3])
    assert torch.allclose(log_prob, expected, atol=1e-5)
    spread = normal.entropy().sum(-1) + first.entropy() + second.entropy()
    assert torch.allclose(entropy, spread, atol=1e-5)
    other = params.flip(1)
    masked_params, masked_other = head.masked(params, mask), head.masked(other, mask)
    divergence = head.kl(params, log_std, other, log_std, mask)
    assert torch.allclose(divergence, head.kl(masked_params, log_std, masked_other, log_std, None))


WRONG = {
    "another part": ({"grap": [1, 0]}, r"has the parts \['grap'\], but .* have 'arm', 'grip'"),
    "too short": ({"grip": [1]}, r"action_mask\['grip'\] is \[1\]; .* Discrete\(2, start=3\), 2"),
    "nothing": ({"grip": [0, 0]}, "allows no action"),
}


@pytest.mark.parametrize(("mask", "says"), WRONG.values(), ids=WRONG)
def test_a_wrong_mask_names_its_part(mask, says, tmp_path):
    policy = sw.from_function(
        by_hand, observation_space=Reach.observation_space, action_space=SPACES["dict"]
    )
    with pytest.raises(DeclarationError, match=says):
        sw.Player(policy).act(np.zeros(3, np.float32), mask=mask)
    spec = sw.EnvSpec(lambda: Reach(info={"action_mask": mask}), workers=1)
    with pytest.raises(EnvError, match=says):
        sw.train_agent(spec, ON, 64, tmp_path / "two", quiet=True)


def test_a_mask_of_a_tuple_may_be_one_list():
    space = gym.spaces.Tuple((gym.spaces.Discrete(2), gym.spaces.Discrete(3)))
    expected = [True, False, True, True, False]
    assert space_of(space).allowed([1, 0, 1, 1, 0]).tolist() == expected
    assert space_of(space).allowed([[1, 0], (1, 1, 0)]).tolist() == expected
    assert space_of(space).allowed((None, [1, 1, 0])).tolist() == [True, True, True, True, False]
    with pytest.raises(ValueError, match=r"has the parts \['0', '1', '2'\], but .* have '0', '1'"):
        space_of(space).allowed(([1, 0], [1, 1, 1], [1]))


def test_real_numbers_have_no_mask(tmp_path):
    real = gym.spaces.Dict(arm=gym.spaces.Box(-1, 1, (2,), np.float32))
    policy = sw.from_function(
        lambda obs: {"arm": obs[:, :2]},
        observation_space=Reach.observation_space,
        action_space=real,
    )
    seen = np.zeros(3, np.float32)
    with pytest.raises(DeclarationError, match=r"mask is \[1, 0\], but .* real numbers alone"):
        sw.Player(policy).act(seen, mask=[1, 0])
    assert set(sw.Player(policy).act(seen, info={"action_mask": [1, 0]})) == {"arm"}

    env = Reach(info={"action_mask": np.ones(2, bool)})
    env.action_space = real
    with pytest.warns(UserWarning, match="its action mask is not used, .* real numbers alone"):
        CheckedEnv(env, "reach", 0).reset(seed=0)
