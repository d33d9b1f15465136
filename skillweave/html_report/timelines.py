"""The calls of a report's episodes as plain data: timelines, choices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skillweave.envs.obs_names import ObsNames
from skillweave.html_report.film import Mp4
from skillweave.policies.core import Array
from skillweave.training.played_calls import Episode, PlayedEpisodes

MOST_COORDINATES = 16
LARGEST_VECTOR = 64  # numbers of an observation; of a larger one (an image) none is a coordinate
MOST_DECISIONS = 2_000
MOST_CALLS = 6_000
"""The most calls on the page, of all episodes."""
MOST_CALLS_OF_ONE = 1_500
"""The most calls on the page, of one episode."""


def chosen_episodes(episodes: Sequence[Episode], count: int) -> list[int]:
    """Return the numbers of ``count`` episodes, from the one with the least return to the best."""
    order = np.argsort([e.total for e in episodes], kind="stable")
    places = np.linspace(0, len(order) - 1, min(count, len(order))).round().astype(int)
    return [int(i) for i in order[places]]


def episode_data(
    log: PlayedEpisodes, film: Mp4 | None, named: ObsNames | None = None
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return each episode with its calls, and sentences about parts that are left out.

    Those in the film come first, in its order.

    Args:
        named: names of an observation's numbers; with them, each call has what was observed.
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
        shown.append(_episode(log.episodes[i], i, first.get(i), named))
        if part < count:
            missing.append(f"Of the {count:,} calls of episode {i + 1}, {part:,} are shown.")
    if len(shown) < len(numbers):
        missing.append(
            f"{len(shown)} of {len(numbers)} episodes are shown, as all have too many calls."
        )
    return shown, missing


def _episode(
    episode: Episode, number: int, first: int | None, named: ObsNames | None
) -> dict[str, Any]:
    """Return an episode and its calls as data for the report's timelines."""
    calls = episode.calls[:MOST_CALLS_OF_ONE]
    sums = np.cumsum(episode.rewards, dtype=np.float64) if first is not None else ()
    entry: dict[str, Any] = {
        "number": number + 1,
        "seed": episode.seed,
        "return": rounded(episode.total),
        "steps": len(episode.rewards),
        "cut": episode.cut,
        "frame": first,
        "totals": [rounded(total) for total in sums],
        "calls": page_calls(calls),
    }
    observed = seen(calls, named)
    return entry | ({"seen": rows_of(observed)} if observed else {})


def page_calls(calls: Array) -> dict[str, list[Any]]:
    """Return calls for the page's script: by the name of each field, the values; None: unknown."""
    columns = {name: calls[name] for name in calls.dtype.names or () if name != "start"}
    return {
        k: [*map(rounded, x)] if x.dtype.kind == "f" else x.tolist() for k, x in columns.items()
    }


def names_misfit(obs: Array, names: ObsNames | None) -> str | None:
    """Return a sentence on names that do not fit observations (n, …); None: they do."""
    if names is None:
        return None
    if isinstance(names, Mapping) != (obs.dtype.names is not None):
        kind = "a Dict" if obs.dtype.names is not None else "no Dict"
        return f"obs_names is not used: an observation is {kind}, and the names are not for one."
    parts, named = _by_key(obs, names)
    for key, part_names in named.items():
        where = f" of {key!r}" if key else ""
        if key not in parts:
            return f"obs_names is not used{where}: an observation has no such key."
        count = int(np.prod(parts[key].shape[1:]))
        if len(part_names) != count:
            return (
                f"obs_names is not used{where}: it has {len(part_names):,} names, and an "
                f"observation {count:,} numbers."
            )
    return None


def _by_key(obs: Array, names: ObsNames | None) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the parts of observations, and the names of their numbers; a flat one is of ""."""
    keys = obs.dtype.names
    parts = {"": obs} if keys is None else {key: obs[key] for key in keys}
    return parts, dict(names) if isinstance(names, Mapping) else {"": names}


def decision_data(log: PlayedEpisodes, named: ObsNames | None = None) -> dict[str, Any]:
    """Return the decisions: names of coordinates, a row of these for each, and its call.

    Only coordinates that vary are there; the episode's step is the last one.
    """
    calls = np.concatenate([episode.calls for episode in log.episodes])
    calls = calls[:: -(-len(calls) // MOST_DECISIONS)]
    columns = varying(coordinates(calls["start"], named))
    if columns:
        columns["step of the episode"] = calls["age"]
    return {"names": list(columns), "rows": rows_of(columns), "calls": page_calls(calls)}


def seen(calls: Array, named: ObsNames | None) -> dict[str, Array]:
    """Return the numbers observed at the starts of calls by name, (n,) each.

    There are none if observations have no names, or more numbers than fit on the page.
    """
    columns = {} if named is None else coordinates(calls["start"], named)
    columns = {name: v for name, v in columns.items() if not name.startswith("obs[")}
    return {} if len(columns) > MOST_COORDINATES else columns


def rows_of(columns: Mapping[str, Array]) -> list[list[float | None]]:
    """Return columns of numbers as rows for a report's page."""
    return [[*map(rounded, row)] for row in zip(*columns.values(), strict=True)]


def rounded(value: float) -> float | None:
    """Return a number as the page's data hold it: five significant digits; None: unknown, NaN."""
    return None if np.isnan(value) else float(f"{value:.5g}")


def varying(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return the columns that vary, as many as fit on the page."""
    return dict([(k, v) for k, v in columns.items() if np.ptp(v) > 0][:MOST_COORDINATES])


def coordinates(obs: Array, names: ObsNames | None = None) -> dict[str, Array]:
    """Return the numbers of a batch of observations by name, (n,) each; none where they are images.

    Args:
        names: names for the numbers, where there are as many; see ``names_misfit``.
    """
    parts, named = _by_key(obs, names)
    columns: dict[str, Array] = {}
    for key, part in parts.items():
        name = f'obs["{key}"]' if key else "obs"
        part_names = named.get(key)
        if part.dtype.names is not None:
            continue  # a Dict in a Dict
        flat = np.asarray(part).reshape(len(part), -1)
        count = flat.shape[1]
        if count <= LARGEST_VECTOR:
            usual = [name] if part.ndim == 1 else [f"{name}[{i}]" for i in range(count)]
            fitting = part_names if part_names and len(part_names) == count else usual
            for i, label in enumerate(fitting):
                columns[usual[i] if label in columns else label] = flat[:, i].astype(float)
    return {k: v for k, v in columns.items() if np.isfinite(v).all()}
