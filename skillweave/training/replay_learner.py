"""The learner from replay: its store, and the gradient steps that are due."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.actor_critic import ActorCriticAlgorithm
from skillweave.algorithms.base import ActingParams
from skillweave.algorithms.batches import OF_STEP, Batch, RawRows
from skillweave.algorithms.config import JUDGES_AGAIN, is_offline
from skillweave.buffers.judged import Judge, JudgedStore
from skillweave.buffers.recorded_steps import RecordedSteps
from skillweave.buffers.replay import ReplayStore
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.experience.acting import ActionRepeat, Request
from skillweave.experience.judges import AgentJudge, GoalEnvJudge, SkillJudge, first_step
from skillweave.ops.device import resolve_device
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor
from skillweave.training.learner import Stack, acting_of, member_seeds
from skillweave.training.paid_returns import ENOUGH, FARTHEST, PaidReturns
from skillweave.training.role import Role

DRAWN_AT_ONCE = 8
"""Gradient steps whose samples are drawn at once."""
LOOK, SETTLED = 200, 0.05
"""Gradient steps after which critics that learn alone are looked at; and the share of their mean
value by which it may change between two looks, where they are said to have settled."""


@dataclass
class CriticsFirst:
    """The gradient steps in which critics learn alone, as their policy was learnt without them."""

    left: int
    """The most of the next gradient steps."""
    seen: int = 0
    """Gradient steps since the latest look."""
    total: float = 0.0
    """The sum of the mean values since then."""
    before: float = math.nan
    """The mean value between the two latest looks."""

    def see(self, value: float) -> None:
        """Count a gradient step with this mean value."""
        self.left -= 1
        self.seen += 1
        self.total += value
        if self.seen < LOOK:
            return
        now = self.total / LOOK
        if abs(now - self.before) <= SETTLED * abs(now):
            self.left = 0
        self.seen, self.total, self.before = 0, 0.0, now

    def tensor(self) -> Tensor:
        """Return its numbers, for a checkpoint."""
        numbers = [self.left, self.seen, self.total, self.before]
        return torch.tensor(numbers, dtype=torch.float64, device="cpu")

    @classmethod
    def of(cls, kept: Tensor) -> CriticsFirst:
        """Return it as ``tensor`` recorded it."""
        left, seen, total, before = kept.tolist()
        return cls(int(left), int(seen), total, before)


class ReplayLearner:
    """Stacks side by side that learn from one shared store, or each from its own rows.

    The settings of experience (``num_envs``, ``train_freq``, ``n_step``, the store) are taken from
    the first stack. Budgets and ``learning_starts`` count environment steps; the update ratio
    counts transitions, of which a selector has one for each decision.

    Args:
        store: made by ``store_of``.
        row_steps: approximate environment steps of a row; a selector's calls have several.
        goes_on_at: environment steps of the stage so far.
    """

    report_every = 1_000

    def __init__(
        self,
        stacks: Sequence[Stack],
        store: ReplayStore,
        seeds: Seeds,
        *,
        row_steps: int = 1,
        goes_on_at: int = 0,
    ) -> None:
        self.stacks = stacks
        self.store = store
        self.config = stacks[0].algorithm.config
        self.overlap = bool(self.config.overlap)
        self.threads = int(self.config.threads)
        self._seeds = seeds
        self._row_steps = row_steps
        self.members = sum(s.members for s in stacks)
        self._first = [0, *itertools.accumulate(s.members for s in stacks)]
        self._random_until = int(self.config.learning_starts) * self.members
        self._acts_at_random = True
        # A resumed stage whose store was not saved fills it by acting with its trained policy.
        self._learns_from = self._random_until + (0 if len(store) else goes_on_at)
        self._transitions = np.zeros(2)  # of a member: at the latest update, and now
        self._returns: Array | None = None  # (N,), the open episodes' discounted returns
        alone = len(stacks) == 1 and self.members == 1
        judged = alone and isinstance(stacks[0].algorithm, ActorCriticAlgorithm)
        self.paid = PaidReturns(store.num_envs) if judged else None
        """What its episodes have paid; a learner that goes on counts again. None: of no use."""
        self._acting: tuple[ActingParams, ...] = ()  # of the latest request
        self._resumed: tuple[ActingParams, ...] = ()  # of the first request after a checkpoint
        self.keeps_scaling = False
        """Observations stay scaled as for the policy that was given."""
        self.critics_first: CriticsFirst | None = None
        """Critics learn alone at first; None: the policy learns, too."""

    def act_from_the_start(self) -> None:
        """Skip the phase of random actions: the policy is trained already."""
        self._acts_at_random = False

    def request(self, update: int, steps: int, progress: float) -> Request:
        """Return a request for ``train_freq`` rows of every environment."""
        explored = progress if self._acts_at_random else 1.0  # ε of DQN does not start again
        params = self._resumed or tuple(
            s.algorithm.acting_params(s.state, explored) for s in self.stacks
        )
        self._acting = params
        self._resumed = ()
        rows = int(self.config.train_freq) * self._row_steps
        at_random = self._acts_at_random and steps < self._random_until
        seeds = self._seeds / "collect" / update
        return Request(
            rows,
            params,
            self._gamma(),
            seeds,
            at_random,
            action_repeat=self._action_repeat(update * rows, progress),
            record=self.store.raw,
        )

    def _action_repeat(self, at: int, progress: float) -> ActionRepeat | None:
        """Return the schedule of repeated actions (εz-greedy) from row ``at`` on; None: off."""
        cfg = self.config
        if not cfg.action_repeat:
            return None
        return ActionRepeat(
            at, cfg.action_repeat * (1.0 - progress), cfg.action_repeat_steps, self._seeds / "bouts"
        )

    def take(self, batches: Mapping[str, Batch]) -> None:
        """Store rows, and update the running scales of observations and returns."""
        batch = batches[""]
        self.store.add(batch)
        self._transitions[1] += int(batch.own_rows.sum()) / self.members
        if self.paid is not None:
            self.paid.see(batch, float(self._gamma()[0]))
        self._see(batch)
        if any(s.algorithm.scales_rewards for s in self.stacks):
            self._scale_returns(batch)

    def shared_rows(self) -> dict[str, Tensor]:
        """Return the rows with which the next skill begins."""
        assert isinstance(self.store, JudgedStore)
        return self.store.shared_rows()

    def begin_with(self, shared: Mapping[str, Tensor]) -> None:
        """Begin with the rows of another skill's store, see ``JudgedStore``."""
        assert isinstance(self.store, JudgedStore)
        for batch in self.store.begin_with(shared):
            self._see(batch)

    def begin_with_data(self, data: RecordedSteps, *, scales: bool = True) -> None:
        """Begin with steps that were recorded elsewhere.

        Args:
            data: of the environment.
            scales: update the running scales of observations and returns, too.

        Raises:
            SkillweaveError: the learner's skill cannot judge them.
        """
        store = self.store
        assert isinstance(store, JudgedStore)
        rng = (self._seeds / "data").numpy()
        batch = store.add_recorded(data.rows(store.num_envs, store.raw), rng)
        if not scales:
            return
        self._update_obs_stats(batch["obs"], batch["valid"])
        if any(s.algorithm.scales_rewards for s in self.stacks):
            self._scale_returns(batch)
            self._returns = None

    def _see(self, batch: Batch) -> None:
        """Update the running scales of observations."""
        self._update_obs_stats(*self.store.seen(batch))

    def _update_obs_stats(self, obs: Array, valid: Array | None) -> None:
        """Update the running scales with observations (T, N, …) where ``valid`` (T, N)."""
        for i, stack in enumerate(self.stacks):
            columns = self._columns(i)
            stack.algorithm.update_obs_stats(
                stack.state,
                _rows(obs, columns, stack),
                None if valid is None else _rows(valid, columns, stack),
                scales=not self.keeps_scaling,
            )

    def _scale_returns(self, batch: Batch) -> None:
        """Update the running scale of discounted returns, row by row."""
        _, n = batch.lead
        each = n // self.members
        if self._returns is None:
            self._returns = np.zeros(n, np.float32)
        gamma = self._gamma().repeat(each)
        all_valid = batch.own_rows if "own" in batch else batch.get("valid")
        for at, ended in enumerate(batch.ended):
            valid = None if all_valid is None else all_valid[at]
            power = gamma ** batch["steps"][at].astype(np.float32)
            returns = self._returns * power + batch["reward"][at]
            if "own" in batch:  # where others act, its own call is over
                self._returns = returns * batch.own_rows[at]
            elif valid is None:
                self._returns = returns
            else:
                self._returns = np.where(valid, returns, self._returns)
            for i, stack in enumerate(self.stacks):
                columns = self._columns(i)
                stack.algorithm.update_return_stats(
                    stack.state,
                    _rows(self._returns[None], columns, stack),
                    None if valid is None else _rows(valid[None], columns, stack),
                )
            self._returns[ended if valid is None else ended & valid] = 0.0

    def learn(self, update: int, steps: int, progress: float) -> dict[str, Tensor]:
        """Make the gradient steps that are due; return the metrics of the last one, {} for none."""
        if steps <= self._learns_from or not self.store.ready:
            self._transitions[0] = self._transitions[1]
            return {}
        metrics = [self._learn(i, update, progress) for i in range(len(self.stacks))]
        self._transitions[0] = self._transitions[1]
        if not all(metrics):
            return {}
        return {k: torch.cat([m[k] for m in metrics]) for k in metrics[0]}

    def _learn(
        self, at: int, update: int, progress: float, due: int | None = None
    ) -> dict[str, Tensor]:
        """Make the gradient steps of the stack number ``at``; return the metrics of the last.

        Args:
            due: the gradient steps; None: by the transitions since the latest update.
        """
        stack = self.stacks[at]
        first = self._first[at]
        cfg = stack.algorithm.config
        before, after = (int(t * cfg.update_ratio) for t in self._transitions)
        due = after - before if due is None else due
        metrics: dict[str, Tensor] = {}
        beta = cfg.priority_beta + progress * (1.0 - cfg.priority_beta)
        seeds = member_seeds(self._seeds, "learn", stack.members, update, first)
        rngs = [s.numpy() for s in seeds]
        generators = [s.torch() for s in seeds]
        gamma = stack.state.gamma.cpu()
        # Several draws at once cost little more than one, but priorities change in between.
        draws = 1 if cfg.prioritized else DRAWN_AT_ONCE
        for done in range(0, due, draws):
            size = cfg.batch_size * min(draws, due - done)
            drawn = self.store.sample(size, gamma, rngs, beta, first, progress)
            for sample in drawn.split(cfg.batch_size):
                alone = self.critics_first
                sample.critic_alone = alone is not None
                with torch.enable_grad():  # the user may have switched gradients off
                    stack.state, report = stack.algorithm.update(stack.state, sample, generators)
                metrics = report.metrics
                if alone is not None:
                    alone.see(float(metrics["q"].mean()))
                    self.critics_first = alone if alone.left > 0 else None
                if cfg.prioritized:
                    self.store.update_priorities(sample.index, report.error, first)
        return metrics

    def cut(self, columns: Array) -> None:
        """End the open trajectories of ``columns`` (k,)."""
        self.store.cut(columns)
        if self.paid is not None:
            self.paid.cut(columns)
        if self._returns is not None:
            self._returns[columns] = 0.0

    def kept(self, *, requested: bool = True, replay: bool = True) -> dict[str, Tensor]:
        """Return counts, the next acting parameters, and the store if it is saved."""
        saved = replay and self.config.save_buffer
        tensors = prefixed("store", self.store.state()) if saved else {}
        acting = {str(i): p.state() for i, p in enumerate(self._acting) if requested}
        for i, state in acting.items():
            tensors |= prefixed(f"acting.{i}", state)
        return self.counts() | tensors

    def counts(self) -> dict[str, Tensor]:
        """Return the replay learner's counts of transitions, and the returns of open episodes."""
        counts = {"transitions": torch.from_numpy(self._transitions.copy())}
        if self._returns is not None:
            counts["returns"] = torch.from_numpy(self._returns.copy())
        if self.critics_first is not None:
            counts["critics_first"] = self.critics_first.tensor()
        return counts

    def load(self, kept: dict[str, Tensor]) -> None:
        """Restore the tensors of a checkpoint."""
        self._transitions = kept["transitions"].numpy().copy()
        if "critics_first" in kept:
            self.critics_first = CriticsFirst.of(kept["critics_first"])
        if "returns" in kept:
            self._returns = kept["returns"].numpy().copy()
        if acting := unprefixed("acting", kept):  # a generation starts with its own request
            self._resumed = tuple(
                acting_of(stack, unprefixed(str(i), acting)) for i, stack in enumerate(self.stacks)
            )
        if saved := unprefixed("store", kept):
            self.store.load(saved)
            self._learns_from = self._random_until

    def expects_too_much(self, metrics: Mapping[str, float]) -> str:
        """Return a sentence where critics expect far more than was ever paid; else nothing.

        Args:
            metrics: the latest of its update.
        """
        if self.paid is None or self.paid.episodes < ENOUGH:
            return ""
        (stack,) = self.stacks
        algorithm, state = stack.algorithm, stack.state
        largest = max(self.paid.largest, float(state.end_pay[0]))
        if not largest:
            return ""
        unit = float(algorithm.units(state)[1][0, 0])
        far = 1.0 - float(state.gamma[0])
        entropy = metrics.get("ent_coef", 0.0) * unit * max(0.0, metrics.get("entropy", 0.0))
        if entropy > largest * far:
            return (
                f"its entropy is worth {entropy / far:.3g} in the long run (ent_coef "
                f"{metrics['ent_coef']:.3g} for {metrics['entropy']:.3g} nats in each step), and "
                f"the largest return of its {self.paid.episodes:,} episodes was {largest:.3g}, so "
                "it rather stays random: lower ent_coef, SAC(ent_coef=0.05), or scale rewards up"
            )
        if abs(q := metrics.get("q", 0.0)) > FARTHEST * largest:
            return (
                f"its critics expect {q:.3g} on average, and the largest return of its "
                f"{self.paid.episodes:,} episodes was {largest:.3g}: they overestimate. A lower "
                "learning_rate, update_ratio or n_step may help"
            )
        return ""

    def _gamma(self) -> Array:
        """Return the discounts of all members, (P,) float32."""
        return np.concatenate([s.state.gamma.cpu().numpy() for s in self.stacks])

    def _columns(self, stack: int) -> slice:
        """Return the columns of a stack's members."""
        each = self.store.num_envs // self.members
        return slice(self._first[stack] * each, self._first[stack + 1] * each)


def judge_of(config: Any, role: Role) -> Judge | None:
    """Return who judges a learner's rows again; None: nobody, see ``JUDGES_AGAIN``.

    Raises:
        SkillweaveError: the learner's rows cannot be judged again.
    """
    setting = next((x for x in JUDGES_AGAIN if getattr(config, x, False)), None)
    if setting is None:
        return None
    spaces = role.spec.spaces
    if role.kind == "agent":
        return GoalEnvJudge(role.spec) if config.hindsight else AgentJudge(role.spec)
    if role.skill is None:
        if is_offline(config):
            raise DeclarationError(
                f"the {role.kind} {role.path!r} cannot learn by {type(config).__name__}, which is "
                "for skills and plain agents: let it learn by PPO, which begins from data, too"
            )
        for_whom = "skills with goals and for plain agents" if config.hindsight else "skills"
        raise DeclarationError(
            f"the {role.kind} {role.path!r} cannot learn with {setting}, which is for {for_whom}: "
            f"give it an algorithm without {setting}"
        )
    sharing = role.sharing if config.shared_replay else None
    return SkillJudge(
        role.skill,
        role.part,
        spaces.observation,
        spaces.action,
        hindsight=bool(config.hindsight),
        shared=None if sharing is None else sharing.info,
    )


def try_judge(judge: Judge, config: Any, spec: EnvSpec) -> None:
    """Judge the first step of an episode, before steps are spent.

    Raises:
        SkillweaveError: what the user has written cannot judge them.
    """
    step = first_step(spec)
    known = {name: getattr(step, field) for name, field in OF_STEP.items() if "obs" not in name}
    known["call_elapsed"] = step.elapsed
    columns = {k: known.get(k, x) for k, x in judge.examples.items()}
    rows = RawRows(step.obs, step.next_obs, columns)
    if config.hindsight:
        reached = judge.achieved(step.next_obs)
        judge.judged(rows, reached)
        judge.check(rows, reached, differ=True)
    if config.shared_replay:
        goal = judge.goals(rows)
        if goal is not None:
            goal = judge.practised(step.obs, np.random.default_rng(0))
        judge.check_shared(rows, goal)


def store_of(
    algorithm: Any,
    num_envs: int,
    members: int = 1,
    *,
    shared: bool = False,
    judge: Judge | None = None,
    capacity: int | None = None,
) -> ReplayStore:
    """Return an empty replay store for an algorithm's samples.

    Args:
        num_envs: of all members together.
        shared: each member learns from the experience of all.
        judge: judges rows again; None: nobody does.
        capacity: of all columns together; None: by ``buffer_size``.

    Raises:
        TrainingError: the store is larger than the machine's memory.
        DeclarationError: the store is smaller than one row.
    """
    config, codec = algorithm.config, algorithm.codec
    capacity = capacity or config.buffer_size * (1 if shared else members)
    device = resolve_device(config.device)
    if judge is not None:
        return JudgedStore(
            capacity,
            num_envs,
            members,
            codec.zeros(1),
            config.hindsight or None,
            config.shared_replay,
            judge,
            raw=[name for name in algorithm.raw if name not in judge.examples],
            shared=shared,
            device=device,
        )
    return ReplayStore(
        capacity,
        num_envs,
        members,
        algorithm.observation_space,
        codec.zeros(1),
        choices=codec.size if codec.discrete else 0,
        shared=shared,
        n_step=config.n_step,
        prioritized=config.prioritized,
        alpha=config.priority_alpha,
        between=algorithm.between,
        raw=algorithm.raw,
        device=device,
    )


def _rows(x: Array, columns: slice, stack: Stack) -> Tensor:
    """Return a stack's columns of (T, N, …) as (P, T·B, …) on the stack's device."""
    rows = to_tensor(np.ascontiguousarray(x[:, columns])).unflatten(1, (stack.members, -1))
    flat: Tensor = rows.transpose(0, 1).flatten(1, 2)
    return flat.to(stack.state.params.device)
