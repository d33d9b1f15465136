"""Processes that environments start end when they are told to, without a word of the library."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw

SMALL = sw.PPO(num_envs=2, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((4,)))
FORK = multiprocessing.get_context("fork")


class Simulated(gym.Env):
    """Has a process, whose number stands in a file of ``folder``."""

    observation_space = gym.spaces.Box(-20, 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    folder: Path
    daemon = True

    def __init__(self):
        self.simulator = FORK.Process(target=self.simulate, daemon=self.daemon)
        self.simulator.start()
        (self.folder / str(self.simulator.pid)).touch()

    def simulate(self):
        time.sleep(30)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        return np.zeros(1, np.float32), float(action), self.t == 8, False, {}


class Terminating(Simulated):
    """Ends its process as ``multiprocessing`` documents it."""

    def close(self):
        self.simulator.terminate()
        self.simulator.join(5)
        assert self.simulator.exitcode == -signal.SIGTERM, self.simulator.exitcode


class Forgetful(Simulated):
    """Leaves a process for which ``multiprocessing`` waits."""

    daemon = False


class Deaf(Simulated):
    """Has a process that SIGTERM does not end."""

    def simulate(self):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(30)


def train(env, folder, workers):
    env.folder = folder
    spec = sw.EnvSpec(env, engine="sync", workers=workers)
    return sw.train_agent(spec, SMALL, 64, folder / "run", quiet=True)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_of_an_environment_ends_at_sigterm(workers, tmp_path, capfd):
    began = time.monotonic()
    train(Terminating, tmp_path, workers)
    assert time.monotonic() - began < 4
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
@pytest.mark.parametrize("env", [Simulated, Forgetful, Deaf])
def test_processes_that_environments_leave_in_workers_are_ended(env, tmp_path, capfd):
    train(env, tmp_path, 2)
    pids = {int(f.name) for f in tmp_path.iterdir() if f.name.isdigit()}
    left = {p.pid for p in multiprocessing.active_children()}
    for process in multiprocessing.active_children():  # of environments made to measure a step
        process.kill()
        process.join()
    assert len(pids) > len(left)
    assert not any(map(alive, pids))
    assert capfd.readouterr().err == ""
