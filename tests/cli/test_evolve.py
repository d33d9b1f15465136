"""Populations on the command line, and the figures of their runs."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import pytest
from small_runs import small_manifest, stage_entry

from skillweave import Hierarchy, Skill
from skillweave.cli.main import main
from skillweave.cli.overrides import parse_evolve
from skillweave.errors import DeclarationError, MissingExtra, RunError
from skillweave.evolution import Evolution, Range, Tournament, Truncation
from skillweave.reporting.lineage import read_lineage
from skillweave.reporting.plots import plot_run
from skillweave.runs.directory import RunDirectory

RECIPE = """
from skillweave import Apart, Hierarchy, PPO, Network, Skill

class Left(Skill):
    "Anything."

class Right(Skill):
    "Anything else."

small = PPO(num_envs=2, n_steps=16, batch_size=16, update_epochs=1, network=Network((8,), "relu"))
hierarchy = Hierarchy("CartPole-v1", [Left(), Right()], algorithm=small, selector=small,
                      learn="apart", apart=Apart(skill_steps=128, selector_steps=128))
"""
TINY = (
    "population=3", "generations=2", "episodes=2", "right.population=2",
    "ranges.learning_rate=1e-4,1e-2", "mutations.units=4,16",
)  # fmt: skip


class Left(Skill):
    """Anything."""


def declared() -> Hierarchy:
    return Hierarchy("CartPole-v1", [Left()], learn="apart")


def test_settings_become_a_plan_for_each_stage():
    plan = parse_evolve(
        ["population=5", "left.generations=7", "selection=truncation", "left.selection.share=0.4",
         "ranges.gamma=0.9,0.999,complement", "mutations.units=8,32", "target=200"],
        declared(), False,
    )  # fmt: skip
    assert plan is not None
    left, selector = plan["left"], plan["selector"]
    assert isinstance(left, Evolution)
    assert isinstance(selector, Evolution)
    assert (left.population, left.generations, left.target) == (5, 7, 200.0)
    assert (left.selection, selector.selection) == (Truncation(0.4), Truncation())
    assert selector.generations == Evolution().generations
    assert left.mutations.units == (8, 32)
    assert left.mutations.ranges == {"gamma": Range(0.9, 0.999, "complement")}
    assert parse_evolve([], declared(), False) is None
    only = parse_evolve(["selector.selection.size=3"], declared(), False)
    assert only is not None
    assert only["left"] is None
    assert only["selector"].selection == Tournament(3)  # type: ignore[union-attr]
    assert list(parse_evolve(["population=3"], declared(), True) or ()) == ["agent"]


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("population", "write name=value"),
        ("populatio=3", "no setting 'populatio': is 'population' meant?"),
        ("left.generations=x", "left.generations=x: expected a whole number"),
        ("selection=best", "expected one of tournament, truncation"),
        ("ranges.gamma=0.9", "write low,high"),
        ("ranges.gamma=0.9,0.99,cubic", "Range.scale"),
        ("population=1", "Evolution.population is 1"),
    ],
)
def test_what_cannot_be_is_refused_by_name(setting, said):
    with pytest.raises(DeclarationError, match=said):
        parse_evolve([setting], declared(), False)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evolved")
    (folder / "walk.py").write_text(RECIPE)
    flags = [part for setting in TINY for part in ("--evolve", setting)]
    out = str(folder / "run")
    assert main(["train", str(folder / "walk.py"), "-o", out, "--evaluate", "1", *flags]) == 0
    return folder / "run"


def test_a_recipe_evolves_and_the_winners_family_tree_reaches_back_to_the_start(run: Path):
    stages = {p.name: p for p in RunDirectory.open(run).manifest.stages}
    assert {n: p.budget for n, p in stages.items()} == {
        "left": 3 * 128, "right": 2 * 128, "selector": 3 * 128,
    }  # fmt: skip
    for name, stage in stages.items():
        lineage = read_lineage(RunDirectory.open(run), name)
        assert lineage is not None
        assert lineage.winner.member == stage.winner.member
        assert lineage.winner.generation == stage.winner.generation
        for born in lineage.born.values():
            path = lineage.path(born)
            assert [b.generation for b in path] == list(range(born.generation + 1))
            assert path[0].mutation == "start"
            for before, after in itertools.pairwise(path):
                changed = {k for k in after.settings if after.settings[k] != before.settings[k]}
                assert changed == {k.removeprefix("network.") for k in after.changes}


@pytest.mark.slow
def test_plots_of_populations_are_pictures_and_drawings(run: Path, tmp_path, capsys):
    assert main(["plot", str(run), "-o", str(tmp_path), "--json"]) == 0
    paths = [Path(p) for p in json.loads(capsys.readouterr().out)["paths"]]
    assert {p.name for p in paths} == {
        f"{n}{s}" for n in ("left", "right", "selector") for s in (".png", ".svg")
    }
    for path in paths:
        if path.suffix == ".png":
            assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        else:
            text = path.read_text()
            assert "<svg" in text
            assert text.count("<path") > 20


def test_of_a_run_without_populations_curves_are_drawn_of_whoever_learnt(tmp_path):
    stage = stage_entry("inner/hop")
    directory = RunDirectory.create(tmp_path / "run", small_manifest(stage))
    for steps in (100, 200):
        directory.log({"stage": "inner/hop", "steps": steps, "return": 1.0})
    directory.close()
    assert [p.name for p in plot_run(directory)] == ["inner.hop.png", "inner.hop.svg"]


def test_nothing_to_draw_and_a_damaged_lineage_are_said(run: Path, tmp_path):
    empty = RunDirectory.create(tmp_path / "empty", RunDirectory.open(run).manifest)
    with pytest.raises(RunError, match="nothing to draw"):
        plot_run(empty)
    (empty.path / "lineage.jsonl").write_text('{"stage": "left"}\n')
    with pytest.raises(RunError, match=r"lineage.jsonl, line 1 is damaged"):
        plot_run(empty)


def test_without_matplotlib_it_names_the_extra(run: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match=r"skillweave\[plot\]"):
        plot_run(RunDirectory.open(run))
