"""Options of training that need no other module: the command line reads them, too.

``api.train_options`` completes them to those of ``train`` and ``resume``. The text under a field is
its help everywhere. This module imports nothing, so that help is instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class Continuing:
    """Options of every training, in Python and on the command line."""

    quiet: bool = False
    """No progress."""


@dataclass(frozen=True, kw_only=True)
class Starting:
    """Options of a training that starts a run, in Python and on the command line."""

    resume: bool = False
    """Continue the run in this directory if it has learnt something, else start one. It keeps its
    settings, and a message lists those that differ. If steps have grown (on the command line by
    --set steps=N or --scale), a finished run continues: in new episodes, with schedules over the
    new budget. Steps of stages whose learners learn again in a later one go to that stage."""
    overwrite: bool = False
    """Replace the run in this directory, also a finished one; not with resume. Files there that no
    run writes stay."""
    seed: int = 0
    """The root of every random stream."""


@dataclass(frozen=True, kw_only=True)
class Reports:
    """Options on evaluation, checkpoints and logs, all recorded; None: as ``TrainDefaults``."""

    eval_every: int | None = None
    """Environment steps between evaluations while training, by the learner's own reward; by
    default there are none. Their results are ``eval_return`` and ``eval_success`` in
    ``metrics.jsonl``."""
    eval_episodes: int | None = None
    """Episodes of each of these evaluations, by default 20."""
    checkpoint_every: int | None = None
    """Environment steps between checkpoints, by default 100,000."""
    keep: Literal["last", "best"] | None = None
    """"best": each stage ends with the weights whose periodic evaluation was best, by the mean
    return or by what its target is of; the last weights are evaluated, too. It needs
    ``eval_every``. A population ends with its best member in any case. By default "last"."""
    log_info: Sequence[str] | None = None
    """Keys of ``info``: the mean of each over the latest 100 episodes is ``info/<key>`` in
    ``metrics.jsonl`` and in trackers. Each episode counts with the value in its last step (in a
    skill's own stage, its call's). None, NaN and infinity are left out."""


@dataclass(frozen=True, kw_only=True)
class CallReports(Reports):
    """Options on logs of a hierarchy, too."""

    log_calls: int | None = None
    """Steps: the calls in the latest so many steps in which the selector acted, alone or together
    with skills, are the run's log of calls afterwards, as if ``Run.log_calls`` had recorded them;
    so ``Run.plan`` needs no further steps. Calls that are open at the end are left out. Skills that
    learnt in these steps have changed since: ``handover`` may count their calls, but ``plan``
    refuses them. A run that was interrupted logs the calls after it was continued. Nothing else
    changes. By default there is no log."""
    log_calls_info: Sequence[str] | None = None
    """Keys of ``info`` to record with the calls."""
