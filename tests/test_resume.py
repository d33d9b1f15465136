"""An interrupted run, resumed, ends with the same weights, bit for bit, as an uninterrupted one."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_runs import (
    StopAt,
    Stopped,
    assert_same,
    lines,
    new_run,
    policies,
    reports_every,
    stopped_run,
)

from skillweave import Hierarchy, recipes
from skillweave.cli import main
from skillweave.cli.overrides import apply_overrides
from skillweave.hierarchy import training
from skillweave.hierarchy.roles import roles_of
from skillweave.runs.directory import RunDirectory
from skillweave.training.replay_learner import ReplayLearner

often = reports_every(75)
pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")  # EnvPool's CartPole

RECIPE = '''
"""A small hierarchy on CartPole with a piece of everything that could keep state."""
import numpy as np
from skillweave import (
    Apart, Network, PPO, EnvSpec, Hierarchy, Reflex, Selection, Skill, TrainDefaults,
)

class Left(Skill):
    max_steps = 15
    def reward(self, step):
        return -step.next_obs[:, 0] + 0.1 * step.timed_out

class Balance(Skill):
    def initiation(self, obs):
        return np.abs(obs[:, 2]) < 0.15
    def termination(self, step):
        return np.abs(step.next_obs[:, 0]) > 0.5

small = PPO(num_envs=4, n_steps=8, batch_size=16, update_epochs=2, network=Network(hidden=(8,)))
moving = PPO(
    num_envs=4, n_steps=8, batch_size=32, update_epochs=2, network=Network((6,)), overlap=False,
    normalize_obs=True, learning_rate_schedule="kl", target_kl=0.01, critic=Network(hidden=(5, 5)),
)
Left.algorithm = moving
hierarchy = Hierarchy(
    env=EnvSpec("CartPole-v1", engine="ENGINE", workers=1),
    skills=[Left(), Balance()],
    call_steps=6,
    reflexes=[Reflex(lambda obs: obs[:, 2] > 0.05, action=1, name="catch")],
    algorithm=small,
    selector=small,
    learn="apart",
    apart=Apart(skill_steps=300, selector_steps=750),
    train_defaults=TrainDefaults(checkpoint_every=75),
    selection=Selection(greedy_skills=False),
)
'''

ENGINES = ["sync", "envpool"]


def write_recipe(folder: Path, engine: str = "sync") -> Path:
    path = folder / f"{engine}.py"
    path.write_text(RECIPE.replace("ENGINE", engine))
    return path


Reference = Callable[[str], tuple[Path, Path]]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Reference:
    """An engine's recipe and an uninterrupted run of it, made once."""
    made: dict[str, tuple[Path, Path]] = {}

    def make(engine: str) -> tuple[Path, Path]:
        if engine == "envpool":
            pytest.importorskip("envpool")
        if engine not in made:
            folder = tmp_path_factory.mktemp(engine)
            recipe = write_recipe(folder, engine)
            recipes.load(str(recipe)).train(folder / "run", seed=3, quiet=True)
            made[engine] = recipe, folder / "run"
        return made[engine]

    return make


# Two uninterrupted runs


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("engine", ENGINES)
def test_the_same_seed_gives_the_same_files_byte_by_byte_and_another_seed_other_weights(
    tmp_path, reference, engine
):
    recipe, whole = reference(engine)
    recipes.load(str(recipe)).train(tmp_path / "again", seed=3, quiet=True)
    assert_same(tmp_path / "again", whole)
    for path in (whole / "policies").iterdir():
        assert (tmp_path / "again" / "policies" / path.name).read_bytes() == path.read_bytes()
    recipes.load(str(recipe)).train(tmp_path / "other", seed=4, quiet=True)
    mine, theirs = policies(tmp_path / "other"), policies(whole)
    assert all(mine[name][1] != theirs[name][1] for name in theirs)


def test_the_recipe_is_worth_interrupting(reference):
    _, whole = reference("sync")
    found = lines(whole)
    assert {r["stage"] for r in found} == {"left", "balance", "selector"}
    for stage in ("left", "balance", "selector"):
        steps = [r["steps"] for r in found if r["stage"] == stage]
        assert len({s // 75 for s in steps}) >= 4, "too few checkpoints"
    one, two = [r["learning_rate"] for r in found if r["stage"] == "left"][:2]
    assert one != two


# Interrupted within the process


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("tick", [1, 10, 15, 24])
def test_a_run_stopped_at_a_tick_ends_as_if_it_had_not_been(tmp_path, reference, engine, tick):
    recipe, whole = reference(engine)
    run = stopped_run(recipes.load(str(recipe)), tmp_path / "run", tick)
    assert not run.finished
    recipes.load(str(recipe)).resume(run.path, quiet=True)
    assert_same(run.path, whole)


@pytest.mark.slow
def test_a_flat_run_stopped_in_the_middle_ends_as_if_it_had_not_been(tmp_path):
    recipe = str(write_recipe(tmp_path))
    recipes.load(recipe).train(tmp_path / "whole", seed=3, flat=True, quiet=True)
    run = stopped_run(recipes.load(recipe), tmp_path / "run", 20, flat=True)
    recipes.load(recipe).resume(run.path, quiet=True)
    assert_same(run.path, tmp_path / "whole")


@pytest.mark.slow
def test_a_run_with_networks_of_the_usual_size_ends_as_if_it_had_not_been_stopped(
    tmp_path,
):
    # Where a tensor lies in memory changes the last bit of large matrix products only.
    pytest.importorskip("Box2D")

    def hierarchy() -> Hierarchy:
        found = recipes.load("lunar-lander")
        budgets = [
            "learn=apart",
            "skills.stabilize.steps=1",
            "skills.center.steps=1",
            "apart.selector_steps=1",
        ]
        apply_overrides(found, [*budgets, "skills.landing.steps=24000", "train.checkpoint_every=1"])
        return found

    hierarchy().train(tmp_path / "whole", seed=0, quiet=True)
    run = stopped_run(hierarchy(), tmp_path / "run", 5, seed=0)
    hierarchy().resume(run.path, quiet=True)
    assert_same(run.path, tmp_path / "whole")


def test_a_run_with_a_damaged_checkpoint_goes_on_from_the_one_before(tmp_path, reference):
    recipe, whole = reference("sync")
    path = stopped_run(recipes.load(str(recipe)), tmp_path / "run", 16).path
    assert (path / "checkpoint.previous.safetensors").exists()
    checkpoint = path / "checkpoint.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-1])
    recipes.load(str(recipe)).resume(path, quiet=True)
    assert_same(path, whole)


@pytest.mark.slow
def test_a_run_killed_between_its_last_checkpoint_and_its_policy_loses_nothing(
    tmp_path, reference, monkeypatch
):
    recipe, whole = reference("sync")
    path = tmp_path / "run"

    def stop(*_: Any) -> None:
        raise Stopped

    monkeypatch.setattr(RunDirectory, "save_policies", stop)
    with pytest.raises(Stopped):
        recipes.load(str(recipe)).train(path, seed=3, quiet=True)
    monkeypatch.undo()
    recipes.load(str(recipe)).resume(path, quiet=True)
    assert_same(path, whole)
    mine, theirs = (RunDirectory.open(p).stage("left") for p in (path, whole))
    assert mine.steps == theirs.steps
    assert mine.final.keys() == theirs.final.keys()
    assert mine.final["policy_loss"] == theirs.final["policy_loss"]


def test_resuming_a_finished_run_changes_no_file(tmp_path, reference):
    recipe, whole = reference("sync")
    shutil.copytree(whole, tmp_path / "run")
    before = {p: p.read_bytes() for p in (tmp_path / "run").rglob("*.*")}
    recipes.load(str(recipe)).resume(tmp_path / "run", quiet=True)
    assert {p: p.read_bytes() for p in (tmp_path / "run").rglob("*.*")} == before


# What a resumed run must take from the run, not from the recipe


SETTINGS = [  # a run that lost any of them would end otherwise
    [
        "skills.left.gamma=0.9",
        "train.checkpoint_every=125",
        "apart.selector_steps=350",
    ],
    [
        "selection.greedy_skills=true",
        "call_steps=9",
        "skills.left.steps=200",
        "selector.learning_rate=0.01",
    ],
    ["apart.start_calls=2", "apart.search_steps=12"],
    ["apart.start_calls=2", "apart.episode_calls=3"],
]


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS)
def test_settings_changed_for_a_run_stay_changed_when_it_is_resumed(tmp_path, settings):
    recipe = str(write_recipe(tmp_path))

    def changed() -> Hierarchy:
        hierarchy = recipes.load(recipe)
        apply_overrides(hierarchy, settings)
        return hierarchy

    changed().train(tmp_path / "whole", seed=3, quiet=True)
    run = stopped_run(changed(), tmp_path / "run", 3)
    recipes.load(recipe).resume(run.path, quiet=True)
    assert_same(run.path, tmp_path / "whole")


def test_a_run_whose_skills_have_rewards_of_their_own_is_not_resumed_without_them(tmp_path, capsys):
    # Acting needs none of this recipe's code, but finishing the training does.
    recipe = tmp_path / "rewards.py"
    text = RECIPE.replace(', engine="ENGINE"', "").replace("def initiation", "def _unused")
    text = text.replace("def termination", "def _neither").replace("    reflexes=", "    # ")
    recipe.write_text(text)
    assert roles_of(recipes.load(str(recipe))).is_data
    run = stopped_run(recipes.load(str(recipe)), tmp_path / "run", 3)
    assert main(["resume", str(run.path), "--quiet", "--evaluate", "0"]) == 1
    assert "--recipe" in capsys.readouterr().err
    assert not RunDirectory.open(run.path).finished


# Whoever learns, in processes; in this thread ``test_cuts.py`` holds it


GRU = "rnn=RNN('gru', 4)"
SMALL_REPLAY = (
    "num_envs=4, learning_starts=40, buffer_size=300, batch_size=8, update_ratio=0.25, "
    "normalize_rewards=True, network=Network((8,))"
)
LEARNERS = {
    "ppo": {},
    "recurrent ppo": {
        "network=Network(hidden=(8,))": f"network=Network((8,), {GRU})",
        "network=Network((6,))": f"network=Network((6,), {GRU})",
        " critic=Network(hidden=(5, 5)),": "",
    },
    "self-imitation": {
        "algorithm=small": ("algorithm=SelfImitationPPO(**vars(small), imitation_rows=50)"),
    },
    "dqn and sac": {
        "algorithm=small": f"algorithm=DQN({SMALL_REPLAY})",
        "selector=small": f"selector=SAC({SMALL_REPLAY})",
    },
    "sac and rainbow": {
        "algorithm=small": f"algorithm=SAC({SMALL_REPLAY})",
        "selector=small": f"selector=DQN.rainbow({SMALL_REPLAY})",
    },
}


IMPORTS = {
    "    Apart, Network, PPO,": "    DQN, SAC, Apart, Network, PPO,",
    "import numpy as np\n": (
        "import numpy as np\nfrom skillweave.algorithms import RNN, SelfImitationPPO\n"
    ),
}
FEWER_STEPS = {
    "skill_steps=300": "skill_steps=200",
    "selector_steps=750": "selector_steps=400",
    "checkpoint_every=75": "checkpoint_every=50",
}


def recipe_of(folder: Path, learner: str) -> str:
    text = RECIPE.replace("ENGINE", "sync").replace("workers=1", "workers=2")
    for old, new in (IMPORTS | FEWER_STEPS | LEARNERS[learner]).items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "recipe.py"
    path.write_text(text)
    return str(path)


def restored_stages(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The stages that go on from a checkpoint, from now on."""
    found: set[str] = set()
    plain = RunDirectory.load_checkpoint

    def noted(self: RunDirectory, stage: str) -> Any:
        loaded = plain(self, stage)
        if loaded is not None:
            found.add(stage)
        return loaded

    monkeypatch.setattr(RunDirectory, "load_checkpoint", noted)
    return found


class Killer(StopAt):
    """Kills one of the processes that collect, at every third tick."""

    killed = 0

    def tick(self, *told: Any) -> None:
        super().tick(*told)
        workers = [p for p in multiprocessing.active_children() if p.name.startswith("collector")]
        if self.left % 3 == 0 and workers:
            workers[self.left % len(workers)].kill()
            Killer.killed += 1


@pytest.mark.slow
@pytest.mark.parametrize("learner", LEARNERS)
def test_a_run_in_processes_stopped_again_and_again_ends_as_if_it_had_not_been(
    tmp_path, monkeypatch, learner
):
    gone_on = restored_stages(monkeypatch)
    monkeypatch.setattr(ReplayLearner, "report_every", 50)
    recipe = recipe_of(tmp_path, learner)
    whole = new_run(recipes.load(recipe), tmp_path / "whole")
    training.train(recipes.load(recipe), whole)
    whole.close()
    before, stops = Killer.killed, 0
    run = new_run(recipes.load(recipe), tmp_path / "run")
    while True:
        try:
            training.train(recipes.load(recipe), run, (Killer(6),))
            break
        except Stopped:
            stops += 1
        finally:
            run.close()
        run = RunDirectory.open(run.path)
    assert stops >= 2
    assert {"balance", "selector"} <= gone_on
    assert Killer.killed - before > 3
    assert_same(run.path, whole.path)


# Interrupted from outside


def wait_for_lines(process: subprocess.Popen[str], run: Path, count: int) -> None:
    """Until the run's metrics have so many lines, or its process is over."""
    metrics = run / "metrics.jsonl"
    while process.poll() is None:
        if metrics.exists() and metrics.read_bytes().count(b"\n") >= count:
            return
        time.sleep(0.001)


@pytest.mark.slow
def test_a_run_stopped_by_ctrl_c_says_how_to_go_on_and_ends_as_if_it_had_not_been(tmp_path, capsys):
    recipe, run, whole = str(write_recipe(tmp_path)), tmp_path / "run", tmp_path / "whole"
    train = ["train", recipe, "--seed", "3", "--set", "skills.left.steps=3000", "--evaluate", "0"]
    with subprocess.Popen(
        [sys.executable, "-m", "skillweave", *train, "-o", str(run)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        wait_for_lines(process, run, 20)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    assert "Traceback" not in err
    assert "stopped: saved at" in err
    assert f"skillweave resume {run} --recipe {recipe}" in err
    assert not RunDirectory.open(run).finished
    assert main(["resume", str(run), "--recipe", recipe, "--quiet", "--evaluate", "0"]) == 0
    assert main([*train, "-o", str(whole), "--quiet"]) == 0
    assert_same(run, whole)


FULL = """
mount -t tmpfs -o size=40k tmpfs "$1" || exit 77
"$3" -m skillweave train "$2" -o "$1/run" --seed 3 --evaluate 0 --quiet
echo "code $?"
cp -r "$1/run" "$4/stopped"
mount -o remount,size=4m "$1" || exit 77
"$3" -m skillweave resume "$1/run" --recipe "$2" --evaluate 0 --quiet
echo "code $?"
cp -r "$1/run" "$4/finished"
"""


@pytest.mark.slow
def test_a_run_stopped_by_a_full_disk_goes_on_when_there_is_room_again(tmp_path, reference):
    if shutil.which("unshare") is None:
        pytest.skip("no small file system can be mounted here")
    recipe, whole = reference("sync")
    (tmp_path / "disk").mkdir()
    command = ["unshare", "-rm", "sh", "-c", FULL, "sh", str(tmp_path / "disk"), str(recipe)]
    done = subprocess.run(
        [*command, sys.executable, str(tmp_path)], capture_output=True, text=True, check=False
    )
    if done.returncode == 77 or "unshare:" in done.stderr:
        pytest.skip("no small file system can be mounted here")
    codes = [line for line in done.stdout.splitlines() if line.startswith("code ")]
    assert codes == ["code 1", "code 0"], done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert "could not write" in done.stderr
    assert "No space left on device" in done.stderr
    assert not RunDirectory.open(tmp_path / "stopped").finished
    assert_same(tmp_path / "finished", whole)
