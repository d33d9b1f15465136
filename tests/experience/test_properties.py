"""What holds of all experience: rows chain, joined collectors find what they find alone."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, strategies as st
from reference_calls import POSITION, Counter, Left, Right, Walk, Zigzag
from toy_acting import Choices, requests, valid_rows
from toys import ASKS, SHOWS, alone_in, calling_in, skills_of

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.batches import Batch
from skillweave.algorithms.config import PPO, SAC
from skillweave.envs.joined import JoinedEngines
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acting, Request
from skillweave.experience.collector import Collected, joined_collected, joined_from, parted
from skillweave.networks.config import CNN, RNN, Network
from skillweave.skills import Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.skills.skill_set import SkillSet


def env_of(shows, asks):
    """Environments of any spaces: observations are drawn, and episodes end in three ways."""

    class Any(gym.Env):
        observation_space, action_space = SHOWS[shows], ASKS[asks][0]

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.space = type(self.observation_space)
            self.t, self.length = 0, int(self.np_random.integers(2, 9))
            self.end = int(self.np_random.integers(3))
            self.observation_space.seed(int(self.np_random.integers(1 << 30)))
            return self.observation_space.sample(), {}

        def step(self, action):
            assert self.action_space.contains(action)
            self.t += 1
            ended = self.t == self.length
            obs = self.observation_space.sample()
            return obs, 1.0, ended and self.end != 1, ended and self.end != 0, {}

    return Any


class Half(Skill):
    """May start in about half of all observations, and ends so, too."""

    max_steps = 4

    def initiation(self, obs):
        return half(obs)

    def termination(self, step):
        return half(step.next_obs) & (step.elapsed > 1)


class Whole(Skill):
    """May start anywhere."""


def half(obs):
    """About half of observations of any kind."""
    rows = np.ascontiguousarray(obs).view(np.uint8).reshape(len(obs), -1)
    return rows.astype(np.int64).sum(1) % 2 == 0


def chained(experiences):
    """How many times a row begins where the one before ended, in all columns together."""
    count = 0
    for n in range(experiences[0].lead[1]):
        before = None
        for e in experiences:
            for t in valid_rows(e, n):
                assert not (e["terminated"][t, n] and e["truncated"][t, n])
                if before is not None:
                    np.testing.assert_array_equal(e["obs"][t, n], before)
                    count += 1
                before = None if e.ended[t, n] else e["next_obs"][t, n]
    return count


def learner(env, algorithm="ppo"):
    small = Network((4,), cnn=CNN("plain", (2,), (3,), (2,)))
    kinds = {
        "ppo": PPO(num_envs=3, n_steps=8, batch_size=8, network=small),
        "memory": PPO(
            num_envs=3, n_steps=8, batch_size=8,
            network=Network((4,), cnn=small.cnn, rnn=RNN("gru", 4)),
        ),
        "off": SAC(num_envs=3, buffer_size=99, batch_size=4, learning_starts=4, network=small),
    }  # fmt: skip
    made = make_algorithm(kinds[algorithm], env.observation_space, env.action_space)
    return made, made.acting_params(made.init([Seeds(0)]), 0.0)


def asked(params, rows, **how):
    for i in range(9):
        yield Request(rows, (params,), np.array([0.9]), Seeds(1) / i, **how)


@pytest.mark.fast_cases(13)
@pytest.mark.parametrize("skill", [None, Half()], ids=["task", "skill"])
@pytest.mark.parametrize("asks", ASKS)
@pytest.mark.parametrize("shows", SHOWS)
def test_rows_of_skills_chain_in_every_space(shows, asks, skill):
    kind = env_of(shows, asks)
    for algorithm in ("ppo", "off") if asks in ("Discrete", "Box") else ("ppo",):
        engine = make_engine(EnvSpec(kind, engine="sync"), 3)
        learns, params = learner(kind, algorithm)
        collector = alone_in(engine, Acting([(learns, 1)], 3), skill)
        collector.start(Seeds(2))
        collected = [collector.collect(r) for r in itertools.islice(asked(params, 7), 5)]
        assert sum(c.steps for c in collected) == 105
        found = [c.batches[""] for c in collected]
        assert chained(found) > 20
        assert np.concatenate([e.ended for e in found]).sum() > 4


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("shows", SHOWS)
def test_decisions_chain_in_every_space(shows):
    for asks in ASKS:
        kind = env_of(shows, asks)
        engine = make_engine(EnvSpec(kind, engine="sync"), 3)
        wanted = ASKS[asks][1]
        act = ScriptedPolicy(
            lambda obs, wanted=wanted: wanted[half(obs).astype(int)],
            kind.observation_space, kind.action_space,
        )  # fmt: skip
        calls = SkillSet((Half(), Whole()), (act, act), call_steps=5)
        chooses = type("Chooses", (), {"observation_space": kind.observation_space})
        chooses.action_space = gym.spaces.Discrete(2)
        learns, params = learner(chooses, "memory")
        collector = calling_in(engine, Acting([(learns, 1)], 3), calls)
        collector.start(Seeds(2))
        collected = [collector.collect(r) for r in itertools.islice(asked(params, 9), 5)]
        assert sum(c.steps for c in collected) == 135
        found = [c.batches[""] for c in collected]
        assert chained(found) > 10
        for e in found:
            valid = e.valid_rows
            chosen = np.take_along_axis(e["mask"], e["action"][..., None], 2)[..., 0]
            assert chosen[valid].all(), "a skill was chosen that may not start"


# Joined collectors -----------------------------------------------------------------------------


class Aside(Skill):
    """May start to the left only, so it must be searched for."""

    max_steps = 4

    def initiation(self, obs):
        return obs[:, POSITION] <= -1


def skill_part(kind):
    engine = make_engine(EnvSpec(Walk, engine="sync"), 2)
    skills = {"task": None, "skill": Left(), "search": Aside()}
    return alone_in(engine, Choices(2, 3), skills[kind])


def decision_part(kind):
    calls = skills_of(Left, Right, Zigzag, Counter, call_steps=40)
    engine = make_engine(EnvSpec(Walk, engine="sync"), 2)
    return calling_in(engine, Choices(2, 4), calls, keep_rewards=kind == "rewards")


class Slow(Skill):
    """A call of it lasts until the episode ends, after 3 to 60 steps."""

    policy = Zigzag.policy


class Longer(Walk):
    """A walk of 3 to 60 steps."""

    def reset(self, **how):
        found = super().reset(**how)
        self.length = int(self.np_random.integers(3, 60))
        return found


def long_part(kind):
    skills = SkillSet((Slow(), Slow()), (Slow.policy, Slow.policy))
    engine = make_engine(EnvSpec(Longer, engine="sync"), 2)
    return calling_in(engine, Choices(2, 2), skills, keep_rewards=True)


def compare(one, two):
    """Two experiences are the same in their valid rows; rewards of steps may be padded."""
    a, b = one.batches[""], two.batches[""]
    assert a.lead[1] == b.lead[1]
    for n in range(a.lead[1]):
        rows, others = valid_rows(a, n), valid_rows(b, n)
        assert len(rows) == len(others)
        apart = {"valid", "recurrent_state"}
        assert a.keys() - apart == b.keys() - apart
        for name in a.keys() - apart:
            x, y = a[name][rows, n], b[name][others, n]
            if name == "rewards":
                width = max(x.shape[1], y.shape[1])
                x, y = (np.pad(z, ((0, 0), (0, width - z.shape[1]))) for z in (x, y))
            np.testing.assert_array_equal(x, y)
    assert one.steps == two.steps
    np.testing.assert_array_equal(np.sort(one.episodes, axis=0), np.sort(two.episodes, axis=0))


JOINED = {
    "task": (skill_part, "task", 3),
    "skill": (skill_part, "skill", 3),
    "selector": (decision_part, "plain", 4),
    "selector, rewards kept": (decision_part, "rewards", 4),
    "long calls": (long_part, "rewards", 2),
}


@pytest.mark.fast_cases(4)
@pytest.mark.parametrize("rows", [1, 6, 17])
@pytest.mark.parametrize("kind", JOINED)
def test_joined_collectors_find_what_they_find_alone(kind, rows):
    make, which, actions = JOINED[kind]
    parts, alone = ([make(which) for _ in range(3)] for _ in range(2))
    for i, (part, single) in enumerate(zip(parts, alone, strict=True)):
        part.start(Seeds(4) / i)
        single.start(Seeds(4) / i)
    stream = requests(rows)
    for turn in range(6):
        if turn % 3 == 0 and turn:  # for a while, each alone
            for request in itertools.islice(stream, 2):
                for part, single in zip(parts, alone, strict=True):
                    compare(part.collect(request), single.collect(request))
        joined = joined_from(parts, JoinedEngines([p.engine for p in parts]), Choices(6, actions))
        for request in itertools.islice(stream, 3):
            whole = joined.collect(request)
            compare(whole, joined_collected([c.collect(request) for c in alone], 1))
        parted(joined, parts)


def test_joined_collectors_go_on_with_the_search_for_a_start():
    parts = [skill_part("search") for _ in range(3)]
    for i, part in enumerate(parts):
        part.start(Seeds(4) / i)
    stream, found = requests(5), []
    for _ in range(4):
        joined = joined_from(parts, JoinedEngines([p.engine for p in parts]), Choices(6, 3))
        found += [joined.collect(r).batches[""] for r in itertools.islice(stream, 3)]
        parted(joined, parts)
        for name, rows in joined.kept.items():
            np.testing.assert_array_equal(np.concatenate([p.kept[name] for p in parts]), rows)
        for i, part in enumerate(parts):
            np.testing.assert_array_equal(part.obs, joined.obs[2 * i : 2 * i + 2])
    assert chained(found) > 40
    valid = np.concatenate([e.valid_rows for e in found])
    assert 0 < valid.sum() < valid.size


# Side by side ----------------------------------------------------------------------------------

SIZES = st.lists(st.integers(1, 4), min_size=1, max_size=4)


@given(heights=SIZES, members=st.integers(1, 3), each=st.integers(1, 2), data=st.data())
def test_ragged_parts_stand_side_by_side_member_by_member(heights, members, each, data):
    parts = [part_of(h, i, members * each, data) for i, h in enumerate(heights)]
    collected = joined_collected(parts, members)
    found = collected.batches[""]
    own = each  # environments of a member in one part
    columns = members * each * len(parts)
    assert found["reward"].shape == (max(heights), columns)
    assert collected.steps == sum(p.steps for p in parts)
    for column in range(columns):
        member, rest = divmod(column, own * len(parts))
        number, at = divmod(rest, own)
        part, n = parts[number].batches[""], member * own + at
        rows, others = valid_rows(found, column), valid_rows(part, n)
        assert len(rows) == len(others)
        np.testing.assert_array_equal(found["reward"][rows, column], part["reward"][others, n])
        np.testing.assert_array_equal(found["obs"][rows, column], part["obs"][others, n])
        np.testing.assert_array_equal(found["recurrent_state"][column], part["recurrent_state"][n])
        width = part["rewards"].shape[2]
        np.testing.assert_array_equal(
            found["rewards"][rows, column, :width], part["rewards"][others, n]
        )
        assert not found["rewards"][rows, column, width:].any()
        if found.get("mask") is not None:
            known = part.get("mask")
            wanted = np.ones((len(others), 2)) if known is None else known[others, n]
            np.testing.assert_array_equal(found["mask"][rows, column], wanted)


def part_of(height, number, columns, data):
    """An experience in which every number is another one."""
    lead = (height, columns)
    base = 1_000 * (number + 1) + np.arange(height * columns).reshape(lead)
    counts = [data.draw(st.integers(0, height)) for _ in range(columns)]
    width = data.draw(st.integers(1, 3))
    no = np.zeros(lead, bool)
    masked, ragged = data.draw(st.booleans()), data.draw(st.booleans())
    rows = Batch(
            obs=base[..., None].astype(np.float32), action=base, reward=base.astype(np.float32),
            steps=base, terminated=no, truncated=no, next_obs=base[..., None].astype(np.float32),
            mask=base[..., None] % 3 != np.arange(2) if masked else None,
            valid=np.arange(height)[:, None] < counts if ragged else None,
            recurrent_state=np.arange(columns)[:, None] + 100.0 * number, episode_start=no,
            rewards=base[..., None] + np.arange(width) / 8,
    )  # fmt: skip
    return Collected({"": rows}, int(base.sum()), np.zeros((0, 4)))
