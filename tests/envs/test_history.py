"""Environments that are brought back: by their seeds, and by what was done since."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from skillweave.envs import envpool_engine
from skillweave.envs.history import History
from skillweave.envs.joined import JoinedEngines
from skillweave.envs.make import EnvSpec, make_engine

N = 5
pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")


@given(st.lists(st.tuples(st.sampled_from("asbf"), st.integers(0, 2**N - 1)), max_size=200))
@settings(deadline=None, max_examples=60)
def test_a_history_plays_again_what_was_done(plan):
    history = History(N, np.zeros(N, np.int64))
    done: list[list] = [[] for _ in range(N)]
    for number, (kind, bits) in enumerate(plan):
        ids = np.flatnonzero([bits >> i & 1 for i in range(N)])
        if kind in "as" and len(ids):
            history.add(np.full(len(ids), number), ids)
            for i in ids:
                done[i].append(number)
        elif kind == "b":
            history.begin(ids)
            for i in ids:
                if not done[i] or done[i][-1] != "begins":
                    done[i].append("begins")
        elif kind == "f" and len(ids):
            history.forget(ids)
            for i in ids:
                done[i].clear()
    again = History(N, np.zeros(N, np.int64))
    again.load(history.state())
    played: list[list] = [[] for _ in range(N)]
    for begins, ids, actions in again.play():
        for i in begins:
            played[i].append("begins")
        for i, action in zip(ids, actions, strict=True):
            played[i].append(int(action))
    assert played == done


def run(engine, steps: int, seed: int) -> list:
    """Everything that an engine shows while it is acted in at random."""
    rng, shown = np.random.default_rng(seed), []
    engine.action_space.seed(seed)
    for _ in range(steps):
        ids = np.sort(rng.permutation(N)[: rng.integers(1, N + 1)])
        action = np.stack([engine.action_space.sample() for _ in ids])
        raw = engine.step(action, ids)
        ended = ids[raw.terminated | raw.truncated]
        shown += [raw.next_obs, raw.reward, ended]
        if len(ended):
            shown.append(engine.reset_some(ended))
    return shown


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1", "LunarLander-v3"])
@pytest.mark.parametrize("engine", ["envpool", "sync"])
def test_an_engine_that_is_restored_goes_on_as_if_nothing_had_happened(engine, env, monkeypatch):
    if engine == "envpool":
        pytest.importorskip("envpool")
    monkeypatch.setattr(envpool_engine, "RENEW_AFTER", 150)
    spec = EnvSpec(env, engine=engine)
    first, second = make_engine(spec, N, threads=1), make_engine(spec, N, threads=1)
    try:
        first.reset(3)
        run(first, 333, 0)
        state = first.state()
        made = first.steps_made
        obs, early = second.restore(state)
        assert early.tolist() == []
        assert second.steps_made == 0, "played again, not made"
        again = second.state()
        assert all(np.array_equal(again[k], v) for k, v in state.items())
        for got, want in zip(run(second, 100, 1), run(first, 100, 1), strict=True):
            np.testing.assert_array_equal(got, want)
        assert second.steps_made == first.steps_made - made
        assert obs.shape == (N, *first.observation_space.shape)
    finally:
        first.close()
        second.close()


def test_old_pools_are_left_one_episode_at_a_time_and_histories_stay_short(monkeypatch):
    pytest.importorskip("envpool")
    monkeypatch.setattr(envpool_engine, "RENEW_AFTER", 100)
    engine = make_engine(EnvSpec("CartPole-v1", engine="envpool"), N, threads=1)
    engine.reset(0)
    longest, pools = 0, set()
    for part in range(40):
        run(engine, 20, part)
        longest, pools = max(longest, engine.state()["length"].sum()), pools | {len(engine._pools)}
    assert pools == {1, 2}
    assert longest < 400, "a hundred steps, and the episodes that were open"


def test_two_pools_that_step_at_once_show_what_they_do_one_after_the_other(monkeypatch):
    pytest.importorskip("envpool")
    monkeypatch.setattr(envpool_engine, "RENEW_AFTER", 100)
    shown = []
    for at_once in (True, False):
        if not at_once:
            monkeypatch.setattr(envpool_engine, "_steps_apart", lambda pool: False)
        engine = make_engine(EnvSpec("CartPole-v1", engine="envpool"), N, threads=2)
        engine.reset(0)
        parts, pools = [], set()
        for part in range(20):
            parts += run(engine, 20, part)
            pools.add(len(engine._pools))
        assert pools == {1, 2}
        shown.append(parts)
        engine.close()
    for one, other in zip(*shown, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("engine", ["envpool", "sync"])
def test_joined_engines_are_their_parts_side_by_side(engine):
    if engine == "envpool":
        pytest.importorskip("envpool")
    spec = EnvSpec("CartPole-v1", engine=engine)
    parts, alone = ([make_engine(spec, 2, threads=1) for _ in range(3)] for _ in range(2))
    joined = JoinedEngines(parts)
    obs = np.concatenate([e.reset(i) for i, e in enumerate(parts)])
    for i, e in enumerate(alone):
        np.testing.assert_array_equal(e.reset(i), obs[2 * i : 2 * i + 2])
    rng, ends = np.random.default_rng(0), 0
    for t in range(60):
        ids = rng.permutation(6)[: rng.integers(1, 7)] if t % 2 else np.arange(6)
        action = rng.integers(2, size=len(ids))
        raw = joined.step(action, ids if t % 2 else None)
        for part in np.unique(ids // 2):
            mine = np.flatnonzero(ids // 2 == part)
            own = alone[part].step(action[mine], ids[mine] % 2)
            for name in ("next_obs", "reward", "terminated", "truncated"):
                np.testing.assert_array_equal(getattr(raw, name)[mine], getattr(own, name))
        ended = ids[raw.terminated | raw.truncated]
        ends += len(ended)
        if len(ended):
            fresh = joined.reset_some(ended)
            for part in np.unique(ended // 2):
                mine = np.flatnonzero(ended // 2 == part)
                own = alone[part].reset_some(ended[mine] % 2)
                np.testing.assert_array_equal(fresh[mine], own)
    assert ends > 5
    assert joined.steps_made == sum(e.steps_made for e in alone)
    for e in (*parts, *alone):
        e.close()


class Talker(gym.Env):
    """Tells its time, in two depths, and now and then a word; nothing of it is drawn."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        self.t = 0
        return np.zeros(1), {}

    def step(self, action):
        self.t += 1
        info = {"t": self.t, "deep": {"t": self.t, "even": {}}}
        if action == 1:
            info |= {"word": f"at {self.t}", "goal": True}
        if action == 2:
            info["deep"]["even"] = {"t": 2.0 * self.t, "place": np.arange(2) + self.t}
        return np.zeros(1), 0.0, False, False, info


def same(one, two):
    """Whether two infos are equal, however deep."""
    assert one.keys() == two.keys()
    for name, value in one.items():
        if isinstance(value, dict):
            same(value, two[name])
        else:
            assert value.dtype == two[name].dtype, name
            np.testing.assert_array_equal(value, two[name])


def test_infos_of_joined_engines_are_those_of_one_engine():
    spec = EnvSpec(Talker, engine="sync")
    parts, whole = [make_engine(spec, 2) for _ in range(3)], make_engine(spec, 6)
    for engine in (*parts, whole):
        engine.reset(0)
    joined = JoinedEngines(parts)
    for action in ([0] * 6, [1, 0, 0, 0, 0, 0], [0, 0, 0, 2, 0, 1], [2, 1, 2, 1, 0, 0]):
        one, two = (e.step(np.array(action)) for e in (joined, whole))
        same(one.info, two.info)
    for ids, action in (([5, 0, 3], [1, 0, 2]), ([2, 1], [0, 1]), ([4], [2]), ([3, 2], [1, 2])):
        one, two = (e.step(np.array(action), np.array(ids)) for e in (joined, whole))
        told = {k: v for k, v in one.info.items() if np.size(v)}
        assert told["t"].tolist() == two.info["t"].tolist()
        if 1 in action:
            assert told["word"].tolist() == two.info["word"].tolist()
        if 2 in action:
            same(told["deep"]["even"], two.info["deep"]["even"])
