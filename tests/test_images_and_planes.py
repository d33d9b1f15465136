"""Images and boards: how networks read them, by their spaces or by ``Network.planes``."""

import json
from itertools import count
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from toys import World

import skillweave as sw
from skillweave.cli import main
from skillweave.errors import DeclarationError

BYTES, REALS = np.uint8, np.float32


class Shows(World):
    """Shows random observations of a space, and the highest and lowest ones."""

    def see(self):
        space = self.observation_space
        if not isinstance(space, Box):
            return space.sample()
        if not space.is_bounded() or space.high.max() > 1e6:
            return self.np_random.integers(9, size=space.shape).astype(space.dtype)
        return (space.low, space.high)[self.t].copy() if self.t < 2 else space.sample()


class Recorder(torch.nn.Module):
    """Records what a network gets."""

    spaces: ClassVar[list] = []
    seen: ClassVar[list] = []

    def __init__(self, space):
        super().__init__()
        self.spaces.append(space)
        self.flat = torch.nn.Flatten()

    def forward(self, obs):
        self.seen.append(obs)
        parts = obs.values() if isinstance(obs, dict) else [obs]
        return torch.cat([self.flat(x)[:, :4] for x in parts], 1)


def settings(**network):
    return sw.PPO(num_envs=2, n_steps=8, network=sw.Network((4,), **network))


@pytest.fixture
def read(tmp_path):
    """Return the space that a trained network gets, and what it gets in an evaluation."""
    numbers = count()

    def of(space, **network):
        Recorder.spaces.clear()
        how = settings(encoder=Recorder, **network)
        spec = sw.EnvSpec(lambda: Shows(space), workers=1)
        run = sw.train_agent(spec, how, 16, tmp_path / f"{next(numbers)}", quiet=True)
        Recorder.seen.clear()
        assert run.evaluate(2, quiet=True).mean == 5
        return Recorder.spaces[0], list(Recorder.seen)

    return of


CHANNELS = np.array([1.0, 10.0, 255.0], REALS)


@pytest.mark.parametrize(
    "space",
    [
        Box(0, 1, (8, 8, 3), REALS),
        Box(-1, 1, (3, 8, 8), np.float64),
        Box(0, 7, (8, 8, 3), np.int64),
        Box(-1, 1, (8, 8, 3), np.int8),
        Box(-0.5 * CHANNELS * np.ones((8, 8, 3), REALS), CHANNELS * np.ones((8, 8, 3), REALS)),
        Box(np.zeros((3, 8, 8), BYTES), np.ones((3, 8, 8), BYTES) * 9, dtype=BYTES),
    ],
    ids=str,
)
def test_bounded_images_are_scaled_by_their_bounds(read, space):
    asked, values = read(space)
    assert asked == Box(0, 1, (3, 8, 8), REALS)
    seen = torch.cat([v.flatten(1) for v in values])
    assert float(seen.min()) == 0.0
    assert float(seen.max()) == 1.0
    assert seen.isfinite().all()


def test_each_channel_is_scaled_by_its_own_bounds(read):
    low = np.array([0, -5, 10], REALS) * np.ones((6, 6, 3), REALS)
    _, values = read(Box(low, low + CHANNELS))
    seen = torch.cat([v.transpose(0, 1).flatten(1) for v in values], 1)
    assert seen.min(1).values.tolist() == [0, 0, 0]
    assert seen.max(1).values.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    "space",
    [
        Box(-np.inf, np.inf, (8, 8, 3), REALS),
        Box(np.finfo(REALS).min, np.finfo(REALS).max, (8, 8, 3), REALS),
        Box(0, np.iinfo(np.int64).max, (8, 8, 3), np.int64),
    ],
    ids=["none", "of float32", "of int64"],
)
def test_bounds_that_say_nothing_leave_numbers_to_be_normalised(read, space):
    asked, _ = read(space)
    assert asked == Box(-np.inf, np.inf, (8, 8, 3), REALS)  # as of vectors


@pytest.mark.parametrize("shape", [(3, 4, 5), (84, 84, 3, 4)], ids=str)
def test_a_shape_that_says_nothing_is_refused_with_the_setting(tmp_path, shape):
    run = tmp_path / "run"
    with pytest.raises(DeclarationError) as error:
        sw.train_agent(lambda: Shows(Box(0, 1, shape, BYTES)), settings(), 16, run, quiet=True)
    assert f"the observation of shape {shape}" in str(error.value)
    stacked = f", by its first axis a stack of {shape[0]} frames" in str(error.value)
    assert stacked == (len(shape) == 4)
    assert "may have its planes (channels) in the first axis or in the last" in str(error.value)
    assert 'PPO(network=Network(planes="first")), or planes="last"' in str(error.value)
    assert not run.exists()


def test_the_setting_counts_for_the_images_of_which_it_is_not_known(read):
    space = Dict(board=Box(0, 1, (5, 6, 7), BYTES), camera=Box(0, 255, (9, 9, 3), BYTES))
    with pytest.raises(DeclarationError, match=r"the observation's part board of shape \(5, 6"):
        read(space)
    asked, _ = read(space, planes="first")
    assert {k: part.shape for k, part in asked.items()} == {"board": (5, 6, 7), "camera": (3, 9, 9)}


LAST = sw.Network((4,), planes="last")


class Win(sw.Skill):
    algorithm = sw.PPO(num_envs=2, n_steps=8, network=LAST, critic=LAST)


def test_a_selector_is_refused_before_its_skills_are_trained(tmp_path):
    def make():
        return Shows(Box(0, 1, (5, 6, 7), BYTES))

    declared = sw.Hierarchy(make, [Win()], learn="apart", steps=64)
    with pytest.raises(DeclarationError, match="selector: the observation of shape"):
        declared.train(tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "selector",
    [Win.algorithm, sw.DQN(num_envs=2, learning_starts=8, network=Win.algorithm.network)],
    ids=["PPO", "DQN"],
)
def test_the_critic_of_skills_reads_boards_as_the_selector_does(tmp_path, selector):
    declared = sw.Hierarchy(
        lambda: Shows(Box(0, 1, (5, 6, 7), BYTES)), [Win()], selector=selector, steps=64
    )
    run = declared.train(tmp_path / "run", quiet=True)
    assert run.evaluate(2, quiet=True).mean == 5


@pytest.mark.parametrize("side", [1, 2, 3, 5])
def test_the_usual_network_fits_boards_of_any_size(tmp_path, side):
    space = Box(0, 1, (side, side + 7, 12) if side > 2 else (side, side, 12), BYTES)
    planes = {"planes": "last"} if side > 2 else {}
    run = sw.train_agent(lambda: Shows(space), settings(**planes), 16, tmp_path / "r", quiet=True)
    assert run.evaluate(1, quiet=True).mean == 5


class Board(gym.Env):
    """Asks whether a piece of plane 1 and one of plane 4 share a cell, eight times an episode."""

    action_space = Discrete(2)
    observation_space = Box(0, 1, (3, 3, 6), BYTES)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.see(), {}

    def see(self):
        board = np.zeros((9, 6), BYTES)
        one, other = self.np_random.choice(9, 2, replace=False)
        self.yes = int(self.np_random.integers(2))
        board[one, 1], board[one if self.yes else other, 4] = 1, 1
        return board.reshape(3, 3, 6)

    def step(self, action):
        reward, self.t = float(action == self.yes), self.t + 1
        return self.see(), reward, False, self.t == 8, {}


def test_cells_are_read_one_by_one_wherever_their_axes_are(tmp_path):
    cells, rest = sw.Network((4,), encoder="cells"), sw.Network((4,))
    space = Box(0, 5, (3, 4, 5), BYTES)

    def train(critic):
        how = sw.PPO(num_envs=2, n_steps=8, network=cells, critic=critic)
        return sw.train_agent(lambda: Shows(space), how, 16, tmp_path / "run", quiet=True)

    with pytest.raises(DeclarationError, match="may have its planes"):
        train(rest)
    train(None)


def test_the_command_line_sets_it(tmp_path, capsys):
    recipe = tmp_path / "recipe.py"
    recipe.write_text(
        "import sys\n\nimport numpy as np\nimport skillweave as sw\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from test_images_and_planes import Box, Shows\n\n\n"
        "class Look(sw.Skill):\n    pass\n\n\n"
        "settings = sw.PPO(num_envs=2, n_steps=8)\n"
        "space = Box(0, 1, (3, 4, 5), np.uint8)\n"
        "hierarchy = sw.Hierarchy(\n    lambda: Shows(space), [Look()], algorithm=settings, "
        "selector=settings, steps=32\n)\n"
    )
    train = ["train", str(recipe), "--out", str(tmp_path / "run"), "--quiet", "--evaluate", "0"]
    assert main(train) == 1
    assert 'PPO(network=Network(planes="first"))' in capsys.readouterr().err
    both = [f"--set={who}.network.planes={{}}" for who in ("algorithm", "selector")]
    assert main([*train, *(word.format("middle") for word in both)]) == 1
    assert "expected one of first, last, None" in capsys.readouterr().err
    assert main([*train, *(word.format("last") for word in both)]) == 0
    (stage,) = json.loads((tmp_path / "run" / "run.json").read_text())["stages"]
    assert stage["algorithm"]["network"]["planes"] == "last"
    again = ["evaluate", str(tmp_path / "run"), "--recipe", str(recipe), "--episodes", "2"]
    assert main(again) == 0


@pytest.mark.slow
def test_a_relation_between_planes_is_learnt(tmp_path):
    how = sw.PPO(num_envs=32, n_steps=32, gamma=0.5, network=sw.Network((64,), "relu"))
    run = sw.train_agent(Board, how, 40_000, tmp_path / "run", quiet=True)
    assert run.evaluate(50, quiet=True).mean > 7.5  # chance: 4
