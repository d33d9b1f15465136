"""The tutorial's three scripts, with the import root changed and budgets cut, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from compat.tutorial_scripts import CUT, scripts, short
from PIL import Image

ROOT = Path(__file__).parents[2]
SKILLS = ("stabilize", "center", "landing")

for needed in ("Box2D", "wandb", "tqdm", "imageio"):
    pytest.importorskip(needed)


def run(name: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = folder / f"{name}.py"
    path.write_text(short(scripts()[name]))
    env = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")}
    env |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "HOME": str(folder)}
    env |= {"SDL_VIDEODRIVER": "dummy"}
    return subprocess.run(
        [sys.executable, str(path)], cwd=folder, env=env, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The full training code's folder, and what it said; WANDB is True, and nobody logged in."""
    folder = tmp_path_factory.mktemp("tutorial")
    done = run("training", folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stderr


def test_budgets_are_cut_by_constants_that_are_in_the_text():
    text = "".join(scripts().values())
    assert all(old in text for old in CUT)
    assert '"WANDB": True' in short(scripts()["training"])
    assert [len(s.splitlines()) > 80 for s in scripts().values()] == [True] * 3


@pytest.mark.slow
def test_the_full_training_code_writes_four_agents_that_hold_no_pickle(trained):
    folder, _ = trained
    for name in (*SKILLS, "selector"):
        data = (folder / f"models/PPO/PPO_trained_agent_{name}.pt").read_bytes()
        assert b'"skillweave"' in data[:200_000]
        assert not data.startswith((b"PK", b"\x80"))


@pytest.mark.slow
def test_it_warns_once_of_the_old_id_and_says_once_that_wandb_is_offline(trained):
    folder, said = trained
    assert said.count("LunarLander-v2 means -v3") == 1
    assert "out of date" not in said
    assert said.count("skillweave: no login to Weights & Biases") == 1
    assert len(list((folder / "wandb").glob("offline-run-*"))) == 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["skills", "hierarchy"])
def test_the_rendering_scripts_write_films(trained, name):
    folder, _ = trained
    done = run(name, folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("LunarLander-v2 means -v3") == 1
    films = SKILLS if name == "skills" else ("selector",)
    for film in films:
        with Image.open(folder / f"videos/LunarLander-v2_{film}.gif") as image:
            assert image.n_frames > 5
    assert done.stdout.count("Score: ") == len(films)
