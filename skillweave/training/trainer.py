"""The trainer of a run's stages, one after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from skillweave._internal.interrupts import deferred
from skillweave._internal.notices import notice
from skillweave._internal.paths import names_in
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.calls.recorder import Recorder
from skillweave.calls.run_log import save_calls
from skillweave.runs.directory import RunDirectory
from skillweave.runs.manifest import Checkpoint, StageEntry
from skillweave.runs.trackers import Listener
from skillweave.training.agents import Agents
from skillweave.training.learning_task import LearningTask
from skillweave.training.stage import Policies, Stage
from skillweave.training.stage_log import StageLog
from skillweave.training.stage_run import MakeLearner, StageRun


@dataclass(frozen=True)
class Course:
    """The training of a run, stage by stage."""

    run: RunDirectory
    listeners: tuple[Listener, ...] = ()
    make_learner: MakeLearner = Agents
    """Makes a stage's learner, by its entry."""
    done: Mapping[str, Any] | None = None
    """The events by which a repair is judged, as for ``planning.handover``."""

    def tell(self, entry: StageEntry, text: str) -> None:
        """Send a message about a stage to the listeners."""
        for listener in self.listeners:
            listener.message(f"{entry.name}: {text}")

    def train(self, stages: Sequence[Stage], policies: Policies) -> dict[str, Policy]:
        """Train stages one after another; return all policies after them, by path.

        Args:
            policies: the policies before the first stage.
        """
        by_path = dict(policies)
        for stage in stages:
            by_path |= train_stage(stage, self, by_path)
        return by_path


def train_stage(stage: Stage, course: Course, earlier: Policies) -> dict[str, AgentPolicy]:
    """Train a stage to its end, or load it if it is done; return its policies, by name.

    Args:
        earlier: the policies so far, by path.

    Raises:
        TrainingError: training diverged.
        RunError: a checkpoint is damaged.
    """
    run = course.run
    entry = run.stage(stage.name)
    if entry.done:
        run.drop_used(entry)  # the run may have been killed just before
        return run.load_policies(stage.name)
    seeds = Seeds(run.manifest.seed) / stage.name
    learning_task = stage.learning_task(earlier)
    if keys := run.manifest.log_info:
        learning_task = replace(learning_task, log_info=tuple(keys))
    learning_task, recorder = begin_calls(run, entry, learning_task)
    learner = course.make_learner(StageRun(entry, run, seeds, learning_task, earlier, recorder))
    evolves = entry.evolution is not None
    with (
        global_generators(seeds / "global"),
        deferred("at the end of this generation" if evolves else "after this round"),
    ):
        try:
            learner.open()
            saved, at = run.load_checkpoint(stage.name) or ({}, Checkpoint.start(stage.name))
            log = StageLog(stage.name, run, course.listeners, at)
            learner.restore(saved, log)
            policies = learner.train()
        finally:
            learner.close()
        log.done(policies, learner.states())
    if recorder is not None:
        save_logged(run, entry, recorder, policies)
    return policies


def begin_calls(
    run: RunDirectory, entry: StageEntry, learning_task: LearningTask
) -> tuple[LearningTask, Recorder | None]:
    """Return a stage's task, and the recorder of its calls; None: no calls are logged."""
    steps = run.manifest.log_calls
    skills = learning_task.skills
    if steps is None or skills is None:
        return learning_task, None
    info, spec = run.manifest.log_calls_info, learning_task.role.spec
    spaces = spec.spaces.observation, spec.spaces.action
    recorder = Recorder(skills, spaces, entry.num_envs, info=info, latest=steps, spec=spec)
    return replace(learning_task, log_calls=info), recorder


def save_logged(
    run: RunDirectory, entry: StageEntry, recorder: Recorder, policies: Mapping[str, Policy]
) -> None:
    """Write the calls of a finished stage into its run.

    Args:
        policies: the policies that the stage has trained, by path.
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
