"""The environments of a population's members, and their training between two comparisons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave._internal.prefixes import prefixed, unprefixed
from skillweave._internal.seeding import Seeds
from skillweave.algorithms.agent_policy import AgentPolicy, make_algorithm
from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.buffers.replay import ReplayStore
from skillweave.envs.joined import JoinedEngines
from skillweave.errors import EnvError, SkillweaveError
from skillweave.evolution.stacks import Member, grouped, join, split
from skillweave.experience.acting import Acting
from skillweave.experience.collector import RETURN, Collector, joined_from, parted
from skillweave.experience.group import Collectors
from skillweave.experience.learners import Calling
from skillweave.ops.device import resolve_device
from skillweave.policies.core import Array
from skillweave.spaces import to_tensor
from skillweave.training.episodes import Episodes, EpisodeTally, Tick
from skillweave.training.learner import RolloutLearner, Stack
from skillweave.training.learning_task import LearningTask
from skillweave.training.loop import Loop, LoopState
from skillweave.training.periodic import episodes_of
from skillweave.training.replay_learner import ReplayLearner, judge_of, store_of

OnGenerationTick = Callable[[int, dict[str, float]], None]
"""Receives the steps of all members in this generation so far, and the metrics of an update."""


class Shard:
    """A part of a population: places, each with environments in which a member trains.

    Results are a function of members, seeds and its state.

    Args:
        learning_task: the task that members learn.
        config: settings of any member.
        seeds: the stage's seeds.
        count: the number of places.
        first: the number of the first place in the population.
    """

    steps_elsewhere = 0
    """Environment steps of fitness measurements in other processes."""

    def __init__(
        self,
        learning_task: LearningTask,
        config: AlgorithmConfig,
        seeds: Seeds,
        count: int,
        first: int = 0,
    ) -> None:
        self.spaces = learning_task.role.spaces
        self.row_steps = learning_task.role.row_steps
        self._role = learning_task.role
        self._seeds = seeds
        self._first = first
        each = config.num_envs
        self.replays = make_algorithm(config, *self.spaces).store == "replay"
        who = learning_task.who
        if isinstance(who, Calling):
            learning_task = replace(learning_task, who=replace(who, keep_rewards=self.replays))
        self.places: list[Collector] = []
        """The collectors in which members act: an heir continues its place's open episodes."""
        try:
            for i in range(first, first + count):
                self.places.append(learning_task.collector(each, None, i * each))
        except SkillweaveError as error:
            self.close()
            raise too_many(error, f"{count * each} of them to train in") from error
        self.num_envs = count * each
        self.episodes = Episodes(learning_task.log_info)
        self.rounds = 0
        """Rounds of the loop in which all members learn from one store."""
        self.store: ReplayStore | None = None
        self._kept: dict[str, Tensor] = {}  # counts of its learner
        self._made: dict[AlgorithmConfig, Algorithm] = {}

    def train(
        self,
        members: Sequence[Member],
        until: int,
        schedule_steps: int,
        seeds: Seeds,
        on_tick: OnGenerationTick,
    ) -> None:
        """Train members, one for each place, until each has ``until`` steps.

        With rollouts one stack learns after another; from replay all at once, from one store. A
        recurrent member begins a generation with an empty state, because the open one is of
        another network.
        """
        for i, place in enumerate(self.places):
            place.start(self._seeds / "start" / (self._first + i))
        groups = grouped(members, self.spaces)
        first = spent = 0
        at_once = [groups] if self.replays else [[group] for group in groups]
        for i, some in enumerate(at_once, self._first):
            stacks = [self._stack(group) for group in some]
            learning = [member for group in some for member in group]
            start = sum(m.steps for m in learning)
            count = len(learning)
            own = seeds if self.replays else seeds / i
            learner = self._learner(stacks, learning, own)
            places = self.places[first : first + count]
            joined = self._together(places, stacks)
            end = Loop(
                learner,
                Collectors([joined], count),
                self.episodes,
                own,
                until * count,
                LoopState(self.rounds, start),
                schedule_steps=schedule_steps * count,
                skip_diverged=True,
                on_tick=_counting_from(on_tick, spent - start),
            ).run()
            parted(joined, places)
            for stack, group in zip(stacks, some, strict=True):
                split(stack.algorithm, state_to(stack.state, "cpu"), group, self.spaces)
            for k, member in enumerate(learning):
                member.steps += (end.steps - start + k) // count
            spent += end.steps - start
            first += count
            if isinstance(learner, ReplayLearner):
                self._kept = learner.counts()
                self.rounds = end.update

    def _learner(
        self, stacks: list[Stack], members: Sequence[Member], seeds: Seeds
    ) -> RolloutLearner | ReplayLearner:
        """Return the learner of stacks of these members."""
        if not self.replays:
            (stack,) = stacks
            return RolloutLearner(stack, seeds)
        self.store = self.store or self._make_store(members)
        start = sum(m.steps for m in members)
        learner = ReplayLearner(
            stacks, self.store, seeds, row_steps=self.row_steps, goes_on_at=start
        )
        if self._kept:
            learner.load(self._kept)
        return learner

    def _stack(self, group: list[Member]) -> Stack:
        """Join members to one stack, on the device of learning."""
        algorithm, state = join(group, self.spaces, self._made)
        return Stack(algorithm, state_to(state, resolve_device(algorithm.config.device)))

    def _together(self, places: Sequence[Collector], stacks: Sequence[Stack]) -> Collector:
        """Return the places' collectors as one, in which the stacks act."""
        engine: Any = JoinedEngines([place.engine for place in places])
        acting = Acting([(s.algorithm, s.members) for s in stacks], engine.num_envs)
        return joined_from(places, engine, acting)

    def _make_store(self, members: Sequence[Member]) -> ReplayStore:
        algorithm = members[0].algorithm(self.spaces)
        count = len(self.places)
        judge = judge_of(algorithm.config, self._role)
        num_envs = count * self.places[0].num_envs
        return store_of(algorithm, num_envs, count, shared=True, judge=judge)

    @property
    def tally(self) -> EpisodeTally:
        """Return the tally of logged keys of ``info``."""
        return self.episodes.tally

    def fitness(self, members: Sequence[Member], eval_envs: FitnessEnvs, seeds: Seeds) -> Array:
        """Return each member's mean return in the same episodes; −inf if it has diverged."""
        return np.array(
            [
                -np.inf if has_diverged(m) else eval_envs.score(policy_of(m, self.spaces), seeds)
                for m in members
            ]
        )

    def state(self) -> dict[str, Tensor]:
        """Return the state of environments and counts for a checkpoint."""
        arrays = prefixed("episodes", self.episodes.state())
        for i, place in enumerate(self.places):
            arrays |= prefixed(str(i), place.state())
        tensors = {k: to_tensor(np.array(v)) for k, v in arrays.items()}
        return tensors | prefixed("kept", self._kept)

    def restore(
        self, saved: dict[str, Tensor], members: Sequence[Member], store: dict[str, Tensor]
    ) -> Array:
        """Restore a ``state``; return the environments that were reset, (k,).

        Args:
            store: the content of the replay buffer; empty if it has none.
        """
        self._kept = unprefixed("kept", saved)
        arrays = {k: v.numpy() for k, v in saved.items()}
        self.episodes.load(unprefixed("episodes", arrays))
        if store:
            self.store = self._make_store(members)
            self.store.load(store)
        return self._reset_columns(
            [place.restore(unprefixed(str(i), arrays)) for i, place in enumerate(self.places)]
        )

    def _reset_columns(self, ids: Sequence[Array]) -> Array:
        """Return environments of each place as columns; end their open trajectories."""
        columns = np.concatenate([rows + i * self.places[0].num_envs for i, rows in enumerate(ids)])
        if self.store is not None:
            self.store.cut(columns)
        if "returns" in self._kept:
            self._kept["returns"][columns] = 0.0
        return columns

    def close(self) -> None:
        """Release the environments."""
        for place in self.places:
            place.close()


def too_many(error: SkillweaveError, needed: str) -> EnvError:
    """Return the error of a population for which not enough environments could be made."""
    return EnvError(
        f"{error}. A population needs several environments at once, here {needed}: if there can be "
        "no more, give it fewer members (population) and num_envs, or leave out evolve"
    )


def _counting_from(on_tick: OnGenerationTick, before: int) -> Callable[[Tick], None]:
    """Return a listener that adds ``before`` steps to the ticks of one loop."""
    return lambda tick: on_tick(before + tick.steps, tick.metrics)


def policy_of(member: Member, spaces: tuple[Any, Any]) -> AgentPolicy:
    """Return a member's policy."""
    return AgentPolicy.of(member.algorithm(spaces), member.state)


def has_diverged(member: Member) -> bool:
    """Return whether a member has diverged: a number that it learnt is not finite."""
    return not all(bool(torch.isfinite(v).all()) for v in vars(member.state).values())


class FitnessEnvs:
    """Environments in which one member after another plays the same episodes.

    They are at most as many as in a member's training: more episodes are played in several rounds.

    Args:
        learning_task: the task that members learn.
        episodes: the number of episodes of each member.
        num_envs: environments of a member's training.
    """

    def __init__(self, learning_task: LearningTask, episodes: int, num_envs: int) -> None:
        rounds = -(-episodes // num_envs)
        self._episodes = episodes
        self._who = learning_task.who
        self._engine = learning_task.engine(-(-episodes // rounds))

    @property
    def steps_made(self) -> int:
        """Return the number of steps of all members in these environments."""
        return self._engine.steps_made

    def score(self, policy: AgentPolicy, seeds: Seeds) -> float:
        """Return a policy's mean return of the episodes of these seeds; −inf if not finite."""
        total = self._episodes
        each = self._engine.num_envs
        played = [
            episodes_of(policy, self._who, self._engine, seeds, first, min(each, total - first))
            for first in range(0, total, each)
        ]
        returns = np.concatenate(played)[:, RETURN]
        return float(returns.mean()) if np.isfinite(returns).all() else -np.inf

    def close(self) -> None:
        """Release the environments."""
        self._engine.close()
