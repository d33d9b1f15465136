"""Learning curves of several seeds as a figure, and commands that take a directory of runs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from reporting.cart import RECIPE

import skillweave as sw
from skillweave.cli import main
from skillweave.errors import DeclarationError, RunError
from skillweave.reporting.curves_figure import plot_curves
from skillweave.runs.directory import RunDirectory
from skillweave.runs.several import open_runs
from skillweave.training.evaluation_file import save_evaluation
from skillweave.types import Evaluation

pytest.importorskip("matplotlib")

STEPS = (128, 256, 384, 512)


def write_run(base: Path, to: Path, seed: int, returns: Sequence[float], agent: str) -> None:
    """Copy a run as if it had another seed and other metrics."""
    shutil.copytree(base, to)
    run = RunDirectory.open(to)
    run.manifest.seed = seed
    lines = []
    for stage in run.manifest.stages:
        own = returns if stage.name == agent else [0.0] * 4
        for update, (steps, value) in enumerate(zip(STEPS, own, strict=True), 1):
            # Skills have half as many steps.
            far = steps // (1 if stage.name == agent else 2)
            told = {"stage": stage.name, "update": update, "steps": far, "seconds": 1.0}
            lines.append({**told, "return": value, "entropy": 0.5})
    run.save()
    (to / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A directory with four seeds of a hierarchy, and one with three of a flat agent."""
    found = tmp_path_factory.mktemp("curves")
    (found / "cart.py").write_text(RECIPE)
    train = ["train", str(found / "cart.py"), "--quiet", "--evaluate", "2", "-o"]
    assert main([*train, str(found / "base")]) == 0
    assert main([*train, str(found / "flat-base"), "--flat"]) == 0
    for seed, factor in enumerate((1.0, 2.0, 3.0, 10.0)):
        returns = [factor * k for k in (1, 2, 3, 4)]
        write_run(found / "base", found / "sweep" / f"s{seed}", seed, returns, "selector")
        if seed < 3:
            write_run(found / "flat-base", found / "flat" / f"s{seed}", seed, returns, "agent")
    (found / "sweep" / "plots").mkdir()  # what is no run is passed over
    return found


def test_a_directory_of_runs_stands_for_its_runs_in_their_order(folder, tmp_path):
    runs = open_runs([folder / "sweep", folder / "flat" / "s1"])
    assert [run.path.name for run in runs] == ["s0", "s1", "s2", "s3", "s1"]
    for name in ("s10", "s9"):
        shutil.copytree(folder / "base", tmp_path / name)
    assert [run.path.name for run in open_runs([tmp_path])] == ["s9", "s10"]
    with pytest.raises(RunError, match="holds no run"):
        open_runs([folder / "sweep" / "plots"])
    with pytest.raises(DeclarationError, match="no runs were given"):
        open_runs([])


def test_the_median_and_the_quartiles_of_the_seeds_are_drawn(folder, tmp_path):
    found = sw.reporting.plot_curves(folder / "sweep", tmp_path / "figure")
    (line,) = found.lines
    assert (found.metric, line.seeds, line.label) == ("return", 4, "cart")
    # The selector's steps come after those of the two skills, 256 each.
    assert (line.steps[0], line.steps[-1]) == (512 + 128, 512 + 512)
    # Of 4, 8, 12 and 40 at the end, by hand.
    assert line.middle[-1] == 10
    assert (line.low[-1], line.high[-1]) == (7, 19)
    assert found.caption == "Lines: median of 4 seeds; bands: interquartile range."
    assert found.paths == (tmp_path / "figure.png", tmp_path / "figure.svg")
    assert found.paths[0].read_bytes()[:4] == b"\x89PNG"
    assert "<svg" in found.paths[1].read_text()
    assert 'width="237.6pt"' in found.paths[1].read_text()  # of a column: 3.3 inches of 72 points
    # Seen again, it is the same file.
    again = sw.reporting.plot_curves(folder / "sweep", tmp_path / "again.svg")
    assert again.paths[1].read_bytes() == found.paths[1].read_bytes()


@pytest.mark.slow
def test_other_bands_agents_metrics_and_names(folder, tmp_path):
    runs = {"ours": folder / "sweep", "flat": [folder / "flat"]}
    found = plot_curves(runs, tmp_path / "a", band="range")
    assert [(line.label, line.seeds) for line in found.lines] == [("ours", 4), ("flat", 3)]
    assert found.lines[0].high[-1] == 40
    assert found.lines[1].steps[0] == 128  # no skills learnt before
    assert found.caption == "Lines: median of 3 to 4 seeds; bands: lowest to highest."
    alone = plot_curves(folder / "sweep/s0", tmp_path / "b", agent="left", metric="entropy")
    assert (alone.lines[0].low, alone.caption) == (None, "Lines: one seed each.")
    assert np.allclose(alone.lines[0].middle, 0.5)
    assert alone.lines[0].steps[0] == 64
    named = plot_curves([folder / "sweep", folder / "flat"], tmp_path / "c", labels=["x", "y"])
    assert [line.label for line in named.lines] == ["x", "y"]


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ({"metric": "retrun"}, "has no metric 'retrun' of the whole policy: is 'return' meant"),
        ({"agent": "lefft"}, "has no metrics of 'lefft'; there are metrics of: left, balance"),
        ({"band": "std"}, "band is 'std'; it must be one of iqr, range, none"),
        ({"labels": ["a", "b"]}, "2 labels for 1 lines"),
        ({"width": 0}, "width is 0; it must be from 1 to 40 inches"),
    ],
)
def test_what_cannot_be_drawn_is_told(folder, tmp_path, how, says):
    with pytest.raises(DeclarationError) as error:
        plot_curves(folder / "sweep", tmp_path / "x", **how)  # type: ignore[arg-type]
    assert says in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_plot_and_compare_take_a_sweep(folder, tmp_path, capsys):
    out = tmp_path / "curves"
    words = ["plot", str(folder / "sweep"), str(folder / "flat"), "-o", str(out), "--json"]
    assert main([*words, "--label", "ours", "--label", "flat", "--band", "range"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["lines"] == {"ours": 4, "flat": 3}
    assert told["paths"] == [f"{out}.png", f"{out}.svg"]
    # One run has its own figures, one for each stage.
    assert main(["plot", str(folder / "base"), "-o", str(tmp_path / "one"), "--json"]) == 0
    names = [Path(p).name for p in json.loads(capsys.readouterr().out)["paths"]]
    assert names == [f"{n}{s}" for n in ("left", "balance", "selector") for s in (".png", ".svg")]
    pytest.importorskip("vl_convert")
    assert main(["compare", str(folder / "sweep"), "-o", str(tmp_path / "c.html")]) == 0
    assert "Comparison of 4 runs" in (tmp_path / "c.html").read_text()


def test_tasks_of_0_and_1_are_drawn_in_percent(folder, tmp_path):
    runs = shutil.copytree(folder / "sweep", tmp_path / "runs")
    before = plot_curves(runs, tmp_path / "a").paths[1].read_text()
    assert "episodes solved" not in before
    for path in runs.glob("s*"):
        score = Evaluation((0.0, 1.0), (5, 5), None)
        save_evaluation(RunDirectory.open(path), score, 0, deterministic=True)
    # Matplotlib writes each text as a comment beside its outlines.
    after = plot_curves(runs, tmp_path / "b").paths[1].read_text()
    assert "<!-- episodes solved -->" in after
    assert "<!-- 100% -->" in after
