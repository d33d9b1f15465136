"""How calls end, and what a step is to the skill that acts in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from skillweave.envs.infos import info_rows
from skillweave.skills import Skill, asked
from skillweave.types import Array, Policy, Step

ENDED = "why"
"""Under this name a hierarchy's policy remembers why its last call ended; see ``Why``."""


class Why(IntEnum):
    """Why a call ended."""

    RUNNING = 0
    """It goes on."""
    OWN = 1
    """The skill's ``termination`` ended it."""
    LIMIT = 2
    """It had lasted as long as it may: ``max_steps``, or ``call_steps``."""
    INTERRUPTED = 3
    """The selector cut it, as it was worth more to decide anew."""
    EPISODE = 4
    """The episode ended, or has just begun: there is no call."""


@dataclass(frozen=True)
class Interruption:
    """When a call is cut (Sutton, Precup & Singh 1999, sec. 4)."""

    worth: Callable[[Array], Array]
    """Observations (n, …) to what each skill is worth there, and last what it is worth to decide
    anew, (n, S + 1), in deviations of the return."""
    margin: float
    """By how much deciding anew must be worth more, in the same unit."""
    critic: Policy | None = None
    """Who says what skills are worth, where it is trained."""


def judged(skill: Skill, step: Step, ids: Array, why: Array | None = None) -> tuple[Array, Array]:
    """What a step of environments ``ids`` (k,) was to the skill that acted.

    Args:
        step: as of ``skill_step``.
        why: (k,), why the skill's calls ended; None: it is not called, but acts all the time.

    Returns:
        Its reward (k,) float32; and (k,) bool: nothing is worth anything to it any more.
    """
    reward = asked(skill, "reward", step, len(ids), step.elapsed, ids)
    terminated = step.terminated.copy()
    if skill.defines("termination"):
        rest = ~terminated
        if why is not None:
            terminated[why == Why.OWN] = True
            rest = (why == Why.EPISODE) & ~terminated  # its last step may be the skill's end, too
        if len(rows := np.flatnonzero(rest)):
            last = skill_step(step, rows, step.elapsed[rows], skill.max_steps)
            terminated[rows] = asked(skill, "termination", last, len(rows), last.elapsed, ids[rows])
    return reward, terminated


def skill_step(step: Step, rows: Array, elapsed: Array, max_steps: int | None) -> Step:
    """Rows (m,) of a step, ascending, with the time as the running skill counts it.

    ``elapsed`` (m,) are the steps of its calls so far.
    """
    every = len(rows) == len(step.reward)  # then there is nothing to copy
    at = slice(None) if every else rows
    terminated = step.terminated[at]
    timed_out = np.zeros(len(rows), bool)
    if max_steps is not None:
        timed_out = (elapsed >= max_steps) & ~terminated
    info = step.info if every else info_rows(step.info, rows, len(step.reward))
    return Step(
        step.obs[at], step.action[at], step.next_obs[at], step.reward[at],
        terminated, step.truncated[at], timed_out, elapsed, info,
    )  # fmt: skip
