"""All that let skills act: each plays a world and returns what happened, for the comparison."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
from calls.worlds import Chooser, Network, World, Worths, leaves, made
from reference_calls import seeds_of
from toys import alone_in, calling_in

import skillweave as sw
from skillweave._internal.seeding import Seeds
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acted, Request
from skillweave.experience.collector import Collector
from skillweave.experience.play import SeededEpisodes, play
from skillweave.export import compile
from skillweave.export.graphs import examples, mask_width
from skillweave.export.runner import Runner
from skillweave.export.write import Export, write_export
from skillweave.hierarchy.options_env import OptionsEnv
from skillweave.policies import leaves as policy_leaves
from skillweave.policies.core import Memory, Turn, World as Acting, flat, restart, take
from skillweave.policies.spaces import space_of
from skillweave.skills import Skill
from skillweave.spaces import ChoiceSpace, pack
from skillweave.types import Array, Step

N, SEED = 3, 5
GAMMA = 0.5  # so that sums are exact
SEEDS = range(21, 26)
"""Of episodes; users share them, so that the reference need not play as many."""


# What happened ----------------------------------------------------------------------------------


@dataclass
class Got:
    """One step, as a user made it; memories by name, of this environment."""

    action: Any
    next_obs: Any
    reward: float
    acted: dict[str, Any]
    observed: dict[str, Any] = field(default_factory=dict)
    overridden: bool | None = None
    """A reflex acted; None: this user does not report it."""


@dataclass
class Played:
    """What a user did."""

    episodes: list[tuple[int, list[Got]]] = field(default_factory=list)
    """Each with its seed; the last ones may be open."""
    columns: list[list[dict[str, Any]]] | None = None
    """Of each environment the decisions, as rows of experience; None: it gives none."""
    finished: list[tuple[float, float]] | None = None
    """Return and length of the episodes that are over; None: this user does not report them."""
    restarts: bool = True
    """What it remembers after an episode's last step is that of the next episode."""


def plain(x: Any) -> Any:
    """An observation or an action as numbers, lists and dicts."""
    names = x.keys() if isinstance(x, dict) else np.asarray(x).dtype.names
    return {k: plain(x[k]) for k in names} if names else np.asarray(x).tolist()


class Watch:
    """Writes down the steps of N environments.

    Args:
        seeds: of each environment, those of its episodes.
    """

    def __init__(self, seeds: list[Iterator[int]]) -> None:
        self.episodes: list[tuple[int, list[Got]]] = []
        self._seeds, self._latest = seeds, [Got(0, [], 0.0, {})] * len(seeds)
        self._over = np.ones(len(seeds), bool)
        self._open: list[list[Got]] = [[] for _ in seeds]

    def step(self, ids: Array, action: Array, raw: Any, memory: Memory, aligned: bool) -> None:
        """A step in environments ``ids``; ``aligned``: the memory's rows are of these alone."""
        for k, i in enumerate(ids.tolist()):
            if self._over[i]:
                self._open[i] = []
                self.episodes.append((next(self._seeds[i]), self._open[i]))
            row = k if aligned else i
            remembered = {name: v[row].tolist() for name, v in flat(memory).items()}
            overridden = remembered.pop("overridden", None)
            got = Got(
                plain(action[k]), plain(raw.next_obs[k]), float(raw.reward[k]), remembered,
                overridden=overridden,
            )  # fmt: skip
            self._open[i].append(got)
            self._latest[i] = got
            self._over[i] = raw.terminated[k] or raw.truncated[k]

    def observed(self, ids: Array, memory: Memory, aligned: bool = False) -> None:
        """What is remembered after the latest step of environments ``ids``."""
        for k, i in enumerate(ids.tolist()):
            row = k if aligned else i
            self._latest[i].observed = {n: v[row].tolist() for n, v in flat(memory).items()}

    def on(self, engine: Any, memory: Callable[[], Memory]) -> None:
        """Watch every step of an engine.

        Args:
            memory: that of all N environments; "overridden" in it is true where reflexes acted.
        """
        step = engine.step

        def watched(action: Array, ids: Array | None = None) -> Any:
            rows = np.arange(engine.num_envs) if ids is None else ids
            before = {k: v.copy() for k, v in flat(memory()).items()}
            raw = step(action, ids)
            self.step(rows, action, raw, before, False)
            return raw

        engine.step = watched


def engine_of(world: World) -> Any:
    return make_engine(EnvSpec(world.env, engine="sync"), N)


# Collectors -------------------------------------------------------------------------------------


class Learner:
    """A stand-in where ``Acting`` stands: acts as it would under the world's settings."""

    members = 1

    def __init__(self, net: Any, greedy: bool) -> None:
        self.net, self.memory_size, self.greedy = net, net.size, greedy
        self.each, self.stacks = N, ((net, 1),)

    def begin(self, request: Request, every_step: bool = True) -> None:
        pass

    def to_env(self, action: Array) -> Array:
        space = self.net.action_space
        return space_of(space).of_numbers(action) if isinstance(space, ChoiceSpace) else action

    def widened(self, mask: Array | None) -> Array | None:
        return mask

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Array | None) -> Acted:
        if isinstance(self.net, Worths):  # of a critic
            return Acted(np.zeros(len(obs), np.int64), self.net.heads(obs), None)
        before = {} if memory is None else {"rnn": memory}
        action, after = self.net.act(before, obs, mask, deterministic=self.greedy)
        if isinstance(space := self.net.action_space, ChoiceSpace):
            action = space.rows(action).astype(np.float32)
        first = np.zeros(len(obs)) if action.dtype.names else action.reshape(len(obs), -1)[:, 0]
        return Acted(action, first[:, None].astype(np.float32), after.get("rnn"))


def decisions(world: World) -> Played:
    """A selector that learns, above skills that can act."""
    return trained(world, together=False)


def joint(world: World) -> Played:
    """A selector and all skills that can learn; hierarchies below are trained, too."""
    return trained(world, together=True)


def trained(world: World, together: bool) -> Played:
    built, learners = made(world), dict[str, Any]()
    for path, stand in built.policies.items():
        if isinstance(stand, Network | Worths):
            learners[path] = Learner(stand, built.greedy(path))
    first = learners.pop("selector", None)
    how: dict[str, Any] = {"keep_rewards": not together, "guide": built.guide()}
    skills = built.learning() if together else built.hierarchy().skills
    if together:
        how |= {"learners": learners, "margins": built.margins()}

    def make() -> Collector:
        return calling_in(engine_of(world), first, skills, **how)

    watch = Watch(seeds_of((Seeds(SEED) / "env").integer(), N))
    columns: list[list[dict[str, Any]]] = [[] for _ in range(N)]
    finished: list[tuple[float, float]] = []
    for found in _rounds(world, watch, make, memory_of, learners if together else {}):
        finished += map(tuple, found.episodes[:, [0, 2]].tolist())
        if (batch := found.batches.get("selector" if together else "")) is None:
            continue
        names = batch.keys() - {"valid", "recurrent_state"}
        for t, n in zip(*np.nonzero(batch.valid_rows), strict=True):
            row = {k: batch[k][t, n] for k in names}
            if t == 0 and "recurrent_state" in batch:
                row["recurrent_state"] = batch["recurrent_state"][n]
            columns[n].append(row)
    return Played(watch.episodes, None if world.level.ready else columns, finished)


def memory_of(collector: Any) -> Memory:
    overridden = getattr(collector, "overridden", None)
    return collector.memory | ({} if overridden is None else {"overridden": overridden})


def _rounds(
    world: World, watch: Watch, make: Callable[[], Any], memory_of: Callable[[Any], Memory],
    learners: dict[str, Any],
) -> Iterator[Any]:  # fmt: skip
    """What a collector returns, request by request; perhaps another one goes on half way."""
    collector, count = make(), world.steps // world.rows
    collector.start(Seeds(SEED))
    for i in range(count):
        if world.resumed and i == count // 2:
            state, collector = collector.state(), make()
            assert not len(collector.restore(state)), "an environment did not repeat itself"
        if i == 0 or (world.resumed and i == count // 2):
            watch.on(collector.engine, partial(memory_of, collector))
        request = Request(
            world.rows, (), np.array([GAMMA]), Seeds(0) / i, greedy=world.deterministic
        )  # fmt: skip
        found = collector.collect(replace(request, below=dict.fromkeys(learners, request)))
        assert found.steps == world.rows * N, "an environment waited"
        watch.observed(np.arange(N), memory_of(collector))
        yield found


def leads_to_starts(world: World) -> Played:
    """The skills as those that lead to where another one may start; they sample."""
    never = type("Never", (Skill,), {"initiation": lambda self, obs: np.zeros(len(obs), bool)})
    skills = made(world).hierarchy().skills
    watch = Watch(seeds_of((Seeds(SEED) / "env").integer(), N))

    def make() -> Collector:
        return alone_in(engine_of(world), Anything(), never(), skills=skills)

    for _ in _rounds(world, watch, make, lambda collector: collector.search.memory, {}):
        pass
    return Played(watch.episodes)


class Anything:
    """A learner whose turn never comes."""

    memory_size = 0

    def begin(self, request: Request) -> None:
        pass


# Those that act ---------------------------------------------------------------------------------


def alone(world: World) -> Played:
    """The policy in a plain loop."""
    engine, policy = engine_of(world), made(world).hierarchy().in_place
    watch, rows = Watch(seeds_of(SEED, N)), np.arange(N)
    memory, age = policy.start(N), np.zeros(N, np.int64)
    overridden = np.zeros(N, bool)
    watch.on(engine, lambda: memory | {"overridden": overridden})
    obs = engine.reset(SEED)
    for _ in range(world.steps):
        overridden[:] = False
        acting = Acting(age=age, overridden=overridden)
        turn = Turn(acting, engine.mask(), greedy=world.deterministic)
        action = policy.act(memory, rows, obs, turn)
        raw = engine.step(action)
        age += 1
        step = Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            np.zeros(N, bool), age.copy(), raw.info,
        )  # fmt: skip
        policy.observe(memory, rows, step)
        watch.observed(rows, memory)
        obs, over = raw.next_obs.copy(), np.flatnonzero(raw.terminated | raw.truncated)
        if len(over):
            obs[over], age[over] = engine.reset_some(over), 0
            restart(policy, memory, over)
    return Played(watch.episodes, restarts=False)


def evaluated(world: World) -> Played:
    return in_evaluation(world, made(world).hierarchy(), [*SEEDS])


def in_evaluation(world: World, policy: Any, seeds: list[int]) -> Played:
    """Whole episodes, in environments of which fewer and fewer act in the end."""
    watch = Watch([iter([seed]) for seed in seeds])  # each episode counts as an environment
    episodes = SeededEpisodes(engine_of(world), seeds, 1_000)
    chosen: list[Memory] = []

    def keep(memory: Memory) -> None:
        chosen.append(take(memory, episodes.rows))

    how: Any = {"deterministic": world.deterministic, "before_step": keep}
    for played in play(policy, episodes, **how):
        watch.step(played.episode, played.step.action, played.step, chosen[-1], True)
        watch.observed(played.episode, take(played.memory, played.rows), True)
    return Played(watch.episodes, restarts=False)


def deployed(world: World) -> Played:
    player = sw.Player(made(world).hierarchy(), deterministic=world.deterministic)
    return one_by_one(world, player, SEEDS[:3])


def one_by_one(world: World, acts: Any, seeds: Iterable[int]) -> Played:
    """One observation at a time; ``acts``: of them."""
    found, env = Played(), world.env()
    for seed in seeds:
        steps: list[Got] = []
        obs, info = env.reset(seed=seed)
        acts.reset()
        reward, over = 0.0, False
        while not over:
            action = acts.act(obs, reward=reward, info=info)
            remembered = {k: np.atleast_1d(v)[0].tolist() for k, v in flat(acts.memory).items()}
            obs, reward, terminated, truncated, info = env.step(action)
            steps.append(Got(plain(action), plain(obs), float(np.float32(reward)), remembered))
            over = terminated or truncated
        found.episodes.append((seed, steps))
    return found


# OptionsEnv -------------------------------------------------------------------------------------


def options_env(world: World) -> Played:
    """The world's selector chooses the actions of an ordinary vector of environments."""
    built = made(world)
    env = OptionsEnv(engine_of(world), built.hierarchy().skills, GAMMA)
    watch = Watch(seeds_of(SEED, N))
    watch.on(env.engine, lambda: env._memory)
    obs, info = env.reset(seed=SEED)
    selector, greedy = built.policies["selector"], built.greedy("selector")
    memory = selector.start(N)
    columns: list[list[dict[str, Any]]] = [[] for _ in range(N)]
    for _ in range(world.steps // 3):
        mask = info.get("action_mask")
        choice, memory = selector.act(memory, obs, mask, deterministic=greedy)
        rows = {"obs": obs, "action": choice}
        rows |= {} if mask is None else {"mask": mask}
        assert mask is None or mask.dtype == np.bool_
        obs, reward, terminated, truncated, info = env.step(choice)
        watch.observed(np.arange(N), env._memory)
        rows |= {"reward": reward, "terminated": terminated, "truncated": truncated & ~terminated}
        rows |= {"next_obs": info["next_obs"], "steps": info["steps"]}
        rows |= {k: info[k] for k in ("discount", "call_return")}
        if mask is not None:
            rows["next_mask"] = info["next_action_mask"]
        over = terminated | truncated
        for k, v in selector.start(N).items():
            memory[k][over] = v[over]
        for n in range(N):
            columns[n].append({k: row_of(v, n) for k, v in rows.items()})
    return Played(watch.episodes, columns)


def row_of(x: Any, n: int) -> Any:
    """A row of an array, or of a dict of arrays."""
    return {k: row_of(v, n) for k, v in x.items()} if isinstance(x, dict) else x[n]


# Exports ----------------------------------------------------------------------------------------


class Session:
    """Stands for an ONNX session; the file's content is the number of a network."""

    known: list[tuple[Any, bool]] = []  # noqa: RUF012

    def __init__(self, content: bytes, who: str, trial: bool = False) -> None:
        self.net, self.sampled = self.known[int(content)]

    @classmethod
    def graph(cls, net: Any, sampled: Any, where: str = "") -> Any:
        cls.known.append((net, sampled is True))
        content = b"%d" % (len(cls.known) - 1)
        if isinstance(net, Worths):
            return content
        noise = (("gumbel", 1),) if sampled else ()
        spaces = map(space_of, (net.observation_space, net.action_space))
        width = mask_width(net.action_space)
        return policy_leaves.OnnxNetwork(content, *spaces, width, net.size, noise)

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
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(compile, "agent_graph", Session.graph),
        patch.object(compile, "worth_graph", Session.graph),
        patch.object(policy_leaves, "open_session", Session),
    ):
        yield folder, write_export(Path(folder), made(world).hierarchy(), "crane")


def exported(world: World) -> Played:
    with folder_of(world) as (folder, export):
        return one_by_one(world, Runner(folder, export.functions), SEEDS)


def read_again(world: World) -> Played:
    with folder_of(world) as (folder, export):
        policy = sw.load_policy(folder, code=export.functions)
        return in_evaluation(world, policy, [*SEEDS[:2]])


# All of them ------------------------------------------------------------------------------------


def anything(world: World) -> bool:
    return True


def can_be_chosen_for(world: World) -> bool:
    """Its first selector is trained, and nothing is beside it."""
    return not world.level.ready and world.level.guide is None


def can_search(world: World) -> bool:
    """No automaton would draw its choices where the skills of the first level sample."""
    return not any(below.selector == "automaton" for below in world.level.below)


def can_be_exported(world: World) -> bool:
    """It is greedy, and none of its policies remembers what it observes, which ONNX cannot."""
    skills = [skill for level in world.level.all for skill in level.skills]
    watching = any("watching" in (skill.policy, skill.corrects) for skill in skills)
    return world.deterministic and not watching


@dataclass(frozen=True)
class User:
    plays: Callable[[World], Played]
    can_play: Callable[[World], bool] = anything
    learns: str = "none"
    """Which selectors learn; see ``Course``."""
    missing: str = "never"
    """A pattern of the names in memories that it does not have."""
    chooses: bool = False
    """It chooses by itself, among skills that sample."""


USERS = {
    "player": User(alone),
    "decisions": User(decisions, learns="first"),
    "joint": User(joint, learns="all"),
    "evaluation": User(evaluated),
    "deployment": User(deployed),
    "OptionsEnv": User(options_env, can_be_chosen_for, "outside", r"^selector\."),
    "start states": User(leads_to_starts, can_search, chooses=True),
    "exported": User(exported, can_be_exported),
    "read again": User(read_again, can_be_exported),
}
"""By name, what plays a world."""
