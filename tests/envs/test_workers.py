"""Environments in processes of their own: every fault is a sentence, and nothing hangs."""

import multiprocessing as mp
import os
import signal
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from skillweave.envs.make import EnvSpec, make_engine
from skillweave.types import SkillweaveError


class Unpicklable(Exception):
    """Cannot be sent to another process."""

    def __init__(self, code, lock):
        super().__init__(f"code {code}")
        self.lock = lock


class Faulty(gym.Env):
    """At the step that the action names, something happens."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(9)
    PID = 8  # the reward is the process

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        match int(action):
            case 1:
                raise ValueError("the wing fell off")
            case 2:
                raise Unpicklable(7, lambda: None)
            case 3:
                os._exit(5)
            case 4:
                os.kill(os.getpid(), signal.SIGKILL)
            case 5:
                sys.exit("enough")
            case 6:
                return np.zeros(1, np.float32), 0.0, False, False, {"f": lambda: 0}
            case 7:
                time.sleep(1_000)
        return np.zeros(1, np.float32), float(os.getpid()), False, False, {}


class Stubborn(Faulty):
    """Does not end when asked to."""

    def __init__(self):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def close(self):
        time.sleep(1_000)


@pytest.fixture
def engine():
    made = []

    def make(env=Faulty, num_envs=3):
        made.append(make_engine(EnvSpec(env, engine="async"), num_envs))
        made[-1].reset(0)
        return made[-1]

    yield make
    for e in made:
        e.close()


def alive(pid: int) -> bool:
    """Whether a process still runs; one that only waits to be asked how it ended does not."""
    try:
        os.kill(pid, 0)
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (ProcessLookupError, FileNotFoundError):
        return False


def pids(e) -> list[int]:
    return [int(p) for p in e.step(np.full(e.num_envs, Faulty.PID)).reward]


@pytest.mark.parametrize(
    ("action", "says"),
    [
        (1, r"raised ValueError: the wing fell off \(test_workers\.py, line \d+\)"),
        (2, "raised Unpicklable: code 7"),
        (3, "died with exit code 5"),
        (4, "died by signal 9"),
        (5, "SystemExit: enough"),
        (6, "environment 1: .*(pickle|Pickl)"),
    ],
)
def test_what_goes_wrong_in_a_process_is_told_with_the_environment_and_the_step(
    engine, action, says
):
    e = engine()
    e.step(np.zeros(3, np.int64))
    with pytest.raises(SkillweaveError, match=f"(?s){says}") as raised:
        e.step(np.array([0, action, 0]))
    assert "environment 1" in str(raised.value)
    if action in (1, 2, 3, 4):
        assert "step 2" in str(raised.value)


@pytest.mark.parametrize("env", [Faulty, Stubborn])
def test_closing_ends_every_process_whatever_it_does(engine, env):
    e = engine(env)
    processes = pids(e)
    assert len(set(processes)) == 3
    assert os.getpid() not in processes
    e.close()
    assert not any(alive(pid) for pid in processes)


def test_a_constructor_that_fails_in_a_process_is_told():
    def make():
        if os.getpid() != parent:
            raise ValueError("no device")
        return Faulty()

    parent = os.getpid()
    with pytest.raises(SkillweaveError, match=r"make \(environment \d\).*ValueError: no device"):
        make_engine(EnvSpec(make, engine="async"), 2)


def stuck(tell) -> None:
    """A run whose second environment never answers; tells the processes, then how it ended."""
    os.setsid()  # a group of its own, to which the terminal would send Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    e = make_engine(EnvSpec(Faulty, engine="async"), 2)
    try:
        e.reset(0)
        tell.send(pids(e))
        e.step(np.array([0, 7]))
    except KeyboardInterrupt:
        tell.send("stopped")
    finally:
        e.close()


def waiting(tell) -> None:
    """A run whose environments have nothing to do."""
    e = make_engine(EnvSpec(Faulty, engine="async"), 2)
    e.reset(0)
    tell.send(pids(e))
    time.sleep(1_000)


@pytest.fixture
def forked():
    """Starts a function in a process of its own; gives the process and what it tells."""
    context, started = mp.get_context("fork"), []

    def start(function):
        told, tell = context.Pipe(duplex=False)
        started.append(context.Process(target=function, args=(tell,)))
        started[-1].start()
        return started[-1], told

    yield start
    for process in started:
        process.kill()
        process.join()


def test_ctrl_c_ends_a_run_whose_environment_is_stuck(forked):
    process, told = forked(stuck)
    workers = told.recv()
    time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    assert told.poll(30)
    assert told.recv() == "stopped"
    process.join(30)
    assert process.exitcode == 0
    assert not any(alive(pid) for pid in workers)


def test_processes_end_where_their_parent_was_killed(forked):
    process, told = forked(waiting)
    workers = told.recv()
    assert all(alive(pid) for pid in workers)
    process.kill()
    until = time.monotonic() + 30
    while any(alive(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.02)
    assert not any(alive(pid) for pid in workers)


def test_environments_with_other_spaces_are_refused():
    numbers = iter(range(9))

    class Grows(Faulty):
        def __init__(self, size):
            self.observation_space = gym.spaces.Box(-1.0, 1.0, (size,), np.float32)

    def growing():
        return Grows(os.getpid() % 1_000 + next(numbers))

    for engine in ("sync", "async"):
        with pytest.raises(SkillweaveError, match=r"growing.*(differ|other spaces)"):
            make_engine(EnvSpec(growing, engine=engine), 2)
