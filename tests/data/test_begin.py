"""``train(data=...)``: what is cloned, what is not, and what a clone is worth at its start."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.data.cloning import clone
from skillweave.errors import DeclarationError
from skillweave.types import Array


class Lift(gym.Env):
    """Go down to a block, grip it, and lift it: height of the hand, and whether it grips."""

    observation_space = gym.spaces.Box(-2, 2, (2,))
    action_space = gym.spaces.Discrete(3)  # down, up, grip or let go

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.height, self.grips, self.steps = float(self.np_random.uniform(0.5, 1)), False, 0
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.height = float(np.clip(self.height + (-0.1, 0.1, 0.0)[int(action)], -1, 1))
        if action == 2 and abs(self.height) < 0.1:
            self.grips = not self.grips
        done = self.grips and self.height > 0.8
        self.steps += 1
        return self.seen(), float(done), done, self.steps == 60, {}

    def seen(self) -> Array:
        return np.float32([self.height, self.grips])


class Reach(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return (obs[:, 0] > 0.1) & (obs[:, 1] == 0)

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] < 0.1

    def reward(self, step: Any) -> Array:
        return (step.next_obs[:, 0] < 0.1) - 0.1


class Grip(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 1] == 0

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 1] == 1

    def reward(self, step: Any) -> Array:
        return (step.next_obs[:, 1] == 1) - 0.1


class Raise(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 1] == 1

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] > 0.8

    def reward(self, step: Any) -> Array:
        return (step.next_obs[:, 0] > 0.8) - 0.1


def demonstrator(obs: Array) -> Array:
    grips, height = obs[:, 1] > 0, obs[:, 0]
    return np.where(grips, 1, np.where(height < 0.1, 2, 0))


def spec() -> sw.EnvSpec:
    return sw.EnvSpec(Lift, engine="sync", check_seed=False)


def hierarchy(**how: Any) -> sw.Hierarchy:
    ppo = sw.PPO(num_envs=4, n_steps=32)
    settings: dict[str, Any] = {"steps": 256, "algorithm": ppo, "selector": ppo, "call_steps": 40}
    return sw.Hierarchy(spec(), [Reach(), Grip(), Raise()], **(settings | how))


@pytest.fixture(scope="module")
def data() -> sw.Dataset:
    return sw.record(demonstrator, spec(), episodes=60, seed=5)


def test_skills_and_selector_begin_as_the_demonstrator_acts(
    data: sw.Dataset, tmp_path: Path, capsys: Any
) -> None:
    made = hierarchy()
    run = made.train(tmp_path / "run", data=made.segment(data))
    said = capsys.readouterr().err
    assert "selector is cloned" in said
    assert "reach is cloned" in said
    assert "agrees in" in said
    assert np.mean(run.evaluate(40).returns) > 0.9
    nothing = hierarchy().train(tmp_path / "nothing", quiet=True)
    assert np.mean(nothing.evaluate(40).returns) < 0.5


def test_a_plain_agent_begins_so_too_and_a_run_resumes_without_the_data(
    data: sw.Dataset, tmp_path: Path
) -> None:
    ppo = sw.PPO(num_envs=4, n_steps=32)
    run = sw.train_agent(spec(), ppo, steps=128, run_dir=tmp_path / "a", data=data, quiet=True)
    assert np.mean(run.evaluate(40).returns) > 0.6
    nothing = sw.train_agent(spec(), ppo, steps=128, run_dir=tmp_path / "b", quiet=True)
    assert np.mean(nothing.evaluate(40).returns) < 0.2
    again = sw.train_agent(spec(), ppo, steps=256, run_dir=tmp_path / "a", resume=True, quiet=True)
    assert np.mean(again.evaluate(40).returns) > 0.6


def weights_of(run: Any) -> dict[str, Array]:
    return {name: x.numpy() for name, x in run.policy.weights.items()}


def test_at_first_the_critic_learns_alone_and_a_stopped_run_goes_on_so(
    data: sw.Dataset, tmp_path: Path
) -> None:
    """A fifth of 1,920 steps are three updates: then the actor learns, too."""
    ppo = sw.PPO(num_envs=4, n_steps=32)
    how: Any = {"steps": 1_920, "data": data, "quiet": True, "checkpoint_every": 128}

    def until(updates: int, raises: bool = False) -> Any:
        seen: list[Any] = []

        def stop(event: Any) -> bool:
            seen.append(event)
            if raises and len(seen) == updates:
                raise KeyboardInterrupt
            return raises or len(seen) < updates

        return stop

    after = [
        weights_of(sw.train_agent(spec(), ppo, run_dir=tmp_path / str(k), callback=until(k), **how))
        for k in (1, 4, 14)
    ]
    actor = [name for name in after[0] if name.startswith("actor.")]
    critic = [name for name in after[0] if name.startswith("critic.")]
    assert all((after[0][name] == after[1][name]).all() for name in actor)
    assert any((after[0][name] != after[1][name]).any() for name in critic)
    assert any((after[1][name] != after[2][name]).any() for name in actor)
    for name in ("obs_mean", "obs_var"):
        assert (after[0][name] == after[2][name]).all()
    whole = sw.train_agent(spec(), ppo, run_dir=tmp_path / "whole", **how)
    place = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        sw.train_agent(spec(), ppo, run_dir=place, callback=until(3, raises=True), **how)
    again = sw.train_agent(spec(), ppo, run_dir=place, resume=True, **how)
    for name, value in weights_of(whole).items():
        np.testing.assert_array_equal(weights_of(again)[name], value)


def test_a_skill_that_learns_on_from_its_own_policy_keeps_it(
    data: sw.Dataset, tmp_path: Path, capsys: Any
) -> None:
    module = torch.nn.Sequential(torch.nn.Linear(2, 8), torch.nn.Tanh(), torch.nn.Linear(8, 3))

    class Own(Reach):
        name = "reach"
        policy = sw.from_torch(module, learn=True)

    ppo = sw.PPO(num_envs=4, n_steps=32)
    made = sw.Hierarchy(
        spec(), [Own(), Grip(), Raise()], algorithm=ppo, selector=ppo, steps=256, call_steps=40
    )
    made.train(tmp_path, data=data)
    said = capsys.readouterr().err
    assert "reach is not cloned: it learns on from its own policy" in said
    assert "raise is cloned" in said


def test_what_cannot_be_cloned_is_said(data: sw.Dataset, tmp_path: Path, capsys: Any) -> None:
    hierarchy(
        algorithm=sw.DQN(num_envs=4, learning_starts=16),
        selector=sw.PPO(num_envs=4, n_steps=32), learn="apart",
    ).train(tmp_path / "a", data=data)  # fmt: skip
    said = capsys.readouterr().err
    assert "reach is not cloned: DQN learns from data by shared_replay, which is 0" in said
    assert "selector is cloned" in said
    with pytest.raises(
        DeclarationError, match=r"no learner begins with .*shared_replay, which is 0"
    ):
        sw.train_agent(spec(), sw.DQN(), steps=5_000, run_dir=tmp_path / "b", data=data, quiet=True)
    assert not (tmp_path / "b").exists()
    with pytest.raises(DeclarationError, match="data is 5; it must be a Dataset"):
        sw.train_agent(spec(), sw.PPO(), steps=128, data=5, quiet=True)
    with pytest.raises(DeclarationError, match=r"has observations of .*CartPole"):
        sw.train_agent("CartPole-v1", sw.PPO(), steps=128, data=data, quiet=True)
    few = data.select([0])
    with pytest.raises(DeclarationError, match="rows of it are in the data, fewer than 20"):
        sw.train_agent(spec(), sw.PPO(), steps=128, data=few, quiet=True)
    with pytest.raises(DeclarationError, match="data and start_from are given"):
        hierarchy().train(tmp_path / "c", data=data, start_from=tmp_path / "a", quiet=True)


@pytest.mark.parametrize(("numbers", "few"), itertools.product([False, True], [False, True]))
def test_a_clone_is_judged_by_rows_that_it_has_not_seen(numbers: bool, few: bool) -> None:
    rng = np.random.default_rng(0)
    obs = rng.uniform(-1, 1, (800, 3)).astype(np.float32)
    space = gym.spaces.Box(-1, 1, (3,))
    group = np.arange(800) // (400 if few else 8)
    if numbers:
        acts: Any = gym.spaces.Box(-1, 1, (2,))
        action = np.stack([obs[:, 0] * 0.5, -obs[:, 1] * 0.5], axis=1)
    else:
        acts = gym.spaces.Discrete(2)
        action = (obs[:, 0] > 0).astype(np.int64)
    made = clone(sw.PPO(), obs, action, group, (space, acts), Seeds(0))
    assert made.held_out != few
    assert made.loss < made.before
    assert ("held-out" in str(made)) != few
    policy = made.policy
    given, _ = policy.act(policy.start(800), obs)
    if numbers:
        assert np.abs(given - action).mean() < 0.05
        squashed = clone(sw.PPO(squash_actions=True), obs, action, group, (space, acts), Seeds(0))
        given, _ = squashed.policy.act(squashed.policy.start(800), obs)
        assert np.abs(given - action).mean() < 0.05
        fresh = clone(sw.PPO(), obs[:30], action[:30], group[:30], (space, acts), Seeds(0))
        name = "actor.log_std"
        assert policy.weights[name].tolist() == fresh.policy.weights[name].tolist()
    else:
        assert (given == action).mean() > 0.95
        assert made.agrees is not None
        assert made.agrees > 0.9


def test_calls_of_another_hierarchy_are_refused(data: sw.Dataset, tmp_path: Path) -> None:
    found = hierarchy().segment(data)
    ppo = sw.PPO(num_envs=4, n_steps=32)
    other = sw.Hierarchy(spec(), [Reach(), Raise()], algorithm=ppo, selector=ppo, steps=256)
    with pytest.raises(DeclarationError, match=r"reach, grip, raise, that another hierarchy found"):
        other.train(tmp_path / "run", data=found, quiet=True)
