"""The handover section of a report, from the log of calls in the run: a matrix, films, ends."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from skillweave.envs.engine import RawStep
from skillweave.envs.make import EnvSpec
from skillweave.envs.obs_names import ObsNames
from skillweave.errors import EnvError, SkillweaveError
from skillweave.messages import short
from skillweave.planning import CallLog, Handover
from skillweave.planning.handover import before_each
from skillweave.reporting.report import charts
from skillweave.reporting.report.calls import (
    coordinates,
    names_misfit,
    rounded,
    varying,
)
from skillweave.reporting.report.facts import WHY, WORDS, number, percent, scale_of
from skillweave.reporting.report.film import HOLD, Film, Shot, make_film
from skillweave.reporting.report.page import Section
from skillweave.seeding import Seeds, global_generators
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.skills.goals import goals_of
from skillweave.spaces import env_form
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


@dataclass
class _Clip:
    """A call, with the end of the call before."""

    row: int
    """Of the log."""
    lead: int
    """Steps that are shown of the call before."""
    steps: int
    """Steps that are shown of the call."""
    frame: int = 0
    """The first one in the film."""


@dataclass
class _Cell:
    """The calls of one skill after another one."""

    rows: Array
    """Of the log."""
    clips: list[_Clip] = field(default_factory=list)


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
        (i, j): _Cell(np.flatnonzero((before == i) & (log.skill == j)))
        for i, j in np.argwhere(matrix.calls > 0).tolist()
    }
    film = None
    if spec is not None and filmed:
        try:
            film = _film(log, spec, cells, matrix)
        except SkillweaveError as error:
            missing.append(f"There is no film of handovers: {str(error).rstrip('.')}.")
    named = None if spec is None else spec.observation_names()
    named = None if names_misfit(log.start[:1], named) else named
    if film is None:
        for cell in cells.values():
            cell.clips = []
    points = _points(log, cells, named)
    done = ("done", "not done")
    data = {
        "cells": {
            f"{i}-{j}": _cell(matrix, i, j, log, cell, film, with_goals)
            for (i, j), cell in cells.items()
        },
        "colors": dict(colors),
        "words": list(done),
        "spec": charts.handover(done),
        **points,
    }
    if film is not None:
        data["film"] = {"fps": film.fps}
    context = {"handover": _words(log, matrix, named), "hand_film": film}
    return Section(context, {"handover": data}, missing)


def _words(log: CallLog, matrix: Handover, named: ObsNames | None) -> dict[str, Any]:
    weak = set(matrix.weak())
    rows = []
    for i, name in enumerate(matrix.before):
        cells: list[dict[str, Any] | None] = []
        for j in range(len(matrix.skills)):
            calls, done = int(matrix.calls[i, j]), int(matrix.done[i, j])
            if not calls:
                cells.append(None)
                continue
            cell = {"id": f"{i}-{j}", "share": done / calls, "percent": percent(done / calls)}
            cell |= {"count": f"{done:,} of {calls:,}", "weak": (i, j) in weak}
            cells.append(cell | {"words": _interval(matrix, i, j)})
        rows.append({"name": name if i else "start of an episode", "cells": cells})
    # Names between backticks, and percents as the page writes them.
    prose = [re.sub(r"'([^']+)'", r"`\1`", sentence) for sentence in matrix.weakest()]
    return {
        "columns": list(matrix.skills),
        "rows": rows,
        "weakest": [re.sub(r"(\d)%", r"\1 %", sentence) + "." for sentence in prose],
        "weak": bool(weak),
        "meaning": matrix.meaning,
        "calls": f"{len(log):,}",
        "steps": f"{log.steps:,}",
        "cut": f"{int(matrix.cut.sum()):,}" if matrix.cut.any() else "",
        "ends": _end_rows(log),
        "where": _where_rows(log, named),
    }


def _interval(matrix: Handover, i: int, j: int) -> str:
    low, high = (percent(float(bound[i, j])) for bound in matrix.interval)
    return f"{low} to {high}"


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


def _points(
    log: CallLog, cells: Mapping[tuple[int, int], _Cell], named: ObsNames | None
) -> dict[str, Any]:
    """Return names of coordinates, and rows of each cell: at start and end of a call, if done."""
    both = {when: coordinates(obs, named) for when, obs in (("start", log.start), ("end", log.end))}
    names = list(varying({k: np.stack([v, both["end"][k]]) for k, v in both["start"].items()}))
    if not names:
        return {"names": [], "points": {}}
    most = max(10, MOST_POINTS // max(1, len(cells)))
    points = {}
    for (i, j), cell in cells.items():
        rows = cell.rows[np.linspace(0, len(cell.rows) - 1, min(most, len(cell.rows))).astype(int)]
        points[f"{i}-{j}"] = [
            [*(rounded(both[when][k][c]) for when in both for k in names), int(log.succeeded[c])]
            for c in rows
        ]
    return {"names": names, "points": points}


def _cell(
    matrix: Handover,
    i: int,
    j: int,
    log: CallLog,
    cell: _Cell,
    film: Film | None,
    with_goals: Mapping[str, Skill],
) -> dict[str, Any]:
    """Return a cell for the page's script."""
    calls, done = int(matrix.calls[i, j]), int(matrix.done[i, j])
    reasons = log.take(cell.rows).reasons
    return {
        "skill": matrix.skills[j],
        "before": matrix.before[i] if i else "",
        "done": f"{done:,} of {calls:,} calls ({percent(done / calls)})",
        "interval": _interval(matrix, i, j),
        "ends": ", ".join(f"{WHY[why]} {n:,}" for why, n in reasons.items() if n),
        "clips": [
            {
                "from": clip.frame,
                "call": clip.frame + -(-clip.lead // film.every),
                "to": clip.frame + -(-(clip.lead + clip.steps) // film.every) + HOLD,
                "done": bool(log.succeeded[clip.row]),
                "steps": int(log.tau[clip.row]),
                "goal": _goal(log, clip.row, with_goals),
                "before_goal": _goal(log, _before(log, clip.row), with_goals) if i else "",
            }
            for clip in cell.clips
            if film is not None
        ],
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
def _film(
    log: CallLog, spec: EnvSpec, cells: Mapping[tuple[int, int], _Cell], matrix: Handover
) -> Film | None:
    """Play calls of each cell again, and film them; None: none can be played again.

    Raises:
        EnvError: the environment gives no frames, or does not repeat itself.
        MissingExtra: the extra 'video' is not installed.
    """
    clips = _choose_clips(log, cells, matrix)
    if not clips:
        return None
    film = make_film(
        spec,
        {clip.row: _shot(log, clip) for clip in clips},
        most_frames=MOST_FRAMES,
        most_bytes=MOST_BYTES,
        check_spaces=log.check_spaces,
    )
    for clip in clips:
        clip.frame = film.first[clip.row]
    return film


def _choose_clips(
    log: CallLog, cells: Mapping[tuple[int, int], _Cell], matrix: Handover
) -> list[_Clip]:
    """Choose calls of each cell, one that was not done and one that was, as many as fit.

    Cells that are worse than others come first, and two of their calls that were not done.
    """
    playable, weak = _playable(log), set(matrix.weak())
    age = np.array(log.age)
    order = sorted(cells, key=lambda place: (place not in weak, matrix.rate[place]))
    chosen: list[_Clip] = []
    filmed = replayed = 0
    for many in (False, True):  # a second one of the weak cells if there is room
        for place in order:
            rows = cells[place].rows[playable[cells[place].rows]]
            for done in (False,) if many else (False, True):
                some = rows[log.succeeded[rows] == done]
                if (many and place not in weak) or len(some) <= many:
                    continue
                # In the middle of all ages: neither the first calls of an episode nor the last.
                row = int(
                    some[np.argsort(age[some], kind="stable")][len(some) // (3 if many else 2)]
                )
                tau = int(log.tau[row])
                lead = min(LEAD, int(log.tau[_before(log, row)])) if place[0] else 0
                clip = _Clip(row, lead, min(tau, LONGEST))
                shown, steps = clip.lead + clip.steps, int(age[row]) + tau
                if filmed + shown > MOST_FILMED or replayed + steps > MOST_REPLAYED:
                    continue
                if any(clip.row == other.row for other in cells[place].clips):
                    continue
                filmed, replayed = filmed + shown, replayed + steps
                cells[place].clips.append(clip)
                chosen.append(clip)
    return chosen


def _before(log: CallLog, row: int) -> int:
    """Return the call before a call."""
    return int(np.flatnonzero(log.followed_by == row)[0])


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
        if not space.contains(env_form(space, action)):
            raise EnvError(f"the log has the action {short(action)}, which does not exist")

    def same(t: int, obs: Array, step: RawStep | None) -> bool:
        return np.array_equal(obs, logged[t])

    return Shot(int(log.seed[row]), actions, same, "the same seed", before - clip.lead)
