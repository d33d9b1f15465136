"""What complete episodes have paid, and critics that expect far more."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import skillweave as sw
from skillweave.algorithms.batches import Batch
from skillweave.training.paid_returns import PaidReturns

GAMMA = 0.5


def rows(reward: Any, terminated: Any, truncated: Any, steps: Any = None, **more: Any) -> Batch:
    reward = np.array(reward, np.float32)
    count = np.ones(reward.shape, np.int64) if steps is None else np.array(steps)
    ends = {"terminated": np.array(terminated, bool), "truncated": np.array(truncated, bool)}
    return Batch(reward=reward, steps=count, next_obs=reward[..., None], **ends, **more)


def test_the_largest_return_by_hand() -> None:
    paid = PaidReturns(2)
    # First column: 0, 0, 4, which terminates; second: -1 and a cut after two steps, then 3.
    paid.see(rows([[0, -1], [0, 0]], [[0, 0], [0, 0]], [[0, 0], [0, 1]]), GAMMA)
    assert paid.episodes == 1
    assert paid.largest == pytest.approx(1.0 / (1.0 - 0.25))
    paid.see(rows([[4, 3]], [[1, 0]], [[0, 0]]), GAMMA)
    assert (paid.episodes, paid.largest) == (2, 4.0)
    paid.cut(np.array([1]))
    paid.see(rows([[0, 1]], [[0, 1]], [[0, 0]]), GAMMA)
    assert (paid.episodes, paid.largest) == (3, 4.0)


def test_a_call_of_three_steps_and_rows_of_others() -> None:
    paid = PaidReturns(1)
    own = np.array([[True], [False], [True]])
    batch = rows([[1], [50], [8]], [[0], [0], [1]], [[0], [0], [0]], [[3], [1], [1]], own=own)
    paid.see(batch, GAMMA)
    assert paid.largest == pytest.approx(max(8.0, 1 + 0.5**3 * 8))


class Pays(gym.Env[Any, Any]):
    """Pays ``most`` in each step for the action 1, and ends after twenty steps."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, most: float = 1.0) -> None:
        self.most = most

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return np.float32([0.0]), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        paid = self.most * (1.0 - abs(1.0 - float(action[0])))
        return np.float32([self.steps / 20]), paid, self.steps >= 20, False, {}


@pytest.mark.parametrize(("most", "said"), [(100.0, False), (1e-4, True)])
def test_entropy_that_is_worth_more_than_all_that_was_paid_is_named(
    most: float, said: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    algorithm = sw.SAC(num_envs=4, learning_starts=100, batch_size=32, network=sw.Network((16,)))
    spec = sw.EnvSpec(Pays, kwargs={"most": most}, check_seed=False, workers=1)
    sw.train_agent(spec, algorithm, 1_200, tmp_path / "run", seed=0)
    assert ("ent_coef" in capsys.readouterr().err) is said
