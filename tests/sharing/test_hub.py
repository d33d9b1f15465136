"""Runs pushed to a hub on this machine, and loaded from there."""

import json
import shutil
import sys

import numpy as np
import pytest
from hub_server import go_to
from shared_runs import NAME, SMALL, Left, Right, declare, files_of, same_actions

import skillweave as sw
from skillweave.cli import main
from skillweave.errors import DeclarationError, MissingExtra, RunError
from skillweave.runs.directory import RunDirectory

pytest.importorskip("huggingface_hub")

NOWHERE = "http://127.0.0.1:9"
"""A port at which nothing listens: no network."""


class Careful(sw.Skill):
    """Needs its Python code to act."""

    def termination(self, step):
        return np.abs(step.next_obs[:, 0]) > 0.5


# There and back


def test_a_run_that_was_pushed_acts_the_same_where_it_is_loaded(run, hub):
    told = run.push(NAME)
    assert told["url"] == f"{hub.url}/{NAME}"
    assert told["commit"] == hub.repos[NAME].commits[-1].sha
    loaded = sw.from_hub(NAME)
    assert same_actions(run, loaded)
    assert loaded.evaluate(episodes=2).returns == run.evaluate(episodes=2).returns
    assert loaded.info()["evaluation"] == run.info()["evaluation"]
    (loaded.path / "report.html").write_text("made here, of what was loaded")
    assert same_actions(run, sw.from_hub(NAME))


def test_all_goes_up_in_one_commit_and_nothing_but_data(run, trained, hub):
    pytest.importorskip("matplotlib")
    shutil.copy(trained.path / "metrics.jsonl", run.path)
    for name in ("notes.txt", "train.py", "checkpoint.safetensors", "report.html"):
        (run.path / name).write_text("mine")
    told = run.push(NAME)
    figures = {f"figures/{name}.png" for name in ("left", "right", "selector")}
    own = {"README.md", "hierarchy.gif", *files_of(run.path), *figures}
    assert set(hub.files(NAME)) == own == set(told["files"])
    assert len(hub.repos[NAME].commits) == 2  # the hub's own first one, and this
    assert {k: hub.files(NAME)[k] for k in files_of(run.path)} == files_of(run.path)
    assert told["missing"] == []


def test_calls_go_up_if_asked(run, hub):
    with pytest.raises(RunError, match="has no log of calls"):
        run.push(NAME, calls=True)
    log = run.log_calls(200)
    assert "calls.safetensors" not in run.push(NAME)["files"]
    assert "calls.safetensors" in run.push(NAME, calls=True)["files"]
    page = hub.files(NAME)["README.md"].decode()
    section = page.partition("## Handover")[2].partition("## Training")[0]
    assert "| after | left | " in section
    assert str(log.handover().rows()[0][1]).rstrip(")").partition("(")[2] in section
    loaded = sw.from_hub(NAME)
    assert loaded.info()["handover"] == run.info()["handover"] == log.handover().to_json()
    assert (loaded.calls.next_obs == log.next_obs).all()
    with pytest.raises(RunError, match=r"success\(\) of 'left' is not known: load the run with"):
        loaded.log_calls(100)
    loaded = sw.from_hub(NAME, declare(Left(), Right()))
    loaded.log_calls(100)  # into memory: nothing is written into the hub's copy
    assert loaded.calls.steps > log.steps
    assert (sw.from_hub(NAME).calls.next_obs == log.next_obs).all()
    run.push(NAME)
    assert "calls.safetensors" not in hub.files(NAME)


def test_what_a_run_has_not_is_said(run, hub):
    (run.path / "hierarchy.gif").unlink()
    (run.path / "evaluation.json").unlink()
    (run.path / "policies/hop.onnx").write_bytes(b"a graph")
    hop, film, evaluation, figures = run.push(NAME)["missing"]
    assert hop == "policies/hop.onnx is no safetensors file: it stays"
    assert film.startswith("no film: skillweave render")
    assert evaluation.startswith("no evaluation: skillweave evaluate")
    assert figures.startswith("no figures: ")
    assert not [name for name in hub.files(NAME) if name.endswith((".onnx", ".gif", ".png"))]


def test_a_later_run_takes_the_place_of_an_older_one_which_its_commit_still_has(run, hub, tmp_path):
    first = run.push(NAME)
    (run.path / "hierarchy.gif").rename(run.path / "film.mp4")
    other = declare(Right()).train(tmp_path / "other", quiet=True)
    hub.repos[NAME].commits[-1].files["notes.md"] = b"written on the hub"
    other.push(NAME)
    assert "policies/left.safetensors" not in hub.files(NAME)
    assert "hierarchy.gif" not in hub.files(NAME)
    assert hub.files(NAME)["notes.md"] == b"written on the hub"
    assert same_actions(sw.from_hub(NAME), other)
    assert same_actions(sw.from_hub(NAME, revision=first["commit"]), run)


def test_a_hierarchy_that_needs_code_is_given_it(hub, tmp_path):
    hierarchy = declare(Careful())
    run = hierarchy.train(tmp_path / "run", quiet=True)
    run.push(NAME)
    assert f'sw.from_hub("{NAME}", hierarchy)' in hub.files(NAME)["README.md"].decode()
    with pytest.raises(RunError, match=r"declared in Python.*from_hub\(name, hierarchy\)"):
        sw.from_hub(NAME)
    assert same_actions(sw.from_hub(NAME, declare(Careful())), run)
    with pytest.raises(DeclarationError, match="hierarchy is 'lunar-lander'; it must be the Hi"):
        sw.from_hub(NAME, "lunar-lander")
    with pytest.raises(RunError, match="trained with the skills careful"):
        sw.from_hub(NAME, declare(Left()))


def test_a_plain_agent_is_shared_as_well(hub, tmp_path):
    env = sw.EnvSpec("CartPole-v1", engine="sync", workers=1)
    run = sw.train_agent(env, SMALL, 100, tmp_path / "run", quiet=True)
    run.push(NAME)
    assert same_actions(sw.from_hub(NAME), run)


def test_without_a_network_a_run_is_loaded_as_it_was_downloaded(run, hub, tmp_path, monkeypatch):
    run.push(NAME)
    sw.from_hub(NAME)
    go_to(NOWHERE, tmp_path / "cache", monkeypatch)
    assert same_actions(sw.from_hub(NAME), run)
    go_to(NOWHERE, tmp_path / "empty", monkeypatch)
    with pytest.raises(RunError, match=r"cannot be reached.*no copy of ada/cart.*ConnectError"):
        sw.from_hub(NAME)
    with pytest.raises(RunError, match=r"cannot be reached\. Nothing was pushed"):
        run.push(NAME)


# What is not loaded


@pytest.mark.parametrize("name", ["train.py", "policies/x.pkl", "model.bin", "a/../../b.json"])
def test_a_file_that_is_not_data_is_refused_before_anything_is_downloaded(name, run, hub):
    hub.make(NAME, {**files_of(run.path), name: b"import os"})
    with pytest.raises(RunError, match=f"{NAME} holds '{name}'.*nothing of it is used"):
        sw.from_hub(NAME)
    assert [line for line in hub.asked if "/resolve/" in line] == []


def test_files_of_the_hub_are_checked_like_those_of_any_run(run, hub):
    files = files_of(run.path)
    altered = files["run.json"].replace(b'"call_steps": 5', b'"call_steps": 6')
    hub.make(NAME, files | {"run.json": altered})
    with pytest.raises(RunError, match=r"run\.json is damaged.*checksum"):
        sw.from_hub(NAME)
    swapped = {"policies/left.safetensors": files["policies/right.safetensors"]}
    hub.make("ada/swapped", files | swapped)
    with pytest.raises(RunError, match="holds the policy of stage 'right'"):
        sw.from_hub("ada/swapped")
    hub.make("ada/cut", files | {"policies/left.safetensors": b"\0" * 20})
    with pytest.raises(RunError, match="damaged"):
        sw.from_hub("ada/cut")
    hub.make("ada/else", {"config.json": b"{}", "model.safetensors": b""})
    with pytest.raises(RunError, match="ada/else holds no run of Skillweave"):
        sw.from_hub("ada/else")


def test_wrong_names_private_runs_and_revisions_are_told_with_what_to_do(run, hub, monkeypatch):
    hub.make("eve/secret", files_of(run.path), private=True)
    for token in ("good-token", ""):
        monkeypatch.setenv("HF_TOKEN", token)
        for name in ("ada/nothing", "eve/secret"):
            with pytest.raises(RunError, match=f"has no {name}, or it is private.*log in"):
                sw.from_hub(name)
    hub.make(NAME, files_of(run.path))
    with pytest.raises(RunError, match="ada/cart has no revision 'v2'"):
        sw.from_hub(NAME, revision="v2")
    for wrong in ("cart", "ada/cart/x", "../cart", "ada/", 3, "ada/c art"):
        with pytest.raises(DeclarationError, match="write owner/name"):
            sw.from_hub(wrong)


# What is not pushed


def test_an_unfinished_or_damaged_run_is_refused_before_the_hub_hears_of_it(run, hub):
    path = run.path / "policies/left.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(RunError, match=r"left\.safetensors is damaged"):
        run.push(NAME)
    directory = RunDirectory.open(run.path)
    directory.stage("selector").status = "training"
    directory.save()
    with pytest.raises(RunError, match=r"'selector' is not done.*resume=True"):
        run.push(NAME)
    assert hub.asked == []


def test_who_may_not_write_is_told_what_to_do(run, hub, monkeypatch):
    for name in ("eve/new", "eve/old"):
        hub.make("eve/old", files_of(run.path))
        with pytest.raises(RunError, match=f"you may not write to {name}"):
            run.push(name)
    monkeypatch.setenv("HF_TOKEN", "")
    with pytest.raises(RunError, match=r"does not recognise you: log in \(hf auth login\)"):
        run.push(NAME)


def test_what_is_something_else_or_public_is_left_alone(run, hub):
    hub.make("ada/else", {"config.json": b"{}"})
    hub.make("ada/code", {**files_of(run.path), "train.py": b""})
    for name, why in (("ada/else", "other files"), ("ada/code", "'train.py'")):
        before = hub.files(name)
        with pytest.raises(RunError, match=f"{name} holds {why}"):
            run.push(name)
        assert hub.files(name) == before
    run.push("ada/open")
    with pytest.raises(RunError, match="ada/open is public already"):
        run.push("ada/open", private=True)
    run.push("ada/closed", private=True)
    assert hub.repos["ada/closed"].private


def test_where_the_hub_fails_nothing_is_half_pushed(run, hub):
    for path, answer in (("/commit/", 500), ("/large/", 501), ("/large/", 403)):
        hub.breaks_at, hub.answer = path, answer
        why = "you may not write" if answer == 403 else f"the answer {answer}; try again later"
        with pytest.raises(RunError, match=why):
            run.push(NAME)
        assert hub.files(NAME) == {}
    hub.breaks_at = ""
    run.push(NAME)
    assert same_actions(sw.from_hub(NAME), run)


def test_a_missing_library_names_its_extra(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for share in (lambda: run.push(NAME), lambda: sw.from_hub(NAME)):
        with pytest.raises(MissingExtra, match=r"pip install 'skillweave\[hub\]'"):
            share()


# On the command line


def test_push_and_pull_on_the_command_line(run, hub, tmp_path, capsys):
    assert main(["push", str(run.path), NAME, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["url"] == f"{hub.url}/{NAME}"
    out = tmp_path / "pulled"
    assert main(["pull", NAME, "--out", str(out), "--quiet"]) == 0
    assert str(out) in capsys.readouterr().out
    assert {k: (out / k).read_bytes() for k in files_of(run.path)} == files_of(run.path)
    assert main(["evaluate", str(out), "--episodes", "2"]) == 0
    capsys.readouterr()
    assert main(["pull", NAME, "--out", str(out)]) == 1
    assert "is there already" in capsys.readouterr().err
    assert main(["pull", "ada/nothing"]) == 1
    assert "has no ada/nothing" in capsys.readouterr().err
