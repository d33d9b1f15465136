"""Log of a stage in training: its entry, lines, checkpoints and messages, for any learner."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

from torch import Tensor

from skillweave._internal.messages import suggest
from skillweave._internal.notices import notice
from skillweave.algorithms.agent_policy import AgentPolicy
from skillweave.envs.checked import LONG_EPISODE, LONGEST_EPISODE
from skillweave.errors import RunError, SkillweaveError, reworded
from skillweave.policies.untrusted import shown
from skillweave.runs.command_words import resume_words
from skillweave.runs.directory import LINES, RunDirectory
from skillweave.runs.manifest import Best, BestSoFar, Checkpoint, Reached, StageEntry, Stopped
from skillweave.runs.trackers import Listener
from skillweave.training.callback import TrainCallback
from skillweave.training.episodes import EpisodeTally

ENOUGH = 20
"""Episodes after which a logged key of ``info`` that never occurred is reported."""
SLOW_SECONDS = 10.0
"""Seconds of an evaluation that cause a message, if training takes less."""
T = TypeVar("T")
LARGEST_SPARE = 100 * 2**20
"""Most bytes of replay buffers that a finished stage keeps; without them it fills new ones."""


def success_rate(entry: StageEntry) -> float:
    """Return the share of a skill's calls that succeeded at the end of its stage.

    1 for skills without ``success``, and for populations.
    """
    if entry.succeeded is None:
        return 1.0
    return max(entry.final.get(k) or 0.0 for k in ("success", "eval_success"))


class StageLog:
    """Writer of a stage's entry in the manifest, its lines and checkpoints, and its listeners.

    Args:
        at: the header of the checkpoint to continue from; its progress is counted on.
    """

    def __init__(
        self, name: str, run: RunDirectory, listeners: tuple[Listener, ...], at: Checkpoint
    ) -> None:
        self.run = run
        self.listeners = listeners
        self.entry = run.stage(name)
        self.at = at
        self._callbacks = [x for x in listeners if isinstance(x, TrainCallback)]
        self._has_final = False
        # Before a stage trains, its entry has the size that the files had when it was last done.
        is_new = self.entry.status != "training"
        known = (at,) if is_new else (self.entry, at)
        sizes = {k: v for of in known for k in LINES if (v := getattr(of, k)) is not None}
        incomplete = run.rewind(sizes)
        if is_new or incomplete:
            run.record_lines(self.entry)
        self.entry.status = "training"
        run.save()
        for listener in listeners:
            listener.stage(name, self.entry.budget)
        for file in incomplete:
            self.message(f"{run.path / file} was removed or shortened: curves lack its lines")

    def tick(self, update: int, steps: int, seconds: float, metrics: dict[str, float]) -> None:
        """Write the report of an update, and pass it to listeners."""
        name = self.entry.name
        self.set_counts(update, steps, seconds)
        self.at.metrics = metrics
        header = {"stage": name, "update": update, "steps": steps}
        self.run.log(header | {"seconds": round(seconds, 4)} | metrics)
        for listener in self.listeners:
            listener.tick(name, steps, seconds, metrics)

    @property
    def stop_requested(self) -> bool:
        """True if a callback has ended the stage."""
        return any(callback.stopped for callback in self._callbacks)

    def set_counts(self, update: int, steps: int, seconds: float) -> None:
        """Set the counts of updates, steps and seconds for the next checkpoint."""
        self.at.update = update
        self.at.steps = steps
        self.at.seconds = seconds

    def message(self, text: str) -> None:
        """Send a message about the stage to listeners."""
        for listener in self.listeners:
            listener.message(f"{self.entry.name}: {text}")

    def report_reset(self, count: int, of: int) -> None:
        """Report that ``count`` of ``of`` environments could not repeat their open episodes."""
        if count:
            self.message(
                f"{count} of {of} open episodes start again, so the result may differ from that of "
                "an undisturbed run: given the same seed and the same actions, the environment "
                "does not repeat itself"
            )

    def report_learnt_nothing(self) -> None:
        """Report that the weights are still the initial ones."""
        self.message(
            f"it learnt nothing in {self.at.steps:,} steps, as too few of them were its own: "
            "perhaps its initiation() is seldom True where the others lead. Widen it, or give more "
            "steps"
        )

    def save(self, tensors: Mapping[str, Tensor]) -> None:
        """Write a checkpoint.

        The updates and steps of ``at`` must be of this moment; its metrics are the latest reported
        ones.
        """
        self.run.save_checkpoint(self.at, tensors)
        self._notify_callbacks()

    def _notify_callbacks(self) -> None:
        for callback in self._callbacks:
            callback.checkpoint(self.entry.name, self.at.steps, self.at.metrics)

    def report_episodes(self, tally: EpisodeTally, *, over: bool) -> None:
        """Report once in a run logged keys of ``info`` that never occurred, and endless episodes.

        Args:
            over: the stage has ended, so no more episodes will come.
        """
        if tally.ended >= (1 if over else ENOUGH):
            self._report_absent(tally)
        if tally.longest >= LONG_EPISODE:
            notice(
                f"an episode has run {LONG_EPISODE:,} steps without an end, and no time limit is "
                f"known: it is truncated only after {LONGEST_EPISODE:,} steps, and evaluations cut "
                f"theirs after {LONG_EPISODE:,}. If it should end sooner, or be evaluated for "
                "longer, give the environment a limit: EnvSpec(..., "
                "wrappers=(lambda env: gymnasium.wrappers.TimeLimit(env, 1000),))"
            )

    def _report_absent(self, tally: EpisodeTally) -> None:
        """Report the logged keys of ``info`` that never occurred."""
        absent = [key for key in tally.absent if key not in self.run.reported_absent]
        self.run.reported_absent |= set(absent)
        others = sorted(tally.others - set(absent))
        for key in absent:
            self.message(
                f"none of {tally.ended} episodes ended with a number in info[{key!r}] (log_info)"
                f"{suggest(key, others) or '; it was empty there'}"
            )

    def tell_slow(self, took: float, after: float) -> None:
        """Report once in a run that evaluations take longer than training.

        Args:
            took: seconds of an evaluation.
            after: of training before it.
        """
        if took < max(SLOW_SECONDS, after) or self.run.reported_slow:
            return
        self.run.reported_slow = True
        self.message(
            f"evaluating took {took:.0f} s, and the training before it {after:.0f} s: a larger "
            "eval_every, or a smaller eval_episodes, would make the run faster"
        )

    def stopped(self) -> None:
        """Record that a callback has ended the stage."""
        self.entry.stopped = Stopped(self.at.steps)
        self.message(
            f"the callback returned False after {self.at.steps:,} steps: the stage ends here"
        )

    def kept_best(self, best: BestSoFar, of: Literal["return", "success"]) -> None:
        """Record that the stage ends with the weights of its best evaluation, by this criterion."""
        self.entry.best = Best(best.steps, of, best.metrics[f"eval_{of}"])
        self.at.metrics = self.at.metrics | best.metrics
        self.message(str(self.entry.best))

    def save_final(
        self, needed: Mapping[str, Tensor], spare: Mapping[str, Tensor], *, spent: bool
    ) -> None:
        """Write the state from which the stage could continue for more steps.

        A full disk does not stop the stage: its policies are smaller.

        Args:
            needed: tensors that continuing needs.
            spare: replay buffers, which are left out if they are large.
            spent: the budget is spent, so the state is a checkpoint, too, in case writing the
                policies fails. Else a run that is killed now repeats the end of the stage from
                the previous checkpoint.
        """
        write = self.run.save_checkpoint if spent else self.run.save_final
        small = sum(x.numel() * x.element_size() for x in spare.values()) <= LARGEST_SPARE
        for tensors in ({**needed, **spare}, needed) if spare and small else (needed,):
            try:
                write(self.at, tensors)
            except RunError as error:
                problem = error
            else:
                self._has_final = spent
                break
        else:
            self.run.check()
            self.message(
                f"it cannot be given more steps later, as its final state is not kept: {problem}"
            )
            return
        if spent:
            self._notify_callbacks()

    def reached(self, value: float) -> None:
        """Record that the stage has reached its target."""
        self.entry.reached = Reached(self.at.steps, value)
        target = self.entry.target
        assert target is not None
        self.message(
            f"target reached after {self.at.steps:,} steps: {target.of} {value:g}, "
            f"the target is {target.at_least:g}"
        )

    def done(self, policies: Mapping[str, AgentPolicy], states: Mapping[str, Any]) -> None:
        """Finish the stage: save its policies, and record the result.

        Args:
            states: by name, the states with which learners continue in a later stage.
        """
        entry = self.entry
        at = self.at
        for name, state in states.items():
            if self.run.learns_again(entry.name, name):
                header = {"learns": name}
                self.run.write("states", name, vars(state), header, entry.name)
        self._save_policies(policies)
        for name, policy in policies.items():
            policy.name_outliers(repr(name))
        if self._has_final:
            self.run.keep_final(entry.name)
        entry.status = "done"
        entry.steps = at.steps
        entry.extended = None if entry.continued else at.budget
        entry.seconds = round(at.seconds, 3)
        self.run.record_lines(entry)  # so that a later stage notices removed lines
        entry.evaluation_steps = at.evaluation_steps
        entry.steps_per_second = round(at.steps / max(at.seconds, 1e-9), 1)
        entry.final = dict(at.metrics)
        entry.succeeded = self._succeeded()
        self.run.save()
        if entry.succeeded is False:
            advice = (
                "It may need more steps, a reward that leads there step by step, or states nearer "
                "to it: start_calls, episode_calls, initiation()"
            )
            if at.metrics.get("length") == 1.0:
                advice = (
                    "Every call ended after one step: perhaps its termination() is always true (or "
                    "its max_steps or call_steps is 1)"
                )
            self.message(
                "no call ended with success() true, so stages after this one build on a skill that "
                f"does not work. {advice}"
            )
        self.run.drop_checkpoints()
        self.run.drop_used(entry)
        for listener in self.listeners:
            listener.done(entry.name, at.steps, at.seconds, at.metrics)

    def _save_policies(self, policies: Mapping[str, AgentPolicy]) -> None:
        """Write the policies; on a full disk delete final states of earlier stages first."""
        name = self.entry.name
        try:
            self.run.save_policies(name, policies)
        except RunError:
            if not self.run.make_room():
                raise
            self.run.save_policies(name, policies)
            self.message(
                "the disk is full, so final states of earlier stages were deleted to make room: "
                "those stages cannot be given more steps later"
            )

    def _succeeded(self) -> bool | None:
        """Return True if a call of the skill succeeded; None: unknown."""
        if self.entry.kind != "skill" or self.entry.evolution:
            return None
        lines = [line for line in self.run.metrics() if line.get("stage") == self.entry.name]
        shares = [line[k] for line in lines for k in ("success", "eval_success") if k in line]
        if wrong := [value for value in shares if type(value) not in (int, float)]:
            raise RunError(
                f"{self.run.path / 'metrics.jsonl'}: {self.entry.name!r} has a share of calls "
                f"that succeeded of {shown(wrong[0])}, which is no number; remove that line, then "
                f"{resume_words(self.run)}"
            )
        return max(shares) > 0.0 if shares else None


def resumed(log: StageLog, restore: Callable[[], T]) -> T:
    """Restore environments from a checkpoint by ``restore``; errors name the run and the stage.

    Raises:
        RunError: the checkpoint has other names or shapes, as the program has changed.
    """
    where = f"{log.run.path}: stage {log.entry.name!r}"
    try:
        return restore()
    except SkillweaveError as error:
        raise reworded(error, f"{where}: {error}") from error
    except (KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        raise RunError(f"{where} cannot continue from its checkpoint: {error!r}") from error
