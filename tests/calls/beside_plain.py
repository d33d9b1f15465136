"""Ready skills in the world of a crane, beside what plain Python says that they do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls.worlds import Crane, crane, leaves, numbers

import skillweave as sw
from skillweave.calls import record_calls
from skillweave.envs.make import make_engine
from skillweave.experience.play import SeededEpisodes, play
from skillweave.export.write import write_export
from skillweave.types import Array

NAMES = ("a", "b", "c")


def chosen(seed: int, obs: Any) -> Array:
    return np.floor(numbers(f"{seed} chooses", leaves(obs, "obs"), 1)[:, 0] * 1.5 + 1.5).astype(int)


def hierarchy(seed: int, skills: Sequence[Any]) -> sw.Hierarchy:
    return sw.Hierarchy(
        crane("box", False),
        [skill.skill() for skill in skills],
        call_steps=3,
        selector=lambda obs: [NAMES[k] for k in chosen(seed, obs)],
    )


def one(obs: Any) -> dict[str, Any]:
    """An observation of a batch's row."""
    return {name: np.array(obs[name]) for name in ("arm", "hook", "mode")}


def check_beside(
    seed: int, folder: Path, skills: Sequence[Any], plain_of: Callable[[], Any]
) -> None:
    """Compare every place in which skills act with plain Python.

    Args:
        skills: have ``skill()``, the declared one, and ``call_steps``, or None.
        plain_of: returns an episode in plain Python, with ``act(obs, choice)`` and ``running``.
    """
    run = hierarchy(seed, skills).train(folder / "run", quiet=True)
    policy = run.policy
    most = [skill.call_steps or 3 for skill in skills]
    # Several environments side by side.
    plains = [plain_of() for _ in range(4)]
    elapsed = [10**6] * 4
    spec = sw.EnvSpec(crane("box", False), engine="sync")
    engine = make_engine(spec, 2)
    for now in play(policy, SeededEpisodes(engine, [1, 2, 3, 4], 100)):
        for k, episode in enumerate(now.episode.tolist()):
            obs, plain = one(now.step.obs[k]), plains[episode]
            starts = elapsed[episode] >= (most[plain.running] if plain.running >= 0 else 0)
            choice = int(chosen(seed, now.step.obs[[k]])[0]) if starts else None
            elapsed[episode] = 1 if starts else elapsed[episode] + 1
            wanted = plain.act(obs, choice)
            assert now.step.action[k].tolist() == wanted.tolist()
    # One at a time, in a player and without the library; and read again.
    export = write_export(folder / "export", policy, "crane")
    loaded = sw.load_policy(folder / "export", code=export.functions)
    players: list[Any] = [run.player(), sw.Player(loaded)]
    pytest.importorskip("onnxruntime")
    from skillweave.export.runner import Runner

    players.append(Runner(folder / "export", export.functions))
    for player in players:
        for episode in range(2):
            env, plain, since = Crane("box", False), plain_of(), 10**6
            obs, over = env.reset(seed=episode)[0], False
            player.reset()
            while not over:
                starts = plain.running < 0 or since >= most[plain.running]
                row = {name: np.asarray(value)[None] for name, value in obs.items()}
                choice = int(chosen(seed, row)[0]) if starts else None
                since = 1 if starts else since + 1
                action = player.act(obs)
                assert action.tolist() == plain.act(obs, choice).tolist()
                obs, _, terminated, truncated, _ = env.step(action)
                over = terminated or truncated
    # In a log of random calls.
    in_log(record_calls(spec, policy, 60, num_envs=3), plain_of)


def in_log(log: Any, plain_of: Callable[[], Any]) -> None:
    """Each episode of a log whose first call is known acts as plain Python says."""
    for episode in np.unique(log.episode):
        calls = np.flatnonzero(log.episode == episode)
        calls = calls[np.argsort(log.order[calls])]
        plain = plain_of()
        assert log.order[calls].tolist() == [*range(len(calls))]
        for call in calls:
            obs, choice = log.start[call], int(log.choice[call])
            for t in range(int(log.offset[call]), int(log.offset[call + 1])):
                wanted = plain.act(one(obs), choice)
                assert log.action[t].tolist() == wanted.tolist()
                obs, choice = log.next_obs[t], None
