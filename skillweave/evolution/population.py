"""A population: it trains side by side in stacks, is compared, and becomes its own next generation.

Between generations a member is a thing of its own; see ``stacks`` for how they learn together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skillweave.algorithms.base import Algorithm, state_to
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.algorithms.policy import AgentPolicy
from skillweave.buffers.replay import ReplayStore
from skillweave.collecting.acting import Acting
from skillweave.collecting.collector import Collector, joined_from, parted
from skillweave.collecting.group import Collectors
from skillweave.envs.joined import JoinedEngines
from skillweave.evolution.config import Evolution
from skillweave.evolution.mutation import mutate, random_config
from skillweave.evolution.selection import select
from skillweave.evolution.stacks import Member, Origin, copy, grouped, join, split
from skillweave.ops.device import resolve_device
from skillweave.seeding import Seeds
from skillweave.spaces import to_tensor
from skillweave.training.arena import returns_of
from skillweave.training.episodes import Episodes, Tick
from skillweave.training.learner import RolloutLearner, Stack
from skillweave.training.loop import Progress, train
from skillweave.training.replay_learner import ReplayLearner, store_of
from skillweave.training.scene import Scene
from skillweave.types import Array, prefixed, unprefixed

NEVER = 2**62
"""Steps between cuts: a generation is one piece."""
OnGenerationTick = Callable[[int, Tick], None]
"""Is told the steps of all members in this generation so far, and the tick."""


class Population:
    """Members, what they learn in, and how they evolve.

    Members of one stack stand side by side in ``members``.

    Args:
        scene: where they learn.
    """

    def __init__(
        self,
        members: list[Member],
        evolution: Evolution,
        scene: Scene,
        seeds: Seeds,
    ) -> None:
        self.members, self.evolution, self.seeds = members, evolution, seeds
        self.spaces, self.row_steps = spaces_of(scene), scene.row_steps
        self.next_number = len(members)
        each = members[0].config.num_envs
        self.replays = members[0].algorithm(self.spaces).store == "replay"
        self.places = [
            scene.collector(each, None, i * each, self.replays) for i in range(len(members))
        ]
        """Where they act: an heir goes on with its place's open episodes."""
        self.episodes = Episodes()
        self.rounds = 0
        """Of the loop in which all members learn from one store."""
        self.store: ReplayStore | None = None
        self._kept: dict[str, Tensor] = {}  # what its learner counts
        self._made: dict[AlgorithmConfig, Algorithm] = {}

    @classmethod
    def fresh(
        cls,
        config: AlgorithmConfig,
        evolution: Evolution,
        scene: Scene,
        seeds: Seeds,
    ) -> Population:
        """The first generation, each member with weights of its own."""
        members, spaces = [], spaces_of(scene)
        for i in range(evolution.population):
            own = config
            if evolution.start == "random":
                own = random_config(config, evolution.mutations, (seeds / "start" / i).numpy())
            member = Member(i, own, None)
            member.state = member.algorithm(spaces).init([seeds / "member" / i])
            members.append(member)
        ordered = [m for group in grouped(members, spaces) for m in group]
        return cls(ordered, evolution, scene, seeds)

    @property
    def steps(self) -> int:
        """Environment steps of all members and of their ancestors, each as often as it has heirs.

        What was really spent is counted by the stage.
        """
        return sum(m.steps for m in self.members)

    def train(
        self, until: int, schedule_steps: int, seeds: Seeds, on_tick: OnGenerationTick
    ) -> None:
        """Train every member until it has ``until`` steps."""
        for i, place in enumerate(self.places):
            place.start(self.seeds / "start" / i)
        groups = grouped(self.members, self.spaces)
        if self.replays:
            self._train_side_by_side(groups, until, schedule_steps, seeds, on_tick)
        else:
            self._train_one_by_one(groups, until, schedule_steps, seeds, on_tick)

    def _train_one_by_one(
        self,
        groups: list[list[Member]],
        until: int,
        schedule_steps: int,
        seeds: Seeds,
        on_tick: OnGenerationTick,
    ) -> None:
        """A stack's rollouts are its own, so stacks learn one after another.

        A recurrent member begins a generation without memory: another network made what there was.
        """
        first = spent = 0
        for i, group in enumerate(groups):
            stack = self._stack(group)
            start, count = sum(m.steps for m in group), len(group)
            places = self.places[first : first + count]
            joined = self._together(places, [stack])
            end = train(
                RolloutLearner(stack, seeds / i), Collectors([joined], count), self.episodes,
                seeds / i, until * count, resume_from=Progress(steps=start), cut_every=NEVER,
                schedule_steps=schedule_steps * count, skip_diverged=True,
                on_tick=_telling(on_tick, spent - start),
            )  # fmt: skip
            parted(joined, places)
            self._unstack(stack, group)
            spent, first = spent + end.steps - start, first + count
            _count(group, end.steps - start)

    def _train_side_by_side(
        self,
        groups: list[list[Member]],
        until: int,
        schedule_steps: int,
        seeds: Seeds,
        on_tick: OnGenerationTick,
    ) -> None:
        """All stacks act at once and learn from one store."""
        stacks = [self._stack(group) for group in groups]
        start, count = self.steps, len(self.members)
        self.store = self.store or self._make_store()
        learner = ReplayLearner(
            stacks, self.store, seeds, row_steps=self.row_steps, goes_on_at=start
        )
        if self._kept:
            learner.load(self._kept)
        joined = self._together(self.places, stacks)
        end = train(
            learner, Collectors([joined], count), self.episodes, seeds, until * count,
            resume_from=Progress(self.rounds, start), schedule_steps=schedule_steps * count,
            skip_diverged=True, cut_every=NEVER, on_tick=_telling(on_tick, -start),
        )  # fmt: skip
        parted(joined, self.places)
        for stack, group in zip(stacks, groups, strict=True):
            self._unstack(stack, group)
        self._kept = learner.counts()
        self.rounds = end.update
        _count(self.members, end.steps - start)

    def _stack(self, group: list[Member]) -> Stack:
        """Members as one stack, on the device that they learn on."""
        algorithm, state = join(group, self.spaces, self._made)
        return Stack(algorithm, state_to(state, resolve_device(algorithm.config.device)))

    def _unstack(self, stack: Stack, group: list[Member]) -> None:
        """Give each member its part of what a stack has learnt."""
        split(stack.algorithm, state_to(stack.state, "cpu"), group, self.spaces)

    def _together(self, places: Sequence[Collector], stacks: Sequence[Stack]) -> Collector:
        """The places as one collector, in which the stacks act."""
        engine: Any = JoinedEngines([place.engine for place in places])
        acting = Acting([(s.algorithm, s.members) for s in stacks], engine.num_envs)
        return joined_from(places, engine, acting)

    def _make_store(self) -> ReplayStore:
        algorithm = self.members[0].algorithm(self.spaces)
        count = len(self.members)
        return store_of(algorithm, count * self.places[0].num_envs, count, shared=True)

    def cut(self, seeds: Seeds) -> dict[str, Tensor]:
        """Make a clean cut; what resuming from it needs of the environments."""
        self._begun_anew([place.cut(seeds / i) for i, place in enumerate(self.places)])
        found = prefixed("episodes", self.episodes.state())
        for i, place in enumerate(self.places):
            found |= prefixed(str(i), place.state())
        return {k: to_tensor(np.array(v)) for k, v in found.items()} | prefixed("kept", self._kept)

    def resume(self, saved: dict[str, Tensor], store: dict[str, Tensor]) -> Array:
        """Stand where a cut was; (k,) environments that begin anew."""
        self._kept = unprefixed("kept", saved)
        arrays = {k: v.numpy() for k, v in saved.items()}
        self.episodes.load(unprefixed("episodes", arrays))
        if store:
            self.store = self._make_store()
            self.store.load(store)
        return self._begun_anew([
            place.restore(unprefixed(str(i), arrays)) for i, place in enumerate(self.places)
        ])  # fmt: skip

    def _begun_anew(self, ids: Sequence[Array]) -> Array:
        """Environments of each place, as columns; their open trajectories end here."""
        columns = np.concatenate([own + i * self.places[0].num_envs for i, own in enumerate(ids)])
        if self.store is not None:
            self.store.cut(columns)
        if "returns" in self._kept:
            self._kept["returns"][columns] = 0.0
        return columns

    def close(self) -> None:
        """Release the environments."""
        for place in self.places:
            place.close()

    def fitness(self, arena: Collector, seeds: Seeds) -> Array:
        """Mean return of each member's episodes, from the same starts; −inf if it has diverged."""
        return np.array([
            -np.inf if has_diverged(m) else score(self.policy(m), arena, seeds)
            for m in self.members
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
        if self.store is not None:
            self.store.inherit(np.array([places[m.number] for m in self.members]))


def spaces_of(scene: Scene) -> tuple[Any, Any]:
    """What algorithms are made for: (observation space, action space)."""
    return scene.observation_space, scene.action_space


def _telling(on_tick: OnGenerationTick, before: int) -> Callable[[Tick], None]:
    """Tells the ticks of one loop in terms of the generation, ``before`` steps later."""
    return lambda tick: on_tick(before + tick.steps, tick)


def _count(members: list[Member], steps: int) -> None:
    """Give each of the members its part of the steps that they took together."""
    for i, member in enumerate(members):
        member.steps += (steps + i) // len(members)


def score(policy: AgentPolicy, arena: Collector, seeds: Seeds) -> float:
    """Mean return of an episode in each environment; −inf if it is not finite."""
    returns = returns_of(policy, arena, seeds)
    return float(returns.mean()) if np.isfinite(returns).all() else -np.inf


def has_diverged(member: Member) -> bool:
    """Whether a number that it has learnt is not finite."""
    return not all(bool(torch.isfinite(v).all()) for v in vars(member.state).values())
