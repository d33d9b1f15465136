"""The handover section of a report, from the log of calls in the run: a matrix, films, ends."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from skillweave._internal.messages import short
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.calls.handover import CallEnds, Handover, before_each
from skillweave.calls.log import CallLog
from skillweave.calls.neighbors import evenly
from skillweave.envs.engine import RawStep
from skillweave.envs.make import EnvSpec
from skillweave.envs.obs_names import ObsNames
from skillweave.errors import EnvError
from skillweave.html_report import charts
from skillweave.html_report.film import HOLD, Mp4, Shot, make_film
from skillweave.html_report.page import Page
from skillweave.html_report.timelines import coordinates, names_misfit, rounded, varying
from skillweave.policies.core import Array
from skillweave.policies.spaces import space_of
from skillweave.reporting.facts import WHY, WORDS, number, percent, scale_of, span
from skillweave.skills import Skill
from skillweave.skills.goal_spaces import shown_goal
from skillweave.skills.goals import goals_of
from skillweave.training.skill_report import end_cells

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


@global_generators(Seeds(0) / "handover film")
def add_handover(
    page: Page,
    log: CallLog,
    spec: EnvSpec | None,
    colors: Mapping[str, str],
    with_goals: Mapping[str, Skill],
    *,
    filmed: bool,
) -> None:
    """Put the handover section, made of a log of calls, into a report's page.

    Args:
        spec: of the environment; None: unknown, so nothing can be filmed.
        colors: of the skills.
        with_goals: the skills with goals, by path.
        filmed: play calls again, and film them.
    """
    matrix = log.handover()
    named = None
    film: Mp4 | None = None
    before = before_each(log, log.succeeded)
    cells = {
        (i, j): np.flatnonzero((before == i) & (log.skill == j))
        for i, j in np.argwhere(matrix.calls > 0).tolist()
    }
    if spec is not None and filmed:
        chosen = _choose_clips(log, cells, matrix)
        with page.without("is no film of handovers"):
            shots = {row: _shot(log, row) for row in chosen}
            if shots:
                film = make_film(spec, shots, MOST_FRAMES, MOST_BYTES, log.check_spaces)
    if spec is not None:
        named = spec.observation_names()
        named = None if names_misfit(log.start[:1], named) else named
    clips = {row: _clip(log, row, film, with_goals) for row in film.first} if film else {}
    shown = {
        (i, j): _cell(matrix, i, j, log.take(rows).reasons)
        | {"clips": [clip for row, clip in clips.items() if row in rows]}
        for (i, j), rows in cells.items()
    }
    done = ("done", "not done")
    page.context |= {"handover": _words(log, matrix, shown, named), "hand_film": film}
    page.data["handover"] = {
        "cells": {cell["id"]: cell for cell in shown.values()},
        "colors": colors,
        "words": done,
        "spec": charts.handover(done),
        **_points(log, cells, named),
    }
    if film:
        page.data["handover"]["film"] = {"fps": film.fps}


def _words(
    log: CallLog,
    matrix: Handover,
    shown: Mapping[tuple[int, int], Mapping[str, Any]],
    named: ObsNames | None,
) -> dict[str, Any]:
    """Return the values for the template of the section; ``shown``: those of each cell."""
    rows = [
        {
            "name": name if i else "start of an episode",
            "cells": [shown.get((i, j)) for j in range(len(matrix.skills))],
        }
        for i, name in enumerate(matrix.before)
    ]
    # Names between backticks, and percents as the page writes them.
    prose = [re.sub(r"'([^']+)'", r"`\1`", sentence) for sentence in matrix.weakest()]
    called = [name for i, name in enumerate(log.skills) if (log.skill == i).any()]
    return {
        "matrix": matrix,
        "rows": rows,
        "weakest": [re.sub(r"(\d)%", r"\1 %", sentence) + "." for sentence in prose],
        "weak": any(cell["weak"] for cell in shown.values()),
        "calls": f"{len(log):,}",
        "steps": f"{log.steps:,}",
        "left_out": matrix.left_out,
        "ends": [_end_row(log.call_ends(name)) for name in called],
        "called": called,
        "where": _where_rows(log, called, named),
    }


def _end_row(ends: CallEnds) -> dict[str, Any]:
    """Return a row of the section: the ends of a skill's calls, in words."""
    return {
        "name": ends.skill,
        "calls": f"{ends.calls:,}",
        "length": number(ends.steps, max(ends.steps, 10)),
        "ends": end_cells(ends.reasons, ends.own_with_episode, ends.calls, WORDS),
        "done": percent(ends.succeeded),
    }


def _where_rows(
    log: CallLog, called: Sequence[str], named: ObsNames | None
) -> list[dict[str, Any]]:
    """Return rows of the section: the middle 80 % of each coordinate where skills' calls end."""
    rows = []
    for name, values in varying(coordinates(log.end, named)).items():
        scale = scale_of(np.quantile(values, (0.05, 0.95)).tolist())
        cells = []
        for skill in called:
            some = values[log.skill == log.number(skill)]
            low, middle, high = (
                number(float(q), scale) for q in np.quantile(some, (0.1, 0.5, 0.9))
            )
            cells.append({"middle": middle, "range": f"{low} to {high}"})
        rows.append({"name": name, "cells": cells})
    return rows


def _points(log: CallLog, cells: Cells, named: ObsNames | None) -> dict[str, Any]:
    """Return names of coordinates, and rows of each cell: at start and end of a call, if done."""
    both = {when: coordinates(obs, named) for when, obs in (("start", log.start), ("end", log.end))}
    names = list(varying({k: np.stack([v, both["end"][k]]) for k, v in both["start"].items()}))
    most = max(10, MOST_POINTS // max(1, len(cells)))
    points = {
        f"{i}-{j}": [
            [*(rounded(both[when][k][c]) for when in both for k in names), int(log.succeeded[c])]
            for c in evenly(rows, most)
        ]
        for (i, j), rows in cells.items()
    }
    return {"names": names, "points": points if names else {}}


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


# The film: clips of calls, each with the end of the call before


def _clip(log: CallLog, row: int, film: Mp4, with_goals: Mapping[str, Skill]) -> dict[str, Any]:
    """Return a clip for the page's script."""
    (before, lead, steps) = _extent(log, row)
    first = film.first[row]
    return {
        "from": first,
        "call": first + -(-lead // film.every),
        "to": first + -(-(lead + steps) // film.every) + HOLD,
        "done": bool(log.succeeded[row]),
        "steps": int(log.tau[row]),
        "goal": _goal(log, row, with_goals),
        "before_goal": "".join(_goal(log, other, with_goals) for other in before),
    }


def _goal(log: CallLog, row: int, with_goals: Mapping[str, Skill]) -> str:
    """Return the goal of a call in words; empty: it has none, or its space is not known."""
    name = log.skills[int(log.skill[row])]
    goals = goals_of(with_goals.get(name))
    numbers = log.goals.get(name)
    if goals is None or numbers is None or numbers.shape[1] != goals.space.size:
        return ""
    return shown_goal(goals.space.of_numbers(numbers[[row]])[0])


def _extent(log: CallLog, row: int) -> tuple[list[int], int, int]:
    """Return the call before a call, if there is one, and the steps of each that a film shows."""
    before = np.flatnonzero(log.followed_by == row)
    lead = int(log.tau[before].clip(max=LEAD).sum())
    return before.tolist(), lead, min(int(log.tau[row]), LONGEST)


def _choose_clips(log: CallLog, cells: Cells, matrix: Handover) -> list[int]:
    """Choose calls of each cell, one that was not done and one that was, as many as fit.

    Cells that are worse than others come first, and two of their calls that were not done.
    """
    playable = _playable(log)
    weak = set(matrix.weak())
    age = np.array(log.age)
    chosen = list[int]()
    order = sorted(cells, key=lambda place: (place not in weak, matrix.rate[place]))
    wanted = [(place, done, 2) for place in order for done in (False, True)]
    # A second one of the weak cells if there is room.
    wanted += [(place, False, 3) for place in order if place in weak]
    filmed = replayed = 0
    for place, done, part in wanted:
        rows = cells[place][playable[cells[place]]]
        some = rows[log.succeeded[rows] == done]
        if len(some) < part - 1:
            continue
        # In the middle of all ages: neither the first calls of an episode nor the last.
        row = int(some[np.argsort(age[some], kind="stable")][len(some) // part])
        _, lead, steps = _extent(log, row)
        shown = filmed + lead + steps
        played = replayed + int(age[row] + log.tau[row])
        if row not in chosen and shown <= MOST_FILMED and played <= MOST_REPLAYED:
            filmed = shown
            replayed = played
            chosen.append(row)
    return chosen


def _playable(log: CallLog) -> Array:
    """Return the calls that can be played again, (C,) bool: the log has all before them."""
    playable = np.zeros(len(log), bool)
    first = np.flatnonzero((log.order == 0) & (log.seed >= 0))
    while len(first):
        playable[first] = True
        first = log.followed_by[first]
        first = first[first >= 0]
    return playable


def _shot(log: CallLog, row: int) -> Shot:
    """Return the shot of a call and the end of the one before, with the observations of the log.

    Raises:
        EnvError: the log has an action that does not exist.
    """
    (_, lead, shown) = _extent(log, row)
    before = int(log.age[row])
    space = log.action_space
    calls = np.flatnonzero((log.episode == log.episode[row]) & (log.order <= log.order[row]))
    calls = calls[np.argsort(log.order[calls])]
    steps = np.concatenate([np.arange(log.offset[c], log.offset[c + 1]) for c in calls])
    actions = log.action[steps[: before + shown]]
    logged = np.concatenate([log.start[calls[:1]], log.next_obs[steps]])
    for action in actions:
        if not space.contains(space_of(space).unpacked(action)):
            raise EnvError(f"the log has the action {short(action)}, which does not exist")

    def same(t: int, obs: Array, step: RawStep | None) -> bool:
        return np.array_equal(obs, logged[t])

    return Shot(int(log.seed[row]), actions, same, "the same seed", before - lead)
