"""A run stays where it was when the program changes its working directory."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from skillweave import Agent, load
from skillweave.errors import RunError
from tests.small_runs import ON, policies

STEPS = 96


def agent(make: Any = "CartPole-v1", steps: int = STEPS) -> Agent:
    return Agent(make, ON, steps)


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


def used(places: Path, run: Any) -> None:
    """Use what was trained, from elsewhere."""
    os.chdir(places / "there")
    run.evaluate(1, save=True, quiet=True)
    run.save_weights("w.safetensors")
    assert run.info()["evaluation"]["episodes"] == 1
    assert str(run.path) in repr(run)
    assert run.path.is_dir()
    assert [p.name for p in (places / "there").iterdir()] == ["w.safetensors"]


def test_a_callback_changes_it(places):
    def move(event: Any) -> None:
        os.chdir(places / "there")

    run = agent().train("a/run", quiet=True, checkpoint_every=32, callback=move)
    assert run.path == places / "here" / "a" / "run"
    used(places, run)
    os.chdir(places / "here")
    agent().train("reference", quiet=True, checkpoint_every=32)
    assert policies(Path("a/run")) == policies(Path("reference"))


@pytest.mark.parametrize(
    ("where", "run_dir"), [("__init__", "run"), ("reset", None), ("step", "run")]
)
def test_an_environment_changes_it(places, where, run_dir):
    class Moves(gym.Wrapper):
        pass

    def moved(self: Any, *given: Any, **named: Any) -> Any:
        os.chdir(places / "there")
        return getattr(super(Moves, self), where)(*given, **named)

    setattr(Moves, where, moved)
    run = agent(lambda: Moves(gym.make("CartPole-v1"))).train(run_dir, quiet=True)
    assert run.path.is_relative_to(places / "here")
    used(places, run)


def test_loading_resuming_and_more_steps(places):
    agent().train("run", quiet=True)
    with pytest.raises(RunError, match=r"^run holds a finished run.*train\(\"run\""):
        agent().train("run", quiet=True)
    loaded = load("run")
    used(places, loaded)
    with pytest.raises(RunError, match=r"here/run holds a finished run.*\"/.*here/run\""):
        agent().train(places / "here" / "run", quiet=True)
    os.chdir(places / "here")

    def move(event: Any) -> None:
        os.chdir(places / "there")

    longer = agent(steps=3 * STEPS).train("run", resume=True, quiet=True, callback=move)
    assert longer.info()["stages"][0]["steps"] == 3 * STEPS
    assert [p.name for p in (places / "there").iterdir()] == ["w.safetensors"]


def test_a_working_directory_that_is_gone(places):
    os.mkdir("gone")
    os.chdir("gone")
    shutil.rmtree(places / "here" / "gone")
    for run_dir in ("run", None):
        with pytest.raises(RunError, match="is not there any more"):
            agent().train(run_dir, quiet=True)
    agent().train(places / "run", quiet=True).evaluate(1)
