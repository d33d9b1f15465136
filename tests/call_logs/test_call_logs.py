"""Logs of calls: recorded, against a loop by hand; saved, damaged, joined."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from call_logs.untrained import SKILLS, skill_set
from goals.worlds import Point
from ready_selectors.chain import DOOR, KEY, LAST, NAMES, SPEC, hierarchy
from toys import skills_of

from skillweave import Automaton, EnvSpec, Lengths
from skillweave.calls import CallLog, join, record_calls
from skillweave.calls.columns import columns_of
from skillweave.errors import DeclarationError, EnvError, RunError
from skillweave.policies.core import CallEnd
from skillweave.runs.files import read_tensors, write_tensors
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet

POINT = EnvSpec(lambda: Point(as_dict=True), engine="sync")  # observations are a Dict


@pytest.fixture(scope="module")
def log() -> CallLog:
    return record_calls(SPEC, skill_set(call_steps=5), 600, num_envs=4, seed=3, info=["door"])


def by_hand(obs, skill: int, age: int, most: int) -> list[Any]:
    """The steps of one call in the corridor: observations; and why it ended."""
    place, key, door = (int(x) for x in obs)
    move = (-1, 1, 1, 0)[skill]
    limit = min(most, (most, 12, 1, 2)[skill])
    found = []
    for t in range(1, limit + 1):
        place = max(0, min(place + move, LAST + door))
        key |= place == 0
        door |= place == LAST and key
        found.append((place, key, door))
        over = place > LAST
        late = age + t == 40 and not over
        if (skill == 0 and key) or (skill == 1 and place == LAST):
            return [found, CallEnd.OWN, over, late]
        if over or late:
            return [found, CallEnd.EPISODE, over, late]
    return [found, CallEnd.LIMIT, False, False]


def test_every_call_is_that_of_a_loop_by_hand(log):
    ages = {}
    ends = {}
    orders = {}
    for c in range(len(log)):
        episode, skill = int(log.episode[c]), int(log.skill[c])
        assert log.order[c] == orders.setdefault(episode, 0)
        orders[episode] += 1
        if episode in ends:
            assert (log.start[c] == ends[episode]).all()
        else:
            assert log.start[c, KEY] == 0
        steps, why, terminated, truncated = by_hand(log.start[c], skill, ages.get(episode, 0), 5)
        inside = log.next_obs[log.offset[c] : log.offset[c + 1]]
        assert inside.tolist() == [list(map(float, s)) for s in steps]
        assert log.end_reason[c] == why
        assert (log.terminated[c], log.truncated[c]) == (terminated, truncated)
        assert log.age[c] == ages.get(episode, 0)
        ages[episode] = ages.get(episode, 0) + len(steps)
        ends[episode] = log.end[c]
        won = steps[-1][DOOR] == 1 if skill == 1 else why == CallEnd.OWN
        assert log.succeeded[c] == won
        assert log.may_follow[c].tolist() == [True, bool(log.end[c, KEY]), True, True]
        action = log.action[log.offset[c] : log.offset[c + 1]]
        assert set(action.tolist()) == {(0, 2, 2, 1)[skill]}
    assert sum(log.terminated) == log.reward.sum() > 0
    assert (log.info["door"] == log.next_obs[:, DOOR]).all()
    assert set(log.skill) == {0, 1, 2, 3}
    assert 600 <= log.steps < 600 + 4 * 5
    assert np.unique(log.episode).tolist() == list(range(log.episode.max() + 1))


def test_what_follows_from_the_columns(log):
    assert log.tau.sum() == log.steps == log.offset[-1]
    following = log.followed_by
    for c in range(len(log)):
        later = np.flatnonzero((log.episode == log.episode[c]) & (log.order == log.order[c] + 1))
        assert following[c] == (later[0] if len(later) else -1)
    gamma = 0.9
    wanted = [
        sum(gamma**k * r for k, r in enumerate(log.reward[a:b]))
        for a, b in zip(log.offset[:-1], log.offset[1:], strict=True)
    ]
    np.testing.assert_allclose(log.returns(gamma), wanted)
    step = log.as_steps()
    assert (step.obs[log.offset[:-1]] == log.start).all()
    inner = np.setdiff1d(np.arange(log.steps), log.offset[:-1])
    assert (step.obs[inner] == log.next_obs[inner - 1]).all()
    assert step.terminated.sum() == log.terminated.sum()
    assert (step.elapsed[log.offset[1:] - 1] == log.age + log.tau).all()
    assert (log.elapsed[log.offset[1:] - 1] == log.tau).all()
    some = log.take(np.array([5, 2]))
    assert some.steps == log.tau[5] + log.tau[2]
    assert (some.end == log.end[[5, 2]]).all()
    assert (some.as_steps().obs[0] == log.start[5]).all()
    assert (log.of("wait").skill == 3).all()
    part = log.within(200)
    assert part.steps <= 200 < part.steps + log.tau[len(part)]
    assert log.latest(100).offset[-1] <= 100
    assert log.latest(100).episode[-1] == log.episode[-1]
    assert repr(log.take(np.array([0]))).startswith("<CallLog: 1 calls (")


def test_the_same_seed_gives_the_same_log(log):
    again = record_calls(SPEC, skill_set(call_steps=5), 600, num_envs=4, seed=3, info=["door"])
    other = record_calls(SPEC, skill_set(call_steps=5), 600, num_envs=4, seed=4, info=["door"])
    for name, column in columns_of(log).items():
        assert np.array_equal(column, columns_of(again)[name]), name
    assert not np.array_equal(log.choice[:50], other.choice[:50])


def test_calls_of_a_selector_and_of_chosen_lengths():
    chain = Automaton(
        {"search": "get_key", "unlock": "open_door", "free": "leave"},
        {
            ("search", "unlock"): lambda step: step.next_obs[:, KEY] == 1,
            ("unlock", "free"): "success",
        },
    )
    made = record_calls(SPEC, hierarchy(chain), 60, choose=chain, num_envs=2)
    assert [NAMES[s] for s in made.skill[made.episode == 0]] == ["get_key", "open_door", "leave"]
    lengths = skill_set(call_steps=Lengths(1, 3))
    made = record_calls(SPEC, lengths, 300, num_envs=3)
    assert made.lengths == (1, 3)
    assert made.choices == 8
    assert made.may_follow.shape == (len(made), 8)
    limited = made.end_reason == CallEnd.LIMIT
    assert (made.tau[limited & (made.skill == 0)] == np.array([1, 3])[
        made.choice[limited & (made.skill == 0)] % 2]).all()  # fmt: skip
    assert set(made.choice) == set(range(8))


def test_a_log_is_saved_and_read(log, tmp_path):
    class Move(Skill):
        max_steps = 3
        policy = ScriptedPolicy(
            lambda obs: np.full((len(obs), 2), 0.25, np.float32),
            *POINT.spaces,
        )

    points = record_calls(POINT, SkillSet((Move(),), (Move.policy,)), 40, num_envs=2)
    assert points.next_obs["picture"].max() == 21  # it shows the time
    for i, made in enumerate((log, points, record_calls(SPEC, skill_set(), 1))):
        made.save(tmp_path / f"{i}.safetensors")
        read = CallLog.load(str(tmp_path / f"{i}.safetensors"))
        assert (read.skills, read.lengths, read.checksums) == (
            made.skills, made.lengths, made.checksums,
        )  # fmt: skip
        assert read.observation_space == made.observation_space
        for name, column in columns_of(made).items():
            other = columns_of(read)[name]
            assert column.dtype == other.dtype
            assert np.array_equal(column, other), name


class Nested(gym.Env[Any, Any]):
    """A Dict, with a Tuple in it, in a Dict; episodes of ten steps."""

    observation_space = gym.spaces.Dict(
        {
            "far": gym.spaces.Box(-1, 1, (2,), np.float32),
            "inner": gym.spaces.Dict(
                {
                    "near": gym.spaces.Box(-1, 1, (3,), np.float64),
                    "pair": gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.MultiBinary(2))),
                }
            ),
        }
    )
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.left = 10
        return self.observation_space.sample(), {}

    def step(self, action):
        self.left -= 1
        return self.observation_space.sample(), 0.0, False, self.left == 0, {}


def test_a_log_of_a_dict_in_a_dict_is_read_again(tmp_path):
    spec = EnvSpec(Nested, engine="sync")

    class Move(Skill):
        max_steps = 3
        policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64), *spec.spaces)

    path = tmp_path / "nested.safetensors"
    made = record_calls(spec, SkillSet((Move(),), (Move.policy,)), 40, num_envs=2)
    made.save(path)
    read = CallLog.load(path)
    for name, column in columns_of(made).items():
        assert columns_of(read)[name].tobytes() == column.tobytes(), name
    tensors, header = read_tensors(path)
    near = tensors["next_obs"].numpy().view(made.next_obs.dtype)["inner"]["near"]
    near[0, 0, 1] = np.nan
    write_tensors(path, tensors, header)
    with pytest.raises(RunError, match="'next_obs' is not finite"):
        CallLog.load(path)


DAMAGE = {
    "offset": (lambda x: x[::-1].copy(), "'offset' is out of range"),
    "choice": (lambda x: x + 4, "'choice' is out of range"),
    "end_reason": (lambda x: x * 0, "'end_reason' is out of range"),
    "order": (lambda x: x - 1, "'order' is out of range"),
    "reward": (lambda x: x * np.nan, "'reward' is not finite"),
    "start": (lambda x: x * np.inf, "'start' is not finite"),
    "next_obs": (lambda x: x[:-1], "'next_obs' is float32"),
    "succeeded": (lambda x: x.astype(np.int8), "'succeeded' is int8"),
    "may_follow": (lambda x: x[:, :2].copy(), "'may_follow' is bool"),
    "info.door": (lambda x: x[:3], "'info.door' is"),
    "terminated": (lambda x: None, "it has the columns"),
    # Differences that wrap around are positive.
    "offset ": (lambda x: with_values(x, 2**63 - 1, -(2**63), -2), "'offset' is out of range"),
    "info.door ": (lambda x: torch.from_numpy(x).bfloat16(), "'info.door' is torch.bfloat16"),
    "action": (lambda x: x.astype(np.complex64), "'action' is complex64"),
}


def with_values(x, *values: int):
    x[1 : len(values) + 1] = values
    return x


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_is_refused(log, tmp_path, name):
    damage, message = DAMAGE[name]
    name = name.strip()
    path = tmp_path / "log.safetensors"
    log.save(path)
    tensors, header = read_tensors(path)
    changed = damage(tensors[name].numpy())
    tensors = {k: v for k, v in tensors.items() if k != name}
    if changed is not None:
        tensors[name] = torch.as_tensor(changed)
    write_tensors(path, tensors, header)
    with pytest.raises(RunError, match=f"log.safetensors is damaged: {message}"):
        CallLog.load(path)


def test_other_files_are_refused(log, tmp_path):
    path = tmp_path / "log.safetensors"
    with pytest.raises(RunError, match="does not exist"):
        CallLog.load(path)
    path.write_bytes(b"PK")
    with pytest.raises(RunError, match="damaged"):
        CallLog.load(path)
    write_tensors(path, {}, {"kind": "agent"})
    with pytest.raises(RunError, match="no log of calls"):
        CallLog.load(path)
    log.save(path)
    tensors, header = read_tensors(path)
    wrong = {"lengths": [0], "skills": ["a", "a", "b", "c"], "checksums": [], "sees": [[3]] * 4}
    for key, value in wrong.items():
        write_tensors(path, tensors, header | {key: value})
        with pytest.raises(RunError, match=r"log\.safetensors"):
            CallLog.load(path)
    goal = torch.zeros(len(log), dtype=torch.float64)
    write_tensors(path, tensors | {"goal.wait": goal}, header | {"goals": ["wait"]})
    with pytest.raises(RunError, match="goal"):
        CallLog.load(path)


def test_logs_are_joined(log):
    other = record_calls(SPEC, skill_set(call_steps=5), 100, num_envs=4, info=["door"])
    both = join([log, other])
    assert (len(both), both.steps) == (len(log) + len(other), log.steps + other.steps)
    assert (both.end == np.concatenate([log.end, other.end])).all()
    assert len(np.unique(both.episode)) == len(np.unique(log.episode)) + len(
        np.unique(other.episode)
    )
    assert (both.followed_by[len(log) :] >= 0).sum() == (other.followed_by >= 0).sum()
    with pytest.raises(RunError, match="record the same keys"):
        join([log, record_calls(SPEC, skill_set(call_steps=5), 20)])
    with pytest.raises(RunError, match="'get_key' differs between the logs"):
        join([log, record_calls(SPEC, skill_set(call_steps=6), 20, info=["door"])])
    few = skills_of(*SKILLS[2:])
    with pytest.raises(RunError, match="another of leave, wait"):
        join([log, record_calls(SPEC, few, 20)])
    with pytest.raises(DeclarationError, match="at least one"):
        join([])


def test_a_log_of_other_skills_says_so(log):
    log.check_skills(skill_set(call_steps=5))
    for skills, message in (
        (skill_set(call_steps=6), "'get_key' has changed since the log was recorded"),
        (skill_set(call_steps=Lengths(1, 2)), "no chosen lengths, but these are with the lengths"),
        (skills_of(*SKILLS[1:]), "record a log of these skills"),
    ):
        with pytest.raises(RunError, match=message):
            log.check_skills(skills)
    elsewhere = replace(log, observation_space=gym.spaces.Box(0, 1, (2,)))
    with pytest.raises(RunError, match="record a log in this environment"):
        elsewhere.check_skills(skill_set(call_steps=5))
    with pytest.raises(DeclarationError, match=r"no skill 'get_kay'.*is 'get_key' meant"):
        log.of("get_kay")


@pytest.mark.parametrize(
    ("how", "kind", "message"),
    [
        ({"steps": 0}, DeclarationError, "steps is 0"),
        ({"choose": "best"}, DeclarationError, "choose is 'best'; it must be 'random'"),
        ({"info": ["window"]}, EnvError, r"info\['window'\] is to be recorded, but no env"),
        ({"skills": 3}, DeclarationError, "3 has no skills"),
        ({"steps": 10**12}, DeclarationError, "at most 4 GiB are recorded"),
    ],
)
def test_wrong_arguments(how, kind, message):
    given = {"env": SPEC, "skills": skill_set(), "steps": 10} | how
    with pytest.raises(kind, match=message):
        record_calls(**given)
