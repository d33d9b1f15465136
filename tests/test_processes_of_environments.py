"""Processes that environments start end when they are told to, without a word of the library."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from living import all_end
from toys import World

import skillweave as sw

SMALL = sw.PPO(num_envs=2, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((4,)))
FORK = multiprocessing.get_context("fork")


class Simulated(World):
    """Has a process, whose number stands in a file of ``folder``."""

    folder: Path
    daemon = True

    def __init__(self):
        super().__init__()
        self.simulator = FORK.Process(target=self.simulate, daemon=self.daemon)
        self.simulator.start()
        (self.folder / str(self.simulator.pid)).touch()

    def simulate(self):
        time.sleep(30)


class Terminating(Simulated):
    """Ends its process as ``multiprocessing`` documents it."""

    def close(self):
        self.simulator.terminate()
        self.simulator.join(25)
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


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_of_an_environment_ends_at_sigterm(workers, tmp_path, capfd):
    train(Terminating, tmp_path, workers)
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
    assert all_end(pids)
    assert capfd.readouterr().err == ""


class Killed(Simulated):
    """Is killed once, in its second step, with a process that no module of Python waits for."""

    def __init__(self):
        World.__init__(self)
        self.simulator = subprocess.Popen(["sleep", "30"])
        (self.folder / str(self.simulator.pid)).touch()

    def step(self, action):
        once = self.folder / "once"
        if self.t == 1 and multiprocessing.parent_process() is not None and once.exists():
            once.unlink(missing_ok=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)

    def close(self):
        self.simulator.terminate()
        self.simulator.wait()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_processes_of_a_worker_that_was_killed_are_ended(tmp_path):
    (tmp_path / "once").touch()
    train(Killed, tmp_path, 2)
    assert not (tmp_path / "once").exists()
    assert all_end(int(f.name) for f in tmp_path.iterdir() if f.name.isdigit())


PROGRAM = """
import sys, time
sys.path.insert(0, {tests!r})
import test_processes_of_environments as made
import skillweave as sw

class Asking(made.Simulated):
    folder = made.Path(".")
    def __init__(self):
        self.ours, self.theirs = made.FORK.Pipe()
        super().__init__()
    def simulate(self):
        while True:
            self.theirs.send(self.theirs.recv() + 1)
    def step(self, action):
        self.ours.send(self.t)
        assert self.ours.recv() == self.t + 1
        time.sleep(0.002)
        return super().step(action)
    def close(self):
        self.simulator.terminate()

spec = sw.EnvSpec(Asking, engine="sync", workers={workers})
sw.train_agent(spec, made.SMALL, 100_000, "run")
"""


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_is_saved_at_ctrl_c_though_it_has_simulators(workers, tmp_path):
    text = PROGRAM.format(tests=str(Path(__file__).parent), workers=workers)
    (tmp_path / "program.py").write_text(text)
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    program = subprocess.Popen(
        [sys.executable, "program.py"], cwd=tmp_path, env=os.environ | {"PYTHONPATH": path},
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while len(list(tmp_path.glob("[0-9]*"))) < 2 and time.monotonic() < until:
        time.sleep(0.1)
    time.sleep(1.5)
    os.killpg(program.pid, signal.SIGINT)  # as a terminal does
    said = program.communicate(timeout=30)[1]
    assert said.count("stopping after this round, and saving") == 1
    assert "Continue: " in said
    assert "SkillweaveError" not in said
    assert "Process " not in said
