"""What older versions wrote: their words are read, and nothing that was saved is lost.

``older/`` was written by the version that said "phase" for a stage and "flat" for a plain agent.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from skillweave import PPO, Agent, Hierarchy, Network, Skill, SkillweaveError
from skillweave.cli import main
from skillweave.reporting.lineage import read_lineage
from skillweave.reporting.plots import plot_run
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_tensors
from skillweave.runs.older import header_today, manifest_today

OLDER = Path(__file__).parent / "older"
SMALL = PPO(num_envs=2, n_steps=8, batch_size=8, update_epochs=1, network=Network((4,)))


@pytest.fixture
def older(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLDER, tmp_path / "older"))


class Left(Skill):
    max_steps = 15


class Right(Skill):
    max_steps = 10


def hierarchy() -> Hierarchy:
    return Hierarchy("CartPole-v1", [Left(), Right()], call_steps=6, algorithm=SMALL)


def test_the_files_have_the_old_words() -> None:
    for run in ("hierarchy", "flat", "unfinished"):
        text = (OLDER / run / "run.json").read_text()
        assert '"phases"' in text
        assert "stage" not in text
        assert '"phase"' in (OLDER / run / "metrics.jsonl").read_text()


def test_a_finished_hierarchy_scores_as_it_did(older: Path) -> None:
    assert hierarchy().load(older / "hierarchy").evaluate(3, seed=1).returns == (15, 13, 19)
    weights = hierarchy().load_weights(older / "hierarchy.safetensors")
    assert weights.evaluate(3, seed=1).returns == (15, 13, 19)


def test_a_finished_flat_agent_scores_as_it_did(older: Path) -> None:
    for run in (
        hierarchy().load(older / "flat"),
        Agent("CartPole-v1", SMALL, 1).load(older / "flat"),
        Agent.from_weights(older / "flat.safetensors"),
        hierarchy().load_weights(older / "flat.safetensors"),
    ):
        assert run.evaluate(3, seed=1).returns == (9, 9, 8)


def test_its_manifest_is_told_in_todays_words(older: Path) -> None:
    left, right, selector = RunDirectory.open(older / "hierarchy").manifest["stages"]
    assert (left["kind"], left["learns"], left["decides"]) == ("skill", ["left"], None)
    assert left["target"] == {"of": "return", "at_least": 1e6}
    assert "target" not in right
    assert (selector["kind"], selector["decides"]) == ("selector", "selector")
    flat = RunDirectory.open(older / "flat").manifest
    assert flat["kind"] == "agent"
    assert [(s["name"], s["kind"]) for s in flat["stages"]] == [("flat", "agent")]


def test_its_lines_are_read_for_plots_and_tables(older: Path, tmp_path: Path) -> None:
    run = RunDirectory.open(older / "hierarchy")
    assert {line["stage"] for line in run.metrics()} == {"left", "right", "selector"}
    lineage = read_lineage(run, "left")
    assert lineage is not None
    assert lineage.winner.member == run.stage("left")["winner"]["member"]
    names = {p.name for p in plot_run(run, tmp_path / "plots")}
    assert {"left.png", "right.png", "selector.png"} <= names


@pytest.mark.parametrize("run", ["hierarchy", "flat"])
def test_commands_work_on_it(older: Path, capsys: pytest.CaptureFixture[str], run: str) -> None:
    for command in (["info"], ["evaluate", "--episodes", "1"], ["weights", "-o", str(older / "w")]):
        assert main([command[0], str(older / run), *command[1:], "--json"]) == 0
        json.loads(capsys.readouterr().out)


def test_a_policy_in_anothers_place_is_still_refused(older: Path) -> None:
    policies = older / "hierarchy" / "policies"
    shutil.copy(policies / "left.safetensors", policies / "right.safetensors")
    with pytest.raises(SkillweaveError, match="holds the policy of stage 'left'"):
        hierarchy().load(older / "hierarchy")


def test_an_unfinished_run_goes_on_from_its_checkpoint(older: Path) -> None:
    at = read_tensors(older / "unfinished" / "checkpoint.safetensors")[1]
    assert (at["stage"], at["steps"] > 0) == ("flat", True)
    run = hierarchy().resume(older / "unfinished", quiet=True)
    (entry,) = run.info()["stages"]
    assert entry["status"] == "done"
    steps = [line["steps"] for line in RunDirectory.open(run.path).metrics()]
    assert steps == sorted(set(steps)), "no line twice"
    assert (older / "unfinished" / "policies" / "flat.safetensors").exists()


@pytest.mark.parametrize(
    "told", [{"phases": 5}, {"phases": [5, {"name": []}, {"evolution": 3}], "kind": []}, {}]
)
def test_what_is_damaged_is_left_to_the_schema(told: Any) -> None:
    assert manifest_today(told).keys() <= {"stages", "kind"}


def test_todays_words_are_left_alone() -> None:
    header = {"stage": "a", "phase": "b"}
    assert header_today(header) is header
    assert manifest_today({"stages": [], "phases": 3}) == {"stages": [], "phases": 3}
