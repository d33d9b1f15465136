"""Trackers: written where they should be, never asking for a login, missing extras named."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from small_runs import small_manifest, stage_entry

from skillweave.errors import MissingExtra, RunError, SkillweaveError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.trackers import (
    TRACKERS,
    make_trackers,
    mlflow_keys,
    track_film,
    trackers_of,
)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def events_in(folder: Path) -> Any:
    """What TensorBoard shows of a folder."""
    module = "tensorboard.backend.event_processing.event_accumulator"
    return pytest.importorskip(module).EventAccumulator(str(folder)).Reload()


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    return RunDirectory.create(tmp_path / "run", small_manifest())


def uninstall(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let a package be missing; what finds packages in truth."""
    real = importlib.util.find_spec

    def without(wanted: str, package: str | None = None) -> Any:
        return None if wanted == name else real(wanted, package)

    monkeypatch.setattr(importlib.util, "find_spec", without)
    return real


@pytest.mark.parametrize("name", TRACKERS)
def test_a_missing_package_names_its_extra(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    real = uninstall(name, monkeypatch)
    with pytest.raises(MissingExtra, match=rf"pip install 'skillweave\[{name}\]'"):
        make_trackers((name,), None)
    for other in set(TRACKERS) - {name}:
        if real(other):
            assert make_trackers((other,), None) == ()


def test_a_missing_package_is_said_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from skillweave import Hierarchy, Skill

    class Balance(Skill):
        pass

    uninstall("wandb", monkeypatch)
    with pytest.raises(MissingExtra):
        Hierarchy("CartPole-v1", [Balance()], learn="apart").train(
            tmp_path / "run", track=["wandb"]
        )
    assert not (tmp_path / "run").exists()


def test_tensorboard_shows_every_scalar_of_each_stage_once_also_after_a_resume(
    run: RunDirectory,
) -> None:
    (killed,) = make_trackers(("tensorboard",), run)
    killed.stage("landing", 1000)
    for steps in (100, 200, 300):  # the latest checkpoint is of step 100
        killed.tick("landing", steps, 1.0, {"return": 1.0, "kl": 0.25})
    killed.done("landing", 300, 1.0, {"return": 1.0})
    for steps in (100, 200):
        killed.tick("selector", steps, 1.0, {"return": 1.0})
    killed.close()
    (resumed,) = make_trackers(("tensorboard",), run)
    for steps in (200, 300):
        resumed.tick("selector", steps, 1.0, {"return": 2.0})
    resumed.close()
    assert list((run.path / "tensorboard/landing").glob("events.out.tfevents.*"))
    shown = {}
    for stage in ("landing", "selector"):
        events = events_in(run.path / "tensorboard" / stage)
        shown |= {
            tag: [(e.step, e.value) for e in events.Scalars(tag)]
            for tag in events.Tags()["scalars"]
        }
    assert shown == {
        "landing/return": [(100, 1.0), (200, 1.0), (300, 1.0)],
        "landing/kl": [(100, 0.25), (200, 0.25), (300, 0.25)],
        "selector/return": [(100, 1.0), (200, 2.0), (300, 2.0)],
    }


class FakeRun:
    """A run of W&B, as far as the tracker uses it."""

    def __init__(self, **how: Any) -> None:
        self.how = how
        self.id, self.name, self.sweep_id = how.get("id", "x"), how.get("name"), None
        self.logged: list[dict[str, Any]] = []
        self.finished = False

    def define_metric(self, name: str, step_metric: str) -> None:
        pass

    def log(self, values: dict[str, Any]) -> None:
        assert not self.finished
        self.logged.append(values)

    def finish(self) -> None:
        self.finished = True


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A package that has ``made`` the runs that were asked for, and ``run``, the program's own."""
    fake: Any = ModuleType("wandb")
    fake.__spec__ = ModuleSpec("wandb", None)
    fake.__version__ = "0.21.0"
    fake.run, fake.made = None, []
    fake.Settings = lambda **how: how

    def init(**how: Any) -> FakeRun:
        if fake.run is not None and how.get("reinit") != "create_new":
            return fake.run
        fake.made.append(FakeRun(**how))
        return fake.made[-1]

    fake.init = init
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


def track(run: RunDirectory) -> None:
    (tracker,) = make_trackers(("wandb",), run)
    tracker.stage("landing", 1000)
    tracker.tick("landing", 128, 0.5, {"return": 1.5})
    tracker.close()


def unfinished(run: RunDirectory) -> RunDirectory:
    run.manifest.stages = [stage_entry("landing", "training", steps=128)]
    return run


def test_a_run_of_the_programs_own_in_wandb_stays_as_it_is(
    run: RunDirectory, wandb: Any, tmp_path: Path
) -> None:
    wandb.run = FakeRun(name="mine")
    others = unfinished(RunDirectory.create(tmp_path / "other", small_manifest()))
    for one in (unfinished(run), unfinished(run), others):  # the second time it is resumed
        with pytest.warns(UserWarning, match="the W&B run 'mine' is open and stays as it is"):
            track(one)
    assert not wandb.run.finished
    assert wandb.run.logged == []
    first, again, other = wandb.made
    assert first.how["id"] == again.how["id"] != other.how["id"]
    assert first.how["resume"] == again.how["resume"] == "allow"
    assert first.finished
    assert first.logged == [{"landing/return": 1.5, "landing/steps": 128}]


@pytest.mark.parametrize(
    ("sweep", "version", "why"),
    [("s", "0.21.0", ".*a sweep"), (None, "0.19.9", r": wandb before 0\.19\.10")],
)
def test_a_run_of_a_sweep_or_of_an_old_wandb_gets_the_metrics_and_stays_open(
    run: RunDirectory, wandb: Any, sweep: str | None, version: str, why: str
) -> None:
    wandb.run, wandb.__version__ = FakeRun(name="mine"), version
    wandb.run.sweep_id = sweep
    with pytest.warns(UserWarning, match=f"W&B run 'mine', which stays open{why}"):
        track(unfinished(run))
    assert wandb.made == []
    assert wandb.run.logged == [{"landing/return": 1.5, "landing/steps": 128}]
    assert not wandb.run.finished


@pytest.mark.filterwarnings("error")
def test_without_a_run_of_the_programs_own_nothing_is_said(run: RunDirectory, wandb: Any) -> None:
    track(unfinished(run))
    (made,) = wandb.made
    assert made.finished
    assert "reinit" not in made.how


def test_a_tracker_that_fails_ends_no_training(tmp_path: Path, wandb: Any) -> None:
    from skillweave import PPO, Network, train_agent

    def fail(self: FakeRun, values: dict[str, Any]) -> None:
        raise ConnectionError("the network is gone")

    small = PPO(num_envs=2, n_steps=8, batch_size=16, network=Network((4,)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FakeRun, "log", fail)
        patch.setattr(FakeRun, "finish", fail)
        with pytest.warns(UserWarning, match="wandb did not take everything.*network is gone") as w:
            trained = train_agent(
                "CartPole-v1", small, 64, tmp_path / "run", quiet=True, track=["wandb"]
            )
    assert len([one for one in w if "did not take" in str(one.message)]) == 1
    steps = [line["steps"] for line in RunDirectory.open(trained.path).metrics()]
    assert steps == [16, 32, 48, 64]


def test_a_score_is_kept_where_a_tracker_does_not_answer(tracked: RunDirectory, wandb: Any) -> None:
    from skillweave.training.evaluation import Evaluation
    from skillweave.training.evaluation_file import load_evaluation, save_evaluation

    def fail(**how: Any) -> FakeRun:
        raise ConnectionError("no server")

    wandb.init = fail
    tracked.manifest.track = ("tensorboard", "wandb")
    with pytest.raises(RunError, match=r"W&B does not answer.*no server.*WANDB_MODE=offline"):
        make_trackers(("wandb",), tracked)
    with pytest.warns(UserWarning, match="W&B does not answer"):
        save_evaluation(tracked, Evaluation((1.0,), (20,), None, {}), 0, True)
    assert load_evaluation(tracked) is not None


def test_names_that_mlflow_refuses_are_replaced_each_by_another_one() -> None:
    fine = {"plain": "plain", "a: b": "a: b", "größe": "größe", "a/b.c": "a/b.c", "a_": "a_"}
    if os.name == "nt":
        fine.pop("a: b")
    assert mlflow_keys(fine) == fine
    keys = ["a%", "a@", "a_", "vel[x]", "/a//b/../c", "", "x" * 300, "x" * 301]
    names = mlflow_keys(keys)
    assert names["a_"] == "a_"
    assert names["a%"] == "a__2"
    assert names["a@"] == "a__3"
    assert names["vel[x]"] == "vel_x_"
    assert names["/a//b/../c"] == "_/a/_/b/_/c"
    assert len(set(names.values())) == len(keys)
    assert max(map(len, names.values())) < 190
    long = "y" * 180
    assert mlflow_keys([long]) == {long: long}


@pytest.fixture
def tracked(run: RunDirectory) -> RunDirectory:
    """A finished run of 700 steps that TensorBoard shows."""
    run.manifest.track = ("tensorboard",)
    run.manifest.stages = [stage_entry("land", steps=500), stage_entry("selector", steps=200)]
    return run


def test_a_saved_evaluation_draws_what_each_skill_did(tracked: RunDirectory) -> None:
    from skillweave.training.evaluation import Evaluation
    from skillweave.training.evaluation_file import save_evaluation
    from skillweave.training.skill_report import SkillReport

    land = SkillReport(steps=30, calls=10, succeeded=4, ended={}, return_sum=None)
    hover = SkillReport(steps=10, calls=2, succeeded=None, ended={}, return_sum=None)
    for returns in ((1.0, 1.0), (1.0, 2.0)):  # the later one takes the place of the first
        found = Evaluation(returns, (20, 20), None, {"land": land, "hover": hover})
        save_evaluation(tracked, found, 0, True)
    events = events_in(tracked.path / "tensorboard/evaluation")
    shown = {}
    for tag in events.Tags()["scalars"]:
        (point,) = events.Scalars(tag)
        assert point.step == 700
        shown[tag.removeprefix("evaluation/")] = point.value
    assert shown == {
        "return_mean": 1.5, "usage/land": 0.75, "usage/hover": 0.25, "call_length/land": 3.0,
        "call_length/hover": 5.0, "success/land": pytest.approx(0.4),
    }  # fmt: skip


def gif(path: Path) -> Path:
    """A GIF of one frame of 3 by 2 pixels, as far as its header says."""
    path.write_bytes(b"GIF89a\x03\x00\x02\x00\xf0\x00\x00;")
    return path


def test_tensorboard_shows_a_film(tracked: RunDirectory) -> None:
    film = gif(tracked.path / "hierarchy.gif")
    track_film(tracked, film)
    track_film(tracked, tracked.path / "other.mp4")  # it cannot show those, and says nothing
    events = events_in(tracked.path / "tensorboard/film")
    assert events.Tags()["images"] == ["hierarchy"]
    (image,) = events.Images("hierarchy")
    assert (image.step, image.width, image.height) == (700, 3, 2)
    assert image.encoded_image_string == film.read_bytes()


def test_a_film_in_the_run_itself_goes_to_its_trackers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import skillweave.api as module
    from skillweave import PPO, Network, train_agent

    small = PPO(num_envs=2, n_steps=8, batch_size=16, network=Network((4,)))
    trained = train_agent("CartPole-v1", small, 16, tmp_path / "run", quiet=True)
    monkeypatch.setattr(module, "render_policy", lambda *given, **how: {"path": given[2]})
    sent: list[Path] = []
    monkeypatch.setattr(module, "track_film", lambda run, path: sent.append(path))
    trained.render(tmp_path / "elsewhere.gif")
    trained.render(tmp_path / "run" / "agent.gif")
    assert sent == [tmp_path / "run" / "agent.gif"]


OFFLINE = """
import sys
from pathlib import Path
from skillweave import PPO, Agent
from skillweave.hierarchy import training
from skillweave.runs.directory import RunDirectory
from skillweave.runs.trackers import make_trackers

manifest = training.manifest(Agent("CartPole-v1", PPO(), 1000), seed=0)
run = RunDirectory.create(Path(sys.argv[1]), manifest)
(tracker,) = make_trackers(("wandb",), run)
tracker.stage("landing", 1000)
tracker.tick("landing", 128, 0.5, {"return": 1.5})
tracker.done("landing", 128, 0.5, {"return": 1.5})
film = run.path / "agent.gif"
film.write_bytes(b"GIF89a\\x03\\x00\\x02\\x00\\xf0\\x00\\x00;")
tracker.film(film, 128)
tracker.close()
"""


@pytest.mark.slow
def test_wandb_without_a_login_works_offline_and_asks_for_nothing(tmp_path: Path) -> None:
    if importlib.util.find_spec("wandb") is None:
        pytest.skip("wandb is not installed")
    env = {k: v for k, v in os.environ.items() if not k.startswith("WANDB") and k != "NETRC"}
    home = tmp_path / "home"
    home.mkdir()
    nowhere = "http://127.0.0.1:9"  # a port at which nothing listens: no network
    env |= {"HOME": str(home), "WANDB_BASE_URL": nowhere}
    env |= {"HTTPS_PROXY": nowhere, "HTTP_PROXY": nowhere}
    done = subprocess.run(
        [sys.executable, "-c", OFFLINE, str(tmp_path / "run")],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=env,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    assert "log" not in done.stderr.lower(), "it talks of a login"
    written = list((tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb"))
    assert len(written) == 1
    assert b"landing/return" in written[0].read_bytes()
    (film,) = (tmp_path / "run" / "wandb").glob("offline-run-*/files/media/videos/**/*.gif")
    assert film.read_bytes().startswith(b"GIF89a")


BESIDE = """
import sys
import wandb
from skillweave import PPO, Network, train_agent

small = PPO(num_envs=2, n_steps=8, batch_size=16, network=Network((4,)))
mine = wandb.init(project="mine", name="mine", config={"lr": 1}, dir=sys.argv[1])
mine.log({"x": 1}, step=1)
for steps in (32, 64):  # the second time, the run's folder has the links of W&B
    train_agent("CartPole-v1", small, steps, sys.argv[2], track=["wandb"], resume=True, quiet=True)
mine.log({"x": 2}, step=2)
wandb.log({"x": 3}, step=3)
assert wandb.run is mine
assert (mine.name, mine.project, dict(mine.config)) == ("mine", "mine", {"lr": 1})
assert mine.step == 3
assert not any("agent" in key for key in dict(mine.summary))
mine.finish()
"""


@pytest.mark.slow
def test_a_training_beside_a_run_of_wandb_is_continued_in_a_run_of_its_own(tmp_path: Path) -> None:
    if importlib.util.find_spec("wandb") is None:
        pytest.skip("wandb is not installed")
    (tmp_path / "mine").mkdir()
    line = [
        sys.executable,
        "-W",
        "ignore",
        "-c",
        BESIDE,
        str(tmp_path / "mine"),
        str(tmp_path / "r"),
    ]
    env = os.environ | {"WANDB_MODE": "offline", "WANDB_SILENT": "true"}
    done = subprocess.run(line, capture_output=True, text=True, env=env, check=False)
    assert done.returncode == 0, done.stderr
    written = [p.name for p in (tmp_path / "r" / "wandb").glob("offline-run-*/*.wandb")]
    assert len(written) == 2
    assert len(set(written)) == 1  # W&B's file is named after the run's id


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_mlflow_goes_on_in_the_same_run_and_shows_each_step_once(
    run: RunDirectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow")
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.chdir(tmp_path)
    run.manifest.track = ("mlflow",)
    stage = stage_entry("landing", "training", steps=300)
    stage.algorithm["gamma"] = 0.9
    run.manifest.stages = [stage]
    (killed,) = make_trackers(("mlflow",), run)
    for steps in (100, 200, 300):
        killed.tick("landing", steps, 1.0, {"return": steps / 100})
    killed.close()
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("skillweave").experiment_id
    assert [r.info.status for r in client.search_runs([experiment])] == ["KILLED"]
    stage.status = "done"
    (resumed,) = make_trackers(("mlflow",), run)
    for steps in (200, 300, 400):  # the latest checkpoint was of step 100
        resumed.tick("landing", steps, 1.0, {"return": steps / 100})
    resumed.close()
    with trackers_of(run) as (later,):
        later.tick("evaluation", 400, 0.0, {"usage/land": 0.5})
        later.film(gif(run.path / "agent.gif"), 400)
    (found,) = client.search_runs([experiment])
    points = client.get_metric_history(found.info.run_id, "landing/return")
    assert [(p.step, p.value) for p in points] == [(100, 1), (200, 2), (300, 3), (400, 4)]
    assert found.data.metrics["evaluation/usage/land"] == 0.5
    assert found.data.params["landing.gamma"] == "0.9"
    assert (found.info.run_name, found.info.status) == ("run", "FINISHED")
    (film,) = client.list_artifacts(found.info.run_id, "films/400")
    assert film.path == "films/400/agent.gif"
    content = small_manifest()
    make_trackers(("mlflow",), RunDirectory.create(tmp_path / "other", content))[0].close()
    assert len(client.search_runs([experiment])) == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_all_metrics_are_in_mlflow_where_it_refuses_a_name(
    run: RunDirectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow")
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.chdir(tmp_path)
    keys = ("plain", "vel[x]", "vel(x)", "x" * 300, "../up")
    run.manifest.log_info = keys
    deep = "/".join(["a" * 64] * 5)
    run.manifest.stages = [stage_entry(deep, "training", steps=300)]
    run.manifest.stages[0].algorithm["gamma"] = 0.9
    with pytest.warns(UserWarning, match=r"'vel\[x\]' is 'vel_x_', 'vel\(x\)' is 'vel_x__2'"):
        (tracker,) = make_trackers(("mlflow",), run)
    values = {f"info/{key}": float(i) for i, key in enumerate(keys)}
    tracker.tick(deep, 100, 1.0, values)
    tracker.tick("landing", 100, 1.0, values | {"nan": float("nan"), "inf": float("inf")})
    tracker.close()
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("skillweave").experiment_id
    (found,) = client.search_runs([experiment])
    metrics = found.data.metrics
    assert metrics["landing/info/vel_x_"] == 1
    assert metrics["landing/info/vel_x__2"] == 2
    assert metrics["landing/info/_/up"] == 4
    assert len(metrics) == 6 + 8


@pytest.mark.slow
def test_where_mlflow_does_not_answer_it_is_said_before_training(
    run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    with pytest.raises(SkillweaveError, match=r"http://127.0.0.1:9 does not answer.*TRACKING_URI"):
        make_trackers(("mlflow",), run)
