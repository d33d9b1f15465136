"""Checkpoints at any places, or none, give the same weights, bit for bit, and the same reports."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from declaring import declare
from gymnasium.spaces import Box, Dict, Discrete, Tuple
from small_runs import (
    MEMORY,
    OFF,
    ON,
    Whole,
    assert_same,
    lines,
    policies,
)
from toys import REALS, World

from skillweave import (
    DQN,
    SAC,
    TD3,
    Agent,
    EnvSpec,
    Network,
    TrainDefaults,
)
from skillweave._internal import interrupts
from skillweave.evolution import Evolution
from skillweave.runs.directory import RunDirectory
from skillweave.training.loop import Loop

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")

SYNC = EnvSpec("CartPole-v1", engine="sync", workers=1)
STEPS = 1_600
SELDOM = TrainDefaults(checkpoint_every=10**9)
REPORTED = replace(SELDOM, eval_every=300, eval_episodes=2)
REPLAY: dict[str, Any] = {
    "num_envs": 4, "batch_size": 8, "learning_starts": 40, "buffer_size": 500, "update_ratio": 0.1,
    "network": Network((8,)), "normalize_rewards": True,
}  # fmt: skip


def plain(algorithm: Any, env: Any = "CartPole-v1", steps: int = STEPS) -> Callable[[], Agent]:
    """A declaration of a plain agent, in one process unless ``env`` says otherwise.

    On a busy machine a measured number of processes may be another one from run to run.
    """
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env, workers=1)
    return lambda: Agent(spec, algorithm, steps, train_defaults=REPORTED)


def in_a_pool() -> Agent:
    pytest.importorskip("envpool")
    return plain(ON, EnvSpec("CartPole-v1", engine="envpool", workers=1))()


NOW = "plain, ppo without overlap"
PARTS = Dict(picture=Box(0, 255, (6, 8, 1), np.uint8), number=Box(-1, 1, (1,), np.float32))
PAIR = Tuple((Discrete(2), Box(-1, 1, (1,), np.float32)))


KINDS: dict[str, Callable[[], Any]] = {
    "plain, ppo": plain(ON, SYNC),
    NOW: plain(replace(ON, overlap=False), SYNC),
    "plain, recurrent ppo": plain(MEMORY, SYNC),
    "plain, in a pool": in_a_pool,
    "plain, dqn": plain(OFF, SYNC),
    "plain, dqn beside collecting": plain(replace(OFF, overlap=True), SYNC),
    "plain, rainbow": plain(DQN.rainbow(**{**vars(OFF), "n_step": 3, "overlap": True}), SYNC),
    "plain, sac beside collecting": plain(SAC(**REPLAY, overlap=True), "Pendulum-v1", 800),
    "plain, td3": plain(TD3(**REPLAY, normalize_obs=True), "Pendulum-v1", 800),
    "plain, dqn in parts": plain(DQN(**REPLAY), lambda: World(PARTS), 800),
    "plain, sac in a tuple": plain(
        SAC(**REPLAY, normalize_obs=True), lambda: World(PAIR, REALS), 800
    ),
    "plain, sac of choices": plain(SAC(**REPLAY), lambda: World(PARTS["picture"]), 800),
    "plain, in two processes": plain(ON, replace(SYNC, workers=2)),
    "together, from replay": lambda: declare(
        algorithm=replace(OFF, overlap=True),
        interrupt=True,
        together_steps=800,
        checkpoint_every=10**9,
    ),
}
POPULATIONS: dict[str, Callable[[], Any]] = {
    "a population": plain(ON, SYNC, 2_000),
    "a population in two parts": plain(ON, replace(SYNC, workers=2), 2_000),
    "a population from replay": plain(OFF, SYNC, 2_000),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Runs in which no checkpoint was written."""
    return Whole(KINDS, tmp_path_factory)


@contextmanager
def at_random_places(share: float, seed: int, stop_after: int) -> Iterator[list[int]]:
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
def test_a_run_that_stops_at_checkpoints_and_goes_on_ends_as_one_without_any(kind, tmp_path, whole):
    (_, reference), path, stops = whole(kind), tmp_path / "run", 0
    for seed in range(100):
        # It goes on in the process after some checkpoints, and from others in a new one.
        with at_random_places(0.2, seed, stop_after=1 + seed % 3) as places:
            try:
                if path.exists():
                    KINDS[kind]().resume(path, quiet=True)
                else:
                    whole.train(kind, path)
                break
            except KeyboardInterrupt:
                stops += 1
                assert places
    assert stops >= 3
    assert_same(path, reference)


@pytest.fixture(scope="module")
def populations(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return Whole(POPULATIONS, tmp_path_factory, evolve=Evolution(2, 3, 2))


@pytest.mark.slow
@pytest.mark.parametrize("kind", POPULATIONS)
def test_a_population_that_stops_after_generations_ends_as_one_that_does_not(
    kind, tmp_path, populations, monkeypatch
):
    (_, reference), path = populations(kind), tmp_path / "run"
    monkeypatch.setattr(interrupts, "requested", lambda: True)
    with pytest.raises(KeyboardInterrupt):
        populations.train(kind, path)
    for _ in range(5):
        with suppress(KeyboardInterrupt):
            POPULATIONS[kind]().resume(path, quiet=True)
            break
    monkeypatch.undo()
    assert RunDirectory.open(path).finished
    assert_same(path, reference)


@pytest.mark.slow
def test_a_run_that_does_not_save_its_buffer_goes_on_with_an_empty_one(tmp_path, whole):
    sizes, (_, reference) = [], whole("plain, dqn")
    for saved in (True, False):
        path, agent = tmp_path / str(saved), plain(replace(OFF, save_buffer=saved), SYNC)()
        with at_random_places(0.2, 0, stop_after=20), pytest.raises(KeyboardInterrupt):
            agent.train(path, seed=3, quiet=True)
        sizes.append((path / "checkpoint.safetensors").stat().st_size)
        agent.resume(path, quiet=True)
        for name, (_, weights) in policies(reference).items():
            assert (policies(path)[name][1] == weights) == saved
    assert sizes[1] < sizes[0]
    assert [r["steps"] for r in lines(path)] == [r["steps"] for r in lines(reference)]


def test_a_checkpoint_is_written_when_the_latest_is_old(tmp_path, monkeypatch):
    saved: list[int] = []
    monkeypatch.setattr(RunDirectory, "save_checkpoint", lambda *_: saved.append(1))
    monkeypatch.setattr("skillweave.training.loop.CHECKPOINT_SHARE", 1e9)
    plain(ON, SYNC, 320)().train(tmp_path / "young", quiet=True)
    assert len(saved) == 1  # the last one
    monkeypatch.setattr("skillweave.training.loop.CHECKPOINT_SECONDS", 0.0)
    plain(ON, SYNC, 320)().train(tmp_path / "old", quiet=True)
    assert len(saved) == 1 + 10


def interrupted(path: Path, declared: Agent, *signals: int) -> None:
    """A run that gets signals at its 10th update."""

    def send(event: Any) -> None:
        if event.steps == 10 * 32:
            for number in signals:
                os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt):
        declared.train(path, seed=3, callback=send)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_the_round_that_was_begun_and_loses_nothing(
    number, tmp_path, whole, capsys
):
    # Ray, where a test before used it, handles SIGTERM by itself.
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    before = signal.getsignal(number)
    (_, reference), declared = whole(NOW), KINDS[NOW]()
    interrupted(tmp_path / "run", declared, number)
    assert signal.getsignal(number) is before
    assert "stopping after this round, and saving" in capsys.readouterr().err
    latest = RunDirectory.open(tmp_path / "run")._checkpoints.latest_header()
    assert latest is not None
    assert latest.update == 10
    declared.resume(tmp_path / "run", quiet=True)
    assert_same(tmp_path / "run", reference)


def test_a_second_interrupt_stops_at_once(tmp_path):
    interrupted(tmp_path / "run", KINDS["plain, ppo"](), signal.SIGINT, signal.SIGINT)
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()


def test_a_program_that_handles_ctrl_c_itself_keeps_its_handler():
    def own(*_: Any) -> None: ...

    before = signal.signal(signal.SIGINT, own)
    try:
        with interrupts.deferred("now"):
            assert signal.getsignal(signal.SIGINT) is own
    finally:
        signal.signal(signal.SIGINT, before)
