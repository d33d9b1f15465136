"""The learners of a stage without a population: one, or a selector and skills together."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.paths import CRITIC, SELECTOR, decides, level_of, relative
from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds, global_generators, seed_global_generators
from skillweave.algorithms.actor_critic import ActorCriticAlgorithm
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm, state_from
from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.batches import Reference
from skillweave.algorithms.config import config_from_json, with_networks
from skillweave.algorithms.schedules import start_rate
from skillweave.buffers.recorded_steps import RecordedSteps
from skillweave.envs.checked import longest_evaluation
from skillweave.envs.engine import Engine
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.experience.acting import Acting, Request
from skillweave.experience.collector import FIRST_INFO, Collector
from skillweave.experience.group import CollectorGroup
from skillweave.ops.device import resolve_device
from skillweave.ops.threads import torch_threads
from skillweave.policies.core import Array
from skillweave.policies.untrusted import shown
from skillweave.runs.initial_policies import initial_policy
from skillweave.runs.manifest import GivenScore, StageEntry, Start
from skillweave.schema import fit
from skillweave.spaces import is_continuous
from skillweave.training.episodes import Episodes, Tick
from skillweave.training.given import FEWEST, compared, looks, score
from skillweave.training.joint import JointLearner
from skillweave.training.keep_best import KeepBest
from skillweave.training.learner import Learner, RolloutLearner, Stack, keep_to_guide
from skillweave.training.learning_task import LearningTask
from skillweave.training.loop import Loop, LoopState, Saved
from skillweave.training.offline import AfterData, data_steps_of
from skillweave.training.periodic import PeriodicEvaluation, episodes_of
from skillweave.training.rehearsal import rehearse
from skillweave.training.replay_learner import CriticsFirst, ReplayLearner, judge_of
from skillweave.training.stack_learner import learner_of
from skillweave.training.stage import Together
from skillweave.training.stage_log import StageLog, resumed, success_rate
from skillweave.training.stage_run import StageRun
from skillweave.workers.placement import MakeCollectors, make_collectors

CRITIC_FEWEST, CRITIC_MOST, CRITIC_SHARE = 5, 20, 0.2
"""Updates in which a critic learns alone, where the policy was learnt without it: at least, at
most, and the most of a stage's budget that they take. By the advantages of a critic that has learnt
nothing the first updates would undo the policy."""
EARLY = 0.25
"""Share of a stage's budget after which skills without a call are reported, and a skill that acts
seldom gets more steps."""
FEW = 10
"""Updates below which a learner has learnt little from its budget."""
LARGEST_FACTOR = 4.0
"""The most steps of a skill that acts seldom, as a multiple of its budget."""
SELDOM = 0.5
"""The share of steps below which a skill acts seldom."""


class Agents:
    """The learners of a stage without a population: one, or several that learn together.

    Args:
        make_collectors: makes the collectors, here or in other processes.
    """

    def __init__(self, stage: StageRun, make_collectors: MakeCollectors = make_collectors) -> None:
        self.stage = stage
        self.entry = stage.entry
        self.task = stage.learning_task
        entry = self.entry
        if entry.evolution is not None:
            raise DeclarationError(f"stage {entry.name!r} evolves: it needs a population to train")
        first = entry.decides or entry.learns[0]
        self.level = level_of(first)
        self.roles = self.task.roles or {first: self.task.role}
        file = str(stage.run.path / "run.json")
        if unknown := [name for name in entry.learns if name not in self.roles]:
            raise RunError(
                f"{file}: stage {entry.name!r}: learns has {shown(unknown[0])}; it must be of "
                f"{', '.join(self.roles)}"
            )
        self.together: Together | None = None
        if entry.together is not None:
            self.together = fit(Together, entry.together, file, f"stage {entry.name!r}: together")
        self._reached: float | None = None
        """The value by which the target is reached; None: it is not."""
        self._resources = ExitStack()
        self._make_collectors = make_collectors

    def open(self) -> None:
        """Make the learning algorithms, and the environments."""
        stage = self.stage
        task = self.task
        num_envs = self.entry.num_envs
        manifest = stage.run.manifest
        self.algorithms: dict[str, Algorithm] = {}
        for name in self.entry.learns:
            wanted = self._config(name), *self.roles[name].spaces
            self.algorithms[name] = self._equal_algorithm(*wanted) or make_algorithm(*wanted)
        # Before the collectors: an environment may exist only once at a time.
        self.judges = {k: judge_of(a.config, self.roles[k]) for k, a in self.algorithms.items()}
        self.earlier = {name: self._earlier_policy(name) for name in self.algorithms}
        self.collectors = self._collectors(num_envs)
        self._resources.callback(self.collectors.close)
        every, episodes = manifest.eval_every, manifest.eval_episodes
        self.evaluation = PeriodicEvaluation(task, stage.seeds, every, episodes, num_envs)
        self._resources.callback(self.evaluation.close)
        target = self.entry.target
        self.best = KeepBest("return" if target is None else target.of, manifest.keep == "best")

    def _collectors(self, num_envs: int) -> CollectorGroup:
        """Return the collectors of the stage; while it learns from data alone, they only wait."""
        task, budget = self.task, self.entry.budget
        how = task, self._acting(), self._margins(), self.stage.seeds / "global"
        data_steps = self._data_steps()
        made = None
        if data_steps < budget:
            made = self._make_collectors(
                partial(_collector, *how), num_envs, self.entry.workers, 1, task.role.spec.name
            )
        if not data_steps:
            assert made is not None
            return made
        return AfterData(made, num_envs, FIRST_INFO + len(task.log_info))

    def _data_steps(self) -> int:
        """Return the steps of the stage that are gradient steps on data alone."""
        entry: StageEntry = self.entry
        config: Any = self.stage.config
        steps_it = bool(getattr(config, "online", 1.0))
        if entry.continued and steps_it:
            return data_steps_of(config, entry.continued[0])  # more steps are in the environment
        return data_steps_of(config, entry.budget)

    def _config(self, name: str) -> Any:
        """Return a learner's settings, with the networks that it has grown in a population."""
        config = config_from_json(self.entry.algorithms.get(name, self.entry.algorithm))
        if self.entry.careful or self._given(name) is not None:
            config = config.learning_on(continuous=is_continuous(self.roles[name].spaces[1]))
        earlier = self.stage.policies.get(name)
        if not isinstance(earlier, AgentPolicy):
            return config
        return with_networks(config, earlier.algorithm.config)

    def _given(self, name: str) -> Start | None:
        """Return the policy that a learner was given for this stage or an earlier one, or None."""
        stages = [*self.stage.stages_before(name), self.entry]
        return next((s.starts[name] for s in stages if name in s.starts), None)

    def _equal_algorithm(self, *wanted: Any) -> Algorithm | None:
        """Return an algorithm with equal settings and spaces: it need not be compiled again.

        An algorithm holds no weights, so several learners may share one.
        """
        for other in self.algorithms.values():
            if (other.config, other.observation_space, other.action_space) == wanted:
                return other
        return None

    def _earlier_policy(self, name: str) -> tuple[AgentPolicy, int] | None:
        """Return the earlier policy of ``name``, with the steps that it learnt from.

        It is from earlier stages, or from the run that this one starts from; None: it is new.
        """
        stage = self.stage
        policy = stage.policies.get(name)
        if isinstance(policy, AgentPolicy):
            return policy, sum(entry.steps or 0 for entry in stage.stages_before(name))
        if self.entry.continued:
            return None  # its final state holds everything
        return initial_policy(stage.run, self.entry.name, name, self.algorithms[name])

    def _acting(self) -> dict[str, Algorithm]:
        """Return the acting algorithms, by their paths in the stage's level."""
        return {relative(k, self.level): a for k, a in self.algorithms.items()}

    def _margins(self) -> dict[str, float]:
        """Return the margins of critics that end calls, by their paths in the stage's level."""
        together = self.together
        margins = {CRITIC: together.margin} if together and together.interrupt else {}
        for path, role in self.roles.items():
            if role.margin is not None and role.level != self.level:
                margins[relative(path, self.level)] = role.margin
        return margins

    def restore(self, tensors: dict[str, Tensor], log: StageLog) -> None:
        """Restore a checkpoint, or prepare to start where ``tensors`` is empty."""
        self.log = log
        self.learners = {name: self._learner(name, tensors) for name in self.algorithms}
        self.joint: JointLearner | None = None
        self.learner: Learner
        if self.together is None:
            (self.learner,) = self.learners.values()
        else:
            how = self.level, self.together.task_weight, self.entry.task_weights
            self.learner = self.joint = JointLearner(self.learners, *how)
        self.best.load(log.at.kept_best, tensors, self.states(), str(log.run.path))
        if isinstance(self.collectors, AfterData):
            self.collectors.data_left = max(0, self._data_steps() - log.at.steps)
        recorder = self.stage.recorder
        self.loop = loop = Loop(
            self.learner,
            self.collectors,
            Episodes(self.task.log_info),
            self.stage.seeds,
            self.entry.budget if self.entry.continued else log.at.budget or self.entry.budget,
            LoopState(log.at.update, log.at.steps, log.at.seconds),
            checkpoint_every=log.run.manifest.checkpoint_every,
            on_tick=self._on_tick,
            on_checkpoint=self._on_checkpoint,
            on_calls=None if recorder is None else recorder.add,
        )
        if tensors:
            ids = resumed(log, lambda: loop.restore(tensors))
            log.report_reset(len(ids), self.collectors.num_envs)

    def _learner(self, name: str, tensors: dict[str, Tensor]) -> Learner:
        """Return a learner that continues from a checkpoint or an earlier stage, or is fresh."""
        state = self._initial_state(name)
        algorithm = self.algorithms[name]
        if self.together and self.earlier[name] is not None and not tensors:
            self._report_lost_state(name)
        device = resolve_device(algorithm.config.device)
        reference = self._reference(name, state, device)
        if tensors:
            saved = unprefixed(f"state.{name}", tensors)
            state = state_from(saved, state, f"{self.log.run.path}: {name}")
        judge = self.judges[name]
        data_steps = self._data_steps()
        data = self._data() if judge is not None and algorithm.config.shared_replay else None
        capacity = None
        if data is not None and data_steps == self.entry.budget:
            capacity = data.room(self.entry.num_envs)  # it holds nothing else
        learner = learner_of(
            Stack(algorithm, state_to(state, device)),
            self.entry.num_envs,
            self._seeds(name),
            self._quota(name),
            row_steps=self.roles[name].row_steps,
            goes_on_at=self.log.at.steps,
            judge=judge,
            data_steps=data_steps,
            capacity=capacity,
        )
        if isinstance(learner, ReplayLearner) and data is not None:
            learner.begin_with_data(data, scales=not tensors)
        if isinstance(learner, ReplayLearner) and not tensors:
            for rows in self.stage.run.load_rows(self.entry):
                if rows:
                    learner.begin_with(rows)
        if isinstance(learner, RolloutLearner):
            learner.reference = reference
            if self.entry.careful and self.log.at.steps == self.entry.continued[-1]:
                rate = learner.stacks[0].state.learning_rate
                rate.fill_(start_rate(algorithm.config))
            first = name == self.entry.decides
            keep_to_guide(learner, self.entry.guide_kl if first else self.roles[name].guide_kl)
            rehearse(learner, self.log.run, self.entry, self.stage.policies.get(name))
            learner.keeps_scaling = self._given(name) is not None
            start = self.entry.starts.get(name)
            if start is not None and not start.critic and not tensors:
                each = int(algorithm.config.n_steps) * self.entry.num_envs
                most = min(CRITIC_MOST, int(CRITIC_SHARE * self.entry.budget) // each)
                learner.critic_first = min(CRITIC_FEWEST, most), most
        elif self.earlier[name] is not None or name in self.entry.starts:
            learner.act_from_the_start()
            learner.keeps_scaling = self._given(name) is not None
            waits = isinstance(algorithm, ActorCriticAlgorithm) and algorithm.follows_critics
            if waits and name in self.entry.starts and not tensors:
                due = float(algorithm.config.update_ratio) * self.entry.budget
                learner.critics_first = CriticsFirst(int(CRITIC_SHARE * due))
        return learner

    def _data(self) -> RecordedSteps | None:
        """Return the steps that were given with ``data``; None: the run has none."""
        tensors = self.stage.run.load_data()
        spaces = self.task.role.spec.spaces
        if tensors is None:
            return None
        return RecordedSteps.from_tensors(tensors, spaces.observation, spaces.action)

    def _seeds(self, name: str) -> Seeds:
        return self.stage.seeds / name if self.together else self.stage.seeds

    def _initial_state(self, name: str) -> Any:
        """Return a learner's state at the start of this stage.

        Where it learns on together, it is that at the end of its latest stage; else it has the
        weights alone of its earlier policy.
        """
        algorithm, earlier = self.algorithms[name], self.earlier[name]
        state = algorithm.init([self._seeds(name) / "member" / 0])
        if earlier is None:
            return state
        if self.together and (kept := self.stage.run.load_state(name, state)) is not None:
            return kept
        policy, steps = earlier
        algorithm.set_weights(state, policy.weights)
        state.obs_count.fill_(max(1.0, steps))
        return state

    def _report_lost_state(self, name: str) -> None:
        """Report that an earlier stage's file with a learner's state is deleted."""
        latest = self._latest_stage(name)
        path = self.stage.run.file("states", name)
        trained = latest is not None and latest.evolution is None and not latest.undone
        if trained and not path.exists():
            self.log.message(
                f"{path} is not there any more, so {name!r} continues with its weights alone, and "
                "learns otherwise than without the interruption"
            )

    def _reference(self, name: str, state: Any, device: torch.device) -> Reference | None:
        """Return the reference policy of a skill that was trained before: that of ``state``."""
        algorithm = self.algorithms[name]
        kl = None if self.together is None else self.together.reference_kl
        latest = self._latest_stage(name)
        # Without a stage it starts from another run, to learn the task of this one.
        if kl is None or decides(name) or algorithm.store != "rollout" or latest is None:
            return None
        if (rate := success_rate(latest)) == 0.0:
            self.log.message(
                f"skill {name!r} did not succeed any more when its own stage ended, so it moves "
                "freely here (together.reference_kl is not used for it)"
            )
            return None
        params = algorithm.acting_params(state, device=device)
        # A skill that seldom succeeded has little to lose, and much to learn.
        return Reference(params, torch.ones(1, dtype=torch.float32, device=device), kl / rate)

    def _quota(self, name: str) -> int | None:
        """Return the valid rows that a learner from rollouts waits for; None: see ``learner_of``.

        Among learners that learn together it is ``together.quota`` of the rows of a rollout.
        """
        together = self.together
        config = self.algorithms[name].config
        if together is None or self.algorithms[name].store != "rollout":
            return None
        if relative(name, self.level) in (SELECTOR, CRITIC):
            return 0
        steps = getattr(self.stage.config, "n_steps", None) or config.n_steps
        rows = self.entry.num_envs * int(steps)
        return max(1, round(rows * together.quota / self.roles[name].row_steps))

    def _latest_stage(self, name: str) -> StageEntry | None:
        """Return the finished stage in which a learner of this one learnt last; None: in none."""
        return next(reversed(self.stage.stages_before(name)), None)

    def stacks(self) -> dict[str, Stack]:
        """Return the stacks of the learners, by path."""
        return {path: s for path, part in self.learners.items() for s in part.stacks}

    def policies(self) -> dict[str, AgentPolicy]:
        """Return the present policies of the learners, by path."""
        return {
            path: AgentPolicy.of(stack.algorithm, state_to(stack.state, "cpu"))
            for path, stack in self.stacks().items()
        }

    def states(self) -> dict[str, Any]:
        """Return the present states of the learners, by path."""
        return {path: state_to(stack.state, "cpu") for path, stack in self.stacks().items()}

    def play(self, engine: Engine, seeds: Seeds) -> Array:
        """Play an episode in each evaluation environment, (n, 4); see ``episodes_of``."""
        if self.together is None:
            (policy,) = self.policies().values()
            return episodes_of(policy, self.task.who, engine, seeds)
        player = _acting_in(engine, self.task, self._acting(), self._margins())
        requests = {
            name: Request(
                0,
                (s.algorithm.acting_params(s.state),),
                s.state.gamma.cpu().numpy(),
                seeds / name,
                greedy=self.roles[name].greedy,
            )
            for name, s in self.stacks().items()
        }
        first = str(self.entry.decides)
        of_selector = requests.pop(first, Request(0, (), np.ones(1), seeds / first, greedy=True))
        below = {relative(k, self.level): r for k, r in requests.items()}
        with torch_threads(1), global_generators(seeds / "global"):
            longest = longest_evaluation(engine.time_limit)
            return player.play(replace(of_selector, below=below), seeds / "start", longest)

    def train(self) -> dict[str, AgentPolicy]:
        """Learn until the budget is spent or the target is reached; return the policies."""
        log = self.log
        steps = self.loop.at.steps
        made = self.collectors.steps_made
        self._score_given()
        self._evaluate_start()
        self.loop.run()
        if self.loop.ended:
            # Count the steps collected since the update, too.
            log.at.steps = steps + self.collectors.steps_made - made
            if self._reached is None:
                log.stopped()
                self._save_final(spent=False)
            else:
                log.reached(self._reached)
        else:
            self._save_final(spent=True)
            if self.entry.kind == "skill" and self._is_unchanged():
                log.report_learnt_nothing()
            self._report_few_updates()
        self._report_expectations()
        log.report_episodes(self.loop.episodes.tally, over=True)
        self.collectors.finish()
        if isinstance(self.learner, ReplayLearner):
            self.stage.run.save_rows(self.entry, self.learner.shared_rows)
        if (best := self.best.found) is not None:
            for path, stack in self.stacks().items():
                stack.state = state_to(self.best.states[path], stack.state.params.device)
            log.kept_best(best, self.best.of)
        self._compare_with_given()
        self._report_little_learnt()
        return self.policies()

    def _score_given(self) -> None:
        """Score the policy that the only learner was given, before the first update.

        Where nobody has said which weights to keep, it is evaluated a few times while it trains.
        """
        log, entry = self.log, self.entry
        if self.together is not None or not any(map(self._given, self.algorithms)):
            return
        new = bool(entry.starts) and not log.at.steps and not entry.continued
        if new and log.at.given is None:
            log.at.given = self._score()
        keep = log.run.manifest.keep
        if log.at.given is None or keep is not None:
            return
        self.best.wanted = True
        every, episodes = looks(log.at.given, entry.budget)
        if every and log.run.manifest.eval_every is None:
            with suppress(SkillweaveError):  # only one environment may exist
                self.evaluation = PeriodicEvaluation(
                    self.task, self.stage.seeds, every, episodes, entry.num_envs
                )
                self._resources.callback(self.evaluation.close)

    def _score(self, like: GivenScore | None = None) -> GivenScore | None:
        """Score the present policy of the only learner; None: no environment can be made for it."""
        (policy,) = self.policies().values()

        def play(engine: Engine, seeds: Seeds, longest: int, greedy: bool) -> Array:
            """Play an episode in each environment."""
            who = self.task.who
            return episodes_of(policy, who, engine, seeds, greedy=greedy, longest=longest)

        try:
            engine = self.task.engine(FEWEST)
        except SkillweaveError as error:
            self.log.message(f"what it was given is not scored: {error}")
            return None
        try:
            found = score(engine, play, self.stage.seeds / "given", self.entry.budget, like)
            self.log.at.evaluation_steps += engine.steps_made
        finally:
            engine.close()
        return found if found.returns else None

    def _compare_with_given(self) -> None:
        """Compare what was learnt with the policy that was given, and keep that if it is better."""
        log, given, best = self.log, self.log.at.given, self.best.found
        if given is None:
            return
        is_given = best is not None and best.steps == 0  # its weights have been scored
        now = given if is_given else self._score(given)
        if now is None:
            return
        # A stage that was continued has no copy of what it was given any more.
        keeps = log.run.manifest.keep != "last" and not self.entry.continued
        self.entry.kept = compared(given, now, keeps)
        log.message(str(self.entry.kept))
        if self.entry.kept.kept == "given":
            for path, stack in self.stacks().items():
                stack.state = state_to(self._initial_state(path), stack.state.params.device)

    def _evaluate_start(self) -> None:
        """Evaluate initial policies that were learnt elsewhere: the best weights may be theirs."""
        log, best = self.log, self.best
        if not best.wanted or not self.entry.starts or log.at.steps or self.entry.continued:
            return
        evaluation = self.evaluation.due(0, 0, self.play, also=True)
        log.at.evaluation_steps += self.evaluation.spent()
        best.see(evaluation, 0, self.states)
        log.at.kept_best = best.found
        log.tick(0, 0, log.at.seconds, evaluation)

    def _on_tick(self, tick: Tick) -> None:
        """Evaluate where it is due, and write a report; end at the target, or for a callback."""
        log = self.log
        best = self.best
        budget = self.loop.budget
        log.report_reset(self.collectors.restarts, self.collectors.num_envs)
        self.collectors.restarts = 0
        log.report_episodes(self.loop.episodes.tally, over=False)
        if tick.since < EARLY * budget <= tick.steps:
            self._report_not_called(tick.steps)
            self._extend(tick.steps)
        # If the best weights count, the last ones must be evaluated, too.
        last = best.wanted and tick.steps >= budget
        evaluation = self.evaluation.due(tick.since, tick.steps, self.play, also=last)
        log.at.evaluation_steps += self.evaluation.spent()
        if evaluation:
            log.tell_slow(self.evaluation.took, self.evaluation.after)
        best.see(evaluation, tick.steps, self.states)
        log.at.kept_best = best.found
        log.tick(tick.update, tick.steps, tick.seconds, tick.metrics | evaluation)
        # No checkpoint at the end: a run that resumes from the previous one comes here again.
        target = self.entry.target
        if target is not None:
            self._reached = target.reached(evaluation, self.entry.name)
        if self._reached is not None or log.stop_requested:
            self.loop.end()

    def _on_checkpoint(self, saved: Saved) -> None:
        """Write a checkpoint; end where a callback ends the stage."""
        self.log.set_counts(saved.at.update, saved.at.steps, saved.at.seconds)
        self.log.save(self._saved(saved.extra))
        if self.log.stop_requested:
            self.loop.end()

    def _saved(self, extra: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return all tensors of a checkpoint: the learners' states, and ``extra``."""
        for name, state in self.states().items():
            extra = extra | prefixed(f"state.{name}", vars(state))
        return extra | self.best.tensors()

    def _save_final(self, *, spent: bool) -> None:
        """Write the state from which more steps continue, in new episodes.

        Args:
            spent: the budget is spent, so the state is a checkpoint, too.
        """
        whole = prefixed("learner", self.learner.kept(requested=False))
        needed = prefixed("learner", self.learner.kept(requested=False, replay=False))
        spare = {k: v for k, v in whole.items() if k not in needed}
        self.log.save_final(self._saved(needed), spare, spent=spent)

    def _is_unchanged(self) -> bool:
        """Return True if the weights of the only learner are still the initial ones."""
        ((name, policy),) = self.policies().items()
        before = AgentPolicy.of(policy.algorithm, self._initial_state(name)).weights
        return all(torch.equal(policy.weights[k], before[k]) for k in before)

    def _extend(self, steps: int) -> None:
        """Give a skill that acts seldom up to four times its steps, so that it can learn."""
        log, entry, learner = self.log, self.entry, self.learner
        if not isinstance(learner, RolloutLearner) or not learner.quota or log.at.budget:
            return
        if entry.kind != "skill" or entry.repair is not None or entry.continued:
            return
        rollout = int(learner.stacks[0].algorithm.config.n_steps) * entry.num_envs
        expected = learner.rows / learner.quota * entry.budget / steps
        if expected >= FEW or entry.budget < FEW * rollout:  # else its budget itself is small
            return
        factor = min(LARGEST_FACTOR, FEW / max(expected, 1e-9))
        self.loop.budget = log.at.budget = math.ceil(factor * entry.budget)
        log.message(
            f"it acted in {learner.rows:,} of {steps:,} steps, so it would learn from "
            f"{expected:.0f} rollouts in {entry.budget:,} steps, which is too few: it takes up to "
            f"{self.loop.budget:,} steps"
        )

    def _report_expectations(self) -> None:
        """Report critics that expect far more than was ever paid."""
        metrics = self.log.at.metrics
        for name, learner in self.learners.items():
            own = metrics if self.joint is None else unprefixed(name, metrics)
            if isinstance(learner, ReplayLearner) and (says := learner.expects_too_much(own)):
                self.log.message(says if self.joint is None else f"{name}: {says}")

    def _report_few_updates(self) -> None:
        """Report that the only learner was updated a few times only, and why."""
        learner, steps = self.learner, self.log.at.steps
        if not isinstance(learner, RolloutLearner) or not 0 < learner.updates < FEW:
            return
        rollout = int(learner.stacks[0].algorithm.config.n_steps) * self.entry.num_envs
        if self.entry.kind == "skill" and learner.rows < SELDOM * steps:
            why = (
                f"as it acted in {learner.rows:,} of these: give it more steps, widen its "
                "initiation(), or let skills learn together"
            )
        else:
            why = (
                f"as each takes {rollout:,} (num_envs * n_steps): give it more steps, or lower "
                "n_steps"
            )
        times = "once" if learner.updates == 1 else f"{learner.updates} times"
        self.log.message(f"its policy was updated {times} only in {steps:,} steps, {why}")

    def _report_not_called(self, steps: int) -> None:
        """Report skills that were not called so far, while training can still be stopped."""
        counts = {} if self.joint is None else self.joint.counts
        for name, (rows, _) in counts.items():
            if not rows and not decides(name):
                self.log.message(
                    f"skill {name!r} was not called in the first {steps:,} steps; it starts to "
                    "learn once its initiation() is True where other skills end"
                )

    def _report_little_learnt(self) -> None:
        """Report skills that learnt nothing beside others."""
        steps = self.log.at.steps
        counts = {} if self.joint is None else self.joint.counts
        for name, (rows, updates) in counts.items():
            if decides(name):
                continue
            if updates and updates < FEW:
                times = "once" if updates == 1 else f"{updates} times"
                self.log.message(
                    f"skill {name!r} acted in {rows:,} of {steps:,} steps, and its policy was "
                    f"updated {times} only: lower together.quota or n_steps, or give more steps"
                )
            elif rows and not updates:
                more = "raise together.epsilon, " if self.entry.decides in counts else ""
                self.log.message(
                    f"skill {name!r} acted in {rows:,} of {steps:,} steps only, too few "
                    f"to learn from once: lower together.quota, {more}or give more steps"
                )
            elif not rows:
                self.log.message(
                    f"skill {name!r} was never called in {steps:,} steps, so it learnt "
                    "nothing: perhaps its initiation() is never True where the other skills "
                    "lead, or the selector never chooses it"
                )

    def close(self) -> None:
        """Release the environments."""
        self._resources.close()


def _collector(
    task: LearningTask,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
    seeds: Seeds,
    num_envs: int,
    first: int,
) -> Collector:
    """Make a collector after seeding the global generators of its process."""
    seed_global_generators(seeds / first)
    return task.logged(_acting_in(task.engine(num_envs, first), task, algorithms, margins))


def _acting_in(
    engine: Engine,
    task: LearningTask,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
) -> Collector:
    """Return a collector in which all learners act, by their paths in the level."""
    acting = {k: Acting([(a, 1)], engine.num_envs) for k, a in algorithms.items()}
    if task.roles is None:
        (alone,) = acting.values()
        return Collector(engine, alone, task.who)
    return Collector(engine, acting.pop(SELECTOR, None), task.who, acting, margins)
