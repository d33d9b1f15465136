"""Hierarchies of all that skills can declare are played as the reference does, to the bit."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from calls.plain_worlds import episode
from calls.reference import Moment
from calls.test_calls import compare_finished, compare_with
from calls.users import (
    Learner,
    Played,
    collected,
    engine_of,
    in_a_loop,
    in_evaluation,
    one_by_one,
    stand_ins,
)
from calls.worlds import (
    ACTIONS,
    GOALS,
    RESTS,
    SEES,
    SELECTORS,
    Chooser,
    Network,
    World,
    Worths,
    leaves,
    made,
    world,
)
from toys import calling_in

import skillweave as sw
from skillweave.api.player import Player
from skillweave.experience.acting import Acted
from skillweave.experience.collector import Collector
from skillweave.export.graphs import examples, mask_width
from skillweave.export.runner import Runner
from skillweave.export.write import Export, write_export
from skillweave.policies.core import CallEnd
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.leaves import Network as FileNetwork
from skillweave.policies.spaces import space_of
from skillweave.spaces import ChoiceSpace, pack
from skillweave.types import Array

# Those that learn -------------------------------------------------------------------------------


class Learns(Learner):
    """A stand-in where ``Acting`` stands."""

    def to_env(self, action: Array) -> Array:
        space = self.net.action_space
        return space.of_rows(action) if isinstance(space, ChoiceSpace) else action

    def widened(self, mask: Array | None) -> Array | None:
        return mask

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Array | None) -> Acted:
        nothing = np.zeros((len(obs), 1), np.float32)
        if isinstance(self.net, Worths):  # of a critic
            return Acted(nothing, self.net.heads(obs), None)
        before = {} if memory is None else {"rnn": memory}
        action, after = self.net.act(before, obs, mask, deterministic=self.greedy)
        if isinstance(space := self.net.action_space, ChoiceSpace):
            action = space.rows(action).astype(np.float32)
        return Acted(action, nothing, after.get("rnn"))


def decisions(world: World) -> Played:
    """A selector that learns, above skills that can act."""
    return trained(world, together=False)


def joint(world: World) -> Played:
    """A selector and all skills that can learn; hierarchies below are trained, too."""
    return trained(world, together=True)


def trained(world: World, together: bool) -> Played:
    built, level = made(world), world.level
    learners = {}
    for path, stand in built.policies.items():
        if isinstance(stand, Network | Worths):
            learners[path] = Learns(stand, built.greedy(path))
    first: Any = learners.pop("selector", None)
    guide = ActiveGuide(built.policies["selector"], decides=True) if level.ready else None
    how: dict[str, Any] = {"keep_rewards": not together, "guide": guide}
    skills = built.hierarchy().skills
    if together:
        skills = built.learning()
        how |= {"learners": learners, "margins": built.margins()}

    def make() -> Collector:
        return calling_in(engine_of(world), first, skills, **how)

    return collected(world, make, None, learners if together else {})


SEEDS = range(21, 26)
"""Of episodes; users share them, so that the reference need not play as many."""

# Those that act ---------------------------------------------------------------------------------


def alone(world: World) -> Played:
    return in_a_loop(world, made(world).hierarchy().in_place)


def evaluated(world: World) -> Played:
    return in_evaluation(world, made(world).hierarchy(), [*SEEDS])


def deployed(world: World) -> Played:
    player = Player(made(world).hierarchy())
    return one_by_one(world, player, lambda: player.memory, SEEDS[:3])


class Session:
    """Stands for an ONNX session; the file's content is the number of a network."""

    known: list[tuple[Any, bool]] = []  # noqa: RUF012

    def __init__(self, content: bytes, who: str) -> None:
        self.net, self.sampled = self.known[int(content)]

    @classmethod
    def graph(cls, net: Any, sampled: Any, where: str = "") -> Any:
        cls.known.append((net, sampled is True))
        content = b"%d" % (len(cls.known) - 1)
        if isinstance(net, Worths):
            return content
        noise = (("gumbel", 1),) if sampled else ()
        spaces = map(space_of, (net.observation_space, net.action_space))
        return FileNetwork(content, *spaces, mask_width(net.action_space), net.size, noise)

    def get_inputs(self) -> list[Any]:
        kinds = {"f": "float", "i": "int64"}
        net = self.net
        found = [
            SimpleNamespace(
                name=name, type=f"tensor({kinds[leaf.numpy().dtype.kind]})", shape=leaf.shape
            )
            for name, leaf in examples(net.observation_space).items()
        ]
        sizes = {}
        if isinstance(net, Network):
            sizes = {"memory": net.size, "noise.0": int(self.sampled)}
            if masked := mask_width(net.action_space):
                found.append(SimpleNamespace(name="mask", type="tensor(bool)", shape=[1, masked]))
        for name, size in sizes.items():
            if size:
                found.append(SimpleNamespace(name=name, type="tensor(float)", shape=[1, size]))
        return found

    def run(self, _: Any, feeds: dict[str, Array]) -> list[Array]:
        given = {k: v for k, v in feeds.items() if k.startswith("obs")}
        named = [pair for name, x in given.items() for pair in leaves(x, name)]
        if isinstance(self.net, Worths):
            return [self.net.named(named)]
        memory = {"rnn": feeds["memory"]} if "memory" in feeds else {}
        found, after = self.net.named(memory, named, feeds.get("mask"), not self.sampled)
        if isinstance(self.net, Chooser):
            number, goals = found
            parts = [x for name in goals for _, x in leaves(goals[name], "")]
            found = np.concatenate([number[:, None], *parts], axis=1) if goals else number
        elif isinstance(space := self.net.action_space, gym.spaces.Dict):
            found = space_of(space).flat(pack(space, found))
        return [found, *after.values()]


@contextmanager
def folder_of(world: World) -> Iterator[tuple[str, Export]]:
    """Its exported folder, whose networks are stand-ins."""
    pytest.importorskip("onnxruntime")
    with tempfile.TemporaryDirectory() as folder, stand_ins(Session):
        yield folder, write_export(Path(folder), made(world).hierarchy(), "crane")


def exported(world: World) -> Played:
    with folder_of(world) as (folder, export):
        runner = Runner(folder, export.functions)
        return one_by_one(world, runner, lambda: runner.memory, SEEDS)


def read_again(world: World) -> Played:
    with folder_of(world) as (folder, export):
        policy = sw.load_policy(folder, code=export.functions)
        return in_evaluation(world, policy, [*SEEDS[:2]])


def anything(world: World) -> bool:
    return True


def can_be_exported(world: World) -> bool:
    """ONNX has no policy that remembers what it observes."""
    skills = [skill for level in world.level.all for skill in level.skills]
    return not any("watching" in (skill.policy, skill.corrects) for skill in skills)


@dataclass(frozen=True)
class User:
    plays: Callable[[World], Played]
    can_play: Callable[[World], bool] = anything
    learns: str = "none"
    """Which selectors learn; see ``Course``."""
    missing: str = "never"
    """A pattern of the names in memories that it does not have."""


USERS = {
    "player": User(alone),
    "decisions": User(decisions, learns="first"),
    "joint": User(joint, learns="all"),
    "evaluation": User(evaluated),
    "deployment": User(deployed),
    "exported": User(exported, can_be_exported),
    "read again": User(read_again, can_be_exported),
}


@lru_cache(64)
def expected(number: int, seed: int, learns: str) -> list[Moment]:
    return episode(world(number), seed, learns)


def check(user: User, world: World) -> None:
    if not user.can_play(world):
        return
    played = user.plays(world)
    played.missing = user.missing
    wanted = {s: expected(world.seed, s, user.learns) for s, _ in played.episodes}
    found = compare_with(lambda seed, steps: wanted[seed], played)
    if played.finished is not None:
        compare_finished(played, found)


@pytest.mark.parametrize("user", USERS)
@pytest.mark.parametrize("seed", range(50))
def test_a_world_is_played_as_the_reference_does(seed: int, user: str) -> None:
    check(USERS[user], world(seed))


def test_the_worlds_show_all_that_can_be_declared() -> None:
    """In the reference, in the seeds of the fast test."""
    seen: Counter[str] = Counter()
    for seed in range(50):
        for moments in (episode(world(seed), start, "all", seen) for start in range(40, 48)):
            for name, value in (pair for m in moments for pair in m.observed.items()):
                if name.endswith("end"):
                    seen[f"{'first' if name == 'end' else 'below'} {CallEnd(value).name}"] += 1
            seen["an override"] += sum(moment.overridden for moment in moments)
    few = {name: count for name, count in seen.items() if count < 5}
    assert not few
    assert set(seen) == {
        *(f"{depth} {end.name}" for depth in ("first", "below") for end in CallEnd),
        *(f"{kind} actions" for kind in ACTIONS),
        *(f"acts of {kind}" for kind in ACTIONS),
        *(f"rests of {kind}: {rest}" for kind, rests in RESTS.items() for rest in rests),
        *(f"a goal of {kind}" for kind in GOALS),
        *(f"sees {name}" for name in SEES),
        *(f"a {policy} acts" for policy in ("network", "recurrent", "function", "watching")),
        *(f"a correction of a {policy}" for policy in ("function", "watching")),
        *(f"a {selector} selects" for selector in SELECTORS),
        "a critic that sees goals", "a fixed goal", "a goal that is clipped", "a hierarchy anew",
        "a hierarchy with a goal", "a length is chosen", "a mask", "a mask of a part",
        "a skill samples", "an override", "chosen again", "stuck",
        "it goes on after a choice that was no call", "the same again, at last",
        "three levels",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("first", range(50, 1_000, 25))
def test_many_more_worlds_are_played_as_the_reference_does(first: int) -> None:
    for seed in range(first, first + 25):
        for user in USERS.values():  # all of them while the reference's episodes are cached
            check(user, world(seed))
