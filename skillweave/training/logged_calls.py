"""The log of calls that a stage keeps while it trains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from skillweave.notices import notice
from skillweave.paths import names_in
from skillweave.planning.recorder import Recorder
from skillweave.planning.run_log import save_calls
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import StageEntry
from skillweave.training.learning_task import LearningTask
from skillweave.types import Policy


def begin_calls(
    run: RunDirectory, entry: StageEntry, learning_task: LearningTask
) -> tuple[LearningTask, Recorder | None]:
    """Return a stage's task, and the recorder of its calls; None: no calls are logged."""
    steps, called = run.manifest.log_calls, learning_task.called
    if steps is None or called is None:
        return learning_task, None
    info, num_envs = run.manifest.log_calls_info, entry.num_envs
    spaces = called.spec.spaces.observation, called.spec.spaces.action
    recorder = Recorder(called.skills, spaces, num_envs, info=info, latest=steps, spec=called.spec)
    return replace(learning_task, log_calls=info), recorder


def save_logged(
    run: RunDirectory, entry: StageEntry, recorder: Recorder, policies: Mapping[str, Policy]
) -> None:
    """Write the calls of a finished stage into its run.

    Args:
        policies: that the stage has trained, by path.
    """
    skills = recorder.skills
    learning = {names_in(path)[0] for path in entry.learns} & {s.name for s in skills.skills}
    recorder.skills = replace(
        skills,
        policies=tuple(
            policies.get(skill.name, policy)
            for skill, policy in zip(skills.skills, skills.policies, strict=True)
        ),
    )
    log = recorder.log(learning)
    if len(log):
        save_calls(run, log)
    else:
        notice(
            f"stage {entry.name!r}: no whole call was recorded in the latest "
            f"{recorder.latest:,} steps (log_calls), so the run has no log of them"
        )
