"""Learning from recorded steps: what a replay store draws, IQL and CQL, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from small_runs import assert_same, interrupted, policies
from test_begin import Lift, demonstrator, hierarchy, spec

import skillweave as sw
from skillweave.algorithms.registry import make_algorithm
from skillweave.errors import DeclarationError, RunError
from skillweave.runs.files import read_tensors
from skillweave.training.replay_learner import judge_of, store_of
from skillweave.training.role import agent_role
from skillweave.types import Array

SMALL = sw.Network((16,), "relu")
OFF: dict[str, Any] = {"num_envs": 3, "batch_size": 16, "learning_starts": 64, "network": SMALL}
ALONE: dict[str, Any] = {"batch_size": 32, "network": SMALL}


@pytest.fixture(scope="module")
def data() -> sw.Dataset:
    return sw.record(demonstrator, spec(), episodes=20, seed=5)


class Counted(gym.Env):
    """Steps are numbered; an odd episode terminates, an even one is truncated."""

    observation_space: Any = gym.spaces.Box(-1e6, 1e6, (1,), np.float64)
    action_space: Any = gym.spaces.Box(np.float32([0.0]), np.float32([10.0]))
    steps_made = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self.observation_space.sample() * 0, {}

    def step(self, action: Any) -> Any:
        type(self).steps_made += 1
        return self.observation_space.sample() * 0, 0.0, False, True, {}


def numbered(lengths: list[int]) -> sw.Dataset:
    """Episodes whose observations, actions and rewards say which step they are."""
    episodes, at = [], 0
    for number, length in enumerate(lengths):
        steps = np.arange(at, at + length)
        at += length + 1
        ends = steps == steps[-1]
        episodes.append(
            {
                "observations": np.append(steps, steps[-1] + 1)[:, None].astype(float),
                "actions": (steps % 11)[:, None].astype(np.float32),
                "rewards": steps * 2.0,
                "terminations": ends & (number % 2 == 1),
                "truncations": ends & (number % 2 == 0),
            }
        )
    return sw.Dataset(episodes, sw.EnvSpec(Counted, check_seed=False))


@pytest.mark.parametrize("num_envs", [1, 3, 8])
def test_a_store_draws_each_recorded_step_as_it_was(num_envs: int) -> None:
    data = numbered([4, 1, 7, 2, 30, *[1] * 17])
    config = sw.SAC(**OFF | {"num_envs": num_envs}, shared_replay=0.5)
    role = agent_role(sw.EnvSpec(Counted, check_seed=False))
    algorithm = make_algorithm(config, *role.spaces)
    steps = data.recorded()
    store: Any = store_of(
        algorithm, num_envs, judge=judge_of(config, role), capacity=steps.room(num_envs)
    )
    store.add_recorded(steps.rows(num_envs, store.raw), np.random.default_rng(0))
    assert len(store) == data.steps
    drawn = store.sample(2_000, torch.tensor([0.9]), [np.random.default_rng(1)])
    obs = drawn.obs[0, :, 0].numpy()
    assert set(obs) == set(data.obs[:, 0])
    np.testing.assert_array_equal(drawn.next_obs[0, :, 0], obs + 1)
    np.testing.assert_array_equal(drawn.reward[0], obs * 2)
    np.testing.assert_allclose(drawn.action[0, :, 0], obs % 11 / 5 - 1, atol=1e-6)
    over = set(data.obs[data.terminated, 0])
    expected = [0.0 if x in over else 0.9 for x in obs]
    np.testing.assert_allclose(drawn.discount[0], expected, rtol=1e-6)


def test_steps_in_a_file_are_the_same_steps(tmp_path: Path) -> None:
    steps = numbered([3, 5]).recorded()
    spaces = Counted.observation_space, Counted.action_space
    again = type(steps).from_tensors(steps.tensors(), *spaces)
    for name in ("obs", "next_obs", "action", "reward", "terminated", "truncated", "elapsed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(steps, name))


def test_a_share_of_each_batch_is_from_the_data(tmp_path: Path, monkeypatch: Any) -> None:
    shares: list[float] = []
    update = sw.algorithms.Algorithm.update

    def watched(self: Any, state: Any, batch: Any, rng: Any) -> Any:
        shares.append(float((batch.obs != 0).float().mean()))
        return update(self, state, batch, rng)

    data = numbered([50, 50])
    config = sw.SAC(**OFF | {"batch_size": 64}, shared_replay=0.25, normalize_obs=False)
    algorithm: Any = type(make_algorithm(config, Counted.observation_space, Counted.action_space))
    update = algorithm.update
    monkeypatch.setattr(algorithm, "update", watched)
    env = sw.EnvSpec(Counted, engine="sync", check_seed=False)
    sw.train_agent(env, config, 200, tmp_path / "run", data=data, quiet=True)
    assert len(shares) > 20
    assert np.mean(shares) == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("kind", [sw.IQL, sw.CQL])
def test_no_environment_is_stepped_while_an_agent_learns_from_data_alone(
    kind: Any, tmp_path: Path
) -> None:
    class Still(Counted):
        observation_space = Lift.observation_space
        action_space = Lift.action_space

        def step(self, action: Any) -> Any:
            raise RuntimeError("nobody should act here")

    data = sw.record(demonstrator, spec(), episodes=20, seed=5)
    env = sw.EnvSpec(Still, engine="sync", check_seed=False)
    run = sw.train_agent(env, kind(**ALONE), 400, tmp_path / "run", data=data, quiet=True)
    acted = np.array([run.act(obs) for obs in data.obs[:40]])
    assert (acted == data.action[:40]).mean() > 0.9
    assert run.info()["stages"][0]["steps"] == 400


def test_skills_learn_from_steps_that_nobody_made_for_them(
    data: sw.Dataset, tmp_path: Path, capsys: Any
) -> None:
    config = sw.IQL(**ALONE)
    run = hierarchy(algorithm=config, learn="apart", steps=3_000).train(tmp_path / "a", data=data)
    said = capsys.readouterr().err
    assert f"reach learns from {data.steps:,} steps of 20 episodes of Lift first" in said
    assert "selector is cloned" in said
    assert np.mean(run.evaluate(20).returns) > 0.9


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("online", [0.0, 0.5])
def test_a_run_that_was_stopped_goes_on_to_the_same_weights(
    online: float, overlap: bool, data: sw.Dataset, tmp_path: Path
) -> None:
    config = sw.IQL(**ALONE, online=online, overlap=overlap, num_envs=4)
    how: dict[str, Any] = {"quiet": True, "checkpoint_every": 100, "eval_every": 200}
    whole = sw.train_agent(spec(), config, 600, tmp_path / "whole", data=data, **how)
    for number in (1, 4):
        place = tmp_path / f"parts{number}"
        with interrupted(number):
            sw.train_agent(spec(), config, 600, place, data=data, **how)
        parts = sw.train_agent(spec(), config, 600, place, resume=True, **how)
        assert_same(parts.path, whole.path)


def test_each_step_on_data_is_a_gradient_step(data: sw.Dataset, tmp_path: Path) -> None:
    for overlap in (False, True):
        config = sw.CQL(**ALONE, overlap=overlap)
        place = tmp_path / str(overlap)
        run = sw.train_agent(spec(), config, 130, place, data=data, quiet=True)
        tensors, _ = read_tensors(run.path / "final" / "agent.safetensors")
        assert int(tensors["state.agent.updates"]) == 130


def test_a_run_with_a_share_of_data_goes_on_to_the_same_weights(
    data: sw.Dataset, tmp_path: Path
) -> None:
    config = sw.DQN(**OFF, shared_replay=0.5)
    how: dict[str, Any] = {"quiet": True, "checkpoint_every": 100}
    whole = sw.train_agent(spec(), config, 400, tmp_path / "whole", data=data, **how)
    with interrupted(2):
        sw.train_agent(spec(), config, 400, tmp_path / "parts", data=data, **how)
    parts = sw.train_agent(spec(), config, 400, tmp_path / "parts", resume=True, **how)
    assert_same(parts.path, whole.path)


def test_more_steps_learn_on_from_the_same_data(
    data: sw.Dataset, tmp_path: Path, capsys: Any
) -> None:
    config = sw.CQL(**ALONE)
    run = sw.train_agent(spec(), config, 200, tmp_path / "run", data=data, quiet=True)
    before = policies(run.path)
    more = sw.train_agent(spec(), config, 400, tmp_path / "run", resume=True, quiet=True)
    assert more.info()["stages"][0]["steps"] == 400
    assert policies(run.path) != before
    other = data.select(range(5))
    other.name = "others"
    sw.train_agent(spec(), config, 500, tmp_path / "run", resume=True, data=other)
    assert f"the run continues as it began, with {data.name}" in capsys.readouterr().err
    (run.path / "data.safetensors").unlink()
    with pytest.raises(RunError, match=r"data\.safetensors is not there any more"):
        sw.train_agent(spec(), config, 600, tmp_path / "run", resume=True, quiet=True)


class Somewhere(sw.Skill):
    """Bring the hand to a height."""

    goal_space = gym.spaces.Box(-1, 1, (1,))
    max_steps = 30

    def reward(self, step: Any) -> Array:
        return -np.abs(step.next_obs[:, 0] - step.goal[:, 0])

    def achieved_goal(self, obs: Array) -> Array:
        return obs[:, :1].clip(-1, 1)


@pytest.mark.parametrize("hindsight", [False, True])
def test_a_skill_with_goals_practises_them_in_the_states_of_data(
    hindsight: bool, tmp_path: Path
) -> None:
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(60):
        actions = rng.integers(2, size=40)
        height = [rng.uniform(-1, 1)]
        for action in actions:
            height.append(np.clip(height[-1] + (-0.1, 0.1)[action], -1, 1))
        seen = np.stack([height, np.zeros(41)], axis=1)
        ends = np.arange(40) == 39
        episodes.append({"observations": seen, "actions": actions, "truncations": ends})
    data = sw.Dataset(episodes, spec())
    made = sw.Hierarchy(
        spec(), [Somewhere()], algorithm=sw.IQL(**ALONE, hindsight=hindsight, gamma=0.8),
        selector=lambda obs: (np.full(len(obs), "somewhere"), np.full((len(obs), 1), 0.5)),
        learn="apart", steps=1_500,
    )  # fmt: skip
    run = made.train(tmp_path / "run", data=data, quiet=True)
    player = run.player()
    obs, _ = (env := Lift()).reset(seed=0)
    for _ in range(30):
        obs, *_ = env.step(player.act(obs))
    assert abs(obs[0] - 0.5) < 0.25


class Masked(Lift):
    """The third action is never allowed."""

    def action_masks(self) -> Array:
        return np.array([True, True, False])


MISTAKES: dict[str, tuple[Any, str]] = {
    "no data": (
        lambda data: sw.train_agent(spec(), sw.IQL(), 500, quiet=True),
        r"'agent' learns by IQL, which learns from recorded steps: give them, data=",
    ),
    "together": (
        lambda data: hierarchy(algorithm=sw.CQL(**ALONE)).train(data=data, quiet=True),
        r'skills that learn together cannot: learn="apart"',
    ),
    "a selector": (
        lambda data: hierarchy(selector=sw.IQL(), learn="apart").train(data=data, quiet=True),
        r"the selector 'selector' cannot learn by IQL, which is for skills and plain agents",
    ),
    "a small buffer": (
        lambda data: sw.train_agent(
            spec(), sw.DQN(**OFF, shared_replay=0.5, buffer_size=200), 500, data=data, quiet=True
        ),
        r"buffer_size is 200, but the data take",
    ),
    "no share": (lambda data: sw.IQL(shared_replay=0.0), "it must be above 0, unless online is 1"),
    "a share of nothing": (
        lambda data: sw.train_agent(spec(), sw.DQN(**OFF, shared_replay=0.5), 500, quiet=True),
        "a plain agent has no skills beside it",
    ),
    "masks": (
        lambda data: sw.train_agent(
            sw.EnvSpec(Masked, engine="sync", check_seed=False), sw.CQL(), 500, data=data,
            quiet=True,
        ),
        r"action masks, but .* has no info\['action_mask'\]",
    ),
    "several steps": (lambda data: sw.CQL(n_step=3), "it must be 1 where shared_replay is set"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_before_anything_is_trained(
    mistake: str, data: sw.Dataset, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    run, says = MISTAKES[mistake]
    with pytest.raises(DeclarationError, match=says):
        run(data)
    assert not list(tmp_path.iterdir())


class Reads(sw.Skill):
    def reward(self, step: Any) -> Array:
        return step.info["heat"]


def test_what_a_skill_reads_and_the_data_lack_is_named(data: sw.Dataset, tmp_path: Path) -> None:
    class Hot(Lift):
        def reset(self, **how: Any) -> Any:
            return super().reset(**how)[0], {"heat": 0.0}

        def step(self, action: Any) -> Any:
            return *super().step(action)[:4], {"heat": 1.0}

    env = sw.EnvSpec(Hot, engine="sync", check_seed=False)
    made = sw.Hierarchy(env, [Reads()], algorithm=sw.IQL(**ALONE), learn="apart", steps=3_000)
    with pytest.raises(DeclarationError, match=r"reads info\['heat'\].*has the keys none of info"):
        made.train(tmp_path / "run", data=data, quiet=True)


SPACES: dict[str, Any] = {
    "large numbers": gym.spaces.Box(0, 60_000, (3,), np.uint16),
    "an image": gym.spaces.Box(0, 255, (12, 12, 3), np.uint8),
    "a dict": gym.spaces.Dict(
        place=gym.spaces.Box(-1, 1, (2,)), kind=gym.spaces.Discrete(3, start=-1)
    ),
    "a tuple": gym.spaces.Tuple((gym.spaces.MultiBinary(2), gym.spaces.Box(-1, 1, (1,)))),
}
ACTIONS: dict[str, Any] = {
    "a range": gym.spaces.Box(np.float32([-2, 0]), np.float32([3, np.inf])),
    "numbers": gym.spaces.Discrete(3, start=5),
}


@pytest.mark.parametrize("acts", ACTIONS)
@pytest.mark.parametrize("sees", SPACES)
def test_it_learns_from_data_of_each_kind_of_space(sees: str, acts: str, tmp_path: Path) -> None:
    class Odd(gym.Env):
        observation_space = SPACES[sees]
        action_space = ACTIONS[acts]

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return self.observation_space.sample(), {}

        def step(self, action: Any) -> Any:
            return self.observation_space.sample(), 1.0, False, True, {}

    def columns(drawn: list[Any]) -> Any:
        if isinstance(drawn[0], dict):
            return {key: np.stack([x[key] for x in drawn]) for key in drawn[0]}
        if isinstance(drawn[0], tuple):
            return tuple(np.stack(part) for part in zip(*drawn, strict=True))
        return np.stack(drawn)

    env = sw.EnvSpec(Odd, engine="sync", check_seed=False)
    episodes = [
        {
            "observations": columns([Odd.observation_space.sample() for _ in range(6)]),
            "actions": columns([Odd.action_space.sample() for _ in range(5)]),
            "rewards": np.ones(5),
        }
        for _ in range(8)
    ]
    data = sw.Dataset(episodes, env)
    config = sw.IQL(batch_size=8, network=SMALL)
    sw.train_agent(env, config, 100, tmp_path / "run", data=data, quiet=True)
    more = sw.train_agent(env, config, 150, tmp_path / "run", resume=True, quiet=True)
    assert all(w.isfinite().all() for w in more.policy.weights.values())
