"""The numbers of observations by which calls are compared, where the user names none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skillweave._internal.messages import short, suggest
from skillweave.calls.columns import CallColumns
from skillweave.calls.neighbors import FeatureMap, Standard, evenly, nearest
from skillweave.errors import DeclarationError
from skillweave.policies.core import Array
from skillweave.spaces import obs_codec

MOST_STEPS = 0.5
"""The share of steps in which a number has to change to be compared, if a skill does not see it."""
FEWEST = 30
"""Calls of a skill from which on it is measured whether a number says where they end."""
MOST = 2_000
"""The most calls, or steps, that this is measured by."""
NEIGHBORS = 5
BETTER = 0.95
"""The error of predicted ends, relative to that without some numbers, below which they help."""

Places = Sequence[int] | None


def fixed_places(log: CallColumns) -> list[int]:
    """Return the numbers that differ between episodes and never change within one.

    They are places in the flat observation, such as those of an episode's goal. Where skills see
    images alone, there are none.
    """
    if _sees_images(log):
        return []
    return np.flatnonzero((log.change_rate == 0) & log.varies).tolist()


def compared_places(log: CallColumns, *, keep_fixed: bool = False) -> tuple[Places, ...]:
    """Return the places by which calls of each skill are compared; None: all.

    They are the places that the skill sees, and those that change in most steps, as a position
    does: these say where a call ends though the skill does not see them, behind which wall, for
    example. A number that differs between episodes and never changes within one, as the place of a
    goal, only divides the log: it counts where it helps to predict where the skill's calls end.

    Args:
        log: the calls.
        keep_fixed: these numbers count in any case, as what is planned depends on them.
    """
    if _sees_images(log):
        return tuple(log.sees)
    codec = obs_codec(log.observation_space)
    fixed = [] if keep_fixed else fixed_places(log)
    moves = np.flatnonzero(log.change_rate > MOST_STEPS).tolist()
    start = log.flat(log.start)
    end = log.flat(log.end)
    places: list[Places] = []
    for skill, seen in enumerate(log.sees):
        if seen is None and codec.images:
            places.append(None)
            continue
        whole = range(codec.size) if seen is None else sorted({*seen, *moves})
        doubtful = [place for place in whole if place in fixed]
        rest = [place for place in whole if place not in fixed and log.varies[place]]
        if doubtful and rest and not _help(log, skill, start, end, rest, doubtful):
            places.append([place for place in whole if place not in fixed])
        else:
            places.append(seen if seen is None else whole)
    return tuple(places)


def feature_maps(
    log: CallColumns,
    features: Any,
    known: Array,
    *,
    keep_fixed: bool = False,
    skills: Sequence[int] | None = None,
) -> dict[int, FeatureMap]:
    """Return the features by which a log's calls are compared, by their skills' places.

    Args:
        log: the calls.
        features: for all skills, or by skill; None: the log's own, else the ``compared_places``.
        known: logged observations.
        keep_fixed: see ``compared_places``.
        skills: the places of those that are compared; None: all.
    """
    places = compared_places(log, keep_fixed=keep_fixed)
    names = log.skills
    features = log.features if features is None else features
    by_skill = features if isinstance(features, Mapping) else dict.fromkeys(names, features)
    for name in by_skill:
        if name not in names:
            raise DeclarationError(
                f"features= names {short(name)}, which is no skill of the log{suggest(name, names)}"
            )
    return {
        i: FeatureMap(
            log.observation_space,
            places[i] if by_skill.get(names[i]) is None else by_skill[names[i]],
            known,
            f"skill {names[i]!r}",
        )
        for i in (range(len(names)) if skills is None else skills)
    }


def _sees_images(log: CallColumns) -> bool:
    """Return whether observations have images, and every skill may see them."""
    images = obs_codec(log.observation_space).images
    return bool(images) and all(seen is None for seen in log.sees)


def _help(
    log: CallColumns, skill: int, start: Array, end: Array, rest: list[int], more: list[int]
) -> bool:
    """Return whether ``more`` numbers beside ``rest`` help to predict where a skill's calls end."""
    rows = np.flatnonzero((log.skill == skill) & ~log.began_late)  # a time limit cuts anywhere
    if len(rows) < FEWEST:
        return True
    rows = evenly(rows, MOST)
    moved = end[rows][:, rest].astype(np.float64) - start[rows][:, rest]
    goal = log.goals.get(log.skills[skill])
    own = np.zeros((len(rows), 0)) if goal is None else goal[rows]

    def points(places: list[int]) -> Array:
        return np.concatenate([start[rows][:, places], own], 1)

    return predict_better(points(rest), points([*rest, *more]), moved)


def predict_better(few: Array, many: Array, values: Array) -> bool:
    """Return whether points ``many`` (n, F) predict values (n, D) better than ``few`` (n, G)."""
    wanted = Standard(values)(values)

    def error(seen: Array) -> float:
        """Return the squared error of predicting a point by its nearest neighbors."""
        points = Standard(seen)(seen).astype(np.float32)
        near, _ = nearest(points, points, NEIGHBORS + 1, np.arange(len(points)))
        others = near != np.arange(len(points))[:, None]
        mean = (wanted[near] * others[..., None]).sum(1) / others.sum(1)[:, None]
        return float(np.square(mean - wanted).mean())

    return error(many) < BETTER * error(few)
