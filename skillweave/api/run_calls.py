"""The recorded calls of a run: in its directory, or in memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from skillweave._internal.messages import shown_path
from skillweave._internal.policy_protocol import Policy
from skillweave.calls.log import CallLog
from skillweave.calls.run_log import (
    RECORD,
    joined,
    load_calls,
    log_so_far,
    next_seed,
    save_calls,
)
from skillweave.envs.make import EnvSpec
from skillweave.errors import RunError
from skillweave.runs.directory import RunDirectory
from skillweave.runs.hub import is_copy_of_hub, must_be_own
from skillweave.schema import Count, fitted
from skillweave.skills.base import RecordedSkill
from skillweave.skills.skill_set import SkillSet, skills_below


class RunCalls:
    """The calls of one run.

    Args:
        path: the run's directory, or its weights file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._memory: CallLog | None = None

    def begin(
        self, policy: Policy, seed: int | None, info: Sequence[str]
    ) -> tuple[int, Sequence[str]]:
        """Return the seed and the keys of ``info`` of a new recording.

        Args:
            seed: None: one that was not used yet.
            info: keys; those of earlier calls are added, so that all calls can be joined.

        Raises:
            RunError: recorded calls could not be kept, or the skills' code is missing, which the
                calls so far were recorded with.
        """
        if self._is_own():
            must_be_own(self._path)  # an error comes before anything is played
            so_far = self._with_memory(log_so_far(RunDirectory.open(self._path)))
        else:
            so_far = self._read()
        if so_far is not None and (skills := skills_below(policy)) is not None:
            _check_code(so_far, skills)
        seed = next_seed(so_far) if seed is None else fitted(Count, seed, "seed")
        if so_far is None or isinstance(info, str):  # which is refused later
            return seed, info
        return seed, (*so_far.info, *(key for key in info if key not in so_far.info))

    def add(self, log: CallLog) -> None:
        """Keep recorded calls.

        Raises:
            RunError: they cannot be written; they stay in memory until they can.
        """
        self._memory = log if self._memory is None else joined(self._memory, log)
        if self._is_own():
            save_calls(RunDirectory.open(self._path), self._memory)
            self._memory = None

    def has_any(self) -> bool:
        """Return whether there are calls.

        Raises:
            RunError: their file cannot be used.
        """
        return self._read() is not None

    def read(self, policy: Policy, spec: EnvSpec) -> CallLog:
        """Return all calls of a policy's skills; notice where they are of another environment.

        Raises:
            RunError: there are none, or they are of other skills.
        """
        log = self._read()
        if log is None:
            raise RunError(f"{shown_path(self._path)} has no log of calls; {RECORD}")
        if (skills := skills_below(policy)) is not None:
            log.check_skills(skills, learning=True)  # how often they succeeded may be counted
        log.check_environment(spec)
        return log

    def _read(self) -> CallLog | None:
        is_run = self._path.is_dir()
        return self._with_memory(load_calls(RunDirectory.open(self._path)) if is_run else None)

    def _with_memory(self, log: CallLog | None) -> CallLog | None:
        """Return the calls in the run's file, joined with those that are only in memory."""
        if log is None or self._memory is None:
            return self._memory if log is None else log
        return joined(log, self._memory)

    def _is_own(self) -> bool:
        """Return whether calls are kept in the run's directory."""
        return self._path.is_dir() and not is_copy_of_hub(self._path)


def _check_code(log: CallLog, skills: SkillSet) -> None:
    """Raise a RunError where success() of a skill is not known, though it was in the log."""
    for name, known, skill in zip(log.skills, log.own_success, skills.skills, strict=False):
        if known and name == skill.name and isinstance(skill, RecordedSkill):
            raise RunError(
                f"the run's calls were recorded with the code of its skills, but now success() of "
                f"{name!r} is not known: load the run with its hierarchy (on the command line "
                "--recipe FILE.py)"
            )
