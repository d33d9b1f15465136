"""Checkpoints at any places, or none, give the same weights, bit for bit, and the same reports."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_runs import MEMORY, OFF, ON, Balance, Left, Push, assert_same, plain_recipe

from skillweave import DQN, SAC, Agent, Apart, EnvSpec, Hierarchy, Network, Together, TrainDefaults
from skillweave._internal import interrupts
from skillweave.evolution import Evolution
from skillweave.runs.directory import RunDirectory
from skillweave.training.loop import Loop

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")

SYNC = EnvSpec("CartPole-v1", engine="sync", workers=1)
STEPS = 1_600
SELDOM = TrainDefaults(checkpoint_every=10**9)
REPORTED = {"checkpoint_every": 10**9, "eval_every": 300, "eval_episodes": 2}
BOX = SAC(
    num_envs=4,
    batch_size=8,
    learning_starts=40,
    buffer_size=500,
    update_ratio=0.1,
    normalize_rewards=True,
    network=Network((8,)),
)


def plain(algorithm: Any, env: Any = "CartPole-v1", steps: int = STEPS) -> Callable[[], Agent]:
    """A declaration of a plain agent."""
    return lambda: Agent(env, algorithm, steps)


def skills(learn: str, algorithm: Any = ON, **how: Any) -> Callable[[], Hierarchy]:
    """A declaration of a hierarchy of two skills that learn and one that is ready."""

    def declare() -> Hierarchy:
        settings = {
            "algorithm": algorithm,
            "selector": ON,
            "call_steps": 6,
            "apart": Apart(skill_steps=400, selector_steps=600),
            "together": Together(steps=800, interrupt=True),
            "train_defaults": SELDOM,
        } | how
        return Hierarchy(
            SYNC,
            [Left(), Balance(), Push()],
            learn=learn,  # type: ignore[arg-type]
            **settings,
        )

    return declare


def nested() -> Hierarchy:
    """A hierarchy in which a skill is one."""
    inner = Hierarchy(
        SYNC,
        [Left(), Push()],
        algorithm=ON,
        selector=ON,
        call_steps=3,
        name="inner",
        train_defaults=SELDOM,
    )
    return Hierarchy(
        SYNC,
        [inner.as_skill("inner"), Balance()],
        algorithm=ON,
        selector=ON,
        call_steps=8,
        learn="together",
        together=Together(steps=800),
        train_defaults=SELDOM,
    )


KINDS: dict[str, Callable[[], Any]] = {
    "plain, ppo": plain(ON, SYNC),
    "plain, ppo without overlap": plain(replace(ON, overlap=False), SYNC),
    "plain, recurrent ppo": plain(MEMORY, SYNC),
    "plain, in a pool": plain(ON, EnvSpec("CartPole-v1", engine="envpool", workers=1)),
    "plain, dqn": plain(OFF, SYNC),
    "plain, dqn beside collecting": plain(replace(OFF, overlap=True), SYNC),
    "plain, rainbow": plain(DQN.rainbow(**{**vars(OFF), "n_step": 3, "overlap": True}), SYNC),
    "plain, sac beside collecting": plain(replace(BOX, overlap=True), "Pendulum-v1", 800),
    "plain, in two processes": plain(ON, replace(SYNC, workers=2)),
    "apart": skills("apart"),
    "apart, from replay": skills("apart", OFF),
    "together": skills("together"),
    "together, from replay": skills("together", replace(OFF, overlap=True)),
    "apart, then together": skills("apart, then together"),
    "nested": nested,
}
POPULATIONS: dict[str, Callable[[], Any]] = {
    "a population": plain(ON, SYNC, 2_000),
    "a population in two parts": plain(ON, replace(SYNC, workers=2), 2_000),
    "a population from replay": plain(OFF, SYNC, 2_000),
}


def train(declared: Any, path: Path, evolves: bool = False) -> None:
    how: dict[str, Any] = {"evolve": Evolution(2, 3, 2)} if evolves else {}
    how |= REPORTED if isinstance(declared, Agent) else {}
    declared.train(path, seed=3, quiet=True, **how)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A run of each kind in which no checkpoint was written, made once."""
    made: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind == "plain, in a pool":
            pytest.importorskip("envpool")
        if kind not in made:
            made[kind] = tmp_path_factory.mktemp("whole") / "run"
            evolves = kind in POPULATIONS
            train((KINDS | POPULATIONS)[kind](), made[kind], evolves)
        return made[kind]

    return make


@contextmanager
def at_random_places(share: float, seed: int, stop_after: int | None = None) -> Iterator[list[int]]:
    """Write checkpoints after a share of all rounds; stop right after so many of them.

    Yields:
        The updates at which checkpoints were written.
    """
    rng, places = np.random.default_rng(seed), list[int]()
    save = Loop._save

    def noted(self: Loop) -> None:
        save(self)
        places.append(self.at.update)
        if len(places) == stop_after:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Loop, "is_due", lambda self, before: rng.random() < share)
        patch.setattr(Loop, "_save", noted)
        yield places


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_checkpoints_at_twenty_random_places_change_no_weight_and_no_report(
    kind: str, tmp_path: Path, whole: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = whole(kind)
    with at_random_places(0.5 if kind.startswith("plain") else 0.95, 0) as places:
        train(KINDS[kind](), tmp_path / "run")
    assert len(places) >= 20
    assert_same(tmp_path / "run", reference)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", KINDS)
def test_a_run_that_stops_at_checkpoints_and_goes_on_ends_as_one_without_any(
    kind: str, tmp_path: Path, whole: Callable[[str], Path]
) -> None:
    reference, path, stops = whole(kind), tmp_path / "run", 0
    for seed in range(100):
        # Sometimes it goes on from a checkpoint that is not the latest round's.
        with at_random_places(0.2, seed, stop_after=1 + seed % 3) as places:
            try:
                if path.exists():
                    KINDS[kind]().resume(path, quiet=True)
                else:
                    train(KINDS[kind](), path)
                break
            except KeyboardInterrupt:
                stops += 1
                assert places
    assert stops >= 3
    assert_same(path, reference)


@pytest.mark.slow
@pytest.mark.parametrize("kind", POPULATIONS)
def test_a_population_that_stops_after_generations_ends_as_one_that_does_not(
    kind: str, tmp_path: Path, whole: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    reference, path = whole(kind), tmp_path / "run"
    monkeypatch.setattr(interrupts, "requested", lambda: True)
    with pytest.raises(KeyboardInterrupt):
        train(POPULATIONS[kind](), path, evolves=True)
    for _ in range(5):
        with suppress(KeyboardInterrupt):
            POPULATIONS[kind]().resume(path, quiet=True)
            break
    monkeypatch.undo()
    assert RunDirectory.open(path).finished
    assert_same(path, reference)


def test_a_checkpoint_is_written_when_the_latest_is_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[int] = []
    monkeypatch.setattr(RunDirectory, "save_checkpoint", lambda *_: saved.append(1))
    monkeypatch.setattr("skillweave.training.loop.CHECKPOINT_SHARE", 1e9)
    train(plain(ON, SYNC)(), tmp_path / "young")
    assert len(saved) == 1  # the last one
    monkeypatch.setattr("skillweave.training.loop.CHECKPOINT_SECONDS", 0.0)
    train(plain(ON, SYNC)(), tmp_path / "old")
    assert len(saved) == 1 + STEPS // 32


class Interrupt:
    """A listener that sends this process signals at a tick."""

    def __init__(self, tick: int, *signals: int) -> None:
        self.left, self.signals = tick, signals

    def stage(self, *about: Any) -> None: ...
    def done(self, *about: Any) -> None: ...
    def message(self, text: str) -> None: ...

    def tick(self, *about: Any) -> None:
        self.left -= 1
        if self.left == 0:
            for number in self.signals:
                os.kill(os.getpid(), number)


def interrupted(path: Path, declared: Any, *signals: int) -> None:
    """A run that gets signals at its 10th tick."""
    from skillweave.hierarchy import training
    from skillweave.training.stage import assign_workers

    content = declared.manifest(3, TrainDefaults(**REPORTED))
    assign_workers(content.stages, declared.spec)
    run = RunDirectory.create(path, content)
    try:
        with pytest.raises(KeyboardInterrupt):
            training.train(declared, run, (Interrupt(10, *signals),))
    finally:
        run.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_the_round_that_was_begun_and_loses_nothing(
    number: int, tmp_path: Path, whole: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    # Ray, where a test before used it, handles SIGTERM by itself.
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    before = signal.getsignal(number)
    reference, declared = whole("plain, ppo without overlap"), KINDS["plain, ppo without overlap"]()
    interrupted(tmp_path / "run", declared, number)
    assert signal.getsignal(number) is before
    assert "stopping after this round, and saving" in capsys.readouterr().err
    latest = RunDirectory.open(tmp_path / "run")._checkpoints.latest_header()
    assert latest is not None
    assert latest.update == 10
    declared.resume(tmp_path / "run", quiet=True)
    assert_same(tmp_path / "run", reference)


def test_a_second_interrupt_stops_at_once(tmp_path: Path) -> None:
    interrupted(tmp_path / "run", KINDS["plain, ppo"](), signal.SIGINT, signal.SIGINT)
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()


def test_a_program_that_handles_ctrl_c_itself_keeps_its_handler() -> None:
    def own(*_: Any) -> None: ...

    before = signal.signal(signal.SIGINT, own)
    try:
        with interrupts.deferred("now"):
            assert signal.getsignal(signal.SIGINT) is own
    finally:
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_in_the_command_line_saves_and_names_the_command_to_go_on(tmp_path: Path) -> None:
    recipe, run = tmp_path / "recipe.py", tmp_path / "run"
    recipe.write_text(plain_recipe(200_000))
    command = [sys.executable, "-m", "skillweave", "train", str(recipe), "-o", str(run)]
    with subprocess.Popen(
        [*command, "--evaluate", "0"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        metrics = run / "metrics.jsonl"
        while process.poll() is None and not (metrics.exists() and metrics.stat().st_size):
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate()
    assert process.returncode == 130
    assert "Traceback" not in err
    assert (run / "checkpoint.safetensors").exists()
    assert f"Continue: skillweave resume {run} --recipe {recipe}" in err
