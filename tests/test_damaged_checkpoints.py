"""Files that only their own run reads: what is damaged is named, what has changed is, too."""

import functools
import shutil
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Box
from toys import World

import skillweave as sw
from scripts.torture import kinds as torture
from scripts.torture.kinds import IN_PYTHON, LEARNS, NET, REPLAYS, SEED, Kind, alone
from scripts.torture.samples import unfinished
from skillweave.errors import RunError
from skillweave.runs.files import read_tensors, write_tensors

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*precision lowered", "ignore:the code of the environment has changed"
)

ROLLOUTS = sw.PPO(**LEARNS, network=NET)
STARTED, FINISHED = "start from another run", "finished"
KINDS = {
    "together": torture.KINDS["together"],
    "apart, then together, replay": torture.KINDS["apart, then together, replay"],
    "population, replay": torture.KINDS["population, replay"],
    STARTED: Kind(
        lambda: alone(IN_PYTHON, ROLLOUTS, 320), before=lambda: alone(IN_PYTHON, ROLLOUTS, 64)
    ),
    FINISHED: Kind(lambda: alone(IN_PYTHON, ROLLOUTS, 320)),
}
STOPPED = {
    "together": 2,
    "apart, then together, replay": 8,
    "population, replay": 2,
    STARTED: 2,
}
"""By kind of training, after how many checkpoints it was stopped; the others have ended."""
FOLDERS = (".", "states", "starts", "policies")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a function that makes the run of a kind, once."""
    runs = {}

    def of(kind):
        if kind not in runs:
            runs[kind] = tmp_path_factory.mktemp("made")
            if kind == FINISHED:
                KINDS[kind].train(runs[kind] / "run")
            else:
                unfinished(KINDS[kind], STOPPED[kind])(runs[kind])
        return runs[kind] / "run"

    return of


def resume(kind, run):
    if kind == FINISHED:  # it continues for more steps, from its final state
        return alone(IN_PYTHON, ROLLOUTS, 640).train(run, seed=SEED, resume=True, quiet=True)
    return KINDS[kind].declare().resume(run, quiet=True)


def of_another_run(path: Path):
    """Write the file with a right checksum, as another run would."""
    tensors, header = read_tensors(path)
    del header["sha256"]
    write_tensors(path, tensors, header | {"run": "0" * 8})


def flip(path: Path, share: float):
    data = bytearray(path.read_bytes())
    data[int(share * (len(data) - 1))] ^= 4
    path.write_bytes(data)


DAMAGES = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-8]),
    "first byte flipped": lambda path: flip(path, 0),
    "byte flipped in the middle": lambda path: flip(path, 0.5),
    "last byte flipped": lambda path: flip(path, 1),
    "emptied": lambda path: path.write_bytes(b""),
    "missing": Path.unlink,
    "of another run": of_another_run,
}
REPLACEABLE = (".", "states")
"""Without a checkpoint a stage begins again; without a state, a learner has its weights alone."""


@pytest.mark.fast_cases(7)
@pytest.mark.parametrize("kind", [FINISHED, *STOPPED])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named(made, tmp_path, kind, damage):
    original = made(kind)
    for folder in ["final"] if kind == FINISHED else FOLDERS:
        found = sorted((original / folder).glob("*.safetensors"))
        if not found or (damage == "missing" and folder in REPLACEABLE):
            continue
        run = tmp_path / folder / "run"
        shutil.copytree(original, run)
        (run / "checkpoint.previous.safetensors").unlink(missing_ok=True)
        file = run / found[-1].relative_to(original)
        if folder == ".":
            file = run / "checkpoint.safetensors"
        DAMAGES[damage](file)
        with pytest.raises(RunError) as error:
            resume(kind, run)
        if kind == FINISHED and damage == "missing":
            assert "does not hold the final state of stage 'agent'" in str(error.value)
        else:
            assert str(file) in str(error.value)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("kind", [*STOPPED, FINISHED])
def test_an_undamaged_run_is_resumed(made, tmp_path, kind):
    run = tmp_path / "run"
    shutil.copytree(made(kind), run)
    stages = resume(kind, run).info()["stages"]
    assert all(stage["status"] == "done" for stage in stages)


# A checkpoint that is whole, and does not fit the program any more


REPLAY = sw.DQN(**REPLAYS)
SHOWN = Box(-9, 9, (2,), np.float32)
WIDER, DOUBLES = Box(-9, 9, (3,), np.float32), Box(-9, 9, (2,), np.float64)


@pytest.mark.parametrize(
    ("algorithm", "change", "says"),
    [
        (ROLLOUTS, WIDER, r"agent: tensor params should be"),
        (REPLAY, DOUBLES, r"stage 'agent': .*replay buffer does not fit: 'obs'"),
    ],
    ids=["another size", "another type, replay"],
)
def test_what_a_changed_environment_does_not_fit_is_named(tmp_path, algorithm, change, says):
    def of(space):
        return Kind(lambda: alone(functools.partial(World, space), algorithm, 400))

    unfinished(of(SHOWN), 2)(tmp_path)
    with pytest.raises(sw.SkillweaveError, match=says):
        of(change).declare().resume(tmp_path / "run", quiet=True)
