"""Rows of a hierarchy in a hierarchy, against one environment at a time in plain Python."""

from __future__ import annotations

import itertools
import zlib
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from joint_learners import Learner, Values
from reference_calls import POSITION, T, Walk, one_step, scripted, seeds_of
from toy_acting import Again, Choices, Counts, requests, valid_rows
from toys import alone_in, calling_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.skills import Skill
from skillweave.skills.skill_set import SkillSet, UntrainedHierarchy

N, ROWS, GAMMA, INNER = 4, 40, 0.97, 0.9


class Up(Skill):
    """Learns, beside the hierarchy."""

    def reward(self, step):
        return step.next_obs[:, POSITION] - step.obs[:, POSITION]


class Down(Skill):
    """Learns, in the hierarchy; ends by itself."""

    def reward(self, step):
        return step.obs[:, POSITION] - step.next_obs[:, POSITION] + 0.25 * step.elapsed

    def initiation(self, obs):
        return obs[:, POSITION] >= -1

    def termination(self, step):
        return step.next_obs[:, POSITION] % 4 == 0


class Rest(Skill):
    """Is ready, in the hierarchy."""

    policy = scripted(1)

    def initiation(self, obs):
        return obs[:, T] % 3 != 1


class Paid(Skill):
    """The hierarchy: paid in its own way, it stops by itself or after seven steps."""

    max_steps = 7

    def reward(self, step):
        return step.next_obs[:, POSITION] + 0.5 * step.elapsed + 100.0 * step.timed_out

    def termination(self, step):
        return step.next_obs[:, POSITION] == 3


class Plain(Skill):
    """The hierarchy, for the task's reward."""


class Selector(Learner):
    """Chooses among the skills in the hierarchy."""

    def __init__(self, num_envs, actions):
        super().__init__(num_envs)
        self.actions = actions


class Remembering(Selector, Counts):
    """The same; it remembers how often it chose."""

    memory_size = 1

    def some(self, rows, obs, mask, memory):
        return Counts.some(self, rows, obs, mask, memory)


def collector_of(node, outer_steps, inner_steps, chooser=Selector, env=Walk):
    skills = SkillSet((Down(), Rest()), (None, Rest.policy), call_steps=inner_steps)
    inner = UntrainedHierarchy(skills, None)
    whole = SkillSet((Up(), node()), (None, inner), call_steps=outer_steps)
    engine = make_engine(EnvSpec(env, engine="sync"), N)
    name = node().name
    learners = {
        "up": Learner(N), f"{name}/down": Learner(N), f"{name}/selector": chooser(N, 2),
        f"{name}/skill_critic": Values(N), "skill_critic": Values(N),
    }  # fmt: skip
    collector = calling_in(engine, Choices(N, 2), whole, learners=learners)
    collector.start(Seeds(7))
    return collector


def asked(rows, collector):
    """Requests for the selector and the five others; the inner selector has its own γ."""
    for request in requests(rows, GAMMA):
        inner = replace(request, gamma=np.array([INNER]))
        below = {k: inner if k.endswith("/selector") else request for k in collector.learners}
        yield replace(request, below=below)


def choose(obs, actions, allowed=None):
    """What ``Choices`` chooses."""
    rng = np.random.default_rng(zlib.crc32(obs.tobytes()))
    return int(rng.choice(np.flatnonzero(np.ones(actions) if allowed is None else allowed)))


def said(skill, method, about):
    return getattr(skill, method)(about)[0]


class One:
    """One environment, one step after the other, from what a call means."""

    def __init__(self, node, outer_steps, inner_steps):
        self.node, self.limits = node(), (outer_steps, inner_steps)
        self.inside = (Down(), Rest())
        self.decisions, self.leaves, self.critic = [], [], []

    def may(self, obs):
        return [bool(said(s, "initiation", obs[None])) for s in self.inside]

    def play(self, seeds, steps):
        env = Walk()
        obs, _ = env.reset(seed=next(seeds))
        self.outer, self.open, over, inner_over = None, None, True, True
        for _ in range(steps):
            if over:
                before, self.outer = self.outer, choose(obs, 2, [True, any(self.may(obs))])
                self.elapsed = 0
                if self.outer != before:
                    inner_over = True
                    self.close(False, True, obs)
            if self.outer == 1 and inner_over:
                choice = choose(obs, 2, self.may(obs))
                self.skill, self.lasted = choice, 0
                self.open = {"obs": obs, "action": choice, "reward": 0.0, "steps": 0}
            learns = self.outer == 0 or self.skill == 0
            action = choose(obs, 3) if learns else 1
            now, reward, terminated, truncated, info = env.step(action)
            self.elapsed += 1
            ended = terminated or truncated
            what = obs, action, now, reward, terminated, truncated
            if self.outer == 0:
                step = one_step(*what, self.elapsed, Up(), info)
                self.leaves.append(("up", obs, float(said(Up(), "reward", step)), terminated))
                over = ended or self.elapsed >= self.limits[0]
            else:
                over, inner_over = self.inner_step(what, info, ended)
            obs = now
            if ended:
                obs, _ = env.reset(seed=next(seeds))
                self.outer, over, inner_over = None, True, True

    def inner_step(self, what, info, ended):
        """A step of the hierarchy: whether its call is over, and that of its selector."""
        now, terminated = what[2], what[4]
        self.lasted += 1
        skill, node = self.inside[self.skill], self.node
        step = one_step(*what, self.lasted, skill, info)
        own = bool(said(skill, "termination", step))
        inner_over = own or ended or self.lasted >= self.limits[1]
        if self.skill == 0:
            told = float(said(skill, "reward", step))
            self.leaves.append(("down", what[0], told, terminated or own))
        step = one_step(*what, self.elapsed, node, info)
        stops = terminated or bool(said(node, "termination", step))
        timed_out = bool(step.timed_out[0])
        limit = self.elapsed >= self.limits[0] or timed_out
        stuck = inner_over and not ended and not any(self.may(now))
        over = stops or ended or limit or stuck
        reward = float(said(node, "reward", step))
        self.critic.append(
            (what[0], self.skill, reward, stops, over and not stops, self.lasted == 1)
        )
        if self.open is not None:
            self.open["reward"] += INNER ** self.open["steps"] * reward
            self.open["steps"] += 1
        if inner_over or stops or ended or (over and timed_out):
            self.close(stops, over and not stops, now)
        return over, inner_over

    def close(self, terminated, truncated, next_obs):
        if self.open is not None:
            more = {"terminated": terminated, "truncated": truncated, "next_obs": next_obs}
            self.decisions.append(self.open | more)
        self.open = None


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("node", [Paid, Plain])
@pytest.mark.parametrize(("outer", "inner"), [(4, 3), (3, 5), (1, 2), (9, 1), (6, 6)])
def test_decisions_of_both_levels_are_what_calls_mean(node, outer, inner):
    collector = collector_of(node, outer, inner)
    rows = [collector.collect(r).batches for r in itertools.islice(asked(ROWS, collector), 6)]
    name = node().name
    seeds = seeds_of((Seeds(7) / "env").integer(), N)
    ends = np.zeros(3, int)
    for n in range(N):
        one = One(node, outer, inner)
        one.play(seeds[n], 6 * ROWS)
        mine = [_rows(r[f"{name}/selector"], n) for r in rows]
        mine = list(itertools.chain(*mine))
        assert len(mine) == len(one.decisions) > 10
        for row, told in zip(mine, one.decisions, strict=True):
            assert row["action"] == told["action"]
            assert row["steps"] == told["steps"]
            assert row["reward"] == pytest.approx(told["reward"], abs=1e-4)
            np.testing.assert_array_equal(row["obs"], told["obs"])
            np.testing.assert_array_equal(row["next_obs"], told["next_obs"])
            assert (row["terminated"], row["truncated"]) == (told["terminated"], told["truncated"])
            ends += [
                row["terminated"],
                row["truncated"],
                not (row["terminated"] | row["truncated"]),
            ]
        for leaf, path in (("up", "up"), ("down", f"{name}/down")):
            own = itertools.chain(*(_rows(r[path], n) for r in rows))
            told = [x[1:] for x in one.leaves if x[0] == leaf]
            for row, (obs, reward, terminated) in zip(own, told, strict=True):
                np.testing.assert_array_equal(row["obs"], obs)
                assert row["reward"] == pytest.approx(reward, abs=1e-4)
                assert row["terminated"] == terminated
        own = itertools.chain(*(_rows(r[f"{name}/skill_critic"], n) for r in rows))
        for row, (obs, skill, reward, stops, cut, begins) in zip(own, one.critic, strict=True):
            np.testing.assert_array_equal(row["obs"], obs)
            assert (row["action"], row["terminated"], row["truncated"]) == (skill, stops, cut)
            assert row["call_start"] == begins
            assert row["reward"] == pytest.approx(reward, abs=1e-4)
    assert ends[1] > 5
    assert ends.sum() > 60


def _rows(experience, n):
    names = ["obs", "action", "reward", "steps", "terminated", "truncated", "next_obs"]
    if experience.get("call_start") is not None:
        names.append("call_start")
    for t in valid_rows(experience, n):
        yield {k: experience[k][t, n] for k in names}


def test_a_trajectory_of_a_leaf_goes_on_where_it_acts_again_at_once():
    collector = collector_of(Plain, 2, 5)
    seen = 0
    for request in itertools.islice(asked(ROWS, collector), 4):
        rows = collector.collect(request).batches["plain/down"]
        for t, n in zip(*np.nonzero(rows["valid"]), strict=True):
            if rows["terminated"][t, n]:
                assert not rows["truncated"][t, n]
                continue
            ended = rows["obs"][t, n, 1] != (rows["obs"][t + 1, n, 1] if t + 1 < ROWS else -1)
            again = t + 1 < ROWS and rows["valid"][t + 1, n] and not ended
            if again:
                assert not rows["truncated"][t, n], "the same leaf acts on"
                seen += 1
            elif t + 1 < ROWS:
                assert rows["truncated"][t, n]
    assert seen > 8


def test_what_a_selector_below_remembers_begins_with_each_new_call():
    collector = collector_of(Plain, 3, 1, Remembering)
    for request in itertools.islice(asked(ROWS, collector), 3):
        rows = collector.collect(request).batches["plain/selector"]
        for n in range(N):
            counted = None
            for row, t in enumerate(valid_rows(rows, n)):
                if row == 0:
                    counted = rows["recurrent_state"][n, 0]
                if rows["episode_start"][t, n]:
                    counted = 0
                assert rows["dist_params"][t, n, 0] == counted, "what it remembered when it chose"
                counted += 1
    assert rows["episode_start"].any()


class Ending(Skill):
    """Ends by itself in each episode's last step."""

    def termination(self, step):
        return step.terminated | step.truncated


def test_memory_starts_with_each_episode_also_where_the_call_ended_by_itself():
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    skills = SkillSet((Ending(),), (None,), call_steps=3)
    learners = {"ending": Remembering(N, 3)}
    collector = calling_in(engine, Choices(N, 1), skills, learners=learners)
    collector.start(Seeds(7))
    rows = collector.collect(next(asked(ROWS, collector))).batches["ending"]
    assert (rows["episode_start"] == (rows["obs"][..., T] == 0)).all()
    assert (rows["dist_params"][..., 0] == rows["obs"][..., T]).all()
    assert rows["terminated"].sum() > 8
    assert not rows["truncated"][:-1].any()


def test_a_collector_goes_on_where_a_state_was_taken():
    other = collector_of(Paid, 4, 5, env=Again)
    first, second, third = itertools.islice(asked(17, other), 3)
    other.collect(first)
    state = other.state()
    restored = collector_of(Paid, 4, 5, env=Again)
    restored.restore(state)
    for request in (second, third):
        a, b = other.collect(request).batches, restored.collect(request).batches
        for mine, theirs in zip(a.values(), b.values(), strict=True):
            for name in ("obs", "action", "reward", "steps", "terminated", "truncated", "valid"):
                np.testing.assert_array_equal(mine.get(name), theirs.get(name))


class Early(Skill):
    """May start in the first steps of an episode only."""

    policy = scripted(1)

    def initiation(self, obs):
        return obs[:, T] < 2


@pytest.mark.parametrize("call_steps", [1, 3])
def test_apart_a_hierarchy_is_judged_as_the_skill_that_it_is(call_steps):
    skills = SkillSet((Early(),), (Early.policy,), call_steps=call_steps)
    engine = make_engine(EnvSpec(Walk, engine="sync"), N)
    collector = calling_in(engine, Choices(N, 1), skills, as_skill=Paid())
    collector.start(Seeds(7))
    rows = collector.collect(next(requests(60, GAMMA))).batches[""]
    for n in range(N):
        for row in _rows(rows, n):
            t, tau = row["obs"][T], row["steps"]
            assert t + tau <= max(2, call_steps)
            assert tau <= call_steps
            told = [row["obs"][POSITION] + 0.5 * (t + k + 1) for k in range(int(tau))]
            assert row["reward"] == pytest.approx(sum(GAMMA**k * r for k, r in enumerate(told)))
            if not row["terminated"]:
                assert row["truncated"] == (t + tau >= 2), "then none may start: its value goes on"


class Says(gym.Env):
    """Its episodes last four steps, pay one for each, and say at their end that all is well."""

    observation_space = gym.spaces.Box(0.0, 9.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        over = self.t == 4
        return np.full(1, self.t, np.float32), 1.0, False, over, {"success": over}


class Wait(Skill):
    policy = scripted(1)


@pytest.mark.parametrize(
    ("methods", "success"),
    [
        ({}, 1.0),
        ({"reward": lambda self, step: step.reward}, np.nan),
        ({"success": lambda self, step: step.next_obs[:, 0] < 0}, 0.0),
    ],
)
@pytest.mark.parametrize("called", [False, True])
def test_a_skill_without_a_reward_of_its_own_succeeds_as_the_task_does(methods, success, called):
    skill = type("Whole", (Skill,), methods)()
    engine = make_engine(EnvSpec(Says, engine="sync"), N)
    below = SkillSet((Wait(),), (Wait.policy,), call_steps=2)
    collector = alone_in(engine, Choices(N, 3), skill)
    if called:
        collector = calling_in(engine, Choices(N, 1), below, as_skill=skill)
    collector.start(Seeds(7))
    episodes = collector.collect(next(requests(9, GAMMA))).episodes
    assert len(episodes) == 2 * N
    np.testing.assert_array_equal(episodes[:, 3], success)
    assert (episodes[:, 2] == 4).all()
    assert (episodes[:, 0] == episodes[:, 1]).all(), "all maximise what the task pays"
