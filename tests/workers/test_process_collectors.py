"""Collectors in processes find what collectors in this thread find, whatever happens to them."""

import gc
import importlib.util
import itertools
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import gymnasium as gym
import numpy as np
import pytest
from living import all_end
from reference_calls import EPISODE
from toy_acting import Again, Choices, Mortal, deciding, equal, requests, stepping
from toys import World, alone_in

from skillweave._internal import parent_process
from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.experience.group import Collectors
from skillweave.workers import processes
from skillweave.workers.placement import make_collectors


def here(make):
    return Collectors([make(3, 0), make(3, 3)])


@pytest.fixture
def in_processes():
    made = []

    def of(make):
        made.append(make_collectors(make, 6, 2, 1, "Walk"))
        return made[-1]

    yield of
    for collectors in made:
        collectors.close()


def same(one, two):
    equal(one, two)
    assert not len(one.restarted)
    assert not len(two.restarted)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", [deciding, stepping])
@pytest.mark.parametrize("rows", [1, 20])
def test_the_same_experience_here_and_in_processes(in_processes, kind, rows):
    plain, apart = here(kind()), in_processes(kind())
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    for request in itertools.islice(requests(rows), 40):  # with snapshots in between
        same(plain.collect(request), apart.collect(request))
    assert plain.steps_made == apart.steps_made


@pytest.mark.slow
@pytest.mark.parametrize("kind", [deciding, stepping])
def test_killed_workers_are_made_again_and_find_the_same(in_processes, kind):
    plain, apart = here(kind()), in_processes(kind())
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    rng = np.random.default_rng(0)
    for at, request in enumerate(itertools.islice(requests(15), 60)):
        if rng.random() < 0.25:
            victim = apart._workers[int(rng.integers(2))].process
            os.kill(victim.pid, signal.SIGKILL)
            if rng.random() < 0.5:
                victim.join()
        same(plain.collect(request), apart.collect(request))
        if at % 13 == 12:
            assert plain.state().keys() == apart.state().keys()


class Restless(Again):
    """Every episode shows a number that does not follow from the seed."""

    def reset(self, **how):
        self.number = int.from_bytes(os.urandom(3), "big")
        return super().reset(**how)

    def _obs(self):
        obs = super()._obs()
        obs[EPISODE] = self.number
        return obs


@pytest.mark.parametrize("after", ["collect", "state"])
def test_environments_that_do_not_repeat_themselves_are_told_where_a_worker_was_lost(
    in_processes, after
):
    apart = in_processes(stepping(Restless))
    apart.start(Seeds(3))
    asked = requests(2)
    for _ in range(2):
        assert not len(apart.collect(next(asked)).restarted)
    if after == "state":
        apart.state()
    victim = apart._workers[1].process
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    np.testing.assert_array_equal(apart.collect(next(asked)).restarted, [3, 4, 5])
    assert not len(apart.collect(next(asked)).restarted)
    assert apart.restarts == 3


def test_one_that_dies_in_the_middle_of_a_step_is_made_again(in_processes, tmp_path):
    fuse = tmp_path / "fuse"
    kind = type("Fused", (Mortal,), {"fuse": fuse})
    plain, apart = here(stepping()), in_processes(stepping(kind))
    for collectors in (plain, apart):
        collectors.start(Seeds(3))
    for at, request in enumerate(itertools.islice(requests(15), 6)):
        if at == 3:
            fuse.touch()
        one, two = plain.collect(request), apart.collect(request)
        same(one, two)
    assert not fuse.exists(), "it did not die"


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_processes_that_are_not_forked_get_the_users_code_and_stay(
    in_processes, method, monkeypatch, tmp_path
):
    file = tmp_path / "own_walk.py"  # as a recipe, it cannot be imported by its name
    file.write_text("from toy_acting import Again\n\n\nclass Own(Again):\n    pass\n")
    spec = importlib.util.spec_from_file_location("own_walk", file)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "own_walk", module)
    spec.loader.exec_module(module)
    context = multiprocessing.get_context(method)
    monkeypatch.setattr(processes.mp, "get_context", lambda: context)
    ours, theirs = here(stepping(module.Own)), in_processes(stepping(module.Own))
    pids = [worker.process.pid for worker in theirs._workers]
    for collectors in (ours, theirs):
        collectors.start(Seeds(3))
    for i, request in enumerate(itertools.islice(requests(2), 2)):
        time.sleep(1.5 * parent_process.LOOK * i)  # they look whether their parent lives
        same(ours.collect(request), theirs.collect(request))
    assert [worker.process.pid for worker in theirs._workers] == pids


PARENT = """
import os, pathlib, signal, time
from skillweave.workers import processes
from skillweave.workers import worker_process
from test_process_collectors import make_collectors, stepping
tasks = worker_process._tasks
worker_process._tasks = lambda channel: (time.sleep(0.5), tasks(channel))[1]  # no parent by then
found = make_collectors(stepping(), 3, 3, 1, "Walk")
pids = [worker.process.pid for worker in found._workers]
os.kill(pids[-1], signal.SIGSTOP)
status = pathlib.Path(f"/proc/{pids[-1]}/status")
while "State:\\tT" not in status.read_text():  # a busy machine takes its time to stop it
    time.sleep(0.01)
print(*pids, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_workers_end_where_their_parent_is_killed_though_one_of_them_hangs():
    command = [sys.executable, "-c", PARENT]
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | paths)
    with parent.stdout as said:  # the worker that hangs holds its other end: one line is all
        workers = [int(pid) for pid in said.readline().split()]
    try:
        assert parent.wait(20) == -signal.SIGKILL
        # The system ends a stopped process whose group has lost its parent (SIGHUP, SIGCONT).
        assert all_end(workers)
    finally:
        for pid in workers:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_a_state_goes_from_processes_to_this_thread_and_back(in_processes):
    plain, apart = here(deciding()), in_processes(deciding())
    apart.start(Seeds(3))
    asked = requests(9)
    for request in itertools.islice(asked, 5):
        apart.collect(request)
    state = apart.state()
    assert not len(plain.restore({k: np.array(v) for k, v in state.items()}))
    with pytest.raises(SkillweaveError, match="of 2 collectors, but there are 1"):
        Collectors([deciding()(6, 0)]).restore(state)
    again = in_processes(deciding())
    again.restore(state)
    for request in itertools.islice(asked, 5):
        found = apart.collect(request)
        same(plain.collect(request), found)
        same(again.collect(request), found)


def test_one_worker_is_this_thread_and_environments_are_shared_out_equally():
    assert type(make_collectors(stepping(), 4, 1, 1, "Walk")) is Collectors
    with pytest.raises(SkillweaveError, match="must be a multiple of workers, 3"):
        make_collectors(stepping(), 8, 3, 1, "Walk")


def test_large_columns_come_whole_though_the_memory_must_grow(in_processes):
    """They grow out of the first block of shared memory."""

    def wide():
        return World(gym.spaces.Box(0, 255, (50, 50, 3), np.uint8))

    def make(num_envs, first):
        engine = make_engine(EnvSpec(wide, engine="sync"), num_envs, first=first)
        return alone_in(engine, Choices(num_envs, 2))

    plain, apart = here(make), in_processes(make)
    for collectors in (plain, apart):
        collectors.start(Seeds(0))
    for rows in (2, 40, 3):
        request = next(requests(rows))
        same(plain.collect(request), apart.collect(request))


def left_behind():
    """Names of shared memory, and this process's descriptors."""
    names = set(os.listdir("/dev/shm")) if os.path.isdir("/dev/shm") else set()
    return {n for n in names if "psm_" in n or "torch" in n}, len(os.listdir("/dev/fd"))


def test_nothing_is_left_behind():
    def killed_once():
        collectors = make_collectors(stepping(), 6, 2, 1, "Walk")
        collectors.start(Seeds(0))
        collectors.collect(next(requests(30)))
        os.kill(collectors._workers[1].process.pid, signal.SIGKILL)
        collectors.collect(next(requests(30)))
        collectors.close()

    killed_once()  # what the first processes of a program leave open
    gc.collect()
    before = left_behind()
    killed_once()
    gc.collect()
    assert left_behind() == before
