"""A stage in which a selector and its skills learn together, from the same steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.paths import CRITIC, SELECTOR, decides, join, level_of, name_of, relative
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.batches import Batch, Reference
from skillweave.algorithms.config import config_from_json
from skillweave.algorithms.policy import AgentPolicy, checked_tensor, make_algorithm, state_from
from skillweave.buffers.rollout import RolloutStore
from skillweave.envs.checks import longest_evaluation
from skillweave.envs.engine import Engine
from skillweave.envs.make import make_engine
from skillweave.errors import RunError
from skillweave.experience.acting import Acting, Request
from skillweave.experience.collector import Collector
from skillweave.experience.group import MakeCollector
from skillweave.ops.device import FLOAT, INT, resolve_device
from skillweave.ops.moments import normalize
from skillweave.ops.threads import torch_threads
from skillweave.runs.initial_policies import initial_policy
from skillweave.runs.manifest import StageEntry
from skillweave.training.learner import Learner, RolloutLearner, Stack, keep_to_guide
from skillweave.training.learning_task import JointTask
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.stage import Together
from skillweave.training.stage_log import StageLog, success_rate
from skillweave.training.stage_run import StageRun, begin_as
from skillweave.training.trainer import OneAgent
from skillweave.types import Array, prefixed, unprefixed
from skillweave.workers.placement import MakeCollectors, make_collectors


def agents_of(stage: StageRun, make_collectors: MakeCollectors = make_collectors) -> OneAgent:
    """Return the learner of a stage without a population."""
    kind = JointAgents if stage.entry.together else OneAgent
    return kind(stage, make_collectors)


class JointAgents(OneAgent):
    """A stage's learners where a selector and its skills learn together."""

    stage: Any

    def make_agents(self) -> None:
        """Make the learning algorithms; checkpoints hold their states under ``extra``."""
        entry = self.stage.entry
        learning_task = self.learning_task
        self.together = Together(**entry.together)
        self.first: str = entry.decides
        self.level = level_of(self.first)
        configs = {self.first: self.stage.config} if self.first in entry.learns else {}
        configs |= {name: config_from_json(settings) for name, settings in entry.algorithms.items()}
        self.algorithms: dict[str, Algorithm] = {}
        for name, config in configs.items():
            grown, role = self._as_grown(name, config), learning_task.roles[name]
            spaces = role.observation_space, role.action_space
            self.algorithms[name] = self._equal_algorithm(grown, *spaces) or make_algorithm(
                grown, *spaces
            )

    def _equal_algorithm(
        self, config: Any, observation_space: Any, action_space: Any
    ) -> Algorithm | None:
        """Return an algorithm with equal settings, if one exists: it need not be compiled again.

        An algorithm holds no weights, so several learners may share one.
        """
        wanted = config, observation_space, action_space
        for other in self.algorithms.values():
            if (other.config, other.observation_space, other.action_space) == wanted:
                return other
        return None

    def _as_grown(self, name: str, config: Any) -> Any:
        """Return the settings, with the networks that ``name`` has grown in a population."""
        earlier = self.stage.policies.get(name)
        if not isinstance(earlier, AgentPolicy):
            return config
        settings: Any = earlier.algorithm.config
        grown = {k: getattr(settings, k) for k in ("network", "critic") if hasattr(settings, k)}
        return replace(config, **grown)

    @property
    def learning_task(self) -> JointTask:
        """The learning task of the stage."""
        learning_task: JointTask = self.stage.learning_task
        return learning_task

    def maker(self) -> MakeCollector:
        """Return a function that makes collectors; it may be sent to other machines."""
        return partial(_collector, self.learning_task, self._acting(), self._margins())

    def _acting(self) -> dict[str, Algorithm]:
        """Return the acting algorithms, by their paths in the stage's level."""
        return {relative(k, self.level): a for k, a in self.algorithms.items()}

    def _margins(self) -> dict[str, float]:
        """Return the margins of interruption, by the paths of critics in the stage's level."""
        margins = {CRITIC: self.together.margin} if self.together.interrupt else {}
        for path, role in self.learning_task.roles.items():
            if role.margin is not None and role.level != self.level:
                margins[relative(path, self.level)] = role.margin
        return margins

    def _guide_kl(self, name: str) -> float | None:
        """Return the KL within which a learner stays of its guide; None: without limit."""
        if name == self.first:
            kl: float | None = self.stage.entry.guide_kl
            return kl
        return self.learning_task.roles[name].guide_kl

    def learner_from(self, state: None, extra: dict[str, Tensor], log: StageLog) -> Learner:
        """Return all learners: from a checkpoint, from earlier stages, or fresh."""
        saved = unprefixed("state", extra)
        learners: dict[str, Learner] = {}
        for name, algorithm in self.algorithms.items():
            fresh: Any = algorithm.init([self.stage.seeds / name / "member" / 0])
            device = resolve_device(algorithm.config.device)
            earlier = self._earlier_policy(name)
            state = fresh
            reference = None
            if earlier is not None:
                if not saved:
                    self._report_lost_state(name, log)
                state = self._earlier_state(name, algorithm, fresh, *earlier)
                reference = self._reference(name, algorithm, state, device, log)
            if saved:
                state = state_from(unprefixed(name, saved), state, f"{log.run.path}: {name}")
            stack = Stack(algorithm, state_to(state, device))
            learnt_before = earlier is not None or name in self.stage.entry.starts
            learner = self._learner(name, stack, log, learnt_before=learnt_before)
            if reference is not None:
                learner.reference = reference  # type: ignore[attr-defined]
            keep_to_guide(learner, self._guide_kl(name))
            learners[name] = learner
        weights = self.stage.entry.task_weights
        joint = JointLearner(learners, self.level, self.together.task_weight, weights)
        if extra:
            for name in learners:
                counts = checked_tensor(
                    extra, f"counts.{name}", (2,), torch.int64, str(log.run.path)
                )
                if not ((counts >= 0) & (counts < 2**53)).all():
                    raise RunError(
                        f"{log.run.path}: its counts of rows and updates are out of range"
                    )
                joint.counts[name] = counts.tolist()
        return joint

    def _earlier_policy(self, name: str) -> tuple[AgentPolicy, int] | None:
        """Return the earlier policy of ``name``, with the steps that it learnt from.

        It is from earlier stages, or from the run that this one starts from; None: it is new.
        """
        policy = self.stage.policies.get(name)
        if isinstance(policy, AgentPolicy):
            return policy, self.stage.steps_before(name)
        if self.stage.continues:
            return None  # its final state holds everything
        return initial_policy(self.stage.run, self.stage.name, name, self.algorithms[name])

    def _report_lost_state(self, name: str, log: StageLog) -> None:
        """Report a deleted file of a state."""
        latest = self._latest_stage(name)
        path = self.stage.run.file("states", name)
        trained = latest is not None and latest.evolution is None and not latest.undone
        if trained and not path.exists():
            log.message(
                f"{path} is not there any more, so {name!r} continues with its weights alone, and "
                "learns otherwise than without the interruption"
            )

    def _earlier_state(
        self, name: str, algorithm: Algorithm, fresh: Any, policy: AgentPolicy, steps: int
    ) -> Any:
        """Return the state of ``name`` at the end of its latest stage; else its weights alone."""
        state = self.stage.run.load_state(name, fresh)
        if state is None:
            begin_as(algorithm, fresh, policy, steps)
            state = fresh
        return state

    def _reference(
        self, name: str, algorithm: Algorithm, state: Any, device: torch.device, log: StageLog
    ) -> Reference | None:
        """Return the reference policy of a skill that was trained before: that of ``state``."""
        rollouts = algorithm.store == "rollout"
        if self.together.reference_kl is None or decides(name) or not rollouts:
            return None
        if not self.stage.stages_before(name):
            return None  # it starts from another run, to learn the task of this one
        rate = success_rate(self._latest_stage(name))
        if rate == 0.0:
            log.message(
                f"skill {name!r} did not succeed any more when its own stage ended, so it moves "
                "freely here (together.reference_kl is not used for it)"
            )
            return None
        params = algorithm.acting_params(state, device=device)
        # A skill that seldom succeeded has little to lose, and much to learn.
        return Reference(
            params,
            torch.ones(1, dtype=torch.float32, device=device),
            self.together.reference_kl / rate,
        )

    def _learner(self, name: str, stack: Stack, log: StageLog, *, learnt_before: bool) -> Learner:
        """Return the learner of the selector, or of a skill."""
        num_envs = self.stage.config.num_envs
        seeds = self.stage.seeds / name
        config = stack.algorithm.config
        row_steps = self.learning_task.roles[name].row_steps
        if stack.algorithm.store == "rollout":
            rows = num_envs * int(getattr(self.stage.config, "n_steps", config.n_steps))
            learns_all_rows = relative(name, self.level) in (SELECTOR, CRITIC)
            quota = 0 if learns_all_rows else max(1, round(rows * self.together.quota / row_steps))
            return RolloutLearner(stack, seeds, quota)
        store = store_of(stack.algorithm, num_envs)
        learner = ReplayLearner([stack], store, seeds, row_steps=row_steps, goes_on_at=log.at.steps)
        if learnt_before:
            learner.act_from_the_start()
        return learner

    def _latest_stage(self, name: str) -> StageEntry | None:
        """Return the latest entry of a finished stage in which ``name`` has learnt, or None."""
        return next(reversed(self.stage.stages_before(name)), None)

    def train(self, log: StageLog) -> dict[str, AgentPolicy]:
        """Learn until the stage is over, and report skills that learnt nothing."""
        policies = super().train(log)
        assert isinstance(self.learner, JointLearner)
        for name, (rows, updates) in self.learner.counts.items():
            if decides(name):
                continue
            if rows and not updates:
                learns = self.first in self.stage.entry.learns
                more = "raise together.epsilon, " if learns else ""
                log.message(
                    f"skill {name!r} acted in {rows:,} of {log.at.steps:,} steps only, too few "
                    f"to learn from once: lower together.quota, {more}or give more steps"
                )
            elif not rows:
                log.message(
                    f"skill {name!r} was never called in {log.at.steps:,} steps, so it learnt "
                    "nothing: perhaps its initiation() is never True where the other skills "
                    "lead, or the selector never chooses it"
                )
        return policies

    def tell_early(self, steps: int, log: StageLog) -> None:
        """Report skills that were not called so far."""
        assert isinstance(self.learner, JointLearner)
        for name, (rows, _) in self.learner.counts.items():
            if not rows and not decides(name):
                log.message(
                    f"skill {name!r} was not called in the first {steps:,} steps; it starts to "
                    "learn once its initiation() is True where other skills end"
                )

    def stacks(self) -> dict[str, Stack]:
        """Return the stacks of the learners, by path."""
        assert isinstance(self.learner, JointLearner)
        return {path: s for path, part in self.learner.learners.items() for s in part.stacks}

    def play(self, eval_envs: Collector, seeds: Seeds) -> Array:
        """Play an episode of the hierarchy in each evaluation environment, (N, 4)."""
        player = _joint_collector(
            self.learning_task, self._acting(), self._margins(), eval_envs.engine
        )
        requests = {
            name: Request(
                0,
                (s.algorithm.acting_params(s.state),),
                s.state.gamma.cpu().numpy(),
                seeds / name,
                greedy=self.learning_task.roles[name].greedy,
            )
            for name, s in self.stacks().items()
        }
        ready = Request(0, (), np.ones(1), seeds / self.first, greedy=True)
        of_selector = requests.pop(self.first, ready)
        of_skills = {relative(k, self.level): r for k, r in requests.items()}
        request = replace(of_selector, below=of_skills)
        with torch_threads(1), global_generators(seeds / "global"):
            longest = longest_evaluation(eval_envs.engine.time_limit)
            return player.play(request, seeds / "start", longest)

    def saved(self, extra: dict[str, Tensor]) -> tuple[None, dict[str, Tensor]]:
        """Return all states among the extra tensors."""
        assert isinstance(self.learner, JointLearner)
        states = {
            f"counts.{name}": torch.tensor(counts, **INT)
            for name, counts in self.learner.counts.items()
        }
        for name, state in self.states().items():
            states |= prefixed(f"state.{name}", vars(state))
        return None, extra | states | self.best.tensors()


def _collector(
    learning_task: JointTask,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
    num_envs: int,
    first: int,
) -> Collector:
    engine = make_engine(learning_task.spec, num_envs, first=first)
    return learning_task.logged(_joint_collector(learning_task, algorithms, margins, engine))


def _joint_collector(
    learning_task: JointTask,
    algorithms: Mapping[str, Algorithm],
    margins: Mapping[str, float],
    engine: Engine,
) -> Collector:
    """Return a collector in which the selector and all skills act."""
    acting = {k: Acting([(a, 1)], engine.num_envs) for k, a in algorithms.items()}
    selector = acting.pop(SELECTOR, None)
    return Collector(engine, selector, learning_task.who, acting, margins)


class JointLearner:
    """A selector and skills, each with its own learner, which gets only its own rows.

    Args:
        learners: by path, the selector first unless it is ready, then all other learners.
        level: the path of their level.
        task_weight: the weight of the task's advantage for skills, at the end of the stage.
        weights: weights of skills with another weight, by path.
    """

    def __init__(
        self,
        learners: Mapping[str, Learner],
        level: str,
        task_weight: float = 0.0,
        weights: Mapping[str, float] | None = None,
    ) -> None:
        self.learners = dict(learners)
        self._progress = 0.0
        weights = weights or {}
        # Learners from replay store no advantage, so they follow their own reward alone.
        self._weights = {
            name: weights.get(name, task_weight)
            for name, learner in learners.items()
            if isinstance(learner, RolloutLearner) and not decides(name)
        }
        self._level = level
        self._selector = join(level, SELECTOR)
        self._critic = join(level, CRITIC)
        self.counts = {name: [0, 0] for name in learners}
        """Rows in which each has acted, and updates from them, by path."""
        self._acted: dict[str, Tensor] = {}
        self.stacks: Sequence[Stack] = [s for learner in learners.values() for s in learner.stacks]
        self.overlap = all(learner.overlap for learner in learners.values())
        self.report_every = max(learner.report_every for learner in learners.values())
        self.threads = max(learner.threads for learner in learners.values())

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return the selector's request, with the requests of all others below it.

        Where the selector is ready, the number of rows is the largest that a skill requests.
        """
        self._progress = progress
        requests = {k: p.request(update, steps, progress) for k, p in self.learners.items()}
        first = next(iter(requests.values()))
        if self._selector in self.learners:
            del requests[self._selector]
        else:
            rows = max(r.rows for r in requests.values())
            first = Request(rows, (), first.gamma, first.seeds / self._selector)
        record = tuple(dict.fromkeys(name for r in requests.values() for name in r.record))
        below = {relative(k, self._level): r for k, r in requests.items()}
        return replace(first, below=below, record=record)

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Give each learner its own rows, and skills the task's advantage, if it has a weight."""
        by_learner = {name: batches[relative(name, self._level)] for name in self.learners}
        if any(self._weights.values()):
            advantage = self._progress * self._task_advantage(by_learner[self._critic])
            for name, weight in self._weights.items():
                if weight:
                    by_learner[name] = by_learner[name].replace(advantage=weight * advantage)
        for name, rows in by_learner.items():
            self.counts[name][0] += int(rows.valid_rows.sum())
            self._acted |= prefixed(name, how_it_acted(name, rows))
            self.learners[name].take({"": rows})

    def _task_advantage(self, rows: Batch) -> Array:
        """Return the task's advantage of each step, (T, N) float32, with standard deviation 1.

        Small advantages have less, in units of reward: see ``PPO.min_advantage_std``.
        """
        (stack,) = self.learners[self._critic].stacks
        store = RolloutStore(1, device=stack.state.params.device)
        store.add(rows)
        rollout = store.rollout(stack.state.gamma)
        assert rollout is not None
        advantage = stack.algorithm.advantage(stack.state, rollout)
        min_std = stack.algorithm.config.min_advantage_std / stack.state.return_scale.item()
        scaled: Array = normalize(advantage, eps=1e-3, min_std=min_std)[0].cpu().numpy()
        return scaled

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Update the learners that have enough rows; return metrics under ``<name>.``."""
        all_metrics = self._acted
        self._acted = {}
        for name, learner in self.learners.items():
            metrics = learner.learn(update, steps, progress)
            self.counts[name][1] += bool(metrics)
            all_metrics |= prefixed(name, metrics)
        return all_metrics

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,), whose environments were reset."""
        for learner in self.learners.values():
            learner.cut(columns)

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint beside the states of the stacks."""
        tensors: dict[str, Tensor] = {}
        for name, learner in self.learners.items():
            tensors |= prefixed(name, learner.kept(requested=requested, replay=replay))
        return tensors

    def load(self, kept: dict[str, Tensor]) -> None:
        """Restore the tensors that ``kept`` returned."""
        for name, learner in self.learners.items():
            learner.load(unprefixed(name, kept))


def how_it_acted(name: str, rows: Batch) -> dict[str, Tensor]:
    """Return a selector's mean steps of a call, or a skill's usage and reward.

    Args:
        name: the path of the learner; a critic has no such metrics.
        rows: the learner's own.

    Returns:
        ``call_length``, or ``usage`` (a share of all steps) and ``reward`` (mean of its own
        steps), each (1,).
    """
    valid = rows.valid_rows
    metrics: dict[str, float] = {}
    if name_of(name) == SELECTOR:
        if valid.any():
            metrics["call_length"] = rows["steps"][valid].mean()
    elif not decides(name):
        metrics["usage"] = valid.mean()
        if valid.any():
            metrics["reward"] = rows["reward"][valid].mean()
    return {key: torch.tensor([float(value)], **FLOAT) for key, value in metrics.items()}
