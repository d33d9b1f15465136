"""What tests of several stages share."""

from __future__ import annotations

import pytest

from skillweave.buffers import ram
from skillweave.envs import engine as engines


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """Counts the steps that Gymnasium's engines make."""
    count, plain = [0], engines.GymnasiumEngine.step

    def step(self, action, ids=None):
        count[0] += len(action)
        return plain(self, action, ids)

    monkeypatch.setattr(engines.GymnasiumEngine, "step", step)
    return count


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine has one GiB left."""
    monkeypatch.setattr(ram, "free_memory", lambda: 2**30)
