"""Small runs on CartPole, stopped and resumed: what several files of tests share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from skillweave import DQN, PPO, Hierarchy, Network, Run, Skill
from skillweave.algorithms import RNN
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import LevelEntry, Manifest, StageEntry
from skillweave.training.replay_learner import ReplayLearner
from skillweave.training.stage import assign_workers

SMALL = Network(hidden=(8,))
ON = PPO(num_envs=4, n_steps=8, batch_size=16, update_epochs=2, network=SMALL)
OFF = DQN(
    num_envs=4, batch_size=16, learning_starts=20, buffer_size=2_000, train_freq=2, network=SMALL
)
MEMORY = PPO(num_envs=4, n_steps=8, batch_size=16, network=Network(hidden=(8,), rnn=RNN("gru", 6)))
PLAIN_RECIPE = """from skillweave import *
class Left(Skill):
    max_steps = 15
    def reward(self, step):
        return -step.next_obs[:, 0]
on = PPO(num_envs=4, n_steps=8, batch_size=16, network=Network((8,)))
env = EnvSpec('CartPole-v1', engine='sync', workers=1)
hierarchy = Hierarchy(env, [Left()], algorithm=on, selector=on, steps=STEPS)
"""


def stage_entry(
    name: str,
    status: Literal["waiting", "training", "done"] = "done",
    budget: int = 4_000,
    **more: Any,
) -> StageEntry:
    """The entry of a skill's stage."""
    return StageEntry(name, "skill", [name], None, budget, {"num_envs": 4}, None, status, **more)


def level_entry(**fields: Any) -> LevelEntry:
    """The entry of a hierarchy that learns apart."""
    plain: dict[str, Any] = {"learn": "apart", "call_steps": 10, "interrupt": None}
    plain |= {"greedy_skills": True, "greedy_selector": True, "start_calls": None}
    plain |= {"search_steps": None, "episode_calls": 1, "deliberation_cost": 0.0, "reflexes": []}
    return LevelEntry(**plain | fields)


def small_manifest(*stages: StageEntry, **fields: Any) -> Manifest:
    """The manifest of a plain agent, or of a hierarchy."""
    plain: dict[str, Any] = {"env": "CartPole-v1", "env_kwargs": {}, "seed": 0}
    plain |= {"checkpoint_every": 100, "eval_every": None, "eval_episodes": 20}
    plain |= {"log_info": (), "needs_recipe": False, "resume_needs_recipe": False}
    return Manifest(stages=list(stages), **plain | fields)


class Left(Skill):
    """Moves to the left."""

    max_steps = 15

    def reward(self, step):
        return -step.next_obs[:, 0] + 0.1 * step.timed_out


class Balance(Skill):
    """Stays up, until it is far away."""

    def initiation(self, obs):
        return np.abs(obs[:, 2]) < 0.15

    def termination(self, step):
        return np.abs(step.next_obs[:, 0]) > 0.5


class Push(Skill):
    """Is ready."""

    call_steps = 2

    def policy(self, obs):
        return (obs[:, 2] > 0).astype(np.int64)


class Stopped(Exception):
    """What interrupts a run here."""


class Heard:
    """A listener that keeps messages."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def stage(self, *told: Any) -> None: ...
    def tick(self, *told: Any) -> None: ...
    def done(self, *told: Any) -> None: ...

    def message(self, text: str) -> None:
        self.said.append(text)


class StopAt(Heard):
    """A listener that raises at its n-th tick."""

    def __init__(self, tick: int) -> None:
        super().__init__()
        self.left = tick

    def tick(self, *told: Any) -> None:
        self.left -= 1
        if self.left == 0:
            raise Stopped


def policies(run: Path) -> dict[str, tuple[dict[str, Any], bytes]]:
    """Header (as JSON, its keys in any order) and the tensors' bytes of every policy."""
    found = {}
    for path in sorted((run / "policies").iterdir()):
        data = path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        found[path.name] = (json.loads(data[8 : 8 + size]), data[8 + size :])
    return found


def acts(policy: Any, size: int = 4, steps: int = 40) -> list[Any]:
    """What a hierarchy does, and which skills act, in 16 environments of so many numbers."""
    rng, memory, found = np.random.default_rng(0), policy.start(16), []
    for _ in range(steps):
        obs = rng.normal(size=(16, size)).astype(np.float32)
        action, memory = policy.act(memory, obs)
        found.append((action.tolist(), policy.acting(memory).tolist()))
        memory["end"][:] = rng.random(16) < 0.5
    return found


def lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def assert_same(run: Path, reference: Path) -> None:
    mine, theirs = policies(run), policies(reference)
    assert mine.keys() == theirs.keys()
    assert len(mine) >= 1
    for name, (header, weights) in theirs.items():
        assert mine[name][1] == weights, f"{name}: other weights"
        assert mine[name][0] == header, f"{name}: another header"
    assert_metrics_fit(run, reference)


def assert_metrics_fit(run: Path, reference: Path) -> None:
    """No line twice, none missing, updates and steps rising; all numbers but times the same."""
    mine, theirs = lines(run), lines(reference)
    keys = [(r["stage"], r["update"]) for r in mine]
    assert len(set(keys)) == len(keys), "a line stands twice"
    assert keys == [(r["stage"], r["update"]) for r in theirs]
    for stage in {r["stage"] for r in mine}:
        rows = [r for r in mine if r["stage"] == stage]
        for field in ("update", "steps"):
            values = [r[field] for r in rows]
            assert values == sorted(set(values)), f"{field} of {stage} does not rise"
    for a, b in zip(mine, theirs, strict=True):
        assert {**a, "seconds": 0} == {**b, "seconds": 0}


def new_run(hierarchy: Hierarchy, path: Path, **options: Any) -> RunDirectory:
    """A new run of as many workers as the recipe says."""
    content = training.manifest(hierarchy, **{"seed": 3, "flat": False} | options)
    assign_workers(content.stages, hierarchy.spec)
    return RunDirectory.create(path, content)


def messages(hierarchy: Hierarchy, path: Path, *listeners: Any) -> list[str]:
    """What a listener of a new run hears until its training ends."""
    heard, run = Heard(), new_run(hierarchy, path)
    with closing(run):
        training.train(hierarchy, run, (heard, *listeners))
    return heard.said


def stopped_run(hierarchy: Hierarchy, path: Path, tick: int, **options: Any) -> RunDirectory:
    """A new run that was interrupted by an exception at a tick."""
    return _stopped(hierarchy, new_run(hierarchy, path, **options), tick)


def stopped_again(hierarchy: Hierarchy, path: Path, tick: int) -> RunDirectory:
    """A run that went on, in place and without ``Hierarchy.resume``, and was stopped again."""
    return _stopped(hierarchy, RunDirectory.open(path), tick)


def goes_on(hierarchy: Callable[[], Hierarchy], folder: Path, tick: int = 3) -> Run:
    """A whole run: one that is stopped at a tick, and resumed, ends with the same weights."""
    whole = hierarchy().train(folder / "whole", seed=3, quiet=True)
    stopped_run(hierarchy(), folder / "cut", tick)
    hierarchy().resume(folder / "cut", quiet=True)
    assert_same(folder / "cut", whole.path)
    return whole


def _stopped(hierarchy: Hierarchy, run: RunDirectory, tick: int) -> RunDirectory:
    try:
        with pytest.raises(Stopped):
            training.train(hierarchy, run, (StopAt(tick),))
    finally:
        run.close()
    return run


def plain_recipe(steps: int) -> str:
    """The text of a file that declares a small hierarchy of one skill."""
    return PLAIN_RECIPE.replace("STEPS", str(steps))


def reports_every(steps: int) -> Any:
    """A fixture for a module: learners from replay report this often, not every 1,000 steps."""

    @pytest.fixture(autouse=True, scope="module")
    def frequent_reports() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ReplayLearner, "report_every", steps)
            yield

    return frequent_reports


def interrupt_at_checkpoint(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Ctrl-C, right after so many checkpoints were written."""
    save, left = RunDirectory.save_checkpoint, [number]

    def stop(self: RunDirectory, *about: Any) -> None:
        save(self, *about)
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt

    monkeypatch.setattr(RunDirectory, "save_checkpoint", stop)


@contextmanager
def interrupted(number: int) -> Iterator[pytest.ExceptionInfo[KeyboardInterrupt]]:
    """A block that trains, until Ctrl-C comes right after so many checkpoints."""
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at_checkpoint(patch, number)
        with pytest.raises(KeyboardInterrupt) as stop:
            yield stop


def stop_at(steps: int, stage: str = "agent") -> Callable[[Any], None]:
    """A callback that stops a training after so many steps of a stage."""

    def stop(event: Any) -> None:
        if event.stage == stage and event.steps >= steps:
            raise Stopped

    return stop


Kinds = Mapping[str, Callable[[], Any]]


class Whole:
    """An uninterrupted run of each kind of declaration, made once.

    Args:
        how: further arguments of ``train``.
    """

    def __init__(self, kinds: Kinds, tmp_path_factory: pytest.TempPathFactory, **how: Any) -> None:
        self.kinds, self._folders, self._how = kinds, tmp_path_factory, how
        self._made: dict[str, tuple[Run, Path]] = {}

    def __call__(self, kind: str) -> tuple[Run, Path]:
        if kind not in self._made:
            path = self._folders.mktemp("whole") / "run"
            self._made[kind] = self.train(kind, path), path
        return self._made[kind]

    def train(self, kind: str, path: Path) -> Run:
        return self.kinds[kind]().train(path, seed=3, quiet=True, **self._how)

    def assert_resumes(self, kind: str, ticks: tuple[int, ...], path: Path) -> None:
        """A run that is stopped, and resumed, again and again, ends as if it had not been.

        Args:
            ticks: how many it makes before each stop, counted from the checkpoint that it goes on
                from. At one of several stops at least there must be a checkpoint.
        """
        run = stopped_run(self.kinds[kind](), path, ticks[0])
        checkpoint = path / "checkpoint.safetensors"
        goes_on = checkpoint.exists()
        for tick in ticks[1:]:
            assert not run.finished
            run = stopped_again(self.kinds[kind](), path, tick)
            goes_on = goes_on or checkpoint.exists()
        assert not run.finished
        assert len(ticks) == 1 or goes_on, "its stages only begin again"
        self.kinds[kind]().resume(path, quiet=True)
        assert_same(path, self(kind)[1])

    def assert_loads(self, kind: str, file: Path) -> None:
        """What was learnt is loaded from the run, and from one file of weights."""
        run, path = self(kind)
        found = run.evaluate(3)
        assert self.kinds[kind]().load(path).evaluate(3) == found
        run.save_weights(file)
        assert self.kinds[kind]().load_weights(file).evaluate(3) == found
