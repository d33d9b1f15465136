"""By what calls are compared where observations have images."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import DeclarationError


class WithView(gym.Env):
    """A place on a line, and a picture of it. ``wave`` works near 0 alone."""

    observation_space = gym.spaces.Dict(
        {
            "more": gym.spaces.Discrete(3),
            "place": gym.spaces.Box(-9, 9, (2,), np.float32),
            "view": gym.spaces.Box(0, 255, (12, 12, 3), np.uint8),
        }
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self.seen(), {}

    def seen(self):
        place, view = np.float32([self.x, self.t]), np.full((12, 12, 3), self.t, np.uint8)
        return {"more": np.int64(1), "place": place, "view": view}

    def step(self, action):
        self.t += 1
        self.x = float(np.clip(self.x + action[0], -9, 9))
        return self.seen(), 0.0, False, self.t >= 60, {}


class Go(sw.Skill):
    max_steps = 10

    def policy(self, obs):
        return np.full((len(obs["place"]), 1), 0.3)

    def success(self, step):
        return step.next_obs["place"][:, 0] > 1


class Wave(sw.Skill):
    max_steps = 5

    def reward(self, step):
        return -np.abs(step.next_obs["place"][:, 0])

    def success(self, step):
        return np.abs(step.next_obs["place"][:, 0]) < 1


class WaveBlind(Wave):
    name = "wave"
    sees = "place"


class GoBlind(Go):
    name = "go"
    sees = sw.Part("place", [0])

    def policy(self, obs):
        return np.full((len(obs), 1), 0.3)


class GoByAFunction(GoBlind):
    name = "go"

    def sees(obs):
        return obs["place"][:, :1]


def place(obs):
    return obs["place"]


def run_of(folder, *skills, **how):
    small = sw.PPO(num_envs=4, n_steps=16, batch_size=64)
    hierarchy = sw.Hierarchy(
        WithView,
        [skill() for skill in skills],
        call_steps=None,
        steps=100,
        algorithm=small,
        selector=lambda obs: ["go"] * len(obs["place"]),
        **how,
    )
    return hierarchy.train(folder / "run", quiet=True)


def test_features_of_a_hierarchy_serve_chains_blame_and_repair(tmp_path):
    run = run_of(tmp_path, Go, Wave, features=place)
    recorded = run.log_calls(2_000)
    logs = [recorded, run.calls, run.evaluate(5, log_calls=True, quiet=True).calls]
    assert [log.features for log in logs] == [place] * 3
    for log in logs[:2]:
        assert log.chain("go", "wave").interval[0] <= log.chain("go", "wave").estimate
        assert str(log.blame("wave", "go"))
        assert log.take(np.arange(100)).features is place
    assert run.calls.chain("go", "wave") == run.calls.chain("go", "wave", features=place)
    assert run.plan("go").explain().chance is not None
    repaired = run.repair(
        "wave", after="go", steps=200, calls=10, quiet=True, run_dir=tmp_path / "new"
    )
    assert "'wave' is done in" in repaired.repairs[-1].blame


def test_without_features_images_are_refused_before_anything_is_measured(tmp_path, monkeypatch):
    run = run_of(tmp_path, Go, Wave)
    log = run.log_calls(2_000)
    for call in (lambda: log.chain("go", "wave"), lambda: log.blame("wave", "go")):
        with pytest.raises(DeclarationError, match="skill 'wave' sees images"):
            call()
    from skillweave.repair import repairing

    monkeypatch.setattr(repairing, "measure", None)
    with pytest.raises(DeclarationError, match=r"calls of 'wave' cannot be compared by images"):
        run.repair("wave", after="go", steps=200, calls=10, run_dir=tmp_path / "new")
    of_another = run_of(tmp_path / "other", Go, Wave, features={"go": place})
    with pytest.raises(DeclarationError, match=r"calls of 'wave' cannot be compared by images"):
        of_another.repair("wave", after="go", steps=200, calls=10, run_dir=tmp_path / "new")


def test_a_skill_that_sees_only_numbers_is_compared_by_them(tmp_path):
    # In the flat observation the choice has places 0 to 2.
    log = run_of(tmp_path, GoBlind, WaveBlind).log_calls(2_000)
    assert log.sees == ((3,), (3, 4))
    assert log.chain("go", "wave").estimate < 0.5
    assert str(log.blame("wave", "go"))


def test_only_the_skills_that_are_compared_need_features(tmp_path):
    log = run_of(tmp_path, Go, WaveBlind).log_calls(2_000)
    assert log.sees == (None, (3, 4))
    assert str(log.chain("go", "wave"))
    assert str(log.blame("wave", "go"))
    with pytest.raises(DeclarationError, match="skill 'go' sees images"):
        log.chain("wave", "go")
    of_function = run_of(tmp_path / "other", GoByAFunction, WaveBlind).log_calls(500)
    with pytest.raises(DeclarationError, match="or what a function makes of them"):
        of_function.chain("wave", "go")
