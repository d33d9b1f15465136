"""A run's copies of policies that were ready when it began."""

from __future__ import annotations

from pathlib import Path

from skillweave.policies.files import read_file
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import make_directory, write_bytes
from skillweave.skills.foreign_policy import Foreign, as_recorded
from skillweave.types import Policy


def copy_ready_policy(run: RunDirectory, skill: str, policy: Policy) -> None:
    """Copy the content of a skill's ready policy into the run, if it has content to copy."""
    if isinstance(policy, Foreign) and (content := policy.content()) is not None:
        path = _copy_path(run, skill, policy)
        if not path.exists():  # a resumed run has it
            run.check()
            make_directory(path.parent)
            write_bytes(path, content, make_directories=False)


def policy_at_start(run: RunDirectory, skill: str, policy: Policy) -> Policy:
    """Return a skill's ready policy as it was when the run began.

    Raises:
        RunError: the policy has changed, and the run holds no copy.
    """

    def read() -> bytes | None:
        assert isinstance(policy, Foreign)
        path = _copy_path(run, skill, policy)
        return read_file(path) if path.exists() else None

    return as_recorded(
        policy, run.manifest.by_path[skill].policy, read, f"{run.path}: skill {skill!r}"
    )


def _copy_path(run: RunDirectory, skill: str, policy: Foreign) -> Path:
    return run.path / "policies" / f"{file_name(skill)}{policy.suffix}"
