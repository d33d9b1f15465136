"""A run keeps the calls that were recorded in it, while they are of its skills."""

from __future__ import annotations

import os
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from shared_runs import Left, Right, declare

import skillweave as sw
from skillweave.api import Run
from skillweave.calls import CallLog, record_calls, run_log
from skillweave.envs.engine import GymnasiumEngine
from skillweave.errors import Interrupted, RunError
from skillweave.runs.directory import CALLS, RunDirectory


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Run:
    return declare(Left(), Right()).train(tmp_path_factory.mktemp("calls") / "run", quiet=True)


@pytest.fixture
def run(trained, tmp_path) -> Run:
    return sw.load(shutil.copytree(trained.path, tmp_path / "run"), declare(Left(), Right()))


def same(a: CallLog, b: CallLog) -> bool:
    return np.array_equal(a.choice, b.choice) and np.array_equal(a.next_obs, b.next_obs)


def tilted(obs):
    return obs[:, 2] > 0.05


@pytest.mark.needs("planning")
def test_calls_are_kept_and_joined(run):
    for use in (lambda: run.calls, lambda: run.plan(tilted)):
        with pytest.raises(RunError, match=r"has no log of calls; record a new log: run.log_calls"):
            use()
    first = run.log_calls(300)
    assert same(run.calls, first)
    second = run.log_calls(200)
    assert not same(first.within(100), second.within(100)), "more calls, not the same ones again"
    again = sw.load(run.path, declare(Left(), Right())).calls
    assert len(again) == len(first) + len(second)
    assert again.steps == first.steps + second.steps
    assert np.unique(again.episode).tolist() == list(range(again.episode.max() + 1))
    assert len(run.plan(tilted).hierarchy.selector.log) == len(again), "a plan uses them"


def test_the_same_recording_is_kept_once(run):
    first = run.log_calls(200, seed=3)
    longer = run.log_calls(400, seed=3)
    assert same(longer.take(np.arange(10)), first.take(np.arange(10)))
    assert same(run.calls, longer)
    run.log_calls(400, seed=3)
    assert same(run.calls, longer)
    assert not same(run.log_calls(400, seed=4), longer)
    assert run.calls.steps > longer.steps + 400 - 1


def test_episodes_are_played_again_from_their_seeds(run):
    log = run.log_calls(300, num_envs=3)
    engine = GymnasiumEngine(run.declaration.spec.make, 1, "CartPole")
    row = np.arange(1)
    for episode in np.unique(log.episode)[:5]:
        calls = np.flatnonzero(log.episode == episode)
        assert len(set(log.seed[calls])) == 1
        obs = engine.reset_some(row, [int(log.seed[calls[0]])])
        for c in calls:
            assert (obs[0] == log.start[c]).all()
            for t in range(log.offset[c], log.offset[c + 1]):
                obs = engine.step(log.action[t][None], row).next_obs
                assert (obs[0] == log.next_obs[t]).all()
    engine.close()


def test_keys_of_info_of_earlier_calls_are_recorded_again():
    hierarchy = declare(Left())
    hierarchy.env = sw.EnvSpec(Informed, engine="sync", workers=1)
    run = hierarchy.train(quiet=True)
    first = run.log_calls(100, info=("half",))
    assert tuple(run.log_calls(100).info) == ("half",)
    with pytest.warns(UserWarning, match=r"replaced by the new one.*info keys half"):
        both = run.log_calls(100, info=("third",))
    assert tuple(both.info) == ("half", "third")
    assert run.calls.steps == both.steps > 0
    assert first.steps > 0


class Informed(sw.EnvSpec("CartPole-v1").make().unwrapped.__class__):
    def step(self, action):
        obs, reward, over, cut, _ = super().step(action)
        return obs, reward, over, cut, {"half": obs[0] / 2, "third": obs[0] / 3}


def test_calls_of_skills_that_learnt_on_are_not_used(run):
    old = run.log_calls(300)
    more = declare(Left(), Right())
    more.apart = sw.Apart(skill_steps=200, selector_steps=100)
    run = more.train(run.path, resume=True, quiet=True)
    with pytest.raises(RunError, match="is of the skills before they learnt on; record a new log"):
        run.calls  # noqa: B018
    with pytest.warns(UserWarning, match="before they learnt on. The new log replaces it"):
        new = run.log_calls(100)
    assert same(run.calls, new)
    other = declare(Left(), Right()).train(quiet=True, seed=1)
    shutil.copy(run.path / CALLS, other.path)
    with pytest.raises(RunError, match="belongs to another run"):
        other.calls  # noqa: B018
    old.save(run.path / CALLS)
    with pytest.raises(RunError, match="was not written by this run"):
        run.calls  # noqa: B018


def test_the_selector_may_learn_on(run):
    log = run.log_calls(100)
    more = declare(Left(), Right())
    more.apart = sw.Apart(skill_steps=100, selector_steps=200)
    assert same(more.train(run.path, resume=True, quiet=True).calls, log)


def test_a_run_keeps_its_latest_calls(run, monkeypatch):
    monkeypatch.setattr(run_log, "MOST_STEPS", 250)
    run.log_calls(200)
    with pytest.warns(UserWarning, match="keeps its latest 250 logged steps"):
        second = run.log_calls(200)
    kept = run.calls
    assert kept.steps <= 250
    assert (kept.next_obs[-100:] == second.next_obs[-100:]).all()


def test_a_damaged_file_is_neither_used_nor_replaced(run):
    path = run.path / CALLS
    path.write_bytes(b"no log")
    for use in (lambda: run.calls, lambda: run.log_calls(10)):
        with pytest.raises(RunError, match="is damaged"):
            use()
    assert path.read_bytes() == b"no log"
    path.unlink()
    os.mkfifo(path)
    for use in (lambda: run.calls, lambda: run.log_calls(10)):
        with pytest.raises(RunError, match="is a pipe or a device"):
            use()
    path.unlink()
    path.symlink_to(run.path.parent / "elsewhere")
    with pytest.raises(RunError, match="is a link"):
        run.log_calls(10)


@pytest.mark.needs("planning")
def test_without_a_directory_calls_stay_in_memory(run, tmp_path):
    weights = run.save_weights(tmp_path / "weights.safetensors")
    loaded = declare(Left(), Right()).load_weights(weights)
    log = loaded.log_calls(200)
    assert same(loaded.calls, log)
    loaded.log_calls(200)
    assert loaded.calls.steps > log.steps
    assert not (tmp_path / CALLS).exists()
    loaded.plan(tilted)


def test_calls_that_cannot_be_written_stay_in_memory_until_they_can(run, monkeypatch):
    def full(*_):
        raise RunError("disk full")

    steps = run.log_calls(100).steps
    with monkeypatch.context() as patched:
        patched.setattr(run_log, "write_calls", full)
        with pytest.raises(RunError, match="disk full"):
            run.log_calls(100)
    assert run.calls.steps >= steps + 100
    run.log_calls(100)
    assert run.calls.steps >= steps + 200
    assert same(run.calls, declare(Left(), Right()).load(run.path).calls)


def test_two_that_log_at_once_lose_no_calls(run, monkeypatch):
    def slow(*args):
        time.sleep(0.2)
        write(*args)

    write, directory = run_log.write_calls, RunDirectory.open(run.path)
    logs = [record_calls(run.declaration.spec, run.policy, 100, seed=s) for s in (1, 2)]
    monkeypatch.setattr(run_log, "write_calls", slow)
    directory.begin(finished=True)  # a training holds its lock
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda log: run_log.save_calls(directory, log), logs))
    directory.close()
    assert len(run.calls) == sum(map(len, logs))


def test_an_interrupted_recording_keeps_its_calls(run):
    asked = 0

    def choose(obs):
        nonlocal asked
        asked += 1
        if asked == 100:
            signal.raise_signal(signal.SIGINT)
        return np.zeros(len(obs), int)

    with pytest.raises(Interrupted, match=r"calls .* were recorded and are kept"):
        run.log_calls(1_000_000, choose=choose, num_envs=4)
    assert 0 < run.calls.steps < 1_000_000
    assert (run.calls.end_reason > 0).all()


def test_calls_without_the_skills_code_are_replaced_by_calls_with_it(run):
    sw.load(run.path).log_calls(100)
    assert run.calls.own_success == (False, False)
    with pytest.warns(UserWarning, match=r"is replaced by the new one: .*success\(\) was known"):
        log = run.log_calls(100)
    assert run.calls.own_success == (True, False)
    with pytest.raises(RunError, match="but now success\\(\\) of 'left' is not known"):
        sw.load(run.path).log_calls(100)
    assert same(run.calls, log)
