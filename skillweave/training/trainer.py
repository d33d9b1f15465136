"""One trainer for every stage: a plain agent, a skill, a selector, or a population of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from skillweave._internal.interrupts import deferred
from skillweave._internal.notices import notice
from skillweave._internal.paths import names_in
from skillweave._internal.seeding import Seeds, global_generators, seed_global_generators
from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.errors import DeclarationError
from skillweave.experience.acting import Acting
from skillweave.experience.collector import Collector
from skillweave.experience.group import MakeCollector
from skillweave.ops.device import resolve_device
from skillweave.planning.recorder import Recorder
from skillweave.planning.run_log import save_calls
from skillweave.runs.directory import RunDirectory
from skillweave.runs.initial_policies import initial_policy
from skillweave.runs.manifest import Checkpoint, StageEntry
from skillweave.runs.trackers import Listener
from skillweave.training.episodes import Episodes, Tick
from skillweave.training.learner import Learner, Stack, keep_to_guide
from skillweave.training.learning_task import LearningTask
from skillweave.training.loop import Progress, Saved, begin_episodes, resume, train
from skillweave.training.periodic import PeriodicEvaluation, episodes_of
from skillweave.training.rehearsal import rehearse
from skillweave.training.replay_learner import ReplayLearner, learner_of
from skillweave.training.stage import Policies, Stage
from skillweave.training.stage_log import StageLog, resumed
from skillweave.training.stage_run import MakeLearner, StageRun, begin_as
from skillweave.types import Array, Policy, prefixed, unprefixed
from skillweave.workers.placement import MakeCollectors, make_collectors

EARLY = 0.25
"""Share of a stage's budget after which skills without a call are reported."""


class OneAgent:
    """The learner of a stage without a population.

    Args:
        make_collectors: makes the collectors, here or in other processes.
    """

    def __init__(self, stage: StageRun, make_collectors: MakeCollectors = make_collectors) -> None:
        if stage.entry.evolution is not None:
            raise DeclarationError(f"stage {stage.name!r} evolves: it needs a population to train")
        self.stage = stage
        self._resources = ExitStack()
        self._make_collectors = make_collectors

    def open(self) -> Any:
        """Make the environments and the agent; return the agent's state."""
        stage, config, learning_task = self.stage, self.stage.config, self.stage.learning_task
        manifest = stage.run.manifest
        fresh = self.make_agents()
        workers = stage.entry.workers
        make = partial(_seeded, self.maker(), stage.seeds / "global")
        self.collectors = self._make_collectors(
            make, config.num_envs, workers, 1, learning_task.name
        )
        self._resources.callback(self.collectors.close)
        self.evaluation = PeriodicEvaluation(
            learning_task,
            stage.seeds,
            manifest.eval_every,
            manifest.eval_episodes,
            config.num_envs,
        )
        self._resources.callback(self.evaluation.close)
        self.episodes = Episodes(learning_task.log_info)
        self.best = stage.best
        return fresh

    def make_agents(self) -> Any:
        """Make the learning algorithms; return the fresh state that checkpoints hold, or None."""
        stage, learning_task = self.stage, self.stage.learning_task
        spaces = learning_task.observation_space, learning_task.action_space
        self.algorithm = make_algorithm(stage.config, *spaces)
        self.start = None
        earlier = stage.policies.get(stage.learner)
        if stage.continues:
            pass  # its final state holds everything
        elif isinstance(earlier, AgentPolicy):  # it learns again
            self.start = earlier, stage.steps_before(stage.learner)
        else:
            self.start = initial_policy(stage.run, stage.name, stage.name, self.algorithm)
        return self._initial_state()

    def _initial_state(self) -> Any:
        """Return the agent's state at the start of this stage."""
        state = self.algorithm.init([self.stage.seeds / "member" / 0])
        if self.start is not None:
            begin_as(self.algorithm, state, *self.start)
        return state

    def maker(self) -> MakeCollector:
        """Return a function that makes collectors; it may be sent to other machines."""
        return partial(_collector, self.stage.learning_task, self.algorithm)

    def learner_from(self, state: Any, extra: dict[str, Tensor], log: StageLog) -> Learner:
        """Return the learner that continues from ``state``."""
        stage, config = self.stage, self.stage.config
        stack = Stack(self.algorithm, state_to(state, resolve_device(config.device)))
        learner = learner_of(
            stack,
            config.num_envs,
            stage.seeds,
            row_steps=stage.learning_task.row_steps,
            goes_on_at=log.at.steps,
        )
        keep_to_guide(learner, stage.entry.guide_kl)
        rehearse(learner, stage.run, stage.entry, stage.policies.get(stage.learner))
        starts = stage.entry.starts
        learnt_before = stage.learner in stage.policies or stage.name in starts
        if learnt_before and isinstance(learner, ReplayLearner):
            learner.act_from_the_start()
        return learner

    def stacks(self) -> dict[str, Stack]:
        """Return the stacks of the learners, by path."""
        (stack,) = self.learner.stacks
        return {self.stage.learner: stack}

    def policies(self) -> dict[str, AgentPolicy]:
        """Return the present policies of the learners, by path."""
        return {
            path: AgentPolicy.of(stack.algorithm, state_to(stack.state, "cpu"))
            for path, stack in self.stacks().items()
        }

    def states(self) -> dict[str, Any]:
        """Return the present states of the learners, by path."""
        return {path: state_to(stack.state, "cpu") for path, stack in self.stacks().items()}

    def play(self, eval_envs: Collector, seeds: Seeds) -> Array:
        """Play an episode in each evaluation environment, (n, 4); see ``episodes_of``."""
        (policy,) = self.policies().values()
        return episodes_of(policy, eval_envs, seeds)

    def saved(self, extra: dict[str, Tensor]) -> tuple[Any, dict[str, Tensor]]:
        """Return the state and all other tensors of a checkpoint, ``extra`` included."""
        (stack,) = self.learner.stacks
        return state_to(stack.state, "cpu"), extra | self.best.tensors()

    def _save_final(self, log: StageLog, *, spent: bool) -> None:
        """Write the state from which more steps continue, in new episodes.

        Args:
            spent: the budget is spent, so the state is a checkpoint, too.
        """
        whole = prefixed("learner", self.learner.kept(requested=False))
        needed = prefixed("learner", self.learner.kept(requested=False, replay=False))
        state, extra = self.saved(needed)
        spare = {k: v for k, v in whole.items() if k not in needed}
        log.save_final(state, extra, spare, spent=spent)

    def go_on(self, state: Any | None, extra: dict[str, Tensor], log: StageLog) -> None:
        """Restore a checkpoint."""
        self.learner = self.learner_from(state, extra, log)
        self.at = at = Progress(log.at.update, log.at.steps, log.at.seconds)
        self._steps_before = at.steps
        self.best.load(log.at.kept_best, extra, self.states(), str(log.run.path))
        learner, collectors, episodes = self.learner, self.collectors, self.episodes
        if unprefixed("collector", extra):
            ids = resumed(log, lambda: resume(learner, collectors, episodes, extra, at))
            log.report_reset(len(ids), self.collectors.num_envs)
        elif at.steps:
            resumed(log, lambda: begin_episodes(learner, collectors, extra, at, self.stage.seeds))

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
        """Learn until the budget is spent or the target is reached; return the policies."""
        target = self.stage.target
        made = self.collectors.steps_made

        def on_tick(tick: Tick) -> None:
            log.report_reset(self.collectors.begun_anew, self.collectors.num_envs)
            self.collectors.begun_anew = 0
            log.report_absent(self.episodes.tally, over=False)
            log.report_endless(self.episodes.tally)
            if tick.since < EARLY * self.stage.budget <= tick.steps:
                self.tell_early(tick.steps, log)
            # If the best weights count, the last ones must be evaluated, too.
            last = self.best.wanted and tick.steps >= self.stage.budget
            evaluation = self.evaluation.due(tick.since, tick.steps, self.play, also=last)
            log.at.evaluation_steps += self.evaluation.spent()
            if evaluation:
                log.tell_slow(self.evaluation.took, self.evaluation.after)
            self.best.see(evaluation, tick.steps, self.states)
            log.at.kept_best = self.best.header()
            log.tick(tick.update, tick.steps, tick.seconds, tick.metrics | evaluation)
            # No checkpoint at the end: a run that resumes from the previous one comes here again.
            if target is not None and target.reached(evaluation, self.stage.name) is not None:
                raise _TargetReached
            if log.stop_requested:
                raise _Stopped

        def on_checkpoint(saved: Saved) -> None:
            log.stands(saved.at.update, saved.at.steps, saved.at.seconds)
            log.save(*self.saved(saved.extra))
            if log.stop_requested:
                raise _Stopped

        try:
            train(
                self.learner,
                self.collectors,
                self.episodes,
                self.stage.seeds,
                self.stage.budget,
                resume_from=self.at,
                checkpoint_every=self.stage.run.manifest.checkpoint_every,
                on_tick=on_tick,
                on_checkpoint=on_checkpoint,
                on_calls=None if self.stage.recorder is None else self.stage.recorder.add,
            )
        except (_TargetReached, _Stopped) as end:
            # Count the steps collected since the update, too.
            log.at.steps = self._steps_before + self.collectors.steps_made - made
            if isinstance(end, _Stopped):
                log.stopped()
                self._save_final(log, spent=False)
            else:
                assert target is not None
                log.reached(float(log.at.metrics[f"eval_{target.of}"]))
        else:
            self._save_final(log, spent=True)
            if self.stage.entry.kind == "skill" and self._is_unchanged():
                log.report_learnt_nothing()
        log.report_absent(self.episodes.tally, over=True)
        log.report_endless(self.episodes.tally)
        if self.best.metrics:
            for path, stack in self.stacks().items():
                stack.state = state_to(self.best.states[path], stack.state.params.device)
            log.kept_best(self.best)
        return self.policies()

    def tell_early(self, steps: int, log: StageLog) -> None:
        """Report problems so far, while training can still be stopped; none for one agent."""

    def _is_unchanged(self) -> bool:
        """Return True if the weights are still the initial ones."""
        (stack,) = self.learner.stacks
        before = AgentPolicy.of(self.algorithm, self._initial_state()).weights
        after = AgentPolicy.of(self.algorithm, state_to(stack.state, "cpu")).weights
        return all(torch.equal(after[name], before[name]) for name in before)

    def close(self) -> None:
        """Release the environments."""
        self._resources.close()


def _seeded(make: MakeCollector, seeds: Seeds, num_envs: int, first: int) -> Collector:
    """Make a collector after seeding the global generators of its process."""
    seed_global_generators(seeds / first)
    return make(num_envs, first)


def _collector(
    learning_task: LearningTask, algorithm: Algorithm, num_envs: int, first: int
) -> Collector:
    return learning_task.learners_collector(num_envs, Acting([(algorithm, 1)], num_envs), first)


class _TargetReached(Exception):
    """Signal that ends a loop: the target is reached."""


class _Stopped(Exception):
    """Signal that ends a loop: a callback has returned False."""


@dataclass(frozen=True)
class Course:
    """The training of a run, stage by stage."""

    run: RunDirectory
    listeners: tuple[Listener, ...] = ()
    make_learner: MakeLearner = OneAgent
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
            fresh = learner.open()
            checkpoint = run.load_checkpoint(stage.name, fresh)
            state, at, extra = checkpoint or (fresh, Checkpoint.start(stage.name), {})
            log = StageLog(stage.name, run, course.listeners, at)
            learner.go_on(state, extra, log)
            policies = learner.train(log)
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
