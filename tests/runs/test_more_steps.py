"""``train(..., resume=True)``: begin, continue, and give a finished run more steps."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import (
    OFF,
    ON,
    Balance,
    Left,
    Push,
    Stopped,
    assert_same,
    interrupted,
    lines,
    plain_recipe,
    policies,
)

import skillweave as sw
from skillweave import Agent, EnvSpec, Hierarchy, Run, SkillweaveError
from skillweave._internal.prefixes import unprefixed
from skillweave.cli.main import main
from skillweave.errors import DeclarationError, RunError
from skillweave.evolution import Evolution
from skillweave.runs import files
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.runs.manifest import StageEntry
from skillweave.training import stage_log
from skillweave.training.periodic import PeriodicEvaluation
from skillweave.types import TrainEvent

CARTPOLE = EnvSpec("CartPole-v1", engine="sync", workers=1)


REPLAY = replace(OFF, update_ratio=0.25)


def declare(steps: int = 256, **settings: Any) -> Hierarchy:
    own = {"algorithm": ON, "selector": ON, "learn": "apart"} | settings
    return Hierarchy(CARTPOLE, [Left(), Balance()], steps=steps, **own)


def nested(steps: int, **settings: Any) -> Hierarchy:
    own = {"algorithm": ON, "selector": ON} | settings
    inner = Hierarchy(CARTPOLE, [Left(), Push()], name="inner", **own)
    return Hierarchy(CARTPOLE, [inner.as_skill("inner"), Balance()], steps=steps, **own)


def agent(steps: int, algorithm: Any = ON) -> Agent:
    return Agent(CARTPOLE, algorithm, steps)


def train(path: Path, steps: int, algorithm: Any = ON, **how: Any) -> Run:
    """Begin the run of an agent, or give it more steps."""
    return agent(steps, algorithm).train(path, **{"resume": True, "quiet": True} | how)


def final(path: Path) -> dict[str, torch.Tensor]:
    """The final state of an agent."""
    return unprefixed("state.agent", read_tensors(path / "final/agent.safetensors")[0])


KINDS: dict[str, Callable[[int], Any]] = {
    "an agent with PPO": agent,
    "an agent with DQN": lambda steps: agent(steps, REPLAY),
    "apart": declare,
    "together": lambda steps: declare(steps, learn="together"),
    "together with DQN": lambda steps: declare(steps, learn="together", algorithm=REPLAY),
    "first apart": lambda steps: declare(steps, learn="apart, then together"),
    "nested apart": lambda steps: nested(steps, learn="apart"),
}
QUICK = ("an agent with PPO", "an agent with DQN")


def by_kind(name: str) -> Any:
    return pytest.param(name, id=name, marks=[] if name in QUICK else [pytest.mark.slow])


def stages(run: Run | Path) -> dict[str, StageEntry]:
    path = run.path if isinstance(run, Run) else run
    return {s.name: s for s in RunDirectory.open(path).manifest.stages}


def assert_metrics_rise(path: Path) -> None:
    """Every stage's updates, steps and seconds rise from line to line, over all its trainings."""
    rows = lines(path)
    assert rows
    for name in {row["stage"] for row in rows}:
        own = [row for row in rows if row["stage"] == name]
        for field in ("update", "steps"):
            values = [row[field] for row in own]
            assert values == sorted(set(values)), f"{field} of {name} does not rise"
        assert [row["seconds"] for row in own] == sorted(row["seconds"] for row in own)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run"


# More steps


@pytest.mark.parametrize("kind", [by_kind(name) for name in KINDS])
def test_a_finished_run_learns_on_for_more_steps(kind: str, path: Path) -> None:
    declared = KINDS[kind]
    first = declared(512).train(path, seed=3, quiet=True)
    weights, before, told = policies(path), stages(path), lines(path)
    run = declared(1_024).train(path, seed=3, resume=True, quiet=True)
    assert run.path == first.path
    after = stages(run)
    grown = [name for name, entry in after.items() if entry.continued]
    assert grown
    if kind == "first apart":
        assert grown == ["together"], "what the others learn now it would not know of"
    for name, entry in after.items():
        assert entry.status == "done"
        file = f"{name.replace('/', '.')}.safetensors"
        if name in grown:
            assert entry.continued == [before[name].steps]
            assert entry.steps >= entry.budget > before[name].budget
            assert entry.seconds > before[name].seconds
        else:
            assert entry == before[name]
            assert policies(path)[file] == weights[file]
    assert any(policies(path)[name][1] != old[1] for name, old in weights.items())
    assert sum(e.budget for e in after.values()) == 1_024
    assert lines(path)[: len(told)] == told
    assert len(lines(path)) > len(told)
    assert_metrics_rise(path)
    assert not list(path.glob("checkpoint*"))
    assert run.evaluate(2, quiet=True) == declared(1_024).load(path).evaluate(2, quiet=True)
    done = policies(path)
    declared(1_024).train(path, seed=3, resume=True, quiet=True)
    assert policies(path) == done, "the same call again trains nothing"


def test_more_steps_continue_from_all_that_was_learnt_with_new_episodes(
    path: Path, tmp_path: Path
) -> None:
    train(path, 128).evaluate(1, save=True, quiet=True)
    assert "evaluation" in agent(128).load(path).info()
    before = final(path)
    assert "evaluation" not in train(path, 256).info(), "it is of the policy before"
    after = final(path)
    counts = [k for k in before if k in ("obs_count", "adam_step", "steps", "updates")]
    assert "obs_count" in counts
    for name in counts:
        assert float(after[name].max()) > float(before[name].max()), name
    assert before.keys() == after.keys()
    train(tmp_path / "whole", 256)
    mine, whole = (policies(p)["agent.safetensors"][1] for p in (path, tmp_path / "whole"))
    assert mine != whole, "its episodes are those of the beginning"


def test_a_run_that_a_callback_ended_learns_on(path: Path) -> None:
    calls: list[TrainEvent] = []

    def stop(event: TrainEvent) -> bool:
        calls.append(event)
        return event.steps < 200

    train(path, 512, callback=stop)
    assert [event.steps >= 200 for event in calls].count(True) == 1, "it is not called again"
    ended = stages(path)["agent"]
    assert 200 <= ended.steps < 512
    assert ended.stopped is not None
    assert ended.stopped.steps == ended.steps
    train(path, 512)
    assert stages(path)["agent"] == ended, "it is finished"
    train(path, 1_024)
    after = stages(path)["agent"]
    assert after.steps >= 1_024
    assert after.continued == [ended.steps]
    assert after.stopped is None
    assert_metrics_rise(path)


def test_an_error_of_a_callback_at_the_last_checkpoint_is_not_a_full_disk(path: Path) -> None:
    def fail(event: TrainEvent) -> None:
        if event.kind == "checkpoint" and event.steps >= 256:
            raise SkillweaveError("mine")

    with pytest.raises(SkillweaveError, match="mine"):
        train(path, 256, callback=fail)
    assert stages(path)["agent"].status == "training"
    assert stages(agent(256).resume(path, quiet=True))["agent"].status == "done"


@pytest.mark.parametrize("every", [60, 100_000])
def test_a_run_killed_right_after_its_callback_ended_it_comes_there_again(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    def train(run: Path) -> None:
        agent(512).train(
            run, resume=True, checkpoint_every=every, quiet=True, callback=lambda e: e.steps < 200
        )

    def killed(*_: Any) -> None:
        raise Stopped

    train(tmp_path / "whole")
    with monkeypatch.context() as patched:
        patched.setattr(RunDirectory, "save_policies", killed)
        with pytest.raises(Stopped):
            train(path)
    train(path)
    assert_same(path, tmp_path / "whole")
    assert stages(path)["agent"].steps == stages(tmp_path / "whole")["agent"].steps


def test_the_best_weights_of_before_are_kept_if_none_are_better(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worse_and_worse(self: Any, since: int, steps: int, *_: Any, **how: Any) -> Any:
        return {"eval_return": -float(steps)} if steps // 128 > since // 128 else {}

    monkeypatch.setattr(PeriodicEvaluation, "due", worse_and_worse)
    train(path, 512, keep="best", eval_every=128)
    best, kept = stages(path)["agent"].best, policies(path)
    assert best.steps < 256
    last = final(path)["params"]
    train(path, 1_024)
    assert stages(path)["agent"].best == best
    assert policies(path) == kept
    assert not torch.equal(final(path)["params"], last)


@pytest.mark.parametrize("kind", ["an agent with DQN", "apart"])
@pytest.mark.slow
def test_a_continued_run_that_is_stopped_ends_the_same(kind: str, tmp_path: Path) -> None:
    def train(path: Path, steps: int) -> None:
        KINDS[kind](steps).train(path, seed=3, resume=True, checkpoint_every=64, quiet=True)

    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    for path in (whole, stopped):
        train(path, 512)
    train(whole, 1_024)
    for number in (1, 3):
        with interrupted(number) as stop:
            train(stopped, 1_024)
        assert re.search(r"saved at .*resume=True\)", str(stop.value))
    train(stopped, 1_024)
    assert_same(stopped, whole)


def test_a_continuation_that_is_killed_at_once_continues(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(path, 256)
    with monkeypatch.context() as patched:
        patched.setattr(stage_log.StageLog, "tick", lambda *_: (_ for _ in ()).throw(Stopped))
        with pytest.raises(Stopped):
            train(path, 512)
    with pytest.raises(RunError, match=r"unfinished run, saved at 256 steps of agent"):
        agent(512).train(path, quiet=True)
    run = agent(512).resume(path, quiet=True)
    assert stages(run)["agent"].steps == 512
    assert_metrics_rise(path)


@pytest.mark.slow
def test_a_run_killed_right_before_it_is_done_ends_the_same(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tmp_path / "whole", 256, REPLAY)
    keep = RunDirectory.keep_final

    def killed(self: RunDirectory, stage: str) -> None:
        keep(self, stage)
        raise Stopped

    with monkeypatch.context() as patched:
        patched.setattr(RunDirectory, "keep_final", killed)
        with pytest.raises(Stopped):
            train(path, 256, REPLAY)
    train(path, 256, REPLAY)
    assert_same(path, tmp_path / "whole")
    train(path, 512, REPLAY)
    train(tmp_path / "whole", 512, REPLAY)
    assert_same(path, tmp_path / "whole")


def test_a_skill_that_learns_on_alone_makes_its_selector_old_and_it_is_said(
    path: Path, capfd
) -> None:
    def with_skill(steps: int) -> Hierarchy:
        found = declare(512)
        found.skill("left").steps = steps
        return found

    with_skill(128).train(path, quiet=True)
    capfd.readouterr()
    run = with_skill(256).train(path, resume=True)
    assert [n for n, e in stages(run).items() if e.continued] == ["left"]
    told = capfd.readouterr().err
    assert "left continues: 128 -> 256 steps" in told
    assert "selector stays as it is, so it still chooses for left as they were" in told


def test_a_stage_that_reached_its_target_stays(path: Path, capfd) -> None:
    def with_target(steps: int) -> Agent:
        return Agent(CARTPOLE, ON, steps, target_return=1.0)

    with_target(512).train(path, eval_every=64, eval_episodes=1, quiet=True)
    done = policies(path)
    with_target(1_024).train(path, eval_every=64, eval_episodes=1, resume=True)
    assert "agent has reached its target, so it gets no more steps" in capfd.readouterr().err
    assert policies(path) == done
    assert not (path / "final").exists()


# The replay buffer, and full disks


@pytest.mark.parametrize("kept", [True, False])
def test_a_small_replay_buffer_is_kept(
    path: Path, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    monkeypatch.setattr(stage_log, "LARGEST_SPARE", 2**20 if kept else 100)
    train(path, 256, REPLAY)
    names = RunDirectory.open(path).final_tensors("agent")
    assert any(".store." in name for name in names) == kept
    if not kept:
        with pytest.raises(RunError, match="would learn nothing in 20 more steps"):
            train(path, 276, REPLAY)
    before = policies(path)
    run = train(path, 384, REPLAY)
    assert stages(run)["agent"].steps == 384
    assert policies(path) != before


@contextmanager
def full_disk(fails: Callable[[Path, bytes], bool]) -> Iterator[None]:
    """A block in which some files cannot be written."""
    write = files.write_bytes

    def full(target: Path, data: bytes, **how: Any) -> None:
        if fails(target, data):
            raise RunError(f"could not write {target}: No space left on device")
        write(target, data, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "write_bytes", full)
        yield


@pytest.mark.parametrize("allowed", [0, 8_000])
def test_a_full_disk_keeps_the_policy_and_says_what_is_not_kept(
    path: Path, capfd, allowed: int
) -> None:
    with full_disk(lambda target, data: "checkpoint" in target.name and len(data) > allowed):
        run = agent(256, REPLAY).train(path)
    assert run.evaluate(1, quiet=True).mean > 0
    told = capfd.readouterr().err
    names = RunDirectory.open(path).final_tensors("agent")
    assert not any(".store." in name for name in names)
    assert ("its final state is not kept" in told) == (not names)
    if not names:
        with pytest.raises(RunError, match=r"final state.*start_from="):
            train(path, 512, REPLAY)


def test_a_policy_takes_the_place_of_final_states_on_a_full_disk(path: Path, capfd) -> None:
    left = path / "final/left.safetensors"
    with full_disk(lambda target, _: target.name == "selector.safetensors" and left.exists()):
        declare().train(path)
    assert "the disk is full, so final states" in capfd.readouterr().err
    assert sorted(p.name for p in (path / "final").iterdir()) == ["selector.safetensors"]
    assert RunDirectory.open(path).finished


# What cannot be given more steps


def test_a_final_state_that_is_damaged_or_not_there_changes_nothing(
    path: Path, tmp_path: Path
) -> None:
    train(path, 128)
    file, before = path / "final/agent.safetensors", (path / "run.json").read_bytes()
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(RunError, match=r"final/agent\.safetensors is damaged"):
        train(path, 256)
    shutil.rmtree(path / "final")
    with pytest.raises(RunError, match="final state") as caught:
        train(path, 256)
    assert str(caught.value).endswith(f'agent.train(start_from="{path}")')
    assert (path / "run.json").read_bytes() == before
    assert agent(128).load(path).evaluate(1, quiet=True)
    agent(128).train(tmp_path / "new", start_from=path, quiet=True)


@pytest.mark.slow
def test_a_population_is_refused(path: Path) -> None:
    how = Evolution(population=2, generations=1, episodes=1)
    declared = agent(128)
    declared.train(path, evolve=how, quiet=True)
    assert not (path / "final").exists()
    for evolve in (how, None):
        agent(128).train(path, evolve=evolve, resume=True, quiet=True)
        with pytest.raises(SkillweaveError, match=r"is a population.*start_from="):
            agent(256).train(path, evolve=evolve, resume=True, quiet=True)


def test_a_stage_that_is_done_waits_for_the_end_of_its_run(path: Path, capfd) -> None:
    with interrupted(2):
        declare(256).train(path, checkpoint_every=100, quiet=True)
    assert [e.status for e in stages(path).values()].count("done") == 1
    run = declare(512).train(path, resume=True)
    assert "left can be given more steps once the run is finished" in capfd.readouterr().err
    budgets = {name: e.budget for name, e in stages(run).items()}
    assert budgets == {"left": 64, "balance": 128, "selector": 256}
    run = declare(512).train(path, resume=True, quiet=True)
    assert {name: e.budget for name, e in stages(run).items()} == declare(512).budgets()


# Begin, or continue


def test_resume_begins_where_there_is_nothing_and_continues_what_was_stopped(
    path: Path, tmp_path: Path
) -> None:
    declare().train(tmp_path / "whole", checkpoint_every=64, quiet=True)
    for number in (1, 2):
        with interrupted(number):
            declare().train(path, resume=True, checkpoint_every=64, quiet=True)
    declare().train(path, resume=True, quiet=True)
    assert_same(path, tmp_path / "whole")


def other_skill() -> Hierarchy:
    return Hierarchy(CARTPOLE, [Left(), Push()], algorithm=ON, selector=ON, steps=256)


def other_env() -> Hierarchy:
    spec = replace(CARTPOLE, kwargs={"sutton_barto_reward": True})
    return Hierarchy(spec, [Left(), Balance()], algorithm=ON, selector=ON, steps=256)


def other_recipe() -> Hierarchy:
    found = declare()
    found.recipe = "other.py"
    return found


@pytest.fixture(scope="module")
def mine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a recipe."""
    declared = declare()
    declared.recipe = "mine.py"
    return declared.train(tmp_path_factory.mktemp("mine") / "run", quiet=True).path


@pytest.mark.parametrize(
    ("declared", "how", "says"),
    [
        (other_skill, {}, "was trained with the skills left, balance, but this hierarchy has"),
        (other_env, {}, "was trained on CartPole-v1"),
        (other_recipe, {}, "is a run of the recipe mine.py, not of other.py"),
        (declare, {"seed": 4}, "was trained with seed 0, not 4"),
        (declare, {"flat": True}, r"is the run of a hierarchy, .* as a flat agent \(flat=True\)"),
        (lambda: agent(256), {}, "is the run of a hierarchy, not of a plain agent"),
        (declare, {"resume": "yes"}, "resume is 'yes'; it must be True or False"),
    ],
)
def test_a_run_of_another_declaration_is_a_sentence(
    mine: Path, path: Path, declared: Callable[[], Any], how: dict[str, Any], says: str
) -> None:
    shutil.copytree(mine, path)
    before = (path / "run.json").read_bytes()
    with pytest.raises(SkillweaveError, match=says):
        declared().train(path, **{"resume": True, "quiet": True} | how)
    assert (path / "run.json").read_bytes() == before


def test_settings_that_differ_are_told(path: Path, capfd) -> None:
    declare().train(path, quiet=True)
    other = declare(algorithm=replace(ON, gamma=0.9))
    other.recipe = "mine.py"  # told all the same, as this call says all settings
    other.train(path, resume=True, eval_every=64, track=["tensorboard"])
    told = capfd.readouterr().err
    assert "left.algorithm.gamma is 0.995 (declared now: 0.9)" in told
    assert "the run continues with its own trackers: none" in told
    assert "is finished, so nothing is trained" in told
    fewer = declare(128)
    fewer.train(path, resume=True)
    assert "selector keeps its 128 steps (declared now: 64)" in capfd.readouterr().err


# Loading


def test_a_run_that_acts_by_data_is_loaded_without_its_declaration(path: Path) -> None:
    run = train(path, 128)
    found = sw.load(path)
    assert isinstance(found.declaration, Agent)
    assert found.evaluate(2, quiet=True) == run.evaluate(2, quiet=True)
    data = Hierarchy("CartPole-v1", [Left()], algorithm=ON, selector=ON, steps=128)
    run = data.train(path.with_name("data"), quiet=True)
    found = sw.load(run.path)
    assert [skill.name for skill in found.hierarchy.skills] == ["left"]
    assert found.evaluate(2, quiet=True).returns == run.evaluate(2, quiet=True).returns
    with pytest.raises(DeclarationError, match="it must be the Hierarchy or Agent"):
        sw.load(run.path, run)  # type: ignore[arg-type]
    with pytest.raises(RunError, match="was trained with the skills"):
        sw.load(run.path, declare())
    code = Hierarchy("CartPole-v1", [Left(), Push()], algorithm=ON, selector=ON, steps=128)
    other = code.train(path.with_name("other"), quiet=True).path
    with pytest.raises(RunError, match="was declared in Python") as caught:
        sw.load(other)
    assert str(caught.value).endswith(f'sw.load("{other}", hierarchy)')
    assert sw.load(other, code).hierarchy.skills


def test_code_that_a_run_names_is_not_executed(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("open('sprung', 'w')")
    with pytest.raises(RunError, match=r"declared in mine\.py, and needs that code"):
        sw.load(mine)
    assert not Path("sprung").exists()


# The command line


def test_the_command_line_begins_continues_and_gives_more_steps(
    tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plain.py").write_text(plain_recipe(128))
    train = ["train", "plain.py", "--out", "run", "--resume", "--evaluate", "0"]
    assert main(train) == 0
    before = policies(Path("run"))
    assert main([*train, "--json"]) == 0
    told = capsys.readouterr()
    assert policies(Path("run")) == before
    assert "run is finished, so nothing is trained; to train it for longer, give it " in told.err
    assert main([*train, "--set", "steps=256", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)["stages"]
    assert (entry["budget"], entry["continued"]) == (256, [128])
    assert main(["info", "run"]) == 0
    assert "continued after 128 steps" in capsys.readouterr().out
    assert main([*train, "--seed", "4"]) == 1
    assert "was trained with seed 0, not 4" in capsys.readouterr().err
    assert main([*train, "--flat"]) == 1
    assert "as a flat agent (--flat)" in capsys.readouterr().err
    assert main(["train", "plain.py", "--resume"]) == 1
    assert "--out DIR" in capsys.readouterr().err
    shutil.rmtree("run/final")
    assert main([*train, "--set", "steps=512"]) == 1
    assert "skillweave train plain.py --start-from run" in capsys.readouterr().err
