"""The run directory: never overwritten, exact, and forgiving where it can be."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import level_entry, small_manifest
from torch import Tensor

from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm, state_from
from skillweave.algorithms.config import PPO, config_to_json
from skillweave.errors import RunError, SkillweaveError
from skillweave.networks.config import Network
from skillweave.runs.directory import RunDirectory
from skillweave.runs.files import read_header, read_json, read_tensors, write_json, write_tensors
from skillweave.runs.manifest import (
    Checkpoint,
    Manifest,
    SkillEntry,
    StageEntry,
    versions,
)

ALGORITHM = json.loads(json.dumps(config_to_json(PPO())))


def manifest(seed: int = 7, **fields: Any) -> Manifest:
    return small_manifest(
        StageEntry("landing", "skill", ["landing"], None, 10, ALGORITHM, None, "training"),
        StageEntry(
            "selector", "selector", ["selector"], "selector", 10, ALGORITHM, None, "waiting"
        ),
        seed=seed,
        hierarchy=level_entry(),
        skills=[SkillEntry("landing", None)],
        **fields,
    )


@dataclass
class Learnt:
    """A stand-in for an algorithm's state."""

    weight: Tensor
    count: Tensor


def learnt(seed: int) -> Learnt:
    noise = torch.randn(3, 5, generator=torch.Generator().manual_seed(seed))
    return Learnt(noise, torch.tensor([seed], dtype=torch.int64))


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunDirectory]:
    run = RunDirectory.create(tmp_path / "run", manifest())
    yield run
    run.close()


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def end(run: RunDirectory, stage: str) -> None:
    entry = run.stage(stage)
    entry.status, entry.steps, entry.seconds = "done", 1, 1.0


def save(run: RunDirectory, seed: int, stage: str = "landing") -> Learnt:
    state = learnt(seed)
    run.save_checkpoint(Checkpoint(stage, seed, 10 * seed, 0, 0.0, {}), vars(state))
    return state


def loaded(run: RunDirectory, state: Learnt | None = None) -> Checkpoint:
    """The header of a stage's checkpoint, which holds a state."""
    checkpoint = run.load_checkpoint("landing")
    assert checkpoint is not None
    tensors, header = checkpoint
    if state is not None:
        read = state_from(tensors, state, "here")
        assert read.weight.numpy().tobytes() == state.weight.numpy().tobytes()
        assert torch.equal(read.count, state.count)
    return header


def files_of(run: RunDirectory) -> set[str]:
    return {p.name for p in run.path.iterdir()} - {".lock"}


# Making and opening


def test_a_new_run_can_be_opened_and_says_what_made_it(run: RunDirectory) -> None:
    found = RunDirectory.open(run.path).manifest
    assert found.created
    assert found.versions == versions()
    assert found.versions["torch"] == torch.__version__
    assert {"python", "platform", "torch", "gymnasium", "numpy"} <= set(found.versions)
    assert all(isinstance(v, str) and v for v in found.versions.values())
    assert replace(found, created="", versions={}, id="") == manifest()


def test_an_existing_run_is_never_overwritten(run: RunDirectory) -> None:
    save(run, 1)
    before = (run.path / "run.json").read_bytes()
    with pytest.raises(RunError, match=r"unfinished run, saved at 10 steps") as caught:
        RunDirectory.create(run.path, manifest(8))
    assert f'hierarchy.train("{run.path}", seed=7, resume=True)' in str(caught.value)
    assert (run.path / "run.json").read_bytes() == before


def test_a_run_is_made_in_a_directory_that_is_empty_and_in_no_other(tmp_path: Path) -> None:
    file = tmp_path / "thesis.tex"
    file.write_text("years of work")
    for path in (tmp_path, file):
        with pytest.raises(RunError, match="not an empty directory"):
            RunDirectory.create(path, manifest())
        assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    file.unlink()
    with pytest.raises(RunError, match="holds no run") as caught:
        RunDirectory.open(tmp_path)
    assert str(tmp_path / "run.json") in str(caught.value)
    RunDirectory.create(tmp_path, manifest())
    assert (tmp_path / "run.json").exists()


NEEDED = [f.name for f in fields(Manifest) if f.default is f.default_factory is MISSING]


@pytest.mark.parametrize("field", [*NEEDED, "sha256"])
def test_a_run_without_one_of_its_fields_is_damaged_and_the_field_is_named(
    run: RunDirectory, field: str
) -> None:
    path = run.path / "run.json"
    data = json.loads(path.read_text())
    del data[field]
    path.write_text(json.dumps(data))
    with pytest.raises(RunError, match=f"damaged.*'{field}'") as caught:
        RunDirectory.open(run.path)
    assert str(path) in str(caught.value)


def test_a_run_is_finished_when_every_stage_is_done(run: RunDirectory) -> None:
    end(run, "landing")
    assert not run.finished
    end(run, "selector")
    assert run.finished
    run.save()
    assert RunDirectory.open(run.path).finished
    with pytest.raises(RunError, match="'ladning'; it has: landing, selector"):
        run.stage("ladning")


# Checkpoints

WITH_CHECKPOINTS = {"run.json", "checkpoint.safetensors", "checkpoint.previous.safetensors"}


def test_the_latest_checkpoint_comes_back_exactly_and_no_other_files_stay(
    run: RunDirectory,
) -> None:
    states = [save(run, seed) for seed in (1, 2)]
    run.log({"update": 1})
    states.append(save(run, 3))
    header = loaded(RunDirectory.open(run.path), states[2])
    assert (header.update, header.steps) == (3, 30)
    assert header.metrics_bytes == (run.path / "metrics.jsonl").stat().st_size > 0
    assert files_of(run) == WITH_CHECKPOINTS | {"metrics.jsonl"}


@pytest.mark.parametrize("how", ["altered", "cut off", "emptied", "removed"])
def test_a_bad_checkpoint_falls_back_to_the_one_before_and_two_are_an_error_that_names_both(
    run: RunDirectory, how: str
) -> None:
    before = save(run, 1)
    save(run, 2)
    latest, previous = (run.path / f"checkpoint{x}.safetensors" for x in ("", ".previous"))
    match how:
        case "altered":
            damage(latest)
        case "cut off":
            os.truncate(latest, latest.stat().st_size // 2)
        case "emptied":
            os.truncate(latest, 0)
        case "removed":
            latest.unlink()
    assert loaded(run, before).update == 1
    damage(previous)
    with pytest.raises(RunError, match="damaged") as caught:
        run.load_checkpoint("landing")
    assert str(previous) in str(caught.value)
    assert (str(latest) in str(caught.value)) == (how != "removed")


# Policies


@pytest.fixture
def policy() -> AgentPolicy:
    import gymnasium as gym

    env = gym.make("CartPole-v1")
    config = PPO(num_envs=1, n_steps=4, batch_size=4, network=Network(hidden=(3,)))
    algorithm = make_algorithm(config, env.observation_space, env.action_space)
    env.close()
    return AgentPolicy.of(algorithm, algorithm.init([Seeds(0)]))


def test_the_policy_of_a_finished_stage_comes_back_exactly(
    run: RunDirectory, policy: AgentPolicy
) -> None:
    run.save_policies("landing", {"landing": policy})
    with pytest.raises(RunError, match=r"'landing' is not done .*resume=True\)"):
        run.load_policy("landing")
    run.stage("landing").status = "done"
    found = run.load_policy("landing")
    assert found.weights.keys() == policy.weights.keys()
    assert all(torch.equal(found.weights[k], v) for k, v in policy.weights.items())
    obs = torch.randn(9, 4, generator=torch.Generator().manual_seed(0)).numpy()
    assert (found.act({}, obs)[0] == policy.act({}, obs)[0]).all()


@pytest.mark.parametrize("instead", ["a damaged policy", "a checkpoint"])
def test_what_is_no_policy_is_refused_by_name(
    run: RunDirectory, policy: AgentPolicy, instead: str
) -> None:
    run.save_policies("landing", {"landing": policy})
    run.stage("landing").status = "done"
    path = run.policy_path("landing")
    if instead == "a checkpoint":
        save(run, 1)
        (run.path / "checkpoint.safetensors").rename(path)
    else:
        damage(path)
    with pytest.raises(RunError) as caught:
        run.load_policy("landing")
    assert str(path) in str(caught.value)
    assert "damaged" in str(caught.value) or instead == "a checkpoint"


# Metrics


def test_metrics_come_back_in_order(run: RunDirectory) -> None:
    records = [{"stage": "landing", "update": i, "loss": i / 3} for i in range(5)]
    for record in records:
        run.log(record)
    assert list(run.metrics()) == records
    run.close()
    run.log({"stage": "landing", "update": 5})
    assert [r["update"] for r in RunDirectory.open(run.path).metrics()] == [0, 1, 2, 3, 4, 5]


def test_a_run_without_metrics_has_none(run: RunDirectory) -> None:
    assert list(run.metrics()) == []
    run.record_lines(entry := run.stage("landing"))
    assert entry.metrics_bytes == 0
    run.rewind({"metrics_bytes": 0})
    assert not (run.path / "metrics.jsonl").exists()


def test_rewinding_drops_what_came_after_the_checkpoint(run: RunDirectory) -> None:
    for i in range(3):
        run.log({"update": i})
    save(run, 3)
    for i in range(3, 6):
        run.log({"update": i})
    for size in (loaded(run).metrics_bytes, 10_000):  # beyond the end nothing changes
        run.rewind({"metrics_bytes": size})
        assert [r["update"] for r in run.metrics()] == [0, 1, 2]
    run.log({"update": 3})
    assert [r["update"] for r in run.metrics()] == [0, 1, 2, 3]


@pytest.mark.parametrize("rest", ['{"update": 2', '{"update": 2}', "{"])
def test_a_half_written_last_line_is_left_out(run: RunDirectory, rest: str) -> None:
    run.log({"update": 1})
    run.close()
    with (run.path / "metrics.jsonl").open("a") as file:
        file.write(rest)
    assert [r["update"] for r in run.metrics()] == [1]


@pytest.mark.parametrize(("line", "says"), [('{"upd', ""), ('{"a": "\\ud800"}', "half of a ch")])
def test_a_damaged_line_in_the_middle_is_an_error_that_names_the_file(
    run: RunDirectory, line: str, says: str
) -> None:
    (run.path / "metrics.jsonl").write_text(f'{{"update": 1}}\n{line}\n{{"update": 3}}\n')
    with pytest.raises(RunError, match=rf"metrics\.jsonl is damaged in line 2: .*{says}"):
        list(run.metrics())


def test_a_line_without_end_is_not_read(run: RunDirectory) -> None:
    with (run.path / "metrics.jsonl").open("w") as file:
        file.write('{"update": 1}\n')
        file.truncate(2**40)  # it has no bytes on the disk
    with pytest.raises(RunError, match=r"metrics\.jsonl is damaged in line 2: it has more than"):
        list(run.metrics())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_metrics_on_a_full_disk_say_so_and_the_run_can_still_be_closed(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path / "run", manifest())
    (run.path / "metrics.jsonl").symlink_to("/dev/full")
    with pytest.raises(RunError, match="No space left") as caught:
        run.log({"update": 1})
    assert "resume=True)" in str(caught.value)
    run.close()


# What is wrong in run.json is told by its field


def write_manifest(run: RunDirectory, change: Any) -> None:
    """Write ``run.json`` anew, with the checksum of what it says then."""
    data = read_json(run.path / "run.json")
    change(data)
    write_json(run.path / "run.json", data)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.update(stages=5), "stages is 5; it must be a list"),
        (lambda m: m["stages"][0].pop("status"), "damaged: stages[0] has no field 'status'"),
        (lambda m: m["stages"][0].update(learns=[]), "stages[0].learns is []; it must be at least"),
        (lambda m: m.pop("hierarchy"), "stages has 2 entries, but a plain agent has one"),
        (lambda m: m["stages"][0].update(status="done"), "stages[0] is done, but has no field 's"),
        (lambda m: m["stages"][1].update(name="landing"), "stages[1].name is 'landing', a second"),
        (
            lambda m: m["stages"][1].update(name="../../x"),
            "stages[1].name is '../../x'; it must be",
        ),
        (lambda m: m["skills"].__setitem__(0, None), "skills[0] is None; it must be an object"),
        (
            lambda m: m.update(checkpoint_every=[[]]),
            "checkpoint_every is [[]]; it must be a whole number",
        ),
        (lambda m: m.update(keep="x" * 10_000), "keep is 'xxx"),
        (
            lambda m: m["hierarchy"].update(call_steps=0),
            "hierarchy.call_steps is 0; it must be at least 1, or None",
        ),
        (
            lambda m: m["stages"][0]["algorithm"].pop("num_envs"),
            "the settings of an algorithm, among them",
        ),
        (
            lambda m: m["stages"][0].update(algorithms={"a b": {}}),
            "stages[0].algorithms: a name is 'a b'; it must be names of letters",
        ),
        (
            lambda m: m["stages"][0].update(algorithms={"landing": {"algorithm": "SAC", "tau": 2}}),
            "stages[0].algorithms['landing'].tau is 2; it must be between 0 and 1",
        ),
        (
            lambda m: m["stages"][0].update(evolution={}),
            "stages[0].evolution is {}; it must be the settings of a population",
        ),
        (lambda m: m["stages"][0].update(workers=10**9), "at least 1 and at most 1,024"),
        (lambda m: m.update(skills=[]), "skills has no skill at all"),
        (lambda m: m.update(call_steps=10), "has no field call_steps: made by a newer version?"),
        (
            lambda m: m["stages"][0]["algorithm"].update(gamma="a"),
            "stages[0].algorithm.gamma is 'a'; it must be a number, between 0 and 1",
        ),
        (
            lambda m: m["stages"][0]["algorithm"]["network"].update(hidden=[[]]),
            "stages[0].algorithm.network.hidden[0] is []; it must be a whole number",
        ),
    ],
)
def test_a_wrong_field_of_a_manifest_is_named(run: RunDirectory, change: Any, says: str) -> None:
    write_manifest(run, change)
    with pytest.raises(RunError) as caught:
        RunDirectory.open(run.path)
    assert str(caught.value).startswith(str(run.path / "run.json"))
    assert says in str(caught.value)
    assert len(str(caught.value)) < len(str(run.path)) + 250


# Files belong to their run and stage


def finished(run: RunDirectory, *policies: AgentPolicy) -> None:
    """Every stage of the run, done."""
    for entry, policy in zip(run.manifest.stages, policies, strict=True):
        run.save_policies(entry.name, {entry.name: policy})
        end(run, entry.name)
    run.save()


def other(policy: AgentPolicy, seed: int = 1) -> AgentPolicy:
    """A policy of the same kind with other weights."""
    return AgentPolicy.of(policy.algorithm, policy.algorithm.init([Seeds(seed)]))


def test_a_policy_of_another_stage_or_run_or_that_the_run_did_not_end_with_is_refused(
    run: RunDirectory, policy: AgentPolicy, tmp_path: Path
) -> None:
    finished(run, policy, other(policy))
    theirs = RunDirectory.create(tmp_path / "other", manifest(8))
    finished(theirs, other(policy, 2), other(policy, 3))
    mine = run.policy_path("landing")
    before = mine.read_bytes()
    for file, says in (
        (run.policy_path("selector"), r"landing.*holds the policy of stage 'selector'"),
        (theirs.policy_path("landing"), "belongs to another run"),
    ):
        mine.write_bytes(file.read_bytes())
        with pytest.raises(RunError, match=says):
            RunDirectory.open(run.path).load_policy("landing")
    run.save_policies("landing", {"landing": other(policy, 2)})  # not said in run.json
    with pytest.raises(RunError, match="its checksum differs"):
        RunDirectory.open(run.path).load_policy("landing")
    mine.write_bytes(before)
    assert RunDirectory.open(run.path).load_policy("landing").source() == policy.source()


def test_equal_runs_have_the_same_identity_and_equal_files(
    run: RunDirectory, policy: AgentPolicy, tmp_path: Path
) -> None:
    again = RunDirectory.create(tmp_path / "again", manifest(recipe="elsewhere.py"))
    other_seed = RunDirectory.create(tmp_path / "seed", manifest(8))
    assert again.manifest.id == run.manifest.id != other_seed.manifest.id
    for one in (run, again):
        finished(one, policy, policy)
    for stage in ("landing", "selector"):
        assert again.policy_path(stage).read_bytes() == run.policy_path(stage).read_bytes()


def test_a_checkpoint_of_another_run_or_of_other_tensors_is_refused(
    run: RunDirectory, tmp_path: Path
) -> None:
    state = save(run, 1)
    for weight in (state.weight.T, state.weight.double()):
        with pytest.raises(RunError, match="tensor weight should"):
            loaded(run, Learnt(weight, state.count))
    theirs = RunDirectory.create(tmp_path / "other", manifest(8))
    save(theirs, 1)
    shutil.copy(theirs.path / "checkpoint.safetensors", run.path)
    with pytest.raises(RunError, match="belongs to another run"):
        run.load_checkpoint("landing")


# One process at a time, and what a killed one leaves


def test_two_may_not_train_a_run_at_once_and_what_one_did_is_seen(run: RunDirectory) -> None:
    run.begin()
    second = RunDirectory.open(run.path)  # may be read
    with pytest.raises(RunError, match="being trained by another run of this process") as caught:
        second.begin()
    assert str(run.path) in str(caught.value)
    end(run, "landing")
    run.save()
    run.close()
    second.begin()
    assert second.stage("landing").status == "done"
    second.close()


HOLD = """
import os, sys, time
from skillweave.runs.directory import RunDirectory
run = RunDirectory.open(sys.argv[1])
run.begin()
if os.fork() == 0:  # a worker that outlives its parent
    os.close(1)
    time.sleep(60)
print("held", flush=True)
time.sleep(60)
"""


@pytest.mark.slow
def test_a_process_that_is_killed_holds_the_run_no_longer(run: RunDirectory) -> None:
    command = [sys.executable, "-c", HOLD, str(run.path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with pytest.raises(SkillweaveError, match=f"trained by process {process.pid};"):
            run.begin()
        process.kill()
        process.wait()
        run.begin()
        os.killpg(process.pid, signal.SIGKILL)


def test_a_finished_run_is_not_locked(run: RunDirectory, policy: AgentPolicy) -> None:
    finished(run, policy, policy)
    before = sorted(p.name for p in run.path.iterdir())
    run.begin()
    assert sorted(p.name for p in run.path.iterdir()) == before


def test_files_that_a_killed_process_left_half_written_are_removed(run: RunDirectory) -> None:
    save(run, 1)
    state = save(run, 2)
    run.policy_path("x").parent.mkdir()
    for name in (".run.json.abc.tmp", "policies/.landing.safetensors.abc.tmp"):
        (run.path / name).write_text("half")
    latest = run.path / "checkpoint.safetensors"
    shutil.copy(latest, run.path / "checkpoint.new.safetensors")
    (run.path / "mine.txt").write_text("a note")
    run.begin()
    assert files_of(run) == WITH_CHECKPOINTS | {"policies", "mine.txt"}
    assert not list((run.path / "policies").iterdir())
    run.close()
    latest.rename(run.path / "checkpoint.new.safetensors")  # between its two renames
    run.begin()
    loaded(run, state)


def test_checkpoints_are_those_of_their_stage_and_go_when_it_is_done(run: RunDirectory) -> None:
    save(run, 1, "landing")
    mine = save(run, 2, "landing")
    assert run.load_checkpoint("selector") is None
    save(run, 3, "selector")  # the one before is landing's
    loaded(run, mine)
    end(run, "landing")
    run.save()
    run.begin()
    assert not (run.path / "checkpoint.previous.safetensors").exists()
    assert run.load_checkpoint("selector") is not None
    run.drop_checkpoints()
    assert run.load_checkpoint("selector") is None
    assert not list(run.path.glob("checkpoint*"))


WRITES: dict[str, Any] = {
    "run.json": lambda run, policy: run.save(),
    "a checkpoint": lambda run, policy: save(run, 1),
    "metrics": lambda run, policy: run.log({"update": 1}),
    "a policy": lambda run, policy: run.save_policies("landing", {"landing": policy}),
}


@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES.keys())
@pytest.mark.parametrize("how", ["deleted", "made again"])
def test_a_run_deleted_while_it_is_trained_is_not_made_again(
    run: RunDirectory, policy: AgentPolicy, write: Any, how: str
) -> None:
    run.begin()
    shutil.rmtree(run.path)
    if how == "made again":
        RunDirectory.create(run.path, manifest())
    before = list(run.path.glob("**/*"))
    with pytest.raises(RunError, match="was deleted or moved during"):
        write(run, policy)
    assert list(run.path.glob("**/*")) == before


@pytest.mark.parametrize("call", [0, 1, 2])
def test_a_checkpoint_that_cannot_be_written_or_renamed_leaves_the_last_two(
    run: RunDirectory, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    """The disk is full as it is written, or at one of the two renames."""
    save(run, 1)
    kept = save(run, 2)
    real, calls = os.replace, 0

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def failing(source: Any, target: Any) -> None:
        nonlocal calls
        calls += ".tmp" not in str(source)
        if ".tmp" not in str(source) and calls == call:
            full()
        real(source, target)

    if call:
        monkeypatch.setattr(os, "replace", failing)
    else:
        monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match=r"could not write .*checkpoint.*No space left"):
        save(run, 3)
    monkeypatch.undo()
    loaded(run, kept)
    assert not (run.path / "checkpoint.new.safetensors").exists()
    assert files_of(run) == WITH_CHECKPOINTS or call == 2


def test_a_folder_that_is_no_utf8_is_refused_before_training(tmp_path: Path) -> None:
    strange = tmp_path / os.fsdecode(b"x\xff\xfe")
    try:
        strange.mkdir()
        strange.rmdir()
    except OSError:
        pytest.skip("this file system has no such names")
    for path in (strange, strange / "run"):
        with pytest.raises(RunError, match=r"is not UTF-8.*choose another folder"):
            RunDirectory.create(path, small_manifest())
    assert list(tmp_path.iterdir()) == []
    good = RunDirectory.create(tmp_path / "größe → 大", small_manifest())
    assert (good.path / "run.json").is_file()


def test_weights_in_a_folder_that_is_no_utf8_are_not_said_to_be_damaged(tmp_path: Path) -> None:
    strange = tmp_path / os.fsdecode(b"x\xff\xfe")
    write_tensors(tmp_path / "a.safetensors", {}, {})
    try:
        (tmp_path / "a.safetensors").rename(strange)
    except OSError:
        pytest.skip("this file system has no such names")
    for act in (read_header, read_tensors, lambda path: write_tensors(path, {}, {})):
        with pytest.raises(RunError, match="is not UTF-8"):
            act(strange)
