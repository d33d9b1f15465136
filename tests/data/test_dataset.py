"""``sw.Dataset``, ``sw.record`` and Minari's files: arrays by hand, there and back, bad input."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.errors import DeclarationError, EnvError, RunError, TrainingError
from skillweave.types import Array

SPACE = gym.spaces.Dict({"a": gym.spaces.Box(-1, 1, (2,)), "m": gym.spaces.Discrete(3)})
ACTION = gym.spaces.Tuple((gym.spaces.Discrete(2), gym.spaces.Box(-1, 1, (1,))))
SPACES: Any = {"observation_space": SPACE, "action_space": ACTION}


def episode(steps: int, known: bool = True, end: str = "terminated", first: int = 0) -> Any:
    seen = steps + known
    ends = np.arange(steps) == steps - 1
    return {
        "observations": {
            "a": np.arange(first, first + 2 * seen).reshape(seen, 2) / 100,
            "m": np.arange(seen) % 3,
        },
        "actions": (np.arange(steps) % 2, np.full((steps, 1), 0.5)),
        "rewards": np.arange(steps, dtype=float),
        "terminations": ends & (end == "terminated"),
        "truncations": ends & (end == "truncated"),
        "infos": {"x": np.arange(seen), "name": ["a"] * seen},
    }


def test_episodes_become_arrays_with_the_true_next_observation() -> None:
    data = sw.Dataset([episode(3), episode(2, end="truncated"), episode(2, end="")], **SPACES)
    assert data.offset.tolist() == [0, 3, 5, 7]
    assert data.obs["m"].tolist() == [0, 1, 2, 0, 1, 0, 1]
    assert data.next_obs["m"].tolist() == [1, 2, 0, 1, 2, 1, 2]
    assert data.action["0"].tolist() == [0, 1, 0, 0, 1, 0, 1]
    assert data.info["x"].tolist() == [1, 2, 3, 1, 2, 1, 2]
    assert list(data.info) == ["x"]
    assert data.returns.tolist() == [3, 1, 1]
    assert data.ends == {"terminated": 1, "truncated": 1, "neither": 1}
    assert (len(data), data.steps, data.left_out) == (3, 7, 0)
    assert "ends: 1 terminated, 1 truncated, 1 neither" in str(data)


def test_without_a_last_observation_a_step_that_ends_nothing_is_left_out() -> None:
    data = sw.Dataset([episode(3, known=False), episode(3, known=False, end="")], **SPACES)
    assert data.lengths.tolist() == [3, 2]
    assert data.whole.tolist() == [False, True]
    assert data.terminated.tolist() == [False, False, True, False, False]
    assert data.next_obs["m"].tolist() == [1, 2, 2, 1, 2]  # of a terminated step it counts nowhere
    assert data.left_out == 1
    assert "1 last steps are left out" in str(data)


def equal(one: sw.Dataset, other: sw.Dataset) -> None:
    for name in ("obs", "next_obs", "action", "reward", "terminated", "truncated", "offset"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.info.keys() == other.info.keys()
    for key, value in one.info.items():
        np.testing.assert_array_equal(value, other.info[key])


def test_a_set_is_written_as_minaris_and_read_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    warnings.simplefilter("ignore")  # of Minari, about links and authors
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data = sw.Dataset([episode(3), episode(4, end="truncated"), episode(2, end="")], **SPACES)
    written = data.to_minari("skillweave/test-v0", author="somebody")
    assert (written.total_episodes, written.total_steps) == (3, 9)
    again = minari.load_dataset("skillweave/test-v0")
    first = next(again.iterate_episodes())
    np.testing.assert_array_equal(first.observations["m"], [0, 1, 2, 0])
    assert first.rewards.tolist() == [0, 1, 2]
    for source in ("skillweave/test-v0", again):
        found = sw.Dataset.from_minari(source)
        equal(found, data)
        assert found.name == "skillweave/test-v0"
    with pytest.raises(RunError, match="Minari does not write 'skillweave/test-v0'"):
        data.to_minari("skillweave/test-v0", author="somebody")
    with pytest.raises(RunError, match=r"cannot load 'no/such-v0'.*download_dataset"):
        sw.Dataset.from_minari("no/such-v0")


def lean(obs: Array) -> Array:
    return (obs[:, 2] > 0).astype(int)


def test_recorded_episodes_are_those_that_evaluate_plays() -> None:
    data = sw.record(lean, "CartPole-v1", episodes=5, seed=3)
    scores = sw.evaluate(lean, "CartPole-v1", episodes=5, seed=3)
    assert data.returns.tolist() == list(scores.returns)
    env = gym.make("CartPole-v1")
    for number in range(5):
        one = data.episode(number)
        env.reset(seed=1_000_000 * 4 + number)
        env.unwrapped.state = one["observations"][0].astype(float)  # type: ignore[attr-defined]
        obs, reward, over, *_ = env.step(int(one["actions"][0]))
        np.testing.assert_allclose(obs, one["observations"][1], atol=1e-5)
        assert (reward, over) == (one["rewards"][0], one["terminations"][0])
    with pytest.raises(EnvError, match="sets no 'x'"):
        sw.record(lean, "CartPole-v1", episodes=1, info=["x"])


@pytest.mark.parametrize("episodes", ["5", 2.5, 0])
def test_a_wrong_number_of_episodes_is_named(episodes: object) -> None:
    with pytest.raises(DeclarationError, match="episodes"):
        sw.record(lean, "CartPole-v1", episodes=episodes)  # type: ignore[arg-type]


def test_a_log_of_calls_is_a_set_of_the_same_steps(tmp_path: Path) -> None:
    class Lean(sw.Skill):
        policy = sw.from_function(lean)

    hierarchy = sw.Hierarchy(
        "CartPole-v1", [Lean()], selector=lambda obs: ["lean"] * len(obs), call_steps=7
    )
    run = hierarchy.train(tmp_path, quiet=True)
    run.log_calls(300)
    data = sw.Dataset.from_log(run.calls)
    assert data.steps == run.calls.steps
    assert data.reward.sum() == run.calls.reward.sum()
    inside = np.setdiff1d(np.arange(data.steps - 1), data.offset[1:] - 1)
    np.testing.assert_array_equal(data.next_obs[inside], data.obs[inside + 1])
    assert (lean(data.obs) == data.action).all()


def test_parts_of_a_set() -> None:
    data = sw.Dataset([episode(k + 1) for k in range(10)], **SPACES)
    most, held = data.split(0.2, seed=1)
    assert (len(most), len(held)) == (8, 2)
    assert sorted([*most.lengths, *held.lengths]) == list(range(1, 11))
    assert data.select([3, 1]).lengths.tolist() == [4, 2]
    equal(data.select(range(10)), data)
    for wrong in ([10], [], [0.5], [-1]):
        with pytest.raises(DeclarationError, match="must be numbers from 0 to 9"):
            data.select(wrong)
    with pytest.raises(DeclarationError, match="two episodes at least"):
        data.select([0]).split()


def changed(**parts: Any) -> Any:
    return [episode(3) | parts]


NAN = {"a": np.full((4, 2), np.nan), "m": np.zeros(4, int)}


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "has no episode with a step"),
        ([{}], r"episode 0 is .*must be a mapping with observations"),
        (changed(actions=(np.zeros(2, int), np.zeros((2, 1)))), "has 4 observations for 2 actions"),
        (changed(rewards=np.zeros(2)), "has 2 rewards for 3 actions"),
        (changed(rewards=[0, np.nan, 0]), "its reward of step 1 is nan"),
        (changed(terminations=[True, False, False]), "ends at step 0 .* has 3 steps: split it"),
        (changed(observations=NAN), "observations have a NaN or an infinity at step 0"),
        (changed(observations={"a": np.zeros((4, 2))}), r"do not fit Dict.*'m'"),
        (changed(observations={"a": np.zeros((4, 3)), "m": np.zeros(4)}), "do not fit"),
        (changed(actions=(np.full(3, 2), np.zeros((3, 1)))), r"its action of step 0 is .*not in"),
        (changed(actions=(np.zeros(3, int), np.full((3, 1), 2.0))), "its action of step 0"),
        (changed(infos={"x": np.zeros(2)}), r"infos\['x'\] has 2 values for 3 actions"),
    ],
)
def test_what_does_not_fit_is_named_with_its_place(episodes: Any, message: str) -> None:
    with pytest.raises(DeclarationError, match=message):
        sw.Dataset(episodes, **SPACES)


def test_other_spaces_and_a_set_larger_than_memory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(DeclarationError, match="give env, or"):
        sw.Dataset([episode(3)])
    data = sw.Dataset([episode(3)], **SPACES)
    with pytest.raises(DeclarationError, match=r"has observations of Dict.*CartPole-v1 has Box"):
        sw.Hierarchy("CartPole-v1", [Rise(), Fall()], steps=10).segment(data)
    pytest.importorskip("minari")
    warnings.simplefilter("ignore")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    data.to_minari("skillweave/large-v0", author="somebody")
    monkeypatch.setattr("skillweave.buffers.ram.free_memory", lambda: 10)
    with pytest.raises(TrainingError, match=r"skillweave/large-v0 needs .*filter_episodes"):
        sw.Dataset.from_minari("skillweave/large-v0")


# Segments


class Rise(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 0] < 0.5

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] >= 0.5


class Fall(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 0] >= 0.5

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] < 0.5

    def success(self, step: Any) -> Array:
        return step.info["good"] > 0


class Never(sw.Skill):
    def initiation(self, obs: Array) -> Array:
        return obs[:, 0] > 9

    def termination(self, step: Any) -> Array:
        return step.next_obs[:, 0] > 9


class Line(gym.Env):
    observation_space = gym.spaces.Box(-10, 10, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {"good": 1}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), 0.0, False, False, {"good": 1}


def line(*places: float, good: int = 1) -> Any:
    steps = len(places) - 1
    return {
        "observations": np.float32(places)[:, None],
        "actions": np.zeros(steps, int),
        "infos": {"good": np.full(steps, good)},
    }


def hierarchy() -> sw.Hierarchy:
    spec = sw.EnvSpec(Line, check_seed=False)
    return sw.Hierarchy(spec, [Rise(), Fall(), Never()], steps=10, call_steps=50)


def test_episodes_are_cut_by_what_skills_declare() -> None:
    data = sw.Dataset([line(0, 0.2, 0.6, 0.7, 0.1, 0.2), line(0.6, 0.2, good=0)], Line)
    found = hierarchy().segment(data)
    assert found.skill.tolist() == [0, 0, 1, 1, -1, -1]
    assert found.call.tolist() == [0, 0, 1, 1, -1, -1]
    assert found.counts == {"rise": 1, "fall": 1, "never": 0}
    assert found.claimed == pytest.approx(4 / 6)
    assert found.log.followed_by.tolist() == [1, -1]
    assert found.never_follow == [("fall", "rise")]
    text = str(found)
    assert "33.3% of 6 steps are claimed by no skill" in text
    assert "'never' may start nowhere" in text
    assert "never one directly after the other: fall > rise" in text
    pieces = found.pieces("fall")
    assert pieces.obs[:, 0].tolist() == pytest.approx([0.6, 0.7])
    assert pieces.next_obs[-1, 0] == pytest.approx(0.1)
    assert pieces.terminated.tolist() == [False, True]
    with pytest.raises(DeclarationError, match="no call of 'never' was found"):
        found.pieces("never")
    with pytest.raises(DeclarationError, match=r"pieces\(\): skill is 'fal'"):
        found.pieces("fal")


def test_a_log_of_found_calls_is_one_of_calls() -> None:
    data = sw.Dataset([line(0, 0.6, 0.1, 0.6, 0.1, 0.9)] * 4, Line)
    log = hierarchy().segment(data).log
    assert "rise" in str(log.handover())
    assert log.handover().of("fall", "rise") == (1.0, 8)
    assert str(log.blame("fall", "rise"))


def test_a_key_of_info_that_data_lack_is_named() -> None:
    bare = {k: v for k, v in line(0, 0.6, 0.1).items() if k != "infos"}
    data = sw.Dataset([bare], Line, name="mine")
    with pytest.raises(DeclarationError, match=r"'fall' reads info\['good'\]: mine has .* none"):
        hierarchy().segment(data)


def test_a_skill_that_is_done_where_it_starts_is_noticed() -> None:
    class Done(Rise):
        def initiation(self, obs: Array) -> Array:
            return np.ones(len(obs), bool)

    spec = sw.EnvSpec(Line, check_seed=False)
    made = sw.Hierarchy(spec, [Done(), Fall()], steps=10, call_steps=50)
    data = sw.Dataset([line(0, 0.6, 0.7, 0.8, 0.9, 0.1)], Line)
    assert "'done' ends at its first step in 100% of its calls" in str(made.segment(data))
    assert made.segment(data, shortest=4).counts == {"done": 0, "fall": 1}
    for wrong in ({"shortest": 0}, {"goals": {"up": lean}}, {"data": 5}):
        with pytest.raises(DeclarationError, match=r"segment\(\): |goals names"):
            made.segment(**{"data": data} | wrong)


LINE = gym.spaces.Box(-1, 1, (2,))
PLAIN: dict[str, Any] = {
    "observations": np.zeros((4, 2)), "actions": [0, 1, 1], "rewards": [1, 1, 1],
}  # fmt: skip


def plain(episodes: Any) -> sw.Dataset:
    return sw.Dataset(episodes, observation_space=LINE, action_space=gym.spaces.Discrete(2))


UNTIDY: dict[str, tuple[Any, str]] = {
    "one episode": (lambda: plain(PLAIN), "it must be a list of episodes, each a mapping"),
    "nothing": (lambda: plain(None), "Dataset.*episodes is None"),
    "a number": (lambda: plain(3), "episodes is 3"),
    "D4RL's names": (
        lambda: plain([{**PLAIN, "terminals": [0, 0, 1]}]),
        "has 'terminals', which is not read: call it 'terminations'",
    ),
    "Gym's names": (lambda: plain([{**PLAIN, "dones": [0, 0, 1]}]), "has 'dones'"),
    "ends as texts": (
        lambda: plain([{**PLAIN, "terminations": ["False", "False", "True"]}]),
        "terminations are no numbers",
    ),
    "a large reward": (lambda: plain([{**PLAIN, "rewards": [1e300, 1, 1]}]), "step 0 is inf"),
    "no step": (
        lambda: plain([{"observations": np.zeros((1, 2)), "actions": [], "rewards": []}]),
        "has no episode with a step",
    ),
    "no log": (lambda: sw.Dataset.from_log(5), "log is 5; it must be a log of calls"),
    "no such episode": (lambda: plain([PLAIN]).episode(9), "number is 9; it must be from 0 to 0"),
}


@pytest.mark.parametrize("mistake", UNTIDY)
def test_untidy_episodes_are_named(mistake: str) -> None:
    make, says = UNTIDY[mistake]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DeclarationError, match=says):
            make()


def test_infos_may_be_what_steps_returned() -> None:
    infos = [{"x": 1.0, "name": "a", "own": [1]}, {"x": 2.0, "own": [1, 2]}, {"x": 3.0, "own": []}]
    data = plain([{**PLAIN, "infos": infos}])
    assert data.info.keys() == {"x"}
    assert data.info["x"].tolist() == [1.0, 2.0, 3.0]
    with_first = plain([{**PLAIN, "infos": [{"x": 9.0}, *infos]}])
    assert with_first.info["x"].tolist() == [1.0, 2.0, 3.0]
