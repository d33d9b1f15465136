"""Other people's machines: small trainings under odd limits, streams, files, threads and processes.

A case is one training in one surrounding. It must end in time, with a run that can be evaluated or
with a sentence; no process may be left after it, and no file of others may be touched.
"""

from __future__ import annotations

import ctypes
import json
import locale
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from scripts.torture.processes import fork, group_is_gone, kill_group, wait
from scripts.torture.report import FILES, FINISHED, HANG, LEFT, LOST, REFUSED, TRACEBACK, Outcome
from skillweave import DQN, PPO, SAC, Apart, EnvSpec, Hierarchy, Network, Skill, load
from skillweave.api import Agent
from skillweave.errors import SkillweaveError
from skillweave.evolution import Evolution
from skillweave.runs.files import write_json

PATIENCE = 120.0
"""Seconds that a training of about one second may take."""
SENTENCE = 3
"""The exit code of a training that ended with a sentence."""
WRONG = 4
"""The exit code where a check after the training failed; its words are in the log."""
NET = Network((6,))
ON = {"num_envs": 4, "n_steps": 16, "batch_size": 32, "update_epochs": 1, "network": NET}
OFF = {"num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 400, "network": NET}


class Walk(gym.Env[Any, Any]):
    """Ten steps on a line."""

    action_space: gym.Space[Any] = gym.spaces.Discrete(3)
    observation_space = gym.spaces.Box(-20.0, 20.0, (2,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        self.x, self.t = 0.0, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Start somewhere."""
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        """Go to the left or to the right."""
        self.t += 1
        self.x += float(np.sum(action)) - 1.0
        return self.seen(), -abs(self.x), False, self.t == 10, {}

    def seen(self) -> Any:
        """Return its place and time."""
        return np.array([self.x, self.t], np.float32)


class Sway(Walk):
    """The same with continuous actions."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)


class Elsewhere(Walk):
    """Changes the program's directory."""

    def step(self, action: Any) -> Any:
        os.chdir("/")
        return super().step(action)


class Unclosed(Walk):
    """Cannot be closed."""

    def close(self) -> None:
        raise RuntimeError("the simulator is gone")


class Blocking(Walk):
    """An environment that once in a while waits forever in a step."""

    def step(self, action: Any) -> Any:
        if self.np_random.random() < 0.002:
            time.sleep(1_000)
        return super().step(action)


class Home(Skill):
    """Goes home."""

    max_steps = 4

    def reward(self, step: Any) -> Any:
        """Be near."""
        return -np.abs(step.next_obs[:, 0])


class Away(Home):
    """Goes away."""

    def reward(self, step: Any) -> Any:
        """Be far."""
        return np.abs(step.next_obs[:, 0])


def drawn(rng: random.Random, env: Any = Walk, workers: int | None = 2) -> Any:
    """Return some declaration over an environment, and how it is trained."""
    spec = EnvSpec(env, engine="sync", workers=workers)
    how: dict[str, Any] = {"seed": rng.randrange(100), "quiet": rng.random() < 0.5}
    kind = rng.choice(("apart", "together", "dqn", "sac", "evolve", "many"))
    if kind == "dqn":
        return Agent(spec, DQN(**OFF), 400), how
    if kind == "sac":
        other = Sway if env is Walk else env
        config = SAC(**OFF)
        return Agent(EnvSpec(other, engine="sync", workers=workers), config, 400), how
    if kind == "evolve":
        return Agent(spec, PPO(**ON), 1_200), how | {
            "evolve": Evolution(population=2, generations=2)
        }
    skills: list[Skill] = [Home(), Away()]
    if kind == "many":
        skills = [type(f"Home{i}", (Home,), {"name": f"home{i}"})() for i in range(12)]
    agents = {"algorithm": PPO(**ON), "selector": PPO(**ON)}
    if kind == "apart":
        return Hierarchy(
            spec, skills, learn="apart", apart=Apart(skill_steps=300), **agents, steps=900
        ), how
    return Hierarchy(spec, skills, steps=600, **agents), how


def trained(rng: random.Random, run: Path | str, env: Any = Walk, workers: int | None = 2) -> Any:
    """Train something, and evaluate it."""
    declared, how = drawn(rng, env, workers)
    found = declared.train(run, **how)
    found.evaluate(2, quiet=True)
    return found


def long_tmpdir(rng: random.Random, run: Path) -> None:
    """Temporary files have a path that no socket can have."""
    where = run.parent / ("x" * 100)
    where.mkdir(exist_ok=True)
    os.environ["TMPDIR"] = str(where)
    tempfile.tempdir = None
    trained(rng, run)


def few_descriptors(rng: random.Random, run: Path) -> None:
    """There may be few open files."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (rng.choice((48, 64, 96, 128)), hard))
    trained(rng, run)


def torch_threads(rng: random.Random, run: Path) -> None:
    """PyTorch has threads that a forked process does not have."""
    torch.set_num_threads(rng.choice((2, 4, 8)))
    torch.ones(400, 400) @ torch.ones(400, 400)  # the threads exist from now on
    trained(rng, run)


def trainings_in_threads(rng: random.Random, run: Path) -> None:
    """Train three times at once in one program."""
    failed: list[BaseException] = []

    def job(number: int) -> None:
        try:
            trained(random.Random(number), run / str(number))
        except BaseException as error:
            failed.append(error)

    jobs = [
        threading.Thread(target=job, args=(rng.randrange(100 * i, 100 * i + 100),))
        for i in range(3)
    ]
    for one in jobs:
        one.start()
    for one in jobs:
        one.join()
    if failed:
        raise failed[0]


def killed(rng: random.Random, run: Path) -> None:
    """Kill the process while it trains."""
    seconds = rng.uniform(0.3, 3.0)
    threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()
    while True:
        trained(rng, run, rng.choice((Walk, Blocking)))
        shutil.rmtree(run)


def linked(rng: random.Random, run: Path) -> None:
    """Make a part of the run a link to a user's file, and resume the run."""
    trained(random.Random(1), run, workers=1)
    mine = run.parent / "mine"
    files = sorted(p for p in run.rglob("*") if p.is_file())
    chosen = rng.choice([*files, run / "policies", run / "metrics.jsonl", run / "run.json"])
    mine.mkdir(exist_ok=True)
    other = mine / chosen.name
    shutil.rmtree(other, ignore_errors=True)
    shutil.move(chosen, other)
    chosen.symlink_to(other)
    before = contents(mine)
    declared, how = drawn(random.Random(1), workers=1)
    how.pop("seed")
    refused = None
    try:
        if rng.random() < 0.3:
            shutil.rmtree(run / "final", ignore_errors=True)
        declared.steps *= 2
        declared.train(run, resume=True, **how)
    except SkillweaveError as error:
        refused = error
    if contents(mine) != before:
        raise AssertionError(f"{other} was touched")
    if refused is not None:
        raise refused


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder."""
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def escapes(rng: random.Random, run: Path) -> None:
    """Put control characters of a terminal into the manifest."""
    from skillweave.cli import main

    trained(rng, run, workers=1)
    manifest = json.loads((run / "run.json").read_text())
    del manifest["sha256"], manifest["schema"]
    evil = "\x1b]52;c;ZXZpbA==\x07\x1b[2J"
    manifest[rng.choice(("env", "created"))] += evil
    write_json(run / "run.json", manifest)
    out = run.parent / "said"
    plain = os.dup(1), os.dup(2)
    with out.open("wb") as file:
        sys.stdout.flush()
        sys.stderr.flush()
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            command = rng.choice(("info", "evaluate", "report", "compare", "plot"))
            main([command, str(run)])
        except SystemExit:
            pass
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os.dup2(plain[0], 1)
            os.dup2(plain[1], 2)
    if b"\x1b]" in out.read_bytes() or b"\x1b[2J" in out.read_bytes():
        raise AssertionError(f"{command} printed raw escapes")


def bad_stderr(rng: random.Random, run: Path) -> None:
    """Nothing can be written to standard error."""
    how = rng.choice(("closed", "full", "gone", "none"))
    stream: Any = None
    if how == "gone":
        reader, writer = os.pipe()
        os.close(reader)
        stream = os.fdopen(writer, "w")
    elif how != "none":
        stream = open("/dev/full", "w")  # noqa: SIM115
        if how == "closed":
            stream.close()
    sys.stderr = stream
    trained(rng, run)


def float64(rng: random.Random, run: Path) -> None:
    """PyTorch makes float64 tensors."""
    torch.set_default_dtype(torch.float64)
    trained(rng, run)


def small_shm(rng: random.Random, run: Path, read_only: bool = False) -> None:
    """There is little or no shared memory."""
    if os.geteuid() != 0:
        raise SkillweaveError("only root can mount another /dev/shm")
    libc = ctypes.CDLL(None, use_errno=True)
    size = rng.choice((b"size=4k", b"size=64k", b"size=1m"))
    flags = 1 if read_only else 0
    done = libc.unshare(0x00020000) == 0  # CLONE_NEWNS
    done = done and libc.mount(b"none", b"/", None, 0x4000 | 0x40000, None) == 0  # private
    done = done and libc.mount(b"tmpfs", b"/dev/shm", b"tmpfs", flags, size) == 0
    if not done:
        raise SkillweaveError("another /dev/shm cannot be mounted here")
    trained(rng, run)


def other_directory(rng: random.Random, run: Path) -> None:
    """Change the program's directory."""
    os.chdir(run.parent)
    run.parent.joinpath("relative").mkdir(exist_ok=True)
    name = Path("relative") / run.name
    found = trained(rng, name, Elsewhere)
    os.chdir("/")
    found.evaluate(2, quiet=True, save=True)
    load(run.parent / name, found.declaration).evaluate(1, quiet=True)


def ascii_locale(rng: random.Random, run: Path) -> None:
    """Train where texts can be ASCII only."""
    locale.setlocale(locale.LC_ALL, "C")
    sys.stderr.reconfigure(encoding="ascii", errors="strict")  # type: ignore[union-attr]
    trained(rng, run).report(run / "report.html", episodes=1, films=0)


def umask(rng: random.Random, run: Path) -> None:
    """Train where files are for the user or the group."""
    mask = rng.choice((0o077, 0o002, 0o027))
    os.umask(mask)
    trained(rng, run)
    for path in [run, *run.rglob("*")]:
        wanted = (0o777 if path.is_dir() else 0o666) & ~mask
        if (mode := path.stat().st_mode & 0o777) != wanted:
            raise AssertionError(f"{path.name} has mode {mode:o} under umask {mask:o}")


def daemonic(rng: random.Random, run: Path) -> None:
    """Train in a process that may have no children."""
    process = multiprocessing.get_context("fork").Process(
        target=in_daemon, args=(rng, run, rng.choice((None, 1))), daemon=True
    )
    process.start()
    process.join()
    if process.exitcode == SENTENCE:
        raise SkillweaveError("it was refused")
    if process.exitcode:
        raise AssertionError(f"the daemon ended with {process.exitcode}")


def in_daemon(rng: random.Random, run: Path, workers: int | None) -> None:
    """Train within a daemonic process."""
    try:
        trained(rng, run, workers=workers)
    except SkillweaveError as error:
        print(f"error: {error}")
        os._exit(SENTENCE)


def unclosed(rng: random.Random, run: Path) -> None:
    """Train with environments that cannot be closed."""
    trained(rng, run, Unclosed, rng.choice((1, 2)))


def lost_files(rng: random.Random, run: Path) -> None:
    """Remove a file of the run, and resume the run."""
    found = trained(rng, run, workers=1)
    names = [p for p in sorted(run.rglob("*")) if p.is_file() and p.suffix != ".safetensors"]
    lost = rng.choice([p for p in names if p.name != "run.json"])
    lost.unlink()
    load(run, found.declaration).evaluate(2, quiet=True)
    found.declaration.steps *= 2
    found.declaration.train(run, resume=True, quiet=True)


def start_methods(rng: random.Random, run: Path) -> None:
    """Train where processes are not forked."""
    multiprocessing.set_start_method(rng.choice(("spawn", "forkserver")), force=True)
    trained(rng, run, workers=rng.choice((None, 2)))


SURROUNDINGS: dict[str, tuple[Callable[[random.Random, Path], None], bool]] = {
    "a long TMPDIR": (long_tmpdir, False),
    "few descriptors": (few_descriptors, True),
    "threads of PyTorch": (torch_threads, False),
    "trainings in threads": (trainings_in_threads, False),
    "killed": (killed, False),
    "links in a run": (linked, True),
    "terminal escapes": (escapes, False),
    "a bad stderr": (bad_stderr, False),
    "float64 as default": (float64, False),
    "a small /dev/shm": (small_shm, True),
    "a read-only /dev/shm": (partial(small_shm, read_only=True), True),
    "another directory": (other_directory, False),
    "a locale of ASCII": (ascii_locale, False),
    "a umask": (umask, False),
    "a daemonic process": (daemonic, False),
    "close() that raises": (unclosed, False),
    "lost files": (lost_files, True),
    "processes that are not forked": (start_methods, False),
}
"""By name, what is done in a surrounding, and whether a sentence is enough there."""


class Surroundings:
    """So many trainings in each surrounding."""

    limit = 3 * PATIENCE

    def __init__(self, folder: Path, seed: int, names: Sequence[str] = tuple(SURROUNDINGS)) -> None:
        self.folder, self.seed, self.names = folder, seed, list(names)

    def prepare(self) -> None:
        """Nothing: a case's training has a process of its own."""

    def cases(self, count: int) -> int:
        """Return the requested number of cases, the same number of each."""
        return count

    def case(self, number: int) -> Outcome:
        """Train in one surrounding."""
        name = self.names[number % len(self.names)]
        function, may_refuse = SURROUNDINGS[name]
        rng = random.Random(f"{self.seed} {number}")
        folder = self.folder / str(number)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        log = folder / "log"
        outside = self.folder / "outside"
        outside.mkdir(exist_ok=True)
        outcome = partial(Outcome, what=f"{name}: case {number}")
        pid = fork(partial(guarded, function, rng, folder / "run"), log)
        code = wait(pid, PATIENCE)
        if code is None:
            kill_group(pid)
            return outcome(HANG, said=log.read_text(errors="replace"))
        gone = group_is_gone(pid, 10.0)
        kill_group(pid)
        said = log.read_text(errors="replace")
        if not gone:
            return outcome(LEFT, said=said)
        if code == SENTENCE:
            return outcome(REFUSED if may_refuse else LOST, said=said)
        if code == WRONG:
            return outcome(FILES, said=said)
        if code not in (0, -signal.SIGKILL if function is killed else 0):
            return outcome(TRACEBACK, said=f"exit code {code}\n{said}")
        shutil.rmtree(folder, ignore_errors=True)
        return outcome(FINISHED)


def guarded(function: Callable[[random.Random, Path], None], rng: random.Random, run: Path) -> int:
    """Do it; the exit code says how it ended."""
    stderr = sys.stderr
    try:
        function(rng, run)
    except SkillweaveError as error:
        print(f"error: {error}")
        return SENTENCE
    except AssertionError as error:
        print(f"wrong: {error}")
        return WRONG
    finally:
        sys.stderr = stderr
    return 0
