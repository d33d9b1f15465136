"""The calls of a report's episodes as plain data: timelines, transitions, choices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skillweave.reporting.report.film import Film
from skillweave.training.call_log import CallLog, EpisodeLog
from skillweave.types import Array

MOST_COORDINATES = 16
LARGEST_VECTOR = 64  # numbers of an observation; of a larger one (an image) none is a coordinate
MOST_DECISIONS = 2_000
MOST_CALLS, MOST_CALLS_OF_ONE = 6_000, 1_500  # on the page: of all episodes, and of each


def chosen_episodes(episodes: Sequence[EpisodeLog], count: int) -> list[int]:
    """The numbers of ``count`` episodes, from the one with the least return to the best."""
    order = np.argsort([e.total for e in episodes], kind="stable")
    places = np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int)
    return [int(i) for i in order[places]]


def episode_data(log: CallLog, film: Film | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Each episode with its calls, and sentences on what is left out.

    Those in the film come first, in its order.
    """
    first = {} if film is None else film.first
    numbers = [*first, *(i for i in range(len(log.episodes)) if i not in first)]
    shown: list[dict[str, Any]] = []
    missing: list[str] = []
    left = MOST_CALLS
    for i in numbers:
        count = len(log.episodes[i].calls)
        part = min(count, MOST_CALLS_OF_ONE)
        if part > left and shown:
            continue
        left -= part
        shown.append(_episode(log.episodes[i], i, first.get(i)))
        if part < count:
            missing.append(f"Of the {count:,} calls of episode {i + 1}, {part:,} are shown.")
    if len(shown) < len(numbers):
        missing.append(
            f"{len(shown)} of {len(numbers)} episodes are shown, as all have too many calls."
        )
    return shown, missing


def _episode(episode: EpisodeLog, number: int, first: int | None) -> dict[str, Any]:
    totals = np.cumsum(episode.rewards).round(2).tolist() if first is not None else []
    calls = [
        [
            c.skill, c.start, c.steps, c.why, round(c.reward, 2),
            None if c.own is None else round(c.own, 2), c.succeeded,
        ]
        for c in episode.calls[:MOST_CALLS_OF_ONE]
    ]  # fmt: skip
    told: dict[str, Any] = {
        "number": number + 1,
        "seed": episode.seed,
        "return": round(episode.total, 2),
    }
    told |= {"steps": len(episode.rewards), "cut": episode.cut, "frame": first}
    return told | {"totals": totals, "calls": calls}


def decision_data(log: CallLog) -> dict[str, Any]:
    """What was chosen at which observation: names of coordinates, and a row for each decision.

    A row is the coordinates, then the skill, then whether its call succeeded (None: not known).
    Only coordinates that vary are there; the episode's step is the last one.
    """
    calls = [call for episode in log.episodes for call in episode.calls]
    every = -(-len(calls) // MOST_DECISIONS)
    calls = calls[::every]
    columns = coordinates(np.stack([call.obs for call in calls]))
    columns = dict([(k, v) for k, v in columns.items() if np.ptp(v) > 0][:MOST_COORDINATES])
    if columns:
        columns["step of the episode"] = np.array([float(call.start) for call in calls])
    table = [
        [*(float(f"{v[i]:.5g}") for v in columns.values()), call.skill, call.succeeded]
        for i, call in enumerate(calls)
    ]
    return {"names": list(columns), "rows": table if columns else [], "every": every}


def coordinates(obs: Array) -> dict[str, Array]:
    """The numbers of a batch of observations by name, (n,) each; none where they are images."""
    if obs.dtype.names is not None:
        parts = [(f'obs["{name}"]', obs[name]) for name in obs.dtype.names]
    else:
        parts = [("obs", obs)]
    found: dict[str, Array] = {}
    for name, part in parts:
        if part.dtype.names is not None:
            continue  # a Dict in a Dict
        flat = np.asarray(part).reshape(len(part), -1)
        if flat.shape[1] <= LARGEST_VECTOR:
            alone = part.ndim == 1
            for i in range(flat.shape[1]):
                found[name if alone else f"{name}[{i}]"] = flat[:, i].astype(float)
    return {k: v for k, v in found.items() if np.isfinite(v).all()}
