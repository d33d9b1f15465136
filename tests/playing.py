"""Episodes in which several actors see the same, one observation at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import skillweave as sw
from skillweave.export.runner import Runner
from skillweave.export.write import Export


def runner_of(export: Export, **how: Any) -> Runner:
    """The runner of an export, with the functions that it needs."""
    return Runner(export.path, export.functions, **how)


def loaded_of(export: Export) -> Any:
    """The policy of an export, read back."""
    return sw.load_policy(export.path, code=export.functions)


def episode(env: Any, *actors: Any, seed: int = 0) -> Iterator[list[Any]]:
    """Play an episode by the first actor; yield the actions of all, before each step."""
    obs, info = env.reset(seed=seed)
    for actor in actors:
        actor.reset()
    reward, over = None, False
    while not over:
        actions = [actor.act(obs, reward=reward, info=info) for actor in actors]
        yield actions
        obs, reward, terminated, truncated, info = env.step(actions[0])
        over = terminated or truncated


def alike(env: Any, *actors: Any, seed: int = 0) -> Iterator[Any]:
    """Play an episode in which all act the same; yield the action, before each step."""
    for action, *others in episode(env, *actors, seed=seed):
        for theirs in others:
            np.testing.assert_allclose(theirs, action, atol=1e-5)
        yield action
