"""The handover section of a report, from the log of calls in the run: a matrix, films, ends."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.envs.engine import RawStep
from skillweave.envs.make import EnvSpec
from skillweave.envs.obs_names import ObsNames
from skillweave.errors import EnvError, SkillweaveError
from skillweave.planning import CallLog, Handover
from skillweave.planning.handover import before_each
from skillweave.planning.neighbors import evenly
from skillweave.policies.spaces import space_of
from skillweave.reporting.report import charts
from skillweave.reporting.report.calls import (
    coordinates,
    names_misfit,
    rounded,
    varying,
)
from skillweave.reporting.report.facts import WHY, WORDS, number, percent, scale_of, span
from skillweave.reporting.report.film import HOLD, Film, Shot, make_film
from skillweave.reporting.report.page import Section
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.skills.goals import goals_of
from skillweave.training.skill_report import end_cells
from skillweave.types import Array

MOST_FRAMES = 1_200
MOST_FILMED = 4 * MOST_FRAMES
"""The most steps in the film."""
MOST_REPLAYED = 100_000
"""The most steps that are played again, to come to the calls in the film."""
MOST_BYTES = 1_800_000
LEAD = 40
"""The most steps that a clip shows of the call before."""
LONGEST = 300
"""The most steps that a clip shows of the call."""
MOST_POINTS = 2_000
"""The most calls in the chart, of all cells."""


Cells = Mapping[tuple[int, int], Array]
"""The rows of the log by the skills before and after, as places in the matrix."""


@dataclass(frozen=True)
class _Clip:
    """A call, with the end of the call before."""

    row: int
    """Of the log."""
    before: int
    """The row of the call before; −1: it begins an episode."""
    lead: int
    """Steps that are shown of the call before."""
    steps: int
    """Steps that are shown of the call."""


def handover_section(
    log: CallLog,
    spec: EnvSpec | None,
    colors: Mapping[str, str],
    with_goals: Mapping[str, Skill],
    *,
    filmed: bool,
) -> Section:
    """Return the section for a log.

    Args:
        spec: of the environment; None: unknown, so nothing can be filmed.
        colors: of the skills.
        with_goals: the skills with goals, by path.
        filmed: play calls again, and film them.
    """
    matrix, missing = log.handover(), []
    before = before_each(log, log.succeeded)
    cells = {
        (i, j): np.flatnonzero((before == i) & (log.skill == j))
        for i, j in np.argwhere(matrix.calls > 0).tolist()
    }
    film, clips = None, list[_Clip]()
    if spec is not None and filmed:
        try:
            clips = _choose_clips(log, cells, matrix)
            film = _film(log, spec, clips) if clips else None
        except SkillweaveError as error:
            missing.append(f"There is no film of handovers: {str(error).rstrip('.')}.")
    named = None if spec is None else spec.observation_names()
    named = None if names_misfit(log.start[:1], named) else named
    points = _points(log, cells, named)
    done = ("done", "not done")
    shown = {
        (i, j): _cell(matrix, i, j, log.take(rows).reasons)
        | {
            "clips": [
                _shown(log, clip, film, with_goals)
                for clip in clips
                if film is not None and clip.row in rows
            ]
        }
        for (i, j), rows in cells.items()
    }
    data = {
        "cells": {cell["id"]: cell for cell in shown.values()},
        "colors": dict(colors),
        "words": list(done),
        "spec": charts.handover(done),
        **points,
    }
    if film is not None:
        data["film"] = {"fps": film.fps}
    context = {"handover": _words(log, matrix, shown, named), "hand_film": film}
    return Section(context, {"handover": data}, missing)


def _words(
    log: CallLog,
    matrix: Handover,
    shown: Mapping[tuple[int, int], Mapping[str, Any]],
    named: ObsNames | None,
) -> dict[str, Any]:
    """Return what the section's words are made of; ``shown``: of each cell."""
    rows = [
        {
            "name": name if i else "start of an episode",
            "cells": [shown.get((i, j)) for j in range(len(matrix.skills))],
        }
        for i, name in enumerate(matrix.before)
    ]
    # Names between backticks, and percents as the page writes them.
    prose = [re.sub(r"'([^']+)'", r"`\1`", sentence) for sentence in matrix.weakest()]
    return {
        "columns": list(matrix.skills),
        "rows": rows,
        "weakest": [re.sub(r"(\d)%", r"\1 %", sentence) + "." for sentence in prose],
        "weak": any(cell["weak"] for cell in shown.values()),
        "meaning": matrix.meaning,
        "calls": f"{len(log):,}",
        "steps": f"{log.steps:,}",
        "cut": f"{int(matrix.cut.sum()):,}" if matrix.cut.any() else "",
        "ends": _end_rows(log),
        "where": _where_rows(log, named),
    }


def _called(log: CallLog) -> list[str]:
    """Return the skills with calls."""
    return [name for i, name in enumerate(log.skills) if (log.skill == i).any()]


def _end_rows(log: CallLog) -> list[dict[str, Any]]:
    """Return a row for each skill: how its calls end."""
    rows = []
    for name in _called(log):
        ends = log.call_ends(name)
        rows.append(
            {
                "name": name,
                "calls": f"{ends.calls:,}",
                "length": number(ends.steps, max(ends.steps, 10)),
                "ends": end_cells(ends.reasons, ends.own_with_episode, ends.calls, WORDS),
                "done": percent(ends.succeeded),
            }
        )
    return rows


def _where_rows(log: CallLog, named: ObsNames | None) -> dict[str, Any]:
    """Return the middle 80 % of each coordinate where calls end, by skill."""
    columns = varying(coordinates(log.end, named))
    skills = _called(log)
    rows = []
    for name, values in columns.items():
        scale, cells = scale_of(np.quantile(values, (0.05, 0.95)).tolist()), []
        for skill in skills:
            some = values[log.skill == log.number(skill)]
            low, middle, high = (
                number(float(q), scale) for q in np.quantile(some, (0.1, 0.5, 0.9))
            )
            cells.append({"middle": middle, "range": f"{low} to {high}"})
        rows.append({"name": name, "cells": cells})
    return {"skills": skills, "rows": rows}


def _points(log: CallLog, cells: Cells, named: ObsNames | None) -> dict[str, Any]:
    """Return names of coordinates, and rows of each cell: at start and end of a call, if done."""
    both = {when: coordinates(obs, named) for when, obs in (("start", log.start), ("end", log.end))}
    names = list(varying({k: np.stack([v, both["end"][k]]) for k, v in both["start"].items()}))
    if not names:
        return {"names": [], "points": {}}
    most = max(10, MOST_POINTS // max(1, len(cells)))
    points = {}
    for (i, j), rows in cells.items():
        some = evenly(rows, most)
        points[f"{i}-{j}"] = [
            [*(rounded(both[when][k][c]) for when in both for k in names), int(log.succeeded[c])]
            for c in some
        ]
    return {"names": names, "points": points}


def _cell(matrix: Handover, i: int, j: int, reasons: Mapping[str, int]) -> dict[str, Any]:
    """Return a cell for the page and its script; ``reasons``: its calls by their ends."""
    calls, done = int(matrix.calls[i, j]), int(matrix.done[i, j])
    count = f"{done:,} of {calls:,}"
    return {
        "id": f"{i}-{j}",
        "skill": matrix.skills[j],
        "before": matrix.before[i] if i else "",
        "share": done / calls,
        "count": count,
        "done": f"{count} calls ({percent(done / calls)})",
        "weak": (i, j) in matrix.weak(),
        "interval": span(bound[i, j] for bound in matrix.interval),
        "ends": ", ".join(f"{WHY[why]} {n:,}" for why, n in reasons.items() if n),
    }


def _shown(
    log: CallLog, clip: _Clip, film: Film, with_goals: Mapping[str, Skill]
) -> dict[str, Any]:
    """Return a clip for the page's script."""
    first = film.first[clip.row]
    return {
        "from": first,
        "call": first + -(-clip.lead // film.every),
        "to": first + -(-(clip.lead + clip.steps) // film.every) + HOLD,
        "done": bool(log.succeeded[clip.row]),
        "steps": int(log.tau[clip.row]),
        "goal": _goal(log, clip.row, with_goals),
        "before_goal": _goal(log, clip.before, with_goals) if clip.before >= 0 else "",
    }


def _goal(log: CallLog, row: int, with_goals: Mapping[str, Skill]) -> str:
    """Return the goal of a call in words; empty: it has none, or its space is not known."""
    name = log.skills[int(log.skill[row])]
    goals, numbers = goals_of(with_goals.get(name)), log.goals.get(name)
    if goals is None or numbers is None or numbers.shape[1] != goals.space.size:
        return ""
    return shown_goal(goals.space.of_numbers(numbers[[row]])[0])


# The film


@global_generators(Seeds(0) / "handover film")
def _film(log: CallLog, spec: EnvSpec, clips: Sequence[_Clip]) -> Film:
    """Play calls again, and film them.

    Raises:
        EnvError: the environment gives no frames, or does not repeat itself.
        MissingExtra: the extra 'video' is not installed.
    """
    return make_film(
        spec,
        {clip.row: _shot(log, clip) for clip in clips},
        most_frames=MOST_FRAMES,
        most_bytes=MOST_BYTES,
        check_spaces=log.check_spaces,
    )


def _choose_clips(log: CallLog, cells: Cells, matrix: Handover) -> list[_Clip]:
    """Choose calls of each cell, one that was not done and one that was, as many as fit.

    Cells that are worse than others come first, and two of their calls that were not done.
    """
    playable, weak = _playable(log), set(matrix.weak())
    age, tau = np.array(log.age), log.tau
    order = sorted(cells, key=lambda place: (place not in weak, matrix.rate[place]))
    chosen: dict[int, _Clip] = {}
    filmed = replayed = 0
    for many in (False, True):  # a second one of the weak cells if there is room
        for place in order:
            rows = cells[place][playable[cells[place]]]
            for done in (False,) if many else (False, True):
                some = rows[log.succeeded[rows] == done]
                if (many and place not in weak) or len(some) <= many:
                    continue
                # In the middle of all ages: neither the first calls of an episode nor the last.
                row = int(
                    some[np.argsort(age[some], kind="stable")][len(some) // (3 if many else 2)]
                )
                before = int(np.flatnonzero(log.followed_by == row)[0]) if place[0] else -1
                lead = min(LEAD, int(tau[before])) if place[0] else 0
                clip = _Clip(row, before, lead, min(int(tau[row]), LONGEST))
                shown, steps = clip.lead + clip.steps, int(age[row] + tau[row])
                if filmed + shown > MOST_FILMED or replayed + steps > MOST_REPLAYED:
                    continue
                if row not in chosen:
                    filmed, replayed = filmed + shown, replayed + steps
                    chosen[row] = clip
    return list(chosen.values())


def _playable(log: CallLog) -> Array:
    """Return the calls that can be played again, (C,) bool: the log has all before them."""
    playable = np.zeros(len(log), bool)
    first = np.flatnonzero((log.order == 0) & (log.seed >= 0))
    while len(first):
        playable[first] = True
        first = log.followed_by[first]
        first = first[first >= 0]
    return playable


def _shot(log: CallLog, clip: _Clip) -> Shot:
    """Return the shot of a clip, with the observations of the log.

    Raises:
        EnvError: the log has an action that does not exist.
    """
    row, space = clip.row, log.action_space
    calls = np.flatnonzero((log.episode == log.episode[row]) & (log.order <= log.order[row]))
    calls = calls[np.argsort(log.order[calls])]
    before = int(log.age[row])
    steps = [np.arange(log.offset[call], log.offset[call + 1]) for call in calls]
    actions = log.action[np.concatenate(steps)[: before + clip.steps]]
    logged = np.concatenate([log.start[calls[:1]], log.next_obs[np.concatenate(steps)]])
    for action in actions:
        if not space.contains(space_of(space).unpacked(action)):
            raise EnvError(f"the log has the action {short(action)}, which does not exist")

    def same(t: int, obs: Array, step: RawStep | None) -> bool:
        return np.array_equal(obs, logged[t])

    return Shot(int(log.seed[row]), actions, same, "the same seed", before - clip.lead)
