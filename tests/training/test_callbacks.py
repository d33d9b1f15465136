"""``train(callback=...)``: what a callback gets, how it stops a stage, what its exceptions do."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import OFF, ON, Balance, Left, Push, assert_same, lines

import skillweave as sw
from skillweave import Agent, Apart, EnvSpec, Hierarchy, SkillweaveError
from skillweave.cli.execute import run_lines
from skillweave.errors import DeclarationError, Interrupted
from skillweave.evolution import Evolution
from skillweave.reporting.facts import stage_rows
from skillweave.runs.directory import RunDirectory
from skillweave.types import TrainEvent

SYNC = EnvSpec("CartPole-v1", engine="sync", workers=1)
EVALUATED = {"eval_every": 200, "eval_episodes": 2, "checkpoint_every": 150}


def agent(steps: int = 640, algorithm=ON) -> Agent:
    return Agent(SYNC, algorithm, steps)


def apart() -> Hierarchy:
    """Two skills that learn, then the selector: 320 steps each."""
    return Hierarchy(
        SYNC,
        [Left(), Balance(), Push()],
        algorithm=ON,
        selector=ON,
        call_steps=6,
        learn="apart",
        apart=Apart(skill_steps=320, selector_steps=320),
    )


def never(event: TrainEvent):
    raise AssertionError(f"called with {event}")


class TrialPruned(Exception):
    """Stands for Optuna's."""


def test_a_callback_gets_each_report_and_each_checkpoint_as_the_run_has_them(tmp_path):
    events = []
    how = EVALUATED | {"callback": events.append, "quiet": True}
    sw.train_agent(SYNC, ON, 640, tmp_path / "run", **how)
    reports = [e for e in events if e.kind == "report"]
    checkpoints = [e for e in events if e.kind == "checkpoint"]
    assert len(reports) + len(checkpoints) == len(events)
    assert len(checkpoints) == 4 + 1, "at 160, 320, 480, ... steps, and at the end"
    written = lines(tmp_path / "run")
    assert [(e.stage, e.steps) for e in reports] == [(w["stage"], w["steps"]) for w in written]
    for event, line in zip(reports, written, strict=True):
        rest = {k: v for k, v in line.items() if k not in ("stage", "update", "steps", "seconds")}
        assert event.metrics == rest
        assert {type(v) for v in event.metrics.values()} == {float}
        assert (event.budget, event.total_steps) == (640, event.steps)
        assert event.progress == event.steps / 640
        assert event.run_dir == tmp_path / "run"
    assert [e.steps for e in reports if "eval_return" in e.metrics] == [224, 416, 608]
    before = [events[i - 1] for i, e in enumerate(events) if e.kind == "checkpoint"]
    assert [e.metrics for e in checkpoints] == [e.metrics for e in before]


@pytest.fixture(scope="module")
def whole_apart(tmp_path_factory) -> tuple[Path, list[TrainEvent]]:
    """A run of three stages that nothing stopped, and its events."""
    events: list[TrainEvent] = []
    path = tmp_path_factory.mktemp("apart") / "run"
    apart().train(path, quiet=True, callback=events.append)
    return path, events


def test_steps_and_progress_count_all_stages(whole_apart):
    events = whole_apart[1]
    assert list(dict.fromkeys(e.stage for e in events)) == ["left", "balance", "selector"]
    total = [e.total_steps for e in events]
    assert total == sorted(total)
    assert total[-1] == 960
    assert [e.progress for e in events] == [e.total_steps / 960 for e in events]
    assert {e.steps for e in events if e.stage == "balance"} <= set(range(321))


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("algorithm", [ON, replace(OFF, update_ratio=0.25)], ids=["ppo", "dqn"])
def test_a_callback_changes_nothing_but_when_it_stops(algorithm, tmp_path):
    answers = itertools.cycle((None, 0, True, ""))  # not False

    def meddle(event: TrainEvent):
        torch.manual_seed(5)
        np.random.seed(5)  # noqa: NPY002  # as users do
        random.seed(5)
        torch.rand(7)
        event.metrics.clear()
        return next(answers)

    agent(600, algorithm).train(tmp_path / "without", quiet=True, **EVALUATED)
    agent(600, algorithm).train(tmp_path / "with", quiet=True, callback=meddle, **EVALUATED)
    assert_same(tmp_path / "with", tmp_path / "without")


def stops_at(steps: int, answer=False, kind: str = "report") -> Callable[[TrainEvent], Any]:
    return lambda event: answer if event.steps >= steps and event.kind == kind else None


@pytest.mark.parametrize(
    ("answer", "kind"),
    [(False, "report"), (np.bool_(False), "report"), (False, "checkpoint")],
    ids=["False", "numpy's", "at a checkpoint"],
)
def test_false_ends_a_plain_agent_with_what_it_has_learnt(answer, kind, tmp_path):
    path = tmp_path / "run"
    how = EVALUATED | {"callback": stops_at(300, answer, kind), "quiet": True}
    run = agent().train(path, **how)
    (entry,) = run.info()["stages"]
    assert entry["status"] == "done"
    assert 300 <= entry["stopped"]["steps"] == entry["steps"] < 400
    # A checkpoint comes before the report of the update that is still made.
    assert lines(path)[-1]["steps"] == (288 if kind == "checkpoint" else 320)
    assert len(run.evaluate(2).returns) == 2
    assert not list(path.glob("checkpoint*"))
    again = agent().resume(path, quiet=True, callback=never)
    assert again.info()["stages"] == run.info()["stages"]
    told = RunDirectory.open(path)
    assert any("a callback ended it after" in text for text in run_lines(told.manifest, [], "run"))
    assert "a callback ended it after" in stage_rows(told, {})[0]["notes"]


def test_false_ends_one_stage_and_the_next_one_starts(tmp_path):
    seen = []

    def stop(event: TrainEvent) -> bool:
        seen.append(event.stage)
        return not (event.stage == "left" and event.steps >= 100)

    run = apart().train(tmp_path / "run", quiet=True, callback=stop)
    steps = {entry["name"]: entry["steps"] for entry in run.info()["stages"]}
    assert steps["left"] < 200
    assert steps["balance"] == steps["selector"] == 320
    assert "stopped" not in run.info()["stages"][1]
    assert run.policy.labels == ("left", "balance", "push")


def test_false_while_all_learn_together_ends_the_run_judged(tmp_path):
    hierarchy = Hierarchy(
        SYNC, [Left(), Push()], algorithm=ON, selector=ON, call_steps=6, steps=640
    )
    run = hierarchy.train(tmp_path / "run", quiet=True, callback=stops_at(200))
    (entry,) = run.info()["stages"]
    assert entry["steps"] < 400
    assert "kept" in entry
    assert len(run.evaluate(2).returns) == 2


@pytest.mark.parametrize(("workers", "kind"), [(1, "report"), (2, "report"), (1, "checkpoint")])
def test_false_ends_a_population_after_its_generation(workers, kind, tmp_path):
    env = EnvSpec("CartPole-v1", engine="sync", workers=workers)
    how = {"evolve": Evolution(2, 4, 2), "callback": stops_at(700, kind=kind)}
    run = Agent(env, ON, 2_000).train(tmp_path / "run", quiet=True, **how)
    (entry,) = run.info()["stages"]
    assert entry["status"] == "done"
    assert 700 <= entry["stopped"]["steps"] == entry["steps"]
    assert entry["winner"]["generations"] < 4
    generations = {line.generation for line in RunDirectory.open(tmp_path / "run").lineage.read()}
    assert len(generations) == entry["winner"]["generations"], "no generation is left half done"
    assert len(run.evaluate(2).returns) == 2


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """An agent's run that nothing stopped; it is read only."""
    return agent().train(tmp_path_factory.mktemp("whole") / "run", quiet=True, **EVALUATED).path


@pytest.mark.parametrize("error", [TrialPruned(), SkillweaveError("mine")])
def test_an_exception_passes_through_and_leaves_a_run_to_resume(error, whole, tmp_path):
    def fail(event: TrainEvent):
        if event.steps > 400:
            raise error

    path = tmp_path / "run"
    with pytest.raises(type(error)) as caught:
        agent().train(path, quiet=True, callback=fail, **EVALUATED)
    assert caught.value is error
    (note,) = error.__notes__
    line = fail.__code__.co_firstlineno + 2
    assert f"{Path(__file__).name}, line {line}" in note
    assert "saved at 320 steps of agent" in note
    assert f'agent.train("{path}", resume=True, callback=callback)' in note
    error.__notes__.clear()
    agent().resume(path, quiet=True)
    assert_same(path, whole)


def test_an_exception_in_the_first_report_of_a_later_stage(whole_apart, tmp_path):
    def fail(event: TrainEvent):
        if event.stage == "selector":
            raise TrialPruned

    with pytest.raises(TrialPruned) as caught:
        apart().train(tmp_path / "run", quiet=True, callback=fail)
    assert "saved after balance" in caught.value.__notes__[0]
    events = []
    apart().resume(tmp_path / "run", quiet=True, callback=events.append)
    assert {e.stage for e in events} == {"selector"}
    assert events[0].total_steps == 640 + events[0].steps
    assert_same(tmp_path / "run", whole_apart[0])


def test_a_keyboard_interrupt_of_a_callback_is_one(tmp_path):
    def stop(event: TrainEvent):
        if event.steps > 400:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="saved at 320 steps"):
        agent().train(tmp_path / "run", quiet=True, callback=stop, **EVALUATED)
    assert isinstance(Interrupted(), KeyboardInterrupt)


class Wanders:
    """As Stable-Baselines3's callbacks: an object that cannot be called."""


async def asynchronous(event: TrainEvent): ...


def generator(event: TrainEvent):
    yield event


@pytest.mark.parametrize(
    ("callback", "says"),
    [
        (3, r"callback is 3; give a function of one event: def callback\(event\)"),
        (Wanders(), "callback is <.*Wanders object.*>; give a function of one event"),
        (Wanders, "callback is the class Wanders; give a function of one event, or an object"),
        (asynchronous, "callback is an async function, which would not run when called"),
        (generator, "callback is a generator, which would not run when called"),
        (lambda: None, r"callback takes \(\), but it is called with one event"),
        (lambda a, b: None, r"callback takes \(a, b\), but it is called with one event"),
    ],
)
def test_what_is_no_callback_is_refused_before_anything_is_written(callback, says, whole, tmp_path):
    with pytest.raises(DeclarationError, match=says):
        agent().train(tmp_path / "run", callback=callback)
    assert not (tmp_path / "run").exists()
    with pytest.raises(SkillweaveError, match=says):
        agent().resume(whole, callback=callback)


def test_functions_written_in_c_and_partial_ones_are_callbacks(tmp_path):
    events = {}
    agent(64).train(tmp_path / "a", quiet=True, callback=lambda e, seen=events: seen.update({1: e}))
    agent(64).train(tmp_path / "b", quiet=True, callback=print)
    assert events
