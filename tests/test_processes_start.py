"""Where processes are chosen without being asked, and where they cannot be started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ENV = """
import multiprocessing, os, sys, time
import gymnasium as gym, numpy as np
import skillweave as sw

class Slow(gym.Env):
    observation_space = gym.spaces.Box(-20, 20, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}
    def step(self, action):
        time.sleep(0.001)
        self.t += 1
        return np.full(1, self.t, np.float32), float(action), False, self.t == 10, {}
    def close(self):
        open(f"pid-{os.getpid()}", "w").close()

SMALL = sw.PPO(num_envs=4, n_steps=16, batch_size=32, update_epochs=1, network=sw.Network((4,)))
sw_cores = "skillweave.envs.make.cores"
import skillweave.envs.make as make
make.cores = lambda: 2
"""
TRAIN = "sw.train_agent({env}, SMALL, 64, 'run')\n"


def run_program(folder: Path, text: str) -> str:
    """Run a program in a folder; what it says."""
    (folder / "program.py").write_text(text)
    paths = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), str(folder)])}
    command = [sys.executable, "program.py"]
    done = subprocess.run(
        command, cwd=folder, env=os.environ | paths, capture_output=True, text=True, timeout=600
    )
    return done.stderr


def trained(folder: Path, text: str, processes: int) -> str:
    """Run a program that trains in this many processes; what it says."""
    said = run_program(folder, ENV + text)
    assert "64 of 64 steps (100%)" in said
    assert len(list(folder.glob("pid-*"))) == processes  # each closes an environment
    return said


def method(name: str) -> str:
    return f"multiprocessing.set_start_method({name!r})\n"


GUARD = "if __name__ == '__main__':\n    "


PLAIN = TRAIN.format(env="Slow")
FUNCTION = f"\ndef main():\n    {PLAIN}\n"
NO_MEMORY = (
    "import tempfile\ndef full(*_):\n    raise OSError(28, 'No space left on device')\n"
    "tempfile.TemporaryFile = full\n"
    "if hasattr(os, 'memfd_create'):\n    del os.memfd_create\n"
)
LOCKED = (
    "\nlock = __import__('threading').Lock()\ndef made():\n    lock.locked()\n    return Slow()\n"
)
MAIN, SENT = "__name__ == '__main__'", "cannot be sent to another process"
SCRIPTS = {  # by name: the text, in how many processes it trains, and what is said once
    **{f"plain, {name}": (method(name) + PLAIN, 1, MAIN) for name in ("spawn", "forkserver")},
    "plain, fork": (method("fork") + PLAIN, 3, ""),
    **{
        f"{where}, {name}": (f"{FUNCTION}{GUARD}{method(name)}    {body}", 3, "")
        for where, body in (("in the guard", PLAIN), ("in a function", "main()\n"))
        for name in ("spawn", "forkserver", "fork")
    },
    **{
        f"without shared memory, {name}": (f"{NO_MEMORY}{GUARD}{method(name)}    {PLAIN}", 3, "")
        for name in ("spawn", "forkserver")
    },
    "a lock": (f"{LOCKED}{GUARD}{method('spawn')}    {TRAIN.format(env='made')}", 1, SENT),
}


@pytest.mark.slow
@pytest.mark.parametrize(("text", "processes", "says"), SCRIPTS.values(), ids=SCRIPTS)
def test_a_script_trains_in_processes_where_they_can_be_started(text, processes, says, tmp_path):
    said = trained(tmp_path, text, processes)
    assert not says or said.count(says) == 1
    assert ("EnvSpec(workers=2) uses processes" in said) == (processes == 1)


@pytest.mark.slow
def test_asking_for_processes_in_a_plain_script_is_an_error_before_training(tmp_path):
    env = "sw.EnvSpec(Slow, workers=2)"
    said = run_program(tmp_path, ENV + method("spawn") + TRAIN.format(env=env))
    last = said.strip().splitlines()[-2:]
    assert "put what trains inside a block that begins with: if __name__ == '__main__':" in last[0]
    assert "EnvSpec(workers=1)" in last[1]
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_run_begun_in_processes_goes_on_where_there_can_be_none(tmp_path):
    stop = "sw.train_agent(Slow, SMALL, 640, 'run', checkpoint_every=64, callback=stopped)\n"
    stopped = "\ndef stopped(now):\n    if now.steps > 300:\n        raise KeyboardInterrupt\n"
    run_program(tmp_path, f"{ENV}{stopped}{GUARD}{method('fork')}    {stop}")
    train = "sw.train_agent(Slow, SMALL, 640, 'run', resume=True)\n"
    said = run_program(tmp_path, ENV + method("spawn") + train)
    assert "640 of 640 steps (100%)" in said
    assert "its 2 collectors work in this process" in said


@pytest.mark.slow
@pytest.mark.parametrize("surrounding", ["a long TMPDIR", "few descriptors"])
def test_tasks_reach_processes_in(surrounding, tmp_path):
    if surrounding == "a long TMPDIR":
        long = tmp_path / ("x" * 100)
        long.mkdir()
        first = f"import tempfile\ntempfile.tempdir = {str(long)!r}\n"
    else:
        first = "import resource\nresource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))\n"
    skills = (
        "skills = [type(f'S{i}', (sw.Skill,), {'name': f's{i}', 'max_steps': 5})() "
        "for i in range(12)]\n"
        "h = sw.Hierarchy(sw.EnvSpec(Slow, workers=2), skills, algorithm=SMALL, selector=SMALL, "
        "learn='together', call_steps=4, together=sw.Together(steps=200))\n"
        "h.train('run')\nprint('all well', file=sys.stderr)\n"
    )
    assert "all well" in run_program(tmp_path, ENV + first + skills)


@pytest.mark.slow
def test_too_few_descriptors_for_processes_is_a_sentence(tmp_path):
    limit = (
        "import resource\nkept = [open('/dev/null') for _ in range(50)]\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (65, 65))\n"
    )
    train = "sw.train_agent(sw.EnvSpec(Slow, workers=4), SMALL, 64, 'run')\n"
    said = run_program(tmp_path, ENV + limit + train)
    assert "ulimit -n" in said.strip().splitlines()[-1]


THREADS = """
import threading
import torch

class Own(Slow):
    def __init__(self):
        torch.set_num_threads(2)
        self.a = torch.ones(300, 300)
    def step(self, action):
        torch.set_num_threads(2)
        self.a @ self.a
        (torch.ones(100_000) + 1).sum()
        return super().step(action)

def train(i):
    env = sw.EnvSpec(Own if own else Slow, engine="sync", workers=2)
    sw.train_agent(env, SMALL, 128, f"run-{i}", quiet=True)

if __name__ == "__main__":
    torch.set_num_threads(2)
    torch.ones(800, 800) @ torch.ones(800, 800)
    (torch.ones(1_000_000) + 1).sum()
    threads = [threading.Thread(target=train, args=(i,)) for i in range(count)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    if count == 0:
        train(0)
    print("all well", file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("own", "count"), [(True, 0), (False, 4), (True, 4)])
def test_processes_work_where_the_program_has_threads(own, count, tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    said = run_program(tmp_path, ENV + f"own, count = {own}, {count}\n" + THREADS)
    assert "all well" in said


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fork", "spawn"])
def test_a_thread_trains_in_processes_after_the_main_thread_has_ended(name, tmp_path):
    text = (
        "\nimport threading\n\ndef later():\n    threading.main_thread().join()\n    "
        f"sw.train_agent(Slow, SMALL, 64, 'run')\n\n{GUARD}{method(name)}    "
        "threading.Thread(target=later).start()\n"
    )
    trained(tmp_path, text, 3)
