"""Collectors in processes of their own: every fault is a sentence, and nothing hangs."""

import multiprocessing as mp
import os
import signal
import time

import gymnasium as gym
import numpy as np
import pytest
from living import alive, all_end
from toy_acting import Given, requests
from toys import alone_in

from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.workers.placement import make_collectors

PID = 8  # the reward is the process


class Unpicklable(Exception):
    """Cannot be sent to another process."""

    def __init__(self, code, lock):
        super().__init__(f"code {code}")
        self.lock = lock


class Faulty(gym.Env):
    """Something happens that the action names."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(9)

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
            case 6:
                return np.zeros(1, np.float32), 0.0, False, False, {"f": lambda: 0}
            case 7:
                time.sleep(1_000)
        return np.zeros(1, np.float32), float(os.getpid() % 2**20), False, False, {}


class Stubborn(Faulty):
    """Does not end when asked to."""

    def __init__(self):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def close(self):
        time.sleep(1_000)


class Plan(Given):
    """In row ``late`` the second worker's second environment does ``action``, else all do 8."""

    def __init__(self, first, action, late=1):
        super().__init__(2)
        self.first, self.action, self.late, self.at = first, action, late, 0

    def some(self, rows, obs, mask, memory):
        self.then = np.full(2, PID)
        if self.first == 2 and self.at == self.late:
            self.then[1] = self.action
        self.at += 1
        return super().some(rows, obs, mask, memory)


def collectors_of(env=Faulty, action=PID, late=1):
    """Two workers with two environments each."""

    def make(num_envs, first):
        engine = make_engine(EnvSpec(env, engine="sync"), num_envs, first=first)
        return alone_in(engine, Plan(first, action, late))

    found = make_collectors(make, 4, 2, 1, "Faulty")
    found.start(Seeds(0))
    return found


@pytest.fixture
def collectors():
    made = []

    def of(**how):
        made.append(collectors_of(**how))
        return made[-1]

    yield of
    for each in made:
        each.close()


def pids(collectors) -> list[int]:
    """The workers' processes."""
    return [worker.process.pid for worker in collectors._workers]


@pytest.mark.parametrize(
    ("action", "says"),
    [
        (1, r"environment 3, step 2.*raised ValueError: the wing fell off \(test_workers\.py, lin"),
        (2, "environment 3, step 2.*raised Unpicklable: code 7"),
        (3, r"worker 1 \(environments 2 to 3\) died with exit code 5"),
    ],
)
def test_what_goes_wrong_in_a_process_is_told_with_who_it_was(collectors, action, says):
    with pytest.raises(SkillweaveError, match=f"(?s){says}"):
        collectors(action=action).collect(next(requests(3)))


def test_an_info_that_cannot_leave_its_process_does_no_harm(collectors):
    experience = collectors(action=6).collect(next(requests(3))).batches[""]
    assert (experience["reward"][:, :3] > 0).all()
    assert experience["reward"][1, 3] == 0.0


@pytest.mark.parametrize("env", [Faulty, Stubborn])
def test_closing_ends_every_process_whatever_it_does(collectors, env):
    made = collectors(env=env)
    processes = pids(made)
    rewards = made.collect(next(requests(2))).batches[""]["reward"]
    assert rewards[0].tolist() == [p % 2**20 for p in processes for _ in range(2)]
    assert len({*processes, os.getpid()}) == 3
    made.close()
    assert all_end(processes)


def stuck(tell) -> None:
    """A run whose last environment never answers; tells the processes, then how it ended."""
    os.setsid()  # a group of its own, to which the terminal would send Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    made = collectors_of(action=7)
    try:
        tell.send(pids(made))
        made.collect(next(requests(3)))
    except KeyboardInterrupt:
        tell.send("stopped")
    finally:
        made.close()


def waiting(tell) -> None:
    """A run whose environments have nothing to do."""
    made = collectors_of()
    tell.send(pids(made))
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
    assert all_end(workers)


def test_processes_end_where_their_parent_was_killed(forked):
    process, told = forked(waiting)
    workers = told.recv()
    assert all(alive(pid) for pid in workers)
    process.kill()
    assert all_end(workers)


def test_environments_with_other_spaces_are_refused():
    numbers = iter(range(9))

    class Grows(Faulty):
        def __init__(self, size):
            self.observation_space = gym.spaces.Box(-1.0, 1.0, (size,), np.float32)

    def growing():
        return Grows(1 + next(numbers))

    with pytest.raises(SkillweaveError, match=r"growing.*(differ|other spaces)"):
        make_engine(EnvSpec(growing, engine="sync"), 2)
