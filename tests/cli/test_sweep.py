"""A sweep trains each run once, whoever is stopped, and tells what came out."""

import json
import re
import sys

import pytest
from small_runs import interrupt_at_checkpoint
from sweep_recipes import DYING_RECIPE, RECIPE

from skillweave.cli import main, sweep
from skillweave.cli.main import _with_addresses
from skillweave.cli.sweep import code_files, summary
from skillweave.errors import DeclarationError
from skillweave.recipes import load, source
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import load_evaluation


@pytest.fixture
def recipe(tmp_path):
    file = tmp_path / "still.py"
    file.write_text(RECIPE)
    return file


@pytest.fixture
def swept(tmp_path, recipe, capsys):
    """The command: it returns its exit code, and what it answers."""

    def command(*more, file=recipe, out="runs"):
        words = ["sweep", str(file), "--out", str(tmp_path / out), "--evaluate", "3"]
        code = main([*words, "--json", "--quiet", *more])
        return code, json.loads(capsys.readouterr().out)

    return command


@pytest.fixture
def trained(monkeypatch):
    """Runs are trained in this process, one after another; which ones."""
    names = []

    def here(tasks, command):
        for code, job in tasks:
            names.append(job.path.name)
            yield job, job.run(code)

    monkeypatch.setattr(sweep, "_in_processes", here)
    return names


def test_each_combination_is_trained_with_each_seed_and_none_twice(swept, trained):
    each = "--set-each", "selector.gamma=0.9,0.99"
    code, first = swept(*each, "--seeds", "0:2")
    assert code == 0
    names = [f"selector.gamma={g}-s{s}" for g in (0.9, 0.99) for s in (0, 1)]
    assert trained == names
    gammas = [
        RunDirectory.open(run["run"]).stage("selector").algorithm["gamma"] for run in first["runs"]
    ]
    assert gammas == [0.9, 0.9, 0.99, 0.99]
    assert [g["settings"] for g in first["groups"]] == ["selector.gamma=0.9", "selector.gamma=0.99"]
    trained.clear()
    assert swept(*each, "--seeds", "0,1,4")[0] == 0
    assert trained == ["selector.gamma=0.9-s4", "selector.gamma=0.99-s4"]
    trained.clear()
    assert swept(*each, "--seeds", "0:2") == (0, first)
    assert trained == []


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_to_the_same_end(swept, trained, monkeypatch):
    _, whole = swept("--seeds", "3:4", out="whole")
    interrupt_at_checkpoint(monkeypatch, 2)
    code, stopped = swept("--seeds", "3:4")
    assert code == 130
    assert "0 of 1 runs are finished; the same command continues" in stopped["error"]
    trained.clear()
    _, found = swept("--seeds", "3:4")
    assert trained == ["s3"]
    assert found["runs"][0]["return"] == whole["runs"][0]["return"]
    ends = [RunDirectory.open(r["runs"][0]["run"]).stage("selector") for r in (whole, found)]
    assert ends[0].sha256 == ends[1].sha256


def test_runs_of_other_settings_are_not_taken_for_these(swept, trained):
    swept("--seeds", "0:1")
    code, found = swept("--seeds", "0:1", "--scale", "2")
    assert code == 1
    assert "holds a run of other settings" in found["failed"][0]["error"]
    assert found["groups"] == [{"settings": "as declared", "runs": 0}]


# A sampled evaluation is kept beside the score, so the sweep's own is still there.
@pytest.mark.parametrize(("how", "again"), [({"seed": 7}, ["s0"]), ({"deterministic": False}, [])])
def test_an_evaluation_made_otherwise_is_not_taken_for_the_sweeps(
    swept, recipe, trained, tmp_path, how, again
):
    first = swept("--seeds", "0:1")
    run = load(str(recipe)).load(tmp_path / "runs/s0")
    run.evaluate(3, save=True, **how)
    trained.clear()
    assert swept("--seeds", "0:1") == first
    assert trained == again
    saved = load_evaluation(RunDirectory.open(run.path))
    assert (saved.seed, saved.deterministic) == (0, True)


EDITED = RECIPE.replace("-abs(", "-2 * abs(")


@pytest.fixture
def helper(recipe, tmp_path, monkeypatch):
    """A module of the user's own, from which the recipe takes a number and nothing else."""
    file = tmp_path / "helper_of_sweep/__init__.py"
    file.parent.mkdir()
    file.write_text("from .weights import WEIGHT\n")
    (file.parent / "weights.py").write_text("WEIGHT = 1\n")
    recipe.write_text(f"from helper_of_sweep import WEIGHT\n{recipe.read_text()}")
    monkeypatch.syspath_prepend(tmp_path)
    yield file.parent / "weights.py"
    for name in ("helper_of_sweep", "helper_of_sweep.weights"):
        sys.modules.pop(name, None)


def assert_refused(answer, *said):
    code, found = answer
    assert code == 1
    for text in said:
        assert str(text) in found["error"]


@pytest.mark.slow
def test_an_edited_recipe_does_not_go_on_with_a_sweep(swept, recipe, trained, tmp_path):
    first = swept("--seeds", "0:1")
    recipe.write_text(EDITED)
    for more in ((), ("--flat",)):
        assert_refused(swept("--seeds", "0:2", *more), recipe, tmp_path / "runs", "--out")
    assert trained == ["s0"]
    recipe.write_text(RECIPE)
    assert swept("--seeds", "0:1") == first
    moved = tmp_path / "elsewhere" / "still.py"
    moved.parent.mkdir()
    moved.write_text(RECIPE)
    assert swept("--seeds", "0:1", file=moved) == first
    moved.write_text(EDITED)
    assert_refused(swept("--seeds", "0:1", file=moved), moved, recipe)
    assert trained == ["s0"]


@pytest.mark.parametrize("wrong", ["return lock", "raise NameError('lok')"])
def test_a_recipe_that_failed_before_anything_was_learnt_may_be_mended(
    swept, recipe, trained, wrong
):
    broken = RECIPE.replace("return -abs(step.next_obs[:, 1])", wrong)
    held = "import threading\nlock = threading.Lock()\n"  # it cannot be sent to a process
    recipe.write_text(held + broken if "lock" in wrong else broken)
    assert swept("--seeds", "0:1")[0] == 1
    recipe.write_text(RECIPE)
    code, found = swept("--seeds", "0:1")
    assert code == 0
    assert isinstance(found["runs"][0]["return"], float)


@pytest.mark.slow
def test_nor_does_one_whose_module_was_edited(swept, helper, recipe, trained):
    first = swept("--seeds", "0:1")
    helper.write_text("WEIGHT = 2\n")
    assert_refused(swept("--seeds", "0:1"), recipe)
    helper.write_text("WEIGHT = 1\n")
    assert swept("--seeds", "0:1") == first


def test_of_a_shipped_recipe_its_parts_count_and_nothing_else_of_the_library():
    load("mazes")
    found = code_files(source("mazes"))
    assert set(found) == {"", "skillweave.recipes._mazes", "skillweave.recipes._specs"}
    assert found[""] == source("mazes")


@pytest.mark.slow
def test_a_run_whose_process_dies_is_named_and_the_others_are_trained(swept, recipe):
    recipe.write_text(DYING_RECIPE)
    code, found = swept("--seeds", "0:2", "--jobs", "1")
    assert code == 1
    assert [run["seed"] for run in found["runs"]] == [1], found["failed"]
    assert found["failed"][0]["run"].endswith("s0")
    assert "exit code 3" in found["failed"][0]["error"]
    code, found = swept("--seeds", "0:2")
    assert (code, [run["seed"] for run in found["runs"]]) == (0, [0, 1])


def test_what_goes_wrong_in_a_run_is_told_and_the_others_are_trained(swept, trained, tmp_path):
    broken = tmp_path / "runs" / "s0"
    broken.mkdir(parents=True)
    (broken / "mine.txt").touch()
    code, found = swept("--seeds", "0:2")
    assert code == 1
    assert [run["seed"] for run in found["runs"]] == [1]
    assert "s0 exists and is not an empty directory" in found["failed"][0]["error"]


def test_the_table_has_interquartile_means_intervals_and_medians(tmp_path):
    scores = {"a=1": [1.0, 2.0, 3.0, 10.0], "a=2": [7.0, "no"]}
    jobs = [
        (sweep.Job(settings, seed, tmp_path, False, 1), score)
        for settings, row in scores.items()
        for seed, score in enumerate(row)
    ]
    result, text = summary(jobs, tmp_path)
    first, second = result["groups"]
    assert (first["runs"], first["iqm"], first["median"]) == (4, 2.5, 2.5)
    assert (first["least"], first["most"]) == (1.0, 10.0)
    assert first["low"] < 2.5 < first["high"]
    assert second == {
        "settings": "a=2", "runs": 1, "iqm": 7.0, "median": 7.0, "least": 7.0, "most": 7.0,
    }  # fmt: skip
    assert re.search(r"a=2 +1 +7\.0 +one seed +7\.0 +7\.0 to 7\.0", text)
    assert f"failed  {tmp_path}: no" in text


def test_seeds():
    for text, seeds in (("0:3", [0, 1, 2]), ("5", [5]), ("4,2", [4, 2]), ("7:8", [7])):
        assert sweep.parse_seeds(text) == seeds
    for text in ("", "3:1", "-1:2", "a", "1,1", "1:2:3"):
        with pytest.raises(DeclarationError, match="write 0:20 for 0 to 19"):
            sweep.parse_seeds(text)


def test_choices_are_all_combinations_and_values_may_be_tuples():
    assert sweep.parse_choices([]) == [()]
    found = sweep.parse_choices(["a=1,2", "b.c=(8,8),(16,16)"])
    assert found == [
        ("a=1", "b.c=(8,8)"), ("a=1", "b.c=(16,16)"), ("a=2", "b.c=(8,8)"), ("a=2", "b.c=(16,16)"),
    ]  # fmt: skip
    for each in (["a"], ["a="], ["a=1,1"], ["a=1,,2"], ["a=1", "a=2"]):
        with pytest.raises(DeclarationError, match="--set-each"):
            sweep.parse_choices(each)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["train", "x.py", "--ray"], ["train", "x.py", "--ray", ""]),
        (["train", "--ray", "x.py"], ["train", "--ray", "", "x.py"]),
        (["train", "--ray", "--quiet"], ["train", "--ray", "", "--quiet"]),
        (["train", "--ray", "auto", "x"], ["train", "--ray", "auto", "x"]),
        (["train", "--ray", "h:6379", "x"], ["train", "--ray", "h:6379", "x"]),
        (["train", "--ray", "ray://h:1", "x"], ["train", "--ray", "ray://h:1", "x"]),
    ],
)
def test_ray_may_be_said_with_an_address_or_without(words, found):
    assert _with_addresses(words) == found


def test_without_ray_the_extra_is_named(capsys, swept, recipe, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["train", str(recipe), "--ray"]) == 1
    assert "pip install 'skillweave[ray]'" in capsys.readouterr().err
    assert_refused(swept("--ray"), "pip install 'skillweave[ray]'")
