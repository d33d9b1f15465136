"""Decisions equal a scalar loop, call for call, though no environment waits for another."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
import torch
from reference_calls import (
    EPISODE,
    POSITION,
    Counter,
    Counting,
    Left,
    Right,
    Scalar,
    T,
    Walk,
    Zigzag,
    scripted,
    seeds_of,
    shy,
)
from toy_acting import Again, Choices, Counts, Given, requests, valid_rows

from skillweave.algorithms.config import PPO
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.decisions import DecisionCollector
from skillweave.collecting.ends import CallEnd
from skillweave.collecting.skill_rows import SkillCollector
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill
from skillweave.skills.scripted import ScriptedPolicy

N, ALL = 4, (Left, Right, Zigzag, Counter)


def skill_set(*kinds, call_steps=5, **how):
    skills = tuple(kind() for kind in kinds)
    return SkillSet(skills, tuple(s.policy for s in skills), call_steps=call_steps, **how)


def collector_of(skills, n=N, keep_rewards=False, env=Walk, acting=None, **spec):
    engine = make_engine(EnvSpec(env, engine="sync", **spec), n)
    acting = acting or Choices(n, len(skills.skills))
    found = DecisionCollector(engine, acting, skills, keep_rewards)
    found.start(Seeds(7))
    return found


def scalars_of(skills, call_steps, n=N, gamma=0.97, reflexes=(), env=Walk):
    gamma = np.broadcast_to(gamma, n)
    found = [Scalar(env(), skills, call_steps, float(g), reflexes) for g in gamma]
    seed = (Seeds(7) / "env").integer()
    for scalar, seeds in zip(found, seeds_of(seed, n), strict=True):
        scalar.reset(seeds)
        scalar.paid, scalar.length = 0.0, 0
    return found


def compare(collected, scalars, exact=False):
    """Every decision is the scalar loop's next one; how many steps each column's calls took."""
    experience, episodes = collected.batches[""], []
    valid = experience.valid_rows
    assert (valid[:-1] | ~valid[1:]).all(), "a gap within a column"
    steps = np.zeros(len(scalars), int)
    for t, n in zip(*np.nonzero(valid), strict=True):
        scalar = scalars[n]
        allowed, obs = scalar.allowed(), scalar.obs
        np.testing.assert_array_equal(experience["obs"][t, n], obs)
        if experience.get("mask") is not None:
            assert experience["mask"][t, n].tolist() == allowed
        want = scalar.call(int(experience["action"][t, n]))
        assert experience["steps"][t, n] == want.steps
        near = np.float32(want.reward) if exact else pytest.approx(want.reward, abs=1e-5)
        assert experience["reward"][t, n] == near
        assert experience["terminated"][t, n] == want.terminated
        assert experience["truncated"][t, n] == (want.truncated and not want.terminated)
        np.testing.assert_array_equal(experience["next_obs"][t, n], want.next_obs)
        assert experience["dist_params"][t, n, 0] == experience["action"][t, n]
        if experience.get("rewards") is not None:
            each = experience["rewards"][t, n]
            total = (each * scalar.gamma ** np.arange(len(each))).sum()
            assert total == pytest.approx(want.reward, abs=1e-5)
            assert not each[want.steps :].any()
        steps[n] += want.steps
        scalar.paid, scalar.length = scalar.paid + want.plain, scalar.length + want.steps
        if want.terminated or want.truncated:
            episodes.append((scalar.paid, scalar.length))
            scalar.paid, scalar.length = 0.0, 0
    told = sorted(map(tuple, collected.episodes[:, [0, 2]]))
    np.testing.assert_allclose(np.reshape(told, (-1, 2)), np.reshape(sorted(episodes), (-1, 2)))
    return steps


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("call_steps", [1, 2, 5, 40])
@pytest.mark.parametrize("rows", [1, 7, 64])
def test_every_decision_is_that_of_a_scalar_loop(call_steps, rows):
    skills = skill_set(*ALL, call_steps=call_steps, reflexes=(shy(),))
    collector = collector_of(skills, keep_rewards=True)
    scalars = scalars_of(skills.skills, call_steps, reflexes=skills.reflexes)
    taken, ticks, ended = np.zeros(N, int), 0, 0
    for request in itertools.islice(requests(rows), -(-200 // rows)):
        collected = collector.collect(request)
        taken += compare(collected, scalars)
        ticks, ended = ticks + rows, ended + len(collected.episodes)
        assert collected.steps == rows * N
    # What is not in a decision yet is in an open call: no step is lost, none invented.
    open_calls = np.where(collector.memory["end"] == CallEnd.RUNNING, collector.kept["tau"], 0)
    np.testing.assert_array_equal(taken + open_calls, ticks)
    assert ended > 20


BACK = Reflex(lambda obs: obs[:, POSITION] <= -2, lambda obs: 1 + (obs[:, T] % 2).astype(int))


@pytest.mark.parametrize("call_steps", [3, None])
@pytest.mark.parametrize("reflexes", [(BACK, shy()), (shy(), BACK)])
def test_reflexes_override_and_the_last_one_wins(call_steps, reflexes):
    skills = skill_set(Left, Counter, call_steps=call_steps, reflexes=reflexes)
    collector = collector_of(skills)
    scalars = scalars_of(skills.skills, call_steps, reflexes=reflexes)
    for request in itertools.islice(requests(40), 4):
        compare(collector.collect(request), scalars)
    for env, scalar in zip(collector.engine._envs.envs, scalars, strict=True):
        assert env.unwrapped.log[: len(scalar.env.log)] == scalar.env.log
    assert {a for s in scalars for _, _, a in s.env.log} == {0, 1, 2}


def test_a_power_of_two_as_gamma_agrees_to_the_last_bit():
    skills = skill_set(*ALL, call_steps=7)
    collector, scalars = collector_of(skills), scalars_of(skills.skills, 7, gamma=0.5)
    for request in itertools.islice(requests(50, gamma=0.5), 3):
        assert compare(collector.collect(request), scalars, exact=True).sum() > 100


class Members(Choices):
    """As many members as environments, each with a γ of its own."""

    def __init__(self, num_envs, actions):
        super().__init__(num_envs, actions)
        self.each, self.members = 1, num_envs


def test_every_member_has_its_own_gamma_and_the_rewards_of_each_step_are_kept():
    skills, gamma = skill_set(*ALL, call_steps=40), np.linspace(0.5, 1.0, N)
    collector = collector_of(skills, keep_rewards=True, acting=Members(N, len(ALL)))
    scalars = scalars_of(skills.skills, 40, gamma=gamma)
    widths = set()
    for request in itertools.islice(requests(60, gamma), 3):
        collected = collector.collect(request)
        compare(collected, scalars)
        widths.add(collected.batches[""]["rewards"].shape)
    assert all(width >= 13 for _, _, width in widths)
    plain = collector_of(skills).collect(next(requests(60))).batches[""]
    assert "rewards" not in plain


class Push(Skill):
    """CartPole: to the left."""

    max_steps = 2
    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64), None, None)


class Balance(Skill):
    """CartPole: against the fall, while the cart is left of the middle."""

    policy = ScriptedPolicy(lambda obs: (obs[:, 2] + obs[:, 3] > 0).astype(np.int64), None, None)

    def initiation(self, obs):
        return obs[:, 0] < 0.05

    def termination(self, step):
        return np.abs(step.next_obs[:, 1]) > 0.4


class Hover(Skill):
    """LunarLander: the main engine while sinking, until rising."""

    policy = ScriptedPolicy(lambda obs: np.where(obs[:, 3] < -0.1, 2, 0), None, None)

    def initiation(self, obs):
        return obs[:, 3] < 0

    def termination(self, step):
        return step.next_obs[:, 3] > 0


class Turn(Skill):
    """LunarLander: against the lean."""

    policy = ScriptedPolicy(lambda obs: np.where(obs[:, 4] > 0, 3, 1), None, None)


@pytest.mark.parametrize(
    ("env_id", "kinds", "limit"),
    [("CartPole-v1", (Push, Balance), 23), ("LunarLander-v3", (Push, Hover, Turn), 95)],
)
def test_real_environments_agree_with_a_scalar_loop(env_id, kinds, limit):
    def make():
        return gym.make(env_id, max_episode_steps=limit)

    skills = skill_set(*kinds, call_steps=7)
    collector, scalars = collector_of(skills, env=make), scalars_of(skills.skills, 7, env=make)
    terminated = truncated = 0
    for request in itertools.islice(requests(100), 4):
        collected = collector.collect(request)
        compare(collected, scalars)
        valid = collected.batches[""]["valid"]
        valid = ... if valid is None else valid
        terminated += collected.batches[""]["terminated"][valid].sum()
        truncated += collected.batches[""]["truncated"][valid].sum()
    assert terminated
    assert truncated


def test_calls_of_different_lengths_do_not_wait_for_each_other():
    class Long(Skill):
        max_steps = 50
        policy = Zigzag.policy

    class Short(Skill):
        max_steps = 1
        policy = Zigzag.policy

    collector = collector_of(skill_set(Long, Short, call_steps=None))
    counts = np.zeros(N, int)
    for request in itertools.islice(requests(32), 6):
        experience = collector.collect(request).batches[""]
        counts += experience.valid_rows.sum(0)
    assert counts.max() > counts.min(), "columns are not ragged"


def test_masks_of_successors_are_those_of_the_next_decision():
    collector = collector_of(skill_set(*ALL))
    experience = collector.collect(next(requests(128))).batches[""]
    checked = 0
    for n in range(N):
        for now, then in itertools.pairwise(valid_rows(experience, n)):
            mask = experience["next_mask"][now, n]
            if experience["terminated"][now, n]:
                assert mask.all()
            elif not experience["truncated"][now, n]:
                assert mask.tolist() == experience["mask"][then, n].tolist()
                checked += 1
    assert checked > 20


def test_where_no_skill_may_start_it_says_so():
    collector = collector_of(skill_set(Right, call_steps=3))
    with pytest.raises(SkillweaveError, match="no skill may start in observation"):
        collector.collect(next(requests(256)))


@pytest.mark.parametrize("rows", [3, 64])
def test_restored_it_goes_on_as_if_it_had_not_been_stopped(rows):
    def fresh():
        return collector_of(skill_set(*ALL), keep_rewards=True, env=Again)

    first, asked = fresh(), requests(rows)
    for _ in range(3):
        first.collect(next(asked))
    again = fresh()
    assert not len(again.restore(first.state()))
    for request in [next(asked) for _ in range(3)]:
        one, two = first.collect(request), again.collect(request)
        for name in ("obs", "action", "reward", "steps", "terminated", "next_obs", "rewards"):
            np.testing.assert_array_equal(one.batches[""][name], two.batches[""][name])
        np.testing.assert_array_equal(one.episodes, two.episodes)


class Told(Again):
    """Tells whether an episode was a success, in odd episodes."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        if (terminated or truncated) and self.episode % 2:
            info["success"] = self.position > 0
        return obs, reward, terminated, truncated, info


@pytest.mark.parametrize("of_selector", [True, False])
def test_the_success_that_an_environment_tells_is_that_of_its_episode(of_selector):
    made = {}

    def make():
        made[len(made)] = Told()
        return made[len(made) - 1]

    if of_selector:
        collector = collector_of(skill_set(*ALL), env=make)
    else:
        engine = make_engine(EnvSpec(make, engine="sync"), N)
        collector = SkillCollector(engine, Choices(N, 3))
        collector.start(Seeds(7))
    kinds = set()
    for request in itertools.islice(requests(1), 90):
        before = {i: e.episode for i, e in made.items()}
        collected = collector.collect(request)
        ends = [i for i, e in made.items() if e.episode > before[i] and i >= len(made) - N]
        for told, i in zip(collected.episodes, ends, strict=True):
            logged = [a for e, _, a in made[i].log if e == before[i]]
            position = sum(logged) - len(logged)
            wanted = float(position > 0) if before[i] % 2 else np.nan
            np.testing.assert_array_equal(told[3], wanted)
            kinds.add(str(told[3]))
    assert kinds == {"0.0", "1.0", "nan"}


# Memory ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 7, 60])
def test_a_selectors_memory_goes_on_from_decision_to_decision_within_an_episode(rows):
    skills = skill_set(*ALL)
    collector = collector_of(skills, acting=Counts(N, len(ALL)))
    scalars, remembered, begun, across = scalars_of(skills.skills, 5), np.zeros(N), 0, 0
    begins = np.ones(N, bool)
    for request in itertools.islice(requests(rows), 140 // rows):
        experience = collector.collect(request).batches[""]
        for n in range(N):
            for at, t in enumerate(valid_rows(experience, n)):
                want = scalars[n].call(int(experience["action"][t, n]))
                remembered[n] = 0 if begins[n] else remembered[n]
                assert experience["episode_start"][t, n] == begins[n]
                assert experience["dist_params"][t, n, 0] == remembered[n]
                if at == 0:
                    assert experience["recurrent_state"][n, 0] == remembered[n]
                    across += not begins[n]
                begun += begins[n]
                begins[n] = want.terminated or want.truncated
                remembered[n] += 1
    assert begun > 20
    assert across


def test_a_skill_that_is_called_again_at_once_goes_on_with_its_memory():
    class Remembering(Skill):
        policy = Counting(1000, action_space=gym.spaces.Discrete(1000))

    class Long(Walk):
        action_space = gym.spaces.Discrete(1000)

        def reset(self, **how):
            found = super().reset(**how)
            self.length, self.end = 11, 0
            return found

        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, 0.0, *rest

    acting = Given(2)
    skills = skill_set(Remembering, Zigzag, call_steps=3)
    collector, asked = collector_of(skills, 2, env=Long, acting=acting), requests(1)
    for t in range(14):  # a call has three steps; that in which the episode ends has two
        acting.then = np.array([0, int(3 <= t < 6)])
        collector.collect(next(asked))
    acted = [[a for _, _, a in e.unwrapped.log] for e in collector.engine._envs.envs]
    assert acted[0] == [*range(11), *range(3)]
    assert acted[1][:3] + acted[1][6:] == [0, 1, 2, *range(5), *range(3)]


# What skills see -------------------------------------------------------------------------------


def recorder(seen, max_steps=None):
    """A skill that writes down every step that its termination was shown."""

    def termination(self, step):
        for i in range(len(step.reward)):
            key = (step.obs[i, 0].item(), step.obs[i, EPISODE].item(), step.obs[i, T].item())
            seen[key] = (
                step.next_obs[i].tolist(), step.reward[i].item(), bool(step.terminated[i]),
                bool(step.truncated[i]), bool(step.timed_out[i]), int(step.elapsed[i]),
                int(np.asarray(step.info["t"]).reshape(-1)[i]), int(step.action[i]),
            )  # fmt: skip
        return np.zeros(len(step.reward), bool)

    attributes = {"termination": termination, "max_steps": max_steps, "policy": scripted(2)}
    return type("Recorder", (Skill,), attributes)


def test_termination_sees_the_step_of_its_own_environment_and_call():
    seen, expected = {}, 0
    collector = collector_of(skill_set(Left, recorder(seen, 3), call_steps=4))
    for request in itertools.islice(requests(60), 3):
        experience = collector.collect(request).batches[""]
        for n in range(N):
            for t in valid_rows(experience, n):
                if experience["action"][t, n] != 1:
                    continue
                tag, episode, time, position = experience["obs"][t, n].tolist()
                tau = experience["steps"][t, n]
                for k in range(1, tau + 1):
                    row, _, ended, _, timed_out, elapsed, told, _ = seen[tag, episode, time + k - 1]
                    assert row == [tag, episode, time + k, position + k]
                    assert (elapsed, told) == (k, time + k)
                    assert ended == (experience["terminated"][t, n] and k == tau)
                    assert ended or timed_out == (k == 3)
                    expected += 1
    assert expected > 100


def test_a_skill_sees_the_same_steps_under_a_selector_as_in_training():
    in_training, in_calls, rows = {}, {}, next(requests(3))
    engine = make_engine(EnvSpec(Walk, engine="sync"), 200)
    alone = SkillCollector(engine, Given(200), recorder(in_training, 3)())
    alone.start(Seeds(7))
    alone.acting.then = np.full(200, 2)
    called = collector_of(skill_set(recorder(in_calls, 3), call_steps=None), 200)
    alone.collect(rows)
    called.collect(rows)
    ends = [v for v in in_calls.values() if v[5] == 3]
    assert any(v[2] for v in ends), "no episode terminated on the skill's last step"
    assert any(not v[2] for v in ends)
    assert in_calls == in_training
    assert len(in_calls) == 600


def test_a_skill_that_watches_sees_the_action_that_reflexes_left():
    seen, late = {}, Reflex(lambda obs: obs[:, T] >= 5, 0)
    collector = collector_of(skill_set(recorder(seen), reflexes=(late,)))
    collector.collect(next(requests(60)))
    assert {(t >= 5, told[-1]) for (_, _, t), told in seen.items()} == {(False, 2), (True, 0)}


class Nested(gym.Env):
    """Tells a number of its own, which is its observation too, in three depths of info."""

    observation_space = gym.spaces.Box(0, 1 << 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.number = float(self.np_random.integers(1 << 20))
        return np.array([self.number], np.float32), {}

    def step(self, action):
        deep = {"id": self.number, "deeper": {"id": self.number}, "word": f"env {self.number}"}
        obs = np.array([self.number], np.float32)
        return obs, 0.0, False, False, {"id": self.number, "deep": deep}


@pytest.mark.usefixtures("unprobed")
def test_a_skill_sees_its_own_rows_of_info_however_deep():
    seen = []

    class Watching(Skill):
        policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64), None, None)

        def termination(self, step):
            seen.append((step.obs[:, 0].tolist(), step.info))
            return np.zeros(len(step.reward), bool)

    class Short(Skill):
        policy, max_steps = Watching.policy, 2

    acting = Given(4)
    acting.then = np.array([0, 1, 0, 1])
    collector = collector_of(skill_set(Short, Watching), env=Nested, acting=acting)
    collector.collect(next(requests(4)))
    assert len(seen) == 4
    for rows, info in seen:
        assert len(set(rows)) == 2
        deep = info["deep"]
        for found in (info["id"], deep["id"], deep["deeper"]["id"]):
            assert found.tolist() == rows
        assert list(deep["word"]) == [f"env {r}" for r in rows]


# What is wrong ---------------------------------------------------------------------------------


def test_without_initiation_sets_there_is_no_mask():
    experience = collector_of(skill_set(Left, Zigzag)).collect(next(requests(9))).batches[""]
    assert experience.get("mask") is None
    assert experience.get("next_mask") is None


def test_where_no_skill_may_start_the_error_names_them_all():
    class Early(Left):
        def initiation(self, obs):
            return obs[:, T] < 1

    class Never(Left):
        def initiation(self, obs):
            return np.zeros(len(obs), bool)

    collector = collector_of(skill_set(Early, Never, call_steps=1))
    collector.collect(next(requests(1)))
    with pytest.raises(SkillweaveError, match=r"no skill may start .*'early', 'never'"):
        collector.collect(next(requests(1)))


def test_a_call_that_nothing_ends_is_told_and_not_waited_for(monkeypatch):
    monkeypatch.setattr("skillweave.collecting.decisions.LONGEST_EPISODE", 20)

    class Eternal(Left):
        max_steps = None

    skills = skill_set(Zigzag, Eternal, call_steps=None)
    acting = Given(2)
    acting.then = np.array([1, 1])
    collector, asked = collector_of(skills, 2, env=Nested, acting=acting), requests(10)
    collector.collect(next(asked))
    with pytest.raises(SkillweaveError, match="skill 'eternal' has run for 20 steps in environ"):
        collector.collect(next(asked))


@pytest.mark.parametrize("method", ["initiation", "termination"])
def test_a_wrong_shape_names_the_skill_and_the_method(method):
    wrong = type("Wrong", (Left,), {method: lambda self, x: np.zeros((2, 1), bool)})
    with pytest.raises(SkillweaveError, match=rf"'wrong'.*{method}\(\).*shape"):
        collector_of(skill_set(wrong)).collect(next(requests(1)))


def test_a_termination_that_is_no_flag_names_the_environment():
    class Half(Left):
        def termination(self, step):
            return np.full(len(step.reward), 0.5)

    acting = Given(3)
    acting.then = np.array([0, 0, 1])
    collector = collector_of(skill_set(Left, Half), 3, acting=acting)
    with pytest.raises(SkillweaveError, match=r"'half': termination\(\).* for environment 2,"):
        collector.collect(next(requests(1)))


# Skills that sample ----------------------------------------------------------------------------


class Sampler(ScriptedPolicy):
    """Greedy: 0; else a die."""

    def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
        n = len(obs)
        return np.zeros(n, np.int64) if deterministic else rng.integers(3, size=n), memory


class Die(Skill):
    policy = Sampler(None, Walk.observation_space, Walk.action_space)


def network():
    """A fresh network's policy."""
    config = PPO(num_envs=1, n_steps=1, batch_size=1)
    algorithm = make_algorithm(config, Walk.observation_space, Walk.action_space)
    state = algorithm.init([Seeds(0)])
    with torch.no_grad():
        state.params[:] = 5 * state.params
    return AgentPolicy.of(algorithm, state)


@pytest.mark.parametrize("kind", ["scripted", "network"])
def test_what_skills_draw_follows_from_the_requests_seeds(kind):
    policies = (Die.policy if kind == "scripted" else network(), Zigzag.policy)

    def play(first, greedy):
        skills = SkillSet((Die(), Zigzag()), policies, call_steps=4, greedy=greedy)
        collector = collector_of(skills)
        for request in itertools.islice(requests(20), first, first + 3):
            collector.collect(request)
        return [e.unwrapped.log for e in collector.engine._envs.envs]

    sampled = play(0, greedy=False)
    assert sampled == play(0, greedy=False)
    assert sampled != play(1, greedy=False)
    assert sampled != play(0, greedy=True)
    if kind == "scripted":
        draws = [a for log in sampled for _, _, a in log]
        assert min(np.bincount(draws, minlength=3)) > len(draws) / 6, "the die is loaded"


def test_skills_go_on_sampling_anew_from_call_to_call():
    collector = collector_of(skill_set(Die, call_steps=3, greedy=False), 1)
    for request in itertools.islice(requests(30), 4):
        collector.collect(request)
    acted = [a for _, _, a in collector.engine._envs.envs[0].unwrapped.log]
    assert len({tuple(acted[i : i + 3]) for i in range(0, 90, 3)}) > 10


def test_greedy_skills_are_told_so_and_others_are_not():
    asked = []

    class Asked(Sampler):
        def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
            asked.append(deterministic)
            return np.zeros(len(obs), np.int64), memory

    for greedy in (True, False):
        policy = Asked(None, Walk.observation_space, Walk.action_space)
        skills = SkillSet((Die(),), (policy,), call_steps=2, greedy=greedy)
        collector_of(skills).collect(next(requests(3)))
        assert asked == [greedy] * 3
        asked.clear()
