"""Processes end soon after the one that has started them, whatever they are doing."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from living import alive, all_end

PROGRAM = """
import multiprocessing, os, socket, subprocess, sys, time
import gymnasium as gym, numpy as np
import skillweave as sw
from skillweave.evolution import Evolution

def forever():
    while True:
        try:
            time.sleep(100)
        except BaseException:
            pass

def deaf():
    ends = socket.socketpair()
    ends[0].recv(1)

class Careless:
    def __del__(self):
        time.sleep(1000)  # what a signal raises here is lost

def careless():
    Careless()
    time.sleep(1000)

class Env(gym.Env):
    observation_space = gym.spaces.Box(-20, 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    def __init__(self):
        if multiprocessing.parent_process() is not None:
            open(f"pid-{os.getpid()}", "w").close()
            if what == "children":
                open(f"child-{subprocess.Popen(['sleep', '600']).pid}", "w").close()
            if what == "constructor":
                time.sleep(1000)
    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}
    def step(self, action):
        if multiprocessing.parent_process() is not None:
            open(f"step-{os.getpid()}", "w").close()
            if what == "children":
                forever()
            if what in blocks:
                blocks[what]()
            time.sleep(0.002)
        return np.zeros(1, np.float32), 0.0, False, False, {}
    def close(self):
        if multiprocessing.parent_process() is not None:
            open(f"closed-{os.getpid()}", "w").close()

what = sys.argv[1]
blocks = {"sleep": lambda: time.sleep(1000), "socket": deaf, "swallows": forever, "del": careless}
long = sw.PPO(num_envs=4, n_steps=8192, batch_size=64, update_epochs=1, network=sw.Network((4,)))
evolve = Evolution(population=2, generations=1, episodes=2) if what == "part" else None
if __name__ == "__main__":
    if what == "spawn":
        multiprocessing.set_start_method("spawn")
    spec = sw.EnvSpec(Env, engine="sync", workers=2)
    sw.train_agent(spec, long, 100_000, "run", quiet=True, evolve=evolve)
"""
CLOSES = ("rollout", "sleep", "socket", "del", "part", "spawn")


def numbers(folder: Path, what: str) -> set[int]:
    """Return the processes that have written a file of this name."""
    return {int(file.name.split("-")[1]) for file in folder.glob(f"{what}-*")}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
@pytest.mark.parametrize("what", [*CLOSES, "constructor", "swallows", "children"])
def test_processes_end_soon_after_their_parent_was_killed(what, tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    paths = {"PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "program.py", what]
    parent = subprocess.Popen(command, cwd=tmp_path, env=os.environ | paths)
    until = time.monotonic() + 60
    while time.monotonic() < until and not (
        len(numbers(tmp_path, "pid")) == 2 and (what == "constructor" or numbers(tmp_path, "step"))
    ):
        time.sleep(0.1)
    time.sleep(1.0)  # well in what blocks
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    pids = numbers(tmp_path, "pid")
    assert len(pids) == 2
    pids |= numbers(tmp_path, "child")
    assert (len(pids) > 2) == (what == "children")
    try:
        assert all_end(pids)
    finally:
        for pid in filter(alive, pids):
            os.kill(pid, signal.SIGKILL)
    if what in CLOSES:  # environments could release what they hold
        assert numbers(tmp_path, "closed") == pids
