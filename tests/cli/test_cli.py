"""Every command: what it prints, what it writes, how it fails, and that a run runs no code."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
from cli.plain_recipe import PLAIN
from small_runs import interrupt_at_checkpoint

from skillweave import recipes
from skillweave.cli import main
from skillweave.errors import DeclarationError
from skillweave.runs.files import read_json, read_tensors, write_json, write_tensors

COMMANDS = ("train", "resume", "evaluate", "render", "plot", "report", "compare", "list", "info")
COMMANDS += ("sweep", "weights", "export", "import-agilerl", "log", "plan")


# The same hierarchy with a reflex, which only code can say.
CATCH = '    reflexes=[Reflex(lambda obs: obs[:, 2] > 0.1, action=1, name="catch")],\n'
CODED = PLAIN.replace("    algorithm=small", CATCH + "    algorithm=small")
QUIET = ("--evaluate", 0, "--quiet")
KEYS = {"episodes", "mean", "std", "ci95", "iqm", "solved_fraction", "length_mean", "skill_usage"}


@dataclass
class Answer:
    """What a command answered."""

    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The one JSON object that standard output must be."""
        assert self.out.endswith("}\n")
        assert self.out.count("\n") == 1
        found: dict[str, Any] = json.loads(self.out)
        return found


Call = Callable[..., Answer]


def run_main(*arguments: object) -> int:
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)


@pytest.fixture
def call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Call:
    """Runs a command in an empty directory, in this process, and checks its exit code."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def call(*arguments: object, code: int = 0) -> Answer:
        capsys.readouterr()
        ended = run_main(*arguments)
        out, err = capsys.readouterr()
        assert ended == code, err
        return Answer(out, err)

    return call


@dataclass
class Trained:
    """Recipes and the runs trained from them."""

    plain: Path
    coded: Path
    plain_run: Path
    coded_run: Path
    flat_run: Path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    folder = tmp_path_factory.mktemp("trained")
    (folder / "plain.py").write_text(PLAIN)
    (folder / "coded.py").write_text(CODED)
    names = "plain.py", "coded.py", "plain-run", "coded-run", "flat-run"
    found = Trained(*(folder / name for name in names))
    assert run_main("train", found.plain, "-o", found.plain_run, *QUIET) == 0
    assert run_main("train", found.coded, "-o", found.coded_run, *QUIET) == 0
    assert run_main("train", found.coded, "-o", found.flat_run, "--flat", *QUIET) == 0
    return found


def copy_of(run: Path, folder: Path) -> Path:
    """A copy of a run, without its evaluations."""
    ignored = shutil.ignore_patterns("evaluation*.json")
    return shutil.copytree(run, folder / "run", ignore=ignored)


def score(call: Call, *arguments: object) -> dict[str, Any]:
    answer = call("evaluate", *arguments, "--episodes", 4, "--json")
    return {k: v for k, v in answer.json.items() if k != "target"}


# Help


def test_help_lists_every_command_and_each_has_its_own(call: Call) -> None:
    listed = call("--help").out.split("subcommands")[1]
    for command in COMMANDS:
        assert f"• {command} " in listed
        answer = call(command, "--help")
        assert f"usage: skillweave {command}" in answer.out
        assert "--json" in answer.out


def test_no_arguments_mean_no_arguments_whatever_the_process_was_called_with(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["pytest", "list"])
    answer = call(code=2)
    assert "recipes:" not in answer.out


# train


def test_train_prints_one_json_object_or_a_few_lines_and_tells_progress_on_stderr(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    common = ("train", trained.plain, "--evaluate", 2, "--scale", 0.25, "-o")
    answer = call(*common, tmp_path / "run", "--json")
    assert answer.json["run"] == str(tmp_path / "run")
    assert [p["name"] for p in answer.json["stages"]] == ["left", "balance", "selector"]
    assert all(p["status"] == "done" for p in answer.json["stages"])
    assert set(answer.json["evaluation"]) >= KEYS
    assert "left (1 of 3): training for 64 steps" in answer.err
    answer = call(*common, tmp_path / "other")
    assert answer.out.startswith("trained 2")
    assert "over 2 episodes" in answer.out
    assert f"run     {tmp_path / 'other'}" in answer.out


def test_train_without_a_directory_takes_a_free_one_under_runs(
    call: Call, trained: Trained
) -> None:
    names = []
    for more in ((), (), ("--seed", 5, "--flat")):
        answer = call("train", trained.plain, *QUIET, "--json", "--scale", 0.1, *more)
        assert answer.err == "", "it is quiet"
        names.append(answer.json["run"])
    assert names == ["runs/plain-1", "runs/plain-2", "runs/plain-flat-1"]
    assert all((Path(name) / "run.json").exists() for name in names)


def test_train_into_an_existing_run_refuses_and_changes_nothing(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    before = {p: p.read_bytes() for p in run.rglob("*.*")}
    answer = call("train", trained.plain, "-o", run, "--seed", 9, code=1)
    assert answer.out == ""
    assert f"error: {run} holds a finished run" in answer.err
    assert f"skillweave resume {run}" in answer.err
    assert {p: p.read_bytes() for p in run.rglob("*.*")} == before


def test_scale_and_set_change_budgets_and_settings(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    answer = call(
        "train", trained.plain, "-o", tmp_path / "run", "--scale", 0.5, *QUIET, "--json",
        "--set", "skills.left.steps=130", "--set", "selector.gamma=0.9",
    )  # fmt: skip
    left, balance, selector = answer.json["stages"]
    assert (left["budget"], balance["budget"], selector["budget"]) == (65, 128, 256)
    assert selector["algorithm"]["gamma"] == 0.9
    assert left["algorithm"]["gamma"] == 0.995
    # A minibatch of 400 does not fit into the recipe's rollout of 4·16 steps: any order will do.
    settings = ["selector.num_envs=20", "selector.n_steps=20", "selector.batch_size=400"]
    for number, order in enumerate((settings, settings[::-1])):
        flags = [part for setting in order for part in ("--set", setting)]
        path = tmp_path / f"run{number}"
        call("train", trained.plain, "-o", path, *flags, *QUIET, "--json", "--scale", 0.1)


@pytest.fixture
def unshared_recipe() -> Iterator[None]:
    """Whatever a test does to the shipped recipe is not seen by other tests."""
    name = "skillweave.recipes.lunar_lander"
    before = sys.modules.pop(name, None)
    yield
    sys.modules.pop(name, None)
    if before is not None:
        sys.modules[name] = before


@pytest.mark.slow
@pytest.mark.usefixtures("unshared_recipe")
def test_training_a_shipped_recipe_twice_in_one_process_scales_it_once(
    call: Call, tmp_path: Path
) -> None:
    before = recipes.load("lunar-lander").total_steps
    budgets = ("apart.skill_steps=100", "skills.landing.steps=100", "apart.selector_steps=100")
    budgets += ("together.steps=100",)
    small = (*(part for b in budgets for part in ("--set", b)), "--scale", 0.5)
    owners = ("algorithm", "skills.landing", "selector")
    tiny = [f"{o}.{k}" for o in owners for k in ("batch_size=4", "n_steps=2", "num_envs=2")]
    sets = [part for setting in tiny for part in ("--set", setting)]
    for number in range(2):
        path = tmp_path / f"run{number}"
        answer = call("train", "lunar-lander", "-o", path, *small, *sets, *QUIET, "--json")
        assert {p["budget"] for p in answer.json["stages"]} == {50}
    assert recipes.load("lunar-lander").total_steps == before


# evaluate, render, weights


def test_evaluate_tells_people_a_line_and_programs_every_number(
    call: Call, trained: Trained
) -> None:
    answer = call("evaluate", trained.plain_run, "--episodes", 4)
    line, head, left, balance = answer.out.splitlines()
    assert "over 4 episodes" in line
    assert head.split() == [
        "skill", "share", "calls", "length", "own", "limit", "interrupted", "episode", "success",
        "return",
    ]  # fmt: skip
    assert (left.split()[0], balance.split()[0]) == ("left", "balance")
    assert len({len(row) for row in (head, left, balance)}) == 1, "aligned"
    found = call("evaluate", trained.plain_run, "--episodes", 4, "--json").json
    assert set(found) >= KEYS | {"target", "env", "seed", "deterministic", "skill"}
    assert found["episodes"] == 4
    assert found["env"] == "CartPole-v1"
    assert set(found["skill_usage"]) == {"left", "balance"}
    assert sum(found["skill_usage"].values()) == pytest.approx(1.0)
    assert found["ci95"][0] <= found["mean"] <= found["ci95"][1]
    assert found["mean"] == found["length_mean"]  # CartPole pays 1 a step
    assert f"{found['mean']:.1f}" in answer.out


def test_the_same_seed_gives_the_same_score_and_another_seed_another(
    call: Call, trained: Trained
) -> None:
    run = trained.plain_run
    one = score(call, run, "--seed", 3)
    assert score(call, run, "--seed", 3) == one
    assert score(call, run, "--seed", 4)["mean"] != one["mean"]
    alone = score(call, run, "--skill", "left")
    assert (alone["skill"], alone["skill_usage"]) == ("left", {})


@pytest.mark.parametrize("flag", ["--no-deterministic", "--stochastic"])
def test_sampling_differs_from_acting_greedily_and_can_be_repeated(
    call: Call, trained: Trained, flag: str
) -> None:
    greedy = score(call, trained.flat_run)
    sampled = score(call, trained.flat_run, flag)
    assert sampled["deterministic"] is False
    assert sampled["mean"] != greedy["mean"]
    assert score(call, trained.flat_run, flag) == sampled


def test_a_weights_file_scores_as_the_run_it_was_written_from(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    recipe = ("--recipe", trained.coded)
    path = tmp_path / "w.safetensors"
    answer = call("weights", trained.coded_run, *recipe, "-o", path, "--json")
    assert answer.json == {"path": str(path), "bytes": path.stat().st_size}
    assert score(call, path, *recipe) == score(call, trained.coded_run, *recipe)


def test_render_writes_a_film_and_says_what_is_in_it(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    pytest.importorskip("pygame")
    path = tmp_path / "film.gif"
    answer = call("render", trained.plain_run, "-o", path, "--json")
    assert answer.json["path"] == str(path)
    assert path.read_bytes()[:4] == b"GIF8"
    assert answer.json["frames"] >= len(answer.json["episodes"]) == 1


# resume, info, list


def test_resuming_a_finished_run_scores_it_and_trains_no_more(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = copy_of(trained.coded_run, tmp_path)
    arguments = ("--recipe", trained.coded, "--evaluate", 2, "--json")
    answer = call("resume", run, *arguments)
    assert answer.json["evaluation"]["episodes"] == 2
    assert answer.json["stages"] == json.loads((run / "run.json").read_text())["stages"]


def test_info_of_a_run_shows_its_stages_and_what_made_it(call: Call, trained: Trained) -> None:
    answer = call("info", trained.coded_run)
    assert "hierarchy on CartPole-v1, seed 0" in answer.out
    assert f"recipe: {trained.coded}" in answer.out
    assert all(name in answer.out for name in ("left", "balance", "selector", "torch"))
    found = call("info", trained.coded_run, "--json").json
    found.pop("evaluation", None)
    recorded = read_json(trained.coded_run / "run.json")
    assert found == {k: v for k, v in recorded.items() if k not in ("schema", "sha256")}


def test_calls_are_logged_shown_and_planned_on(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = copy_of(trained.coded_run, tmp_path)
    recipe = tmp_path / "words.py"
    tilted = "    predicates={'tilted': lambda obs: abs(obs[:, 2]) > 0.1},\n    algorithm=small"
    recipe.write_text(CODED.replace("    algorithm=small", tilted))
    assert "after" not in call("info", run).out
    assert "is 'tilted' meant?" in call("plan", run, "tilt", "--recipe", recipe, code=1).err
    assert not (run / "calls.safetensors").exists(), "an unknown word is named before recording"
    answer = call("log", run, "--recipe", recipe, "--steps", 300)
    assert "recorded " in answer.out
    assert "A call is done if it ended" in answer.out or "No success() is known" in answer.out
    more = call("log", run, "--recipe", recipe, "--steps", 300, "--choose", "explore", "--json")
    assert more.json["steps"] >= 600 > more.json["recorded"]["steps"]
    assert more.json["handover"]["skills"] == ["left", "balance"]
    shown = call("info", run)
    assert shown.out.splitlines()[-1].strip().startswith("No success()") or "elsewhere" in shown.out
    assert call("info", run, "--json").json["handover"] == more.json["handover"]
    planned = call("plan", run, "tilted", "--recipe", recipe, "--episodes", 3, "--json")
    assert (planned.json["mission"], planned.json["episodes"]) == ("tilted", 3)
    assert planned.json["success_rate"] == 1.0
    film = call(
        "plan", run, "tilted", "--recipe", recipe, "--episodes", 1, "-o", tmp_path / "f.gif"
    )
    assert "f.gif: " in film.out
    (run / "calls.safetensors").write_bytes(b"damaged")
    assert "log of calls: " in call("info", run).out
    assert "error" in call("info", run, "--json").json["handover"]


def test_a_plan_without_a_log_records_one(call: Call, trained: Trained, tmp_path: Path) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    recipe = tmp_path / "words.py"
    far = "    predicates={'far': lambda obs: abs(obs[:, 0]) > 0.05},\n    algorithm=small"
    recipe.write_text(PLAIN.replace("    algorithm=small", far))
    arguments = ("--recipe", recipe, "--episodes", 2, "--steps", 400)
    answer = call("plan", run, "far", *arguments)
    assert "recording 400 steps" in answer.err
    assert "recording" not in call("plan", run, "far", *arguments).err
    assert "without the code of its skills" in call("log", run, "--steps", 50).err
    call("log", trained.flat_run, "--recipe", trained.coded, code=1)


PICTURES = """
import gymnasium as gym
import numpy as np
import skillweave as sw


class Line(gym.Env):
    observation_space = gym.spaces.Box(0, 255, (8, 8, 1), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.x = 0, int(self.np_random.integers(3, 6))
        return self.picture(), {}

    def step(self, action):
        self.t, self.x = self.t + 1, min(7, max(0, self.x + 2 * int(action) - 1))
        return self.picture(), 0.0, False, self.t >= 20, {}

    def picture(self):
        picture = np.zeros((8, 8, 1), np.uint8)
        picture[:, self.x] = 255
        return picture


class Left(sw.Skill):
    max_steps = 2

    def policy(self, obs):
        return np.zeros(len(obs), np.int64)


class Right(Left):
    def policy(self, obs):
        return np.ones(len(obs), np.int64)


hierarchy = sw.Hierarchy(
    sw.EnvSpec(Line, engine="sync"),
    [Left(), Right()],
    selector=lambda obs: ["left"] * len(obs),
    predicates={"end": lambda obs: obs[:, 0, 7, 0] > 0},
)
"""


def test_a_world_of_images_is_planned_by_declared_features(call: Call, tmp_path: Path) -> None:
    (tmp_path / "blind.py").write_text(PICTURES)
    seeing = PICTURES.replace(
        "    predicates", "    features=lambda o: o[:, 0, :, 0].argmax(1),\n    predicates"
    )
    (tmp_path / "seeing.py").write_text(seeing)
    run = tmp_path / "run"
    call("train", tmp_path / "blind.py", "-o", run, "--evaluate", 0)
    assert "features" in call("plan", run, "end", "--recipe", tmp_path / "blind.py", code=1).err
    assert not (run / "calls.safetensors").exists(), "they are missed before recording"
    with pytest.warns(UserWarning, match="features"):
        call("log", run, "--recipe", tmp_path / "blind.py", "--steps", 400)
    arguments = ("--recipe", tmp_path / "seeing.py", "--episodes", 5, "--json")
    planned = call("plan", run, "end", *arguments)
    assert planned.json["success_rate"] == 1.0


def test_info_tells_the_latest_evaluation_as_evaluate_did(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    assert "evaluation" not in call("info", run, "--json").json
    call("evaluate", run, "--episodes", 2)
    arguments = ("evaluate", run, "--recipe", trained.plain, "--episodes", 3, "--seed", 2)
    people, told = call(*arguments).out, call(*arguments, "--json").json
    call("evaluate", run, "--skill", "left", "--episodes", 2)  # is no score of the whole
    lines = [line.strip() for line in call("info", run).out.splitlines()]
    assert lines[-len(people.splitlines()) :] == [line.strip() for line in people.splitlines()]
    assert any(x.startswith("evaluated 20") and "seed 2, greedy" in x for x in lines)
    kept = call("info", run, "--json").json["evaluation"]
    assert kept.pop("made").startswith("20")
    assert kept == {k: v for k, v in told.items() if k not in ("target", "env", "skill")}
    # One with sampled actions is kept beside the score.
    file = read_json(run / "evaluation.json")
    call("evaluate", run, "--episodes", 2, "--stochastic")
    assert read_json(run / "evaluation.json") == file
    both = call("info", run, "--json").json
    assert (both["evaluation"]["episodes"], both["evaluation_sampled"]["episodes"]) == (3, 2)
    text = call("info", run).out
    assert "seed 2, greedy:" in text
    assert "seed 0, sampled:" in text


def test_an_evaluation_that_cannot_be_kept_is_told_all_the_same(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    (run / "evaluation.json").mkdir()  # so that no file can have that name
    answer = call("evaluate", run, "--episodes", 2, "--json")
    assert answer.json["episodes"] == 2
    assert "the evaluation is not kept in the run: could not write" in answer.err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"run": "another"}, "belongs to another run"),
        ({"seed": -1}, "seed is -1"),
        ({"evaluation": {"returns": [1.0]}}, "has no field 'lengths'"),
        (
            {"evaluation": {"returns": [1.0], "lengths": [], "threshold": None}},
            "1 returns and 0 lengths",
        ),
    ],
)
def test_a_wrong_evaluation_file_is_told_by_file_and_field(
    call: Call, trained: Trained, tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    call("evaluate", run, "--episodes", 2)
    file = run / "evaluation.json"
    write_json(file, read_json(file) | change)
    answer = call("info", run, code=1)
    assert answer.out == ""
    assert says in answer.err
    assert "evaluation.json" in answer.err


def test_a_python_user_may_keep_an_evaluation_too(trained: Trained, tmp_path: Path) -> None:
    run = copy_of(trained.plain_run, tmp_path)
    loaded = recipes.load(trained.plain).load(run)
    loaded.evaluate(2)
    assert "evaluation" not in loaded.info()
    found = loaded.evaluate(2, save=True)
    assert loaded.info()["evaluation"].items() >= found.to_json().items()
    for how in ({"skill": "left"}, {"engine": "auto"}):
        with pytest.raises(DeclarationError, match="leave out skill and engine"):
            loaded.evaluate(2, save=True, **how)


def test_info_of_a_recipe_shows_settings_that_can_be_set(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    found = call("info", trained.plain, "--json").json
    settings = found["settings"]
    assert settings["apart.selector_steps"] == 512
    assert settings["skills.left.steps"] == 256
    assert settings["selector.network.hidden"] == [8]
    lines = call("info", trained.plain).out.splitlines()
    assert {line.split("=")[0] for line in lines} == set(settings)
    flags = [part for line in lines for part in ("--set", line)]
    call("train", trained.plain, "-o", tmp_path / "run", *flags, *QUIET, "--scale", 0.1)


def test_list_shows_recipes_and_the_runs_here_even_a_damaged_one(
    call: Call, trained: Trained
) -> None:
    shutil.copytree(trained.flat_run, "runs/flat")
    for name, text in (("bad", "{"), ("poor", '{"schema": 1, "seed": 0, "stages": [], "env": ""}')):
        Path("runs", name).mkdir()
        Path("runs", name, "run.json").write_text(text)
    answer = call("list", "--json")
    assert [r["name"] for r in answer.json["recipes"]] == recipes.names()
    runs = {r["path"]: r["status"] for r in answer.json["runs"]}
    assert runs["runs/flat"] == "finished"
    assert "damaged" in runs["runs/bad"]
    assert "damaged" in runs["runs/poor"]
    people = call("list").out
    assert "lunar-lander" in people
    assert "runs/flat" in people


# Mistakes

MISTAKES: dict[str, tuple[list[str], int, list[str]]] = {
    "recipe": (["train", "lunar-landr"], 1, ["'lunar-landr'", "is 'lunar-lander' meant?"]),
    "recipe file": (["train", "nowhere.py"], 1, ["'nowhere.py'", "lunar-lander"]),
    "setting": (["train", "PLAIN", "--set", "selector.gama=0.9"], 1, ["selector.gamma"]),
    "setting alone": (["train", "PLAIN", "--set", "gamma=0.9"], 1, ["skills.left.gamma"]),
    "rate alone": (["train", "PLAIN", "--set", "lr=1"], 1, ["selector.learning_rate"]),
    "plain setting": (["train", "PLAIN", "--set", "call_step=9"], 1, ["call_steps"]),
    "skill's setting": (["train", "PLAIN", "--set", "skills.lef.steps=9"], 1, ["'lef'", "left"]),
    "no value": (["train", "PLAIN", "--set", "call_steps"], 1, ["name=value"]),
    "value's type": (
        ["train", "PLAIN", "--set", "call_steps=few"],
        1,
        ["call_steps=few", "a whole number"],
    ),
    "value's range": (["train", "PLAIN", "--set", "selector.gamma=2"], 1, ["gamma", "0 and 1"]),
    "scale": (["train", "PLAIN", "--scale", "0"], 1, ["scale", "positive"]),
    "seed": (["train", "PLAIN", "--seed", "-1"], 1, ["seed", "-1"]),
    "seed of episodes": (["evaluate", "RUN", "--seed", "-1"], 1, ["seed", "-1"]),
    "episodes": (["evaluate", "RUN", "--episodes", "0"], 1, ["episodes", "at least 1"]),
    "final episodes": (["train", "PLAIN", "--evaluate", "-1"], 1, ["evaluate", "-1"]),
    "skill": (["evaluate", "RUN", "--skill", "lift"], 1, ["'lift'", "is 'left' meant?"]),
    "flat skill": (["evaluate", "FLAT", "--skill", "left"], 1, ["plain agent"]),
    "target": (["evaluate", "nothing"], 1, ["nothing is neither a run nor a weights file"]),
    "target is a recipe": (["evaluate", "lunar-lander"], 1, ["--pretrained"]),
    "no run": (["info", "."], 1, ["holds no run"]),
    "resume nothing": (["resume", "nothing"], 1, ["holds no run"]),
    "command": (["trian", "lunar-lander"], 2, ["trian", "train"]),
    "option": (["train", "PLAIN", "--sed", "3"], 2, ["--sed", "--seed"]),
    "option's type": (["train", "PLAIN", "--seed", "three"], 2, ["--seed", "three"]),
    "tracker": (["train", "PLAIN", "--track", "wandbee"], 2, ["wandbee", "wandb"]),
    "environment": (["train", "CartPole-v1"], 1, ["is an environment", "sw.Hierarchy("]),
    "environment's policy": (["evaluate", "ALE/Pong-v5"], 1, ["an environment", "FILE.py"]),
    "settings' file": (["train", "config.yaml"], 1, ["--set NAME=VALUE"]),
    "steps": (["train", "PLAIN", "--total-timesteps", "9"], 2, ["--set steps=N"]),
    "steps with =": (["train", "PLAIN", "--total_timesteps=9"], 2, ["--set steps=N"]),
    "device": (["train", "PLAIN", "--device", "cuda"], 2, ["--set selector.device=VALUE"]),
    "environments": (["train", "PLAIN", "--n-envs", "4"], 2, ["--set selector.num_envs=VALUE"]),
    "rate": (["train", "PLAIN", "--lr", "1"], 2, ["--set selector.learning_rate=VALUE"]),
    "seeds": (["train", "PLAIN", "--seeds", "1"], 2, ["skillweave sweep RECIPE --seeds 0:5"]),
    "env": (["train", "--env", "CartPole-v1"], 2, ["skillweave train FILE.py"]),
    "enjoy": (["enjoy", "RUN"], 2, ["no command 'enjoy': write evaluate"]),
    "version": (["version"], 2, ["skillweave --version"]),
    "long name": (["evaluate", "a" * 300], 1, ["target is", "too long"]),
    "long names": (["compare", "a" * 300, "b"], 1, ["runs is", "too long"]),
    "long recipe": (["info", "a" * 300], 1, ["target is", "too long"]),
    "nothing to train": (["train"], 2, ["Missing", "A shipped recipe"]),
    "no hierarchy": (["train", __file__], 1, ["defines no Hierarchy"]),
    "flat against flat": (["train", "PLAIN", "--versus-flat", "--flat"], 1, ["leave out"]),
    "no score": (["train", "PLAIN", "--versus-flat", "--evaluate", "0"], 1, ["at least 1"]),
    "report of no run": (["report", "."], 1, [". holds no run"]),
    "comparison of no run": (["compare", "."], 1, [". holds no run"]),
    "demo in a folder": (["demo", "--out", "."], 1, [". exists already: choose another folder"]),
}


def test_settings_that_are_options_elsewhere_exist_here() -> None:
    from skillweave import DQN, PPO, SAC, TD3
    from skillweave.cli.elsewhere import OPTIONS, SAME, SETTINGS

    known = {field.name for kind in (PPO, DQN, SAC, TD3) for field in fields(kind)}
    assert set(SETTINGS) <= known
    assert set(SAME.values()) <= set(OPTIONS)


def test_what_a_message_says_to_write_instead_works(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    words = (
        "--set",
        "steps=512",
        "--set",
        "selector.num_envs=2",
        "--set",
        "skills.left.num_envs=2",
    )
    words += ("--set", "selector.device=cpu", "--set", "skills.left.device=cpu")
    words += ("--set", "selector.learning_rate=0.01", "--set", "train.eval_every=256")
    words += ("--set", "train.eval_episodes=1")
    answer = call("train", trained.plain, "-o", tmp_path / "run", *words, *QUIET, "--json")
    assert 500 <= sum(stage["steps"] for stage in answer.json["stages"]) <= 700
    (tmp_path / "three.py").write_text(
        "import skillweave as sw\n"
        "class Move(sw.Skill): max_steps = 20\n"
        'hierarchy = sw.Hierarchy("CartPole-v1", [Move()], steps=100_000)\n'
    )
    call("train", tmp_path / "three.py", "-o", tmp_path / "three", "--scale", 0.01, *QUIET)


@pytest.mark.parametrize(("arguments", "code", "said"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_explained_on_stderr_and_writes_nothing(
    call: Call, trained: Trained, arguments: list[str], code: int, said: list[str]
) -> None:
    names = {"PLAIN": trained.plain, "RUN": trained.plain_run, "FLAT": trained.flat_run}
    answer = call(*[names.get(a, a) for a in arguments], code=code)
    assert answer.out == ""
    assert all(part in answer.err for part in said), answer.err
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(
    "line",
    ["hierarchy.train('inner', quiet=True)", "train_agent('CartPole-v1', small, 64, 'inner')"],
)
def test_a_file_that_trains_as_soon_as_it_is_read_says_so(
    call: Call, tmp_path: Path, line: str
) -> None:
    file = tmp_path / "script.py"
    file.write_text(f"{PLAIN}\nfrom skillweave import train_agent\n{line}\n")
    answer = call("train", file, "-o", "run", code=1)
    assert f"{file} starts training on import" in " ".join(answer.err.split())
    assert "__main__" in answer.err
    assert not Path("inner").exists()
    assert not Path("run").exists()
    # The same lines in that block: the file is both a script and a recipe.
    file.write_text(f"{PLAIN}\nif __name__ == '__main__':\n    hierarchy.train('inner')\n")
    call("train", file, "-o", "run", "--scale", "0.2")
    assert not Path("inner").exists()


def test_a_file_that_resumes_a_run_as_soon_as_it_is_read_may_do_so_only_if_that_is_finished(
    call: Call, trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "script.py"
    file.write_text(PLAIN + "\nhierarchy.resume('run', quiet=True)\n")
    shutil.copytree(trained.plain_run, "run")
    call("info", file)
    shutil.rmtree("run")
    with monkeypatch.context() as patched:
        interrupt_at_checkpoint(patched, 1)
        call("train", trained.plain, "-o", "run", code=130)
    answer = call("info", file, code=1)
    assert "starts training on import" in " ".join(answer.err.split())


# A run never runs code


def test_a_run_of_a_users_file_is_not_loaded_without_pointing_to_the_file(
    call: Call, trained: Trained
) -> None:
    for command in ("evaluate", "render", "resume", "weights"):
        answer = call(command, trained.coded_run, code=1)
        assert "--recipe FILE.py" in answer.err
        assert str(trained.coded) in answer.err
    assert score(call, trained.coded_run, "--recipe", trained.coded)["episodes"] == 4


def test_a_run_that_needs_no_recipe_is_evaluated_without_one(call: Call, trained: Trained) -> None:
    assert score(call, trained.flat_run)["skill_usage"] == {}
    without = score(call, trained.plain_run)
    coded = score(call, trained.plain_run, "--recipe", trained.plain)
    returns = [x.pop("return_mean") for x in without["skills"].values()]
    assert returns == [None, None], "what the skills maximise is in the code alone"
    assert None not in [x.pop("return_mean") for x in coded["skills"].values()]
    assert without == coded


def test_a_flat_run_needs_nothing_of_the_skills_that_it_was_not_trained_with(
    call: Call, tmp_path: Path
) -> None:
    # Its skills stop by themselves, which only their code knows; the flat agent has no skills.
    recipe = tmp_path / "stops.py"
    text = PLAIN.replace("call_steps=5", "call_steps=None")
    stops = "    def termination(self, step):\n        return step.reward > 2\n"
    recipe.write_text(text.replace("    pass\n", stops))
    call("train", recipe, "-o", tmp_path / "run", "--flat", *QUIET)
    assert score(call, tmp_path / "run")["episodes"] == 4


TRAP = "from pathlib import Path\nPath({marker!r}).write_text('executed')\n"


def trap(run: Path, source: Path, recipe: str, **fields: Any) -> Path:
    """A copy of a run with code inside that its manifest names; returns the code's marker."""
    shutil.copytree(source, run)
    marker = run.parent / "executed"
    for place in (run / "trap.py", run / "policies" / "trap.py", run / "__init__.py"):
        place.write_text(TRAP.format(marker=str(marker)) + PLAIN)
    data = read_json(run / "run.json")
    data |= {"recipe": recipe, **fields}
    write_json(run / "run.json", data)  # with the checksum of what it says now
    return marker


@pytest.mark.fast_cases(5)
@pytest.mark.parametrize("recipe", ["RUN/trap.py", "trap.py", "trap", "./trap.py"])
@pytest.mark.parametrize("command", ["evaluate", "render", "resume", "weights", "info"])
def test_code_inside_a_run_is_never_executed(
    call: Call,
    trained: Trained,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    recipe: str,
    command: str,
) -> None:
    run = tmp_path / "run"
    marker = trap(run, trained.coded_run, recipe.replace("RUN", str(run)), needs_recipe=True)
    monkeypatch.chdir(run)
    monkeypatch.syspath_prepend(run)
    call(command, run, code=0 if command == "info" else 1)
    assert not marker.exists()


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("kind", ["hierarchy", "flat"])
@pytest.mark.parametrize("command", ["evaluate", "render", "resume"])
def test_an_environment_named_by_a_run_never_imports_code(
    call: Call,
    trained: Trained,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    command: str,
) -> None:
    run = tmp_path / "run"
    source = trained.flat_run if kind == "flat" else trained.plain_run
    marker = trap(run, source, "trap.py", env="trap:CartPole-v1", needs_recipe=False)
    monkeypatch.chdir(run)
    monkeypatch.syspath_prepend(run)
    call(command, run, code=1)
    assert not marker.exists()


def test_the_trap_would_spring(tmp_path: Path, trained: Trained) -> None:
    marker = trap(tmp_path / "run", trained.coded_run, "trap.py")
    recipes.load(str(tmp_path / "run" / "trap.py"))
    assert marker.exists()


def test_a_weights_file_that_names_code_is_refused(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    path = tmp_path / "w.safetensors"
    call("weights", trained.coded_run, "--recipe", trained.coded, "-o", path)
    tensors, header = read_tensors(path)
    marker = tmp_path / "executed"
    (tmp_path / "trap.py").write_text(TRAP.format(marker=str(marker)) + PLAIN)
    write_tensors(path, tensors, header | {"recipe": str(tmp_path / "trap.py")})
    answer = call("evaluate", path, code=1)
    assert "--recipe" in answer.err
    assert not marker.exists()


def test_an_error_is_one_line_and_its_traceback_is_shown_on_demand(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    sentence = "error: nowhere is neither a run nor a weights file\n"
    assert call("evaluate", "nowhere", code=1).err == sentence
    shown = call("evaluate", "nowhere", "--traceback", code=1).err
    assert shown.startswith("Traceback (most recent call last)")
    assert "execute.py" in shown
    assert shown.endswith(sentence)
    monkeypatch.setenv("SKILLWEAVE_TRACEBACK", "1")
    assert call("evaluate", "nowhere", code=1).err == shown
