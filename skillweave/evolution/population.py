"""A population: it trains side by side in stacks, is compared, and becomes its own next generation.

Between generations a member is a thing of its own; see ``stacks`` for how they learn together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.config import PPO, AlgorithmConfig
from skillweave.algorithms.policy import AgentPolicy
from skillweave.buffers.replay import ReplayBuffer
from skillweave.envs.joined import JoinedEnvs
from skillweave.evolution.config import Evolution
from skillweave.evolution.mutation import mutate, random_config
from skillweave.evolution.selection import select
from skillweave.evolution.stacks import Member, Origin, copy, grouped, join, split
from skillweave.ops.threads import torch_threads
from skillweave.seeding import Seeds
from skillweave.training.collector import Collector
from skillweave.training.episodes import Tick
from skillweave.training.members import Stack
from skillweave.training.off_policy import make_buffer, train_stacks
from skillweave.training.on_policy import train_on_policy
from skillweave.training.periodic import MakeEnv, first_episodes
from skillweave.types import Array, Policy, VecEnv

NEVER = 2**62
"""Steps between cuts: a generation is one piece."""
OnTick = Callable[[int, Tick], None]
"""Is told the steps of all members in this generation so far, and the tick."""


class Population:
    """Members, what they learn in, and how they evolve.

    Members of one stack stand side by side in ``members``.
    """

    def __init__(
        self,
        members: list[Member],
        evolution: Evolution,
        make_env: MakeEnv,
        spaces: Any,
        seeds: Seeds,
    ) -> None:
        self.members, self.evolution, self.seeds = members, evolution, seeds
        self.spaces = spaces
        self.next_number = len(members)
        each, gamma = members[0].config.num_envs, members[0].config.gamma
        self.collector = Collector(JoinedEnvs([make_env(each, gamma) for _ in members]))
        """What they act in, place by place: an heir goes on with its place's open episodes."""
        self.rounds = 0
        """Of the off-policy loop, in which all members go side by side."""
        self.buffer: ReplayBuffer | None = None
        self._made: dict[AlgorithmConfig, Algorithm] = {}

    @classmethod
    def fresh(
        cls,
        config: AlgorithmConfig,
        evolution: Evolution,
        make_env: MakeEnv,
        spaces: Any,
        seeds: Seeds,
    ) -> Population:
        """The first generation, each member with weights of its own."""
        members = []
        for i in range(evolution.population):
            own = config
            if evolution.start == "random":
                own = random_config(config, evolution.mutations, (seeds / "start" / i).numpy())
            member = Member(i, own, None)
            member.state = member.algorithm(spaces).init([seeds / "member" / i])
            members.append(member)
        ordered = [m for group in grouped(members, spaces) for m in group]
        return cls(ordered, evolution, make_env, spaces, seeds)

    @property
    def steps(self) -> int:
        """Environment steps of all members and of their ancestors, each as often as it has heirs.

        What was really spent is counted by the stage.
        """
        return sum(m.steps for m in self.members)

    def train(self, until: int, horizon: int, seeds: Seeds, on_tick: OnTick) -> None:
        """Train every member until it has ``until`` steps; schedules end at ``horizon``."""
        groups = grouped(self.members, self.spaces)
        gamma = np.array([m.config.gamma for m in self.members])
        self.collector.env.set_gamma(gamma.repeat(self.members[0].config.num_envs))
        if isinstance(self.members[0].config, PPO):
            self._train_one_by_one(groups, until, horizon, seeds, on_tick)
        else:
            self._train_side_by_side(groups, until, horizon, seeds, on_tick)

    def _train_one_by_one(
        self,
        groups: list[list[Member]],
        until: int,
        horizon: int,
        seeds: Seeds,
        on_tick: OnTick,
    ) -> None:
        """On-policy: a stack's rollouts are its own, so stacks learn one after another.

        A recurrent member begins a generation without memory: another network made what there was.
        """
        first = 0
        self.collector.start(self.seeds / "start")
        spent = self.collector.spent()  # in search of a start; what follows, its parts count
        _count(self.members, spent)
        for i, group in enumerate(groups):
            algorithm: Any
            algorithm, state = join(group, self.spaces, self._made)
            start, count = sum(m.steps for m in group), len(group)
            clock = _Clock(spent, start, on_tick)
            train_on_policy(
                algorithm, self.collector.part(first, first + count), state, seeds / i,
                until * count, steps=start, horizon=horizon * count, tolerant=True,
                cut_every=NEVER, on_tick=clock,
            )  # fmt: skip
            split(algorithm, state, group, self.spaces)
            spent, first = spent + clock.taken, first + count
            _count(group, clock.taken)
        self.collector.spent()

    def _train_side_by_side(
        self,
        groups: list[list[Member]],
        until: int,
        horizon: int,
        seeds: Seeds,
        on_tick: OnTick,
    ) -> None:
        """Off-policy: all stacks act in one environment and learn from one buffer."""
        stacks = [Stack(*join(group, self.spaces, self._made)) for group in groups]
        start, count = self.steps, len(self.members)
        clock = _Clock(0, start, on_tick)
        self.collector.start(self.seeds / "start")
        self.buffer = self.buffer or self._make_buffer()
        train_stacks(
            stacks, self.collector, seeds, until * count, self.buffer, steps=start,
            update=self.rounds, horizon=horizon * count, tolerant=True, cut_every=NEVER,
            on_tick=clock,
        )  # fmt: skip
        for stack, group in zip(stacks, groups, strict=True):
            split(stack.algorithm, stack.state, group, self.spaces)
        self.rounds = clock.update
        _count(self.members, clock.taken)

    def _make_buffer(self) -> ReplayBuffer:
        algorithm: Any = self.members[0].algorithm(self.spaces)
        return make_buffer(algorithm, self.collector.env, len(self.members), shared=True)

    def load_buffer(self, saved: dict[str, torch.Tensor]) -> None:
        """Go on with the replay buffer of a checkpoint."""
        self.buffer = self._make_buffer()
        self.buffer.load(saved)
        self.buffer.cut(self.collector.begun_anew)

    def cut(self, seeds: Seeds) -> dict[str, torch.Tensor]:
        """Make a clean cut; what resuming from it needs of the environments."""
        begun_anew = self.collector.cut(seeds)
        if self.buffer is not None:
            self.buffer.cut(begun_anew)
        return self.collector.state()

    def close(self) -> None:
        """Release the environments."""
        self.collector.env.close()

    def fitness(self, env: VecEnv, seeds: Seeds) -> Array:
        """Mean return of each member's episodes, from the same starts; −inf if it has diverged."""
        return np.array([
            -np.inf if has_diverged(m) else score(self.policy(m), env, seeds) for m in self.members
        ])  # fmt: skip

    def policy(self, member: Member) -> AgentPolicy:
        """What a member has learnt."""
        return AgentPolicy.of(member.algorithm(self.spaces), member.state)

    def evolve(self, fitness: Array, seeds: Seeds) -> None:
        """Become the next generation."""
        rng = (seeds / "select").numpy()
        heirs = select(self.evolution, fitness, rng)
        places: dict[int, int] = {}
        members = []
        for place, heir in enumerate(heirs):
            parent = self.members[heir.parent]
            if heir.mutates:
                rng = (seeds / "mutate" / place).numpy()
                child = mutate(parent, self.evolution.mutations, self.spaces, rng)
            else:
                child = replace(copy(parent), origin=Origin(parent.number, "goes on"))
            if heir.mutates or parent.number in places:
                child.number, self.next_number = self.next_number, self.next_number + 1
            places[child.number] = heir.parent
            members.append(child)
        self.members = [m for group in grouped(members, self.spaces) for m in group]
        if self.buffer is not None:
            self.buffer.inherit(np.array([places[m.number] for m in self.members]))


class _Clock:
    """Tells the ticks of one loop in terms of the generation, and remembers where it ended."""

    def __init__(self, before: int, start: int, on_tick: OnTick) -> None:
        self._before, self._start, self._on_tick = before, start, on_tick
        self.taken = self.update = 0

    def __call__(self, tick: Tick) -> None:
        self.taken, self.update = tick.steps - self._start, tick.update
        self._on_tick(self._before + self.taken, tick)


def _count(members: list[Member], steps: int) -> None:
    """Give each of the members its part of the steps that they took together."""
    for i, member in enumerate(members):
        member.steps += (steps + i) // len(members)


def score(policy: Policy, env: VecEnv, seeds: Seeds) -> float:
    """Mean return of an episode in each environment; −inf if it is not finite."""
    with torch_threads(1):  # several wait for each other, for ever on a busy machine
        returns, _ = first_episodes(policy, env, seeds)
    return float(returns.mean()) if np.isfinite(returns).all() else -np.inf


def has_diverged(member: Member) -> bool:
    """Whether a number that it has learnt is not finite."""
    return not all(bool(torch.isfinite(v).all()) for v in vars(member.state).values())
