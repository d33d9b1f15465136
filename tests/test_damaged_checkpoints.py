"""A checkpoint whose checksum is right, but whose numbers cannot be gone on from, is refused."""

import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from scripts.torture.kinds import KINDS
from scripts.torture.samples import unfinished
from skillweave import SkillweaveError
from skillweave.errors import RunError
from skillweave.runs.files import read_tensors, write_tensors

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")

CUTS = {
    "together": 2,
    "apart, then together, replay": 8,
    "replay of continuous actions": 3,
    "population, replay": 2,
}
"""By kind of training, after how many checkpoints it was stopped."""


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Each kind's run, made once."""
    made = {}

    def of(kind):
        if kind not in made:
            made[kind] = tmp_path_factory.mktemp("stopped")
            unfinished(KINDS[kind], CUTS[kind])(made[kind])
        return made[kind] / "run"

    return of


DAMAGES = {
    "infinite": lambda x: torch.full_like(x, torch.inf),
    "NaN": lambda x: torch.full_like(x, torch.nan),
    "nobody": lambda x: torch.full_like(x, -1),
    "nothing but 0": torch.zeros_like,
    "negative": lambda x: torch.full_like(x, -3),
    "a little more": lambda x: x + 1e-3,
    "far too large": lambda x: x + 200,
    "doubles": lambda x: x.double(),
    "singles": lambda x: x.float(),
    "one more axis": lambda x: x[..., None].contiguous(),
    "flat": lambda x: x.flatten(),
    "empty": lambda x: x.flatten()[:0],
    "missing": lambda _: None,
    "short of a row": lambda x: x[:, :-1].contiguous(),
    "one more": lambda x: x + torch.arange(len(x)),
}
LEFT, STORE = "learner.left.0", "learner.left.store"
CASES = {
    "population, replay": {
        "kept.transitions": ["infinite", "empty"],
    },
    "replay of continuous actions": {
        "learner.transitions": ["infinite", "one more", "singles"],
        "learner.store.kind": ["nothing but 0"],
        "learner.store.reward": ["infinite"],
        "collector.0.kept.age": ["negative"],
        "learner.store.obs": ["missing"],
        "learner.store.action": ["NaN"],
        "collector.0.engine.episode": ["negative"],
        "collector.0.engine.root": ["negative"],
        "collector.0.kept.sums": ["NaN"],
    },
    "apart, then together, replay": {
        "learner.selector.transitions": ["negative"],
        f"{STORE}.action": ["far too large"],
        f"{STORE}.reward": ["infinite"],
        f"{STORE}.kind": ["far too large"],
        "learner.selector.store.steps": ["negative"],
        f"{STORE}.priority": ["infinite", "nothing but 0", "a little more"],
        "collector.0.kept.action": ["far too large"],
    },
    "together": {
        f"{LEFT}.reward": ["flat", "doubles", "infinite"],
        f"{LEFT}.obs": ["one more axis", "NaN"],
        f"{LEFT}.next_obs": ["short of a row"],
        f"{LEFT}.action": ["far too large"],
        f"{LEFT}.steps": ["negative"],
        f"{LEFT}.valid": ["missing"],
        "collector.0.kept.player.skill": ["far too large", "negative", "nobody"],
        "collector.0.kept.player.end": ["far too large"],
        "collector.0.open.obs": ["infinite", "missing"],
        "collector.0.kept.action": ["negative"],
        "collector.0.open.dist_params": ["doubles", "infinite"],
        f"{LEFT}.dist_params": ["NaN"],
        "collector.0.kept.discount": ["infinite"],
        "collector.0.kept.tau": ["negative"],
        "collector.0.kept.player.elapsed": ["negative"],
        "collector.0.kept.player.length": ["far too large"],
        "learner.counts": ["negative"],
        "loop.report": ["negative", "doubles", "empty", "far too large"],
        "learner.left.acting.views.actor.0.weight": ["infinite", "flat", "missing"],
    },
}


@pytest.mark.fast_cases(10)
@pytest.mark.parametrize(
    ("kind", "name", "damage"),
    [
        (kind, name, damage)
        for kind, tensors in CASES.items()
        for name, damages in tensors.items()
        for damage in damages
    ],
)
def test_numbers_that_are_never_written_are_refused(stopped, tmp_path, kind, name, damage):
    run = tmp_path / "run"
    shutil.copytree(stopped(kind), run)
    _change(run, name, DAMAGES[damage])
    with pytest.raises(SkillweaveError) as error:
        KINDS[kind].declare().resume(run, quiet=True)
    assert str(run) in str(error.value)


def test_a_checkpoint_without_its_population_is_refused(stopped, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(stopped("population, replay"), run)
    with _rewritten(run) as (_, header):
        del header["population"]
    with pytest.raises(RunError, match="has no population"):
        KINDS["population, replay"].declare().resume(run, quiet=True)


def _change(run: Path, name: str, damage):
    """Change one tensor of the checkpoint."""
    with _rewritten(run) as (tensors, _):
        (full,) = [k for k in tensors if f".{k}".endswith(f".{name}")]
        tensors[full] = damage(tensors[full])
        if tensors[full] is None:
            del tensors[full]


@contextmanager
def _rewritten(run: Path):
    """Write the checkpoint anew, as the tensors and the header are then; none is before it."""
    (run / "checkpoint.previous.safetensors").unlink(missing_ok=True)
    path = run / "checkpoint.safetensors"
    tensors, header = read_tensors(path)
    yield tensors, header
    header.pop("sha256", None)
    write_tensors(path, tensors, header, make_directories=False)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", CUTS)
def test_what_is_not_damaged_is_gone_on_from(stopped, tmp_path, kind):
    run = tmp_path / "run"
    shutil.copytree(stopped(kind), run)
    stages = KINDS[kind].declare().resume(run, quiet=True).info()["stages"]
    assert all(stage["status"] == "done" for stage in stages)
