"""A run of which files were deleted: it goes on with a sentence, or an error names the file."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from skillweave import Agent, Apart, Hierarchy, SkillweaveError, Together, TrainDefaults
from skillweave.cli import main
from skillweave.evolution import Evolution
from tests.small_runs import ON, Left, Push, Stopped, policies, stop_at


def tree(factor: int = 1) -> Hierarchy:
    return Hierarchy(
        "CartPole-v1",
        [Left(), Push()],
        call_steps=4,
        algorithm=ON,
        selector=ON,
        learn="apart, then together",
        apart=Apart(skill_steps=96 * factor, selector_steps=96 * factor),
        together=Together(steps=192 * factor),
        train_defaults=TrainDefaults(checkpoint_every=64),
    )


def agent(steps: int) -> Agent:
    return Agent("CartPole-v1", ON, steps)


def stopped(folder: Path, stage: str, steps: int) -> Path:
    with pytest.raises(Stopped):
        tree().train(folder, quiet=True, callback=stop_at(steps, stage))
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs that were stopped while all learnt together, and before; and a finished one."""
    folder = tmp_path_factory.mktemp("runs")
    stopped(folder / "stopped", "together", 128)
    stopped(folder / "early", "together", 1)
    tree().train(folder / "finished", quiet=True).evaluate(1, save=True, quiet=True)
    return folder


def removed(runs: Path, tmp_path: Path, kind: str, name: str) -> Path:
    run = shutil.copytree(runs / kind, tmp_path / "run")
    path = run / name
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    return run


@pytest.mark.slow
@pytest.mark.parametrize("name", [".lock", "final", "checkpoint.previous.safetensors"])
def test_files_that_going_on_does_not_need(name, runs, tmp_path):
    run = removed(runs, tmp_path, "stopped", name)
    tree().resume(run, quiet=True)
    assert policies(run) == policies(runs / "finished")


def test_lines_of_metrics(tmp_path, capsys):
    with pytest.raises(Stopped):
        agent(160).train(tmp_path / "run", quiet=True, checkpoint_every=32, callback=stop_at(96))
    run, file = tmp_path / "run", tmp_path / "run" / "metrics.jsonl"
    file.unlink()
    agent(160).resume(run)
    said = capsys.readouterr().err
    assert f"{file} was removed or shortened: curves lack its lines" in said
    agent(160).train(tmp_path / "reference", quiet=True, checkpoint_every=32)
    assert policies(run) == policies(tmp_path / "reference")
    file.unlink()
    for words in (["info", str(run)], ["evaluate", str(run), "--episodes", "1"]):
        assert main(words) == 0
    assert main(["plot", str(run)]) == 1
    assert f"there is no {file}" in capsys.readouterr().err


@pytest.mark.parametrize("lost", ["all", "half"])
def test_lines_of_metrics_of_a_finished_run_that_gets_more_steps(lost, tmp_path, capsys):
    run = agent(64).train(tmp_path / "run", quiet=True).path
    whole = shutil.copytree(run, tmp_path / "whole")
    file = run / "metrics.jsonl"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    if lost == "all":
        file.unlink()
    sentence = f"{file} was removed or shortened: curves lack its lines"
    agent(128).train(run, resume=True)
    assert capsys.readouterr().err.count(sentence) == 1
    agent(128).train(whole, resume=True)
    agent(192).train(run, resume=True)  # what is lost already is not said again
    assert "removed or shortened" not in capsys.readouterr().err
    agent(192).train(whole, resume=True, quiet=True)
    assert policies(run) == policies(whole)


@pytest.mark.slow
def test_lines_of_metrics_of_several_stages(runs, tmp_path, capsys):
    run = shutil.copytree(runs / "finished", tmp_path / "run")
    (run / "metrics.jsonl").unlink()
    tree(2).train(run, resume=True)
    assert capsys.readouterr().err.count("metrics.jsonl was removed or shortened") == 1


@pytest.mark.slow
def test_a_state_to_go_on_with(runs, tmp_path, capsys):
    run = shutil.copytree(runs / "early", tmp_path / "run")
    for path in run.glob("checkpoint*"):
        path.unlink()
    (run / "states" / "left.safetensors").unlink()
    tree().resume(run)
    said = capsys.readouterr().err
    assert "left.safetensors is not there any more, so 'left' continues with its weights" in said
    assert "selector.safetensors is not there" not in said


@pytest.mark.slow
@pytest.mark.parametrize("name", ["policies/left.safetensors", "policies", "run.json"])
def test_files_without_which_there_is_no_run(name, runs, tmp_path):
    for kind in ("stopped", "finished"):
        run = removed(runs, tmp_path / kind, kind, name)
        for use in (
            lambda run=run: tree().resume(run, quiet=True),
            lambda run=run: tree().load(run),
            lambda run=run: tree().train(tmp_path / "new", start_from=run, quiet=True),
        ):
            with pytest.raises(SkillweaveError) as caught:
                use()
            file = "run.json" if name == "run.json" else "left.safetensors"
            assert file in str(caught.value)


@pytest.mark.slow
def test_the_lineage_of_a_population(tmp_path, capsys):
    run = agent(600).train(tmp_path / "run", quiet=True, evolve=Evolution(population=3)).path
    (run / "lineage.jsonl").unlink()
    for words in (["info", str(run)], ["plot", str(run)], ["evaluate", str(run)]):
        main(words)
        assert "Traceback" not in capsys.readouterr().err
