"""Trainings of skills that share their steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from declaring import declare
from safetensors.torch import load_file
from small_runs import goes_on, reports_every, stopped_run

import skillweave as sw
from skillweave.buffers.judged import JudgedStore
from skillweave.errors import DeclarationError, EnvError, RunError, SkillError, TrainingError
from skillweave.evolution import Evolution

often = reports_every(75)
SMALL = sw.Network((16,), "relu")
SHARES = sw.SAC(
    num_envs=4,
    learning_starts=60,
    batch_size=32,
    buffer_size=2_000,
    network=SMALL,
    shared_replay=0.5,
)
PPO = sw.PPO(num_envs=4, n_steps=16, network=SMALL)


class Line(gym.Env):
    """A point on a line, which is pushed; its speed is told."""

    observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        self.time = 0
        return self.place.copy(), {}

    def step(self, action: Any) -> Any:
        self.place = np.clip(self.place + 0.5 * np.float32(action), -9, 9).astype(np.float32)
        self.time += 1
        info = {"speed": float(action[0]), "note": "x", "late": self.time}
        return self.place.copy(), 0.0, False, self.time >= 20, info


class Up(sw.Skill):
    """Go up."""

    max_steps = 10
    algorithm: Any = SHARES

    def reward(self, step: Any) -> Any:
        return step.next_obs[:, 0] - step.obs[:, 0]


class Down(Up):
    """Go down, by what the environment tells."""

    def reward(self, step: Any) -> Any:
        return -step.info["speed"]


def sharing(*skills: Any, **how: Any) -> sw.Hierarchy:
    """Two skills that share, or others, in one small hierarchy."""
    plain = {"env": Line, "learn": "apart", "selector": PPO, "skill_steps": 300}
    plain |= {"selector_steps": 64, "together_steps": 300, "call_steps": 5}
    return declare(*(x() for x in skills or (Up, Down)), **plain | how)


@pytest.mark.parametrize(("learn", "tick"), [("apart", 6), ("together", 3)])
def test_a_run_that_is_resumed_ends_with_the_same_weights(learn, tick, tmp_path):
    goes_on(lambda: sharing(learn=learn), tmp_path, tick=tick)


def test_steps_are_handed_on_and_then_deleted(tmp_path, monkeypatch):
    sizes: list[int] = []
    plain = JudgedStore.begin_with

    def begin_with(store: JudgedStore, shared: Any) -> Any:
        yield from plain(store, shared)
        sizes.append(len(store))

    monkeypatch.setattr(JudgedStore, "begin_with", begin_with)
    third = type("Third", (Up,), {})
    sharing(Up, Down, third).train(tmp_path / "run", seed=0, quiet=True)
    assert sizes == [300, 300, 600]
    assert not (tmp_path / "run" / "replay").exists()


def test_skills_with_and_without_hindsight_share(tmp_path):
    class GoTo(Up):
        goal_space = gym.spaces.Box(-2, 2, (1,), np.float32)
        algorithm = replace(SHARES, hindsight=True)

        def reward(self, step: Any) -> Any:
            return -np.abs(step.next_obs[:, :1] - step.goal)[:, 0]

        def achieved_goal(self, obs: Any) -> Any:
            return obs[:, :1]

    for i, skills in enumerate([(GoTo, Down), (Down, GoTo)]):
        sharing(*skills).train(tmp_path / str(i), seed=0, quiet=True)


def test_the_share_of_others_is_as_declared(tmp_path, monkeypatch):
    drawn: list[float] = []
    plain = JudgedStore.sample

    def sample(store: JudgedStore, *args: Any) -> Any:
        found = plain(store, *args)
        own = store._columns.data["own"][found.index % store._columns.slots]
        drawn.append(1.0 - own.mean())
        return found

    monkeypatch.setattr(JudgedStore, "sample", sample)
    algorithm = replace(SHARES, shared_replay=0.25)
    skills = [type(x.__name__, (x,), {"algorithm": algorithm}) for x in (Up, Down)]
    sharing(*skills, learn="together").train(tmp_path / "run", seed=0, quiet=True)
    assert np.mean(drawn) == pytest.approx(0.25, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("learn", ["apart", "together"])
def test_skills_learn_from_others_steps_alone(learn, tmp_path):
    algorithm = replace(SHARES, shared_replay=1.0, update_ratio=2.0)
    skills = [type(x.__name__, (x,), {"algorithm": algorithm}) for x in (Up, Down)]
    run = sharing(*skills, learn=learn, skill_steps=1_500, together_steps=3_000).train(
        tmp_path / "run", seed=0, quiet=True
    )
    found = run.evaluate(20, skill="down", seed=1, quiet=True).skills["down"]
    assert found.return_sum / found.calls > 8


def test_a_run_whose_shared_steps_were_deleted_is_told(tmp_path):
    run = tmp_path / "run"
    stopped_run(sharing(), run, 6)
    for path in (*run.glob("checkpoint*"), *run.glob("replay/*")):
        path.unlink()
    with pytest.raises(RunError, match="is not there any more"):
        sharing().resume(run, quiet=True)


class Timed(Up):
    def reward(self, step: Any) -> Any:
        return step.next_obs[:, 0] - 0.1 * step.elapsed


class Ends(Up):
    def termination(self, step: Any) -> Any:
        return step.timed_out


class Noted(Up):
    def reward(self, step: Any) -> Any:
        return step.info["note"] == "x"


class Later(Up):
    def reward(self, step: Any) -> Any:
        far = np.abs(step.obs[:, 0]) > 1.05
        return step.info["late"] * 1.0 if far.any() else step.next_obs[:, 0]


class Draws(Up):
    seen = 0.0

    def reward(self, step: Any) -> Any:
        self.seen += 1.0
        return self.seen + step.next_obs[:, 0]


def with_algorithm(skill: Any, **settings: Any) -> Any:
    """A kind of skill with other settings of its algorithm."""
    return type(skill.__name__, (skill,), {"algorithm": replace(SHARES, **settings)})


@pytest.mark.parametrize(
    ("skills", "words"),
    [
        ((Timed, Up), r"reward\(\) depends on step.elapsed"),
        ((Up, Ends), r"termination\(\) depends on step.elapsed"),
        ((Up, Noted), r"info\['note'\]"),
        ((Up, type("Changes", (Up,), {"reward_changes": True})), "reward_changes"),
        ((Up, with_algorithm(Down, num_envs=2)), "num_envs must be equal, but is 2 and 4"),
        ((Up, with_algorithm(Down, save_buffer=False)), "save_buffer is False"),
    ],
)
def test_skills_that_cannot_share_are_refused_before_steps_are_spent(skills, words, tmp_path):
    with pytest.raises(DeclarationError, match=words):
        sharing(*skills).train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


def test_populations_do_not_share(tmp_path):
    with pytest.raises(DeclarationError, match="not for populations"):
        sharing().train(tmp_path / "run", evolve=Evolution(population=2, generations=2), quiet=True)


def test_a_corrected_policy_cannot_share(tmp_path):
    policy = sw.Residual(lambda obs: np.zeros((len(obs), 2)), scale=0.1)
    corrected = type("Corrected", (Up,), {"policy": policy})
    with pytest.raises(DeclarationError, match="Residual"):
        sharing(corrected, Up).train(tmp_path / "run", quiet=True)


def test_a_key_that_is_read_later_is_refused(tmp_path):
    with pytest.raises((DeclarationError, SkillError), match=r"info\['late'\]"):
        sharing(Later, Up).train(tmp_path / "run", seed=0, quiet=True)


class Lists(Up):
    def reward(self, step: Any) -> Any:
        return step.next_obs[:, 0] + len(dict(step.info))


def test_reading_all_of_info_is_refused_before_steps_are_spent(tmp_path):
    with pytest.raises((DeclarationError, SkillError), match=r"info\["):
        sharing(Lists, Up).train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


class LateTime(Up):
    """Its reward reads the time of its call where it has gone far."""

    def reward(self, step: Any) -> Any:
        far = np.abs(step.next_obs[:, 0]) > 1.55
        return np.where(far, step.elapsed, step.next_obs[:, 0])


def test_time_that_is_read_now_and_then_is_told_before_anything_is_learnt(tmp_path):
    with pytest.raises(DeclarationError, match="depends on step"):
        sharing(LateTime, Up).train(tmp_path / "run", seed=0, quiet=True)


class Bonus(Line):
    """A bonus is a whole number at first."""

    def step(self, action: Any) -> Any:
        *found, info = super().step(action)
        info["bonus"] = 0 if self.time < 3 else 0.5
        return *found, info


class Collects(Up):
    def reward(self, step: Any) -> Any:
        return step.info["bonus"] + step.next_obs[:, 1]


@pytest.mark.parametrize("learn", ["apart", "together"])
def test_numbers_of_info_keep_their_fractions(learn, tmp_path):
    sharing(Collects, Up, env=Bonus, learn=learn).train(tmp_path / "run", seed=0, quiet=True)


class Sometimes(Line):
    """A key is left out later."""

    def step(self, action: Any) -> Any:
        *found, info = super().step(action)
        if self.time > 5:
            del info["speed"]
        return *found, info


def test_a_key_that_is_left_out_later_is_told(tmp_path):
    algorithm = replace(SHARES, num_envs=1)
    skills = [type(x.__name__, (x,), {"algorithm": algorithm}) for x in (Down, Up)]
    with pytest.raises(EnvError, match=r"info\['speed'\], which is stored with each step"):
        sharing(*skills, env=Sometimes).train(tmp_path / "run", seed=0, quiet=True)


class Once(Line):
    """An environment of which there is one at a time."""

    open = False

    def __init__(self) -> None:
        if Once.open:
            raise RuntimeError("there is one already")
        Once.open = True

    def close(self) -> None:
        Once.open = False


def test_an_environment_that_exists_once_is_enough(tmp_path):
    algorithm = replace(SHARES, num_envs=1)
    skills = [type(x.__name__, (x,), {"algorithm": algorithm}) for x in (Down, Up)]
    how = {"env": sw.EnvSpec(Once, workers=1), "selector": lambda obs: np.zeros(len(obs), int)}
    sharing(*skills, **how).train(tmp_path / "run", seed=0, quiet=True)


def stored_rows(monkeypatch: Any) -> list[list[int]]:
    """Return a list that gets the sizes of stores, own rows and all, when they are handed on."""
    sizes: list[list[int]] = []
    plain = JudgedStore.shared_rows

    def shared_rows(store: JudgedStore) -> Any:
        own = int((store._columns.data["own"] & (store._columns.data["kind"] > 0)).sum())
        sizes.append([own, len(store)])
        return plain(store)

    monkeypatch.setattr(JudgedStore, "shared_rows", shared_rows)
    return sizes


def test_steps_reach_a_skill_past_one_that_could_not_have_made_them(tmp_path, monkeypatch):
    sizes = stored_rows(monkeypatch)
    way = {"algorithm": replace(SHARES, buffer_size=60)}
    first, third, last = (type(name, (Up,), {"acts": (0,)}) for name in ("A", "C", "D"))
    second = type("B", (Up,), {"acts": (1,)} | way)
    sharing(first, second, third, last).train(tmp_path / "run", seed=0, quiet=True)
    assert sizes[0] == [300, 300]
    assert 50 < sizes[1][0] == sizes[1][1] <= 60
    assert sizes[2] == [300, 600]


def test_a_skill_that_never_begins_hands_nothing_on(tmp_path):
    never = type("Never", (Up,), {"initiation": lambda self, obs: obs[:, 0] > 99})
    sharing(never, Up, Down).train(tmp_path / "run", seed=0, quiet=True)


class Crane(gym.Env):
    """An arm with a grip: an action with parts."""

    observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gym.spaces.Dict(
        {"arm": gym.spaces.Box(-1, 1, (2,), np.float32), "grip": gym.spaces.Discrete(3)}
    )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        self.time = 0
        return self.place.copy(), {"action_mask": np.int8([1, 1, 0])}

    def step(self, action: Any) -> Any:
        self.place = np.clip(self.place + action["arm"], -9, 9).astype(np.float32)
        self.time += 1
        info = {"action_mask": np.int8([1, 1, self.time % 2])}
        return self.place.copy(), 0.0, False, self.time >= 20, info


@pytest.mark.parametrize("hindsight", [False, True])
def test_a_part_of_an_action_with_parts_is_stored_as_it_was(hindsight, tmp_path, monkeypatch):
    drawn: list[Any] = []
    plain = JudgedStore.sample

    def sample(store: JudgedStore, *args: Any) -> Any:
        found = plain(store, *args)
        rows = store._rows((found.index % store._columns.slots).ravel())
        drawn.append((found.action[0].numpy(), rows.columns["env_action"]["arm"]))
        return found

    monkeypatch.setattr(JudgedStore, "sample", sample)

    class Arm(sw.Skill):
        max_steps = 10
        acts = "arm"
        algorithm = replace(SHARES, hindsight=hindsight)
        goal_space = gym.spaces.Box(-2, 2, (2,), np.float32) if hindsight else None

        def reward(self, step: Any) -> Any:
            return -np.abs(step.next_obs - (step.goal if hindsight else 1.0)).sum(axis=1)

    if hindsight:
        Arm.achieved_goal = lambda self, obs: obs  # type: ignore[method-assign]
    other = type("Other", (Arm,), {})
    sharing(Arm, other, env=Crane).train(tmp_path / "run", seed=0, quiet=True)
    for action, done in drawn:
        assert np.allclose(action, done, atol=1e-6)


class Steps(gym.Env):
    """Choices that begin at 5, of which some are forbidden."""

    observation_space = gym.spaces.Box(-99, 99, (1,), np.float32)
    action_space = gym.spaces.Discrete(3, start=5)

    def see(self) -> Any:
        return np.float32([self.place]), {"action_mask": np.int8([1, self.place < 3, 1])}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.place, self.time = 0, 0
        return self.see()

    def step(self, action: Any) -> Any:
        assert action != 6 or self.place < 3
        self.place, self.time = self.place + int(action) - 6, self.time + 1
        seen, info = self.see()
        return seen, 0.0, False, self.time >= 20, info


@pytest.mark.filterwarnings("ignore")
def test_choices_that_begin_elsewhere_are_shared(tmp_path):
    names = ("buffer_size", "learning_starts", "num_envs", "network", "shared_replay")
    settings = {name: getattr(SHARES, name) for name in names}
    algorithm = sw.DQN(**settings, batch_size=32)
    skills = [
        type(
            "A", (Up,), {"algorithm": algorithm, "reward": lambda self, step: step.next_obs[:, 0]}
        ),
        type(
            "B", (Up,), {"algorithm": algorithm, "reward": lambda self, step: -step.next_obs[:, 0]}
        ),
    ]
    sharing(*skills, env=Steps).train(tmp_path / "run", seed=0, quiet=True)


def test_a_held_rest_is_refused(tmp_path):
    arms = [type(f"Arm{i}", (Up,), {"acts": (i,)}) for i in range(2)]
    with pytest.raises(DeclarationError, match="rest is 'hold'"):
        sharing(*arms, rest="hold").train(tmp_path / "run", quiet=True)


def test_the_scale_of_returns_is_of_the_skills_own_calls(tmp_path):
    class Paid(Up):
        algorithm = replace(SHARES, normalize_rewards=True)

        def reward(self, step: Any) -> Any:
            return np.ones(len(step.reward))

    found = []
    for share in (0.0, 0.5):
        algorithm = replace(Paid.algorithm, shared_replay=share)
        skills = [type(name, (Paid,), {"algorithm": algorithm}) for name in ("A", "B")]
        turns = lambda obs: (np.abs(obs[:, 0]) * 1e4).astype(int) % 2  # noqa: E731
        hierarchy = sharing(*skills, learn="together", call_steps=3, selector=turns)
        hierarchy.train(tmp_path / str(share), seed=0, quiet=True)
        final = load_file(next((tmp_path / str(share)).glob("final/*")))
        found.append(final["state.a.return_mean"].item())
    assert found[1] == pytest.approx(found[0], rel=0.5)


@pytest.mark.filterwarnings("ignore:.*keeps a state", "ignore:.*reward")
def test_a_reward_that_keeps_a_state_stops_training(tmp_path):
    with pytest.raises((TrainingError, SkillError)):
        sharing(Draws, Up).train(tmp_path / "run", seed=0, quiet=True)
