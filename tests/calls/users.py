"""All that let skills act: each plays a case and returns what happened, for the comparison."""

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

import numpy as np
import pytest
from calls.cases import Case, LevelCase, Worth, guide_of, policy_of, ready, selector_of, skill_set
from reference_calls import seeds_of
from toys import alone_in, calling_in

from skillweave._internal.seeding import Seeds
from skillweave.api.player import Player as Deployed
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.experience.acting import Acted, Request
from skillweave.experience.collector import Collector
from skillweave.experience.levels import UntrainedHierarchy
from skillweave.export import compile
from skillweave.export.runner import Runner
from skillweave.export.write import write_export
from skillweave.hierarchy.options import OptionsEnv
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.policies import leaves
from skillweave.policies.core import Memory, Policy, Turn, World, flat, restart, take
from skillweave.policies.hierarchy import ActiveGuide
from skillweave.policies.spaces import space_of
from skillweave.skills import Skill
from skillweave.skills.skill_set import acting_policy
from skillweave.training.play import SeededEpisodes, play
from skillweave.types import Array, Step

N, SEED = 3, 5
GAMMA = 0.5  # so that sums are exact


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
    missing: str = "never"
    """A pattern of the names in memories that it does not have."""
    restarts: bool = True
    """What it remembers after an episode's last step is that of the next episode."""
    chooses: bool = True
    """The case's selector chooses; else the user does, and the reference follows it."""


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


def engine_of(case: Case, n: int = N) -> Any:
    return make_engine(EnvSpec(case.env, engine="sync"), n)


# Policies ---------------------------------------------------------------------------------------


def policies_of(level: LevelCase) -> tuple[Any, ...]:
    return tuple(
        hierarchy(s.policy) if isinstance(s.policy, LevelCase) else policy_of(s.policy)
        for s in level.skills
    )


def hierarchy(level: LevelCase) -> HierarchyPolicy:
    return HierarchyPolicy(
        selector_of(level), skill_set(level, policies_of(level)), guide_of(level)
    )


class Learner:
    """A ``Net`` where ``Acting`` stands: acts as it would under the case's settings."""

    members = 1

    def __init__(self, net: Any, greedy: bool = True) -> None:
        self.net, self.memory_size, self.greedy = net, net.size, greedy
        self.each, self.stacks = N, ((net, 1),)

    def begin(self, request: Request, every_step: bool = True) -> None:
        pass

    def to_env(self, action: Array) -> Array:
        return action

    def widened(self, mask: Array | None) -> Array | None:
        return mask

    def some(self, rows: Array, obs: Array, mask: Array | None, memory: Array | None) -> Acted:
        before = {} if memory is None else {"rnn": memory}
        action, after = self.net.act(before, obs, mask, deterministic=self.greedy)
        return Acted(action, action[:, None].astype(np.float32), after.get("rnn"))


class Critic(Learner):
    """A ``Worth`` where ``Acting`` stands."""

    memory_size = 0

    def __init__(self, skills: int) -> None:
        self.worth, self.each = Worth(skills), N

    def some(self, rows: Array, obs: Array, mask: Any, memory: Any) -> Acted:
        return Acted(np.zeros(len(obs), np.int64), self.worth.heads(obs), None)


# Collectors -------------------------------------------------------------------------------------


def decisions(case: Case) -> Played:
    """A selector that learns, above skills that can act."""
    guide, selector = _first(case)
    skills = skill_set(case.level, policies_of(case.level))
    return collected(
        case, lambda: calling_in(engine_of(case), selector, skills, True, guide), "", {}
    )  # fmt: skip


def joint(case: Case) -> Played:
    """A selector and all skills that can learn; hierarchies below are trained, too."""
    learners: dict[str, Any] = {}
    margins: dict[str, float] = {}

    def skills_of(level: LevelCase, path: str) -> Any:
        policies: list[Any] = []
        for i, skill in enumerate(level.skills):
            name = f"{path}s{i}"
            if isinstance(skill.policy, LevelCase):
                below = skill.policy
                greedy = level.greedy and below.greedy_selector
                if not below.ready:
                    learners[f"{name}/selector"] = Learner(selector_of(below), greedy)
                chooser = selector_of(below) if below.ready else None
                inner = skills_of(below, f"{name}/")
                policies.append(UntrainedHierarchy(inner, chooser, guide_of(below)))
            elif skill.policy in ("net", "counts"):
                learners[name] = Learner(policy_of(skill.policy), level.greedy)
                policies.append(None)
            else:
                policies.append(policy_of(skill.policy))
        if level.margin is not None:
            learners[f"{path}skill_critic"] = Critic(len(level.skills))
            margins[f"{path}skill_critic"] = level.margin
        return skill_set(level, tuple(policies))

    guide, selector = _first(case)
    skills = skills_of(case.level, "")

    def make() -> Collector:
        how = {"guide": guide, "learners": learners, "margins": margins}
        return calling_in(engine_of(case), selector, skills, **how)

    return collected(case, make, "selector", learners)


def _first(case: Case) -> tuple[ActiveGuide | None, Learner | None]:
    """The first guide and selector of a collector; a ready selector is a guide that decides."""
    level = case.level
    if level.ready:
        return ActiveGuide(ready(level, level.selector), decides=True), None
    greedy = case.deterministic and level.greedy_selector
    return guide_of(level), Learner(selector_of(level), greedy)


def _rounds(
    case: Any, watch: Watch, make: Callable[[], Any], memory_of: Callable[[Any], Memory],
    learners: dict[str, Any],
) -> Iterator[Any]:  # fmt: skip
    """What a collector returns, request by request; perhaps another one goes on half way."""
    collector, count = make(), case.steps // case.rows
    collector.start(Seeds(SEED))
    for i in range(count):
        if case.resumed and i == count // 2:
            state, collector = collector.state(), make()
            assert not len(collector.restore(state)), "an environment did not repeat itself"
        if i == 0 or (case.resumed and i == count // 2):
            watch.on(collector.engine, partial(memory_of, collector))
        request = Request(
            case.rows, (), np.array([GAMMA]), Seeds(0) / i, greedy=case.deterministic
        )  # fmt: skip
        found = collector.collect(replace(request, below=dict.fromkeys(learners, request)))
        assert found.steps == case.rows * N, "an environment waited"
        watch.observed(np.arange(N), memory_of(collector))
        yield found


def collected(
    case: Any, make: Callable[[], Any], path: str | None, learners: dict[str, Any]
) -> Played:  # fmt: skip
    """What a collector does that ``make`` returns.

    Args:
        path: of its first selector, whose decisions are kept; None: nobody's are.
    """

    def memory_of(collector: Any) -> Memory:
        overridden = getattr(collector, "overridden", None)
        more = {} if overridden is None else {"overridden": overridden}
        return collector.memory | more

    watch = Watch(seeds_of((Seeds(SEED) / "env").integer(), N))
    columns: list[list[dict[str, Any]]] | None = [[] for _ in range(N)]
    finished: list[tuple[float, float]] = []
    for found in _rounds(case, watch, make, memory_of, learners):
        batches = found.batches
        finished += map(tuple, found.episodes[:, [0, 2]].tolist())
        if path in batches and columns is not None:
            batch = batches[path]
            names = batch.keys() - {"valid", "recurrent_state"}
            for t, n in zip(*np.nonzero(batch.valid_rows), strict=True):
                row = {k: batch[k][t, n] for k in names}
                if t == 0 and "recurrent_state" in batch:
                    row["recurrent_state"] = batch["recurrent_state"][n]
                columns[n].append(row)
    ready = case.level.ready
    if ready or path is None:
        columns = None
    return Played(watch.episodes, columns, finished)


def leads_to_starts(case: Case) -> Played:
    """The skills as those that lead to where another one may start; they sample."""
    sampled = replace(case.level, greedy=False)
    never = type("Never", (Skill,), {"initiation": lambda self, obs: np.zeros(len(obs), bool)})
    skills = skill_set(case.level, policies_of(sampled))
    watch = Watch(seeds_of((Seeds(SEED) / "env").integer(), N))

    def make() -> Collector:
        return alone_in(engine_of(case), Anything(), never(), skills=skills)

    for _ in _rounds(case, watch, make, lambda collector: collector.search.memory, {}):
        pass
    return Played(watch.episodes, missing=r"^selector\.", chooses=False)


class Anything:
    """A learner whose turn never comes."""

    memory_size = 0

    def begin(self, request: Request) -> None:
        pass


# The player alone -------------------------------------------------------------------------------


def alone(case: Case) -> Played:
    level = case.level
    skills = skill_set(level, policies_of(level))
    return in_a_loop(case, acting_policy(skills, selector_of(level), guide_of(level)))


def in_a_loop(case: Any, policy: Policy) -> Played:
    """The player in a plain loop."""
    engine = engine_of(case)
    watch, rows = Watch(seeds_of(SEED, N)), np.arange(N)
    memory, age = policy.start(N), np.zeros(N, np.int64)
    overridden = np.zeros(N, bool)
    watch.on(engine, lambda: memory | {"overridden": overridden})
    obs = engine.reset(SEED)
    for _ in range(case.steps):
        overridden[:] = False
        world = World(age=age, overridden=overridden)
        turn = Turn(world, engine.mask(), greedy=case.deterministic)
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


# Policies in evaluation and deployment -----------------------------------------------------------


def evaluated(case: Case) -> Played:
    return in_evaluation(case, hierarchy(case.level), [11, 12, 13, 14, 15, 16, 17])


def in_evaluation(case: Any, policy: Any, seeds: list[int]) -> Played:
    """Whole episodes, in environments of which fewer and fewer act in the end."""
    watch = Watch([iter([seed]) for seed in seeds])  # each episode counts as an environment
    episodes = SeededEpisodes(engine_of(case), seeds, 1_000)
    chosen: list[Memory] = []

    def keep(memory: Memory) -> None:
        chosen.append(take(memory, episodes.rows))

    how: Any = {"deterministic": case.deterministic, "before_step": keep}
    for played in play(policy, episodes, **how):
        watch.step(played.episode, played.step.action, played.step, chosen[-1], True)
        watch.observed(played.episode, take(played.memory, played.rows), True)
    return Played(watch.episodes, restarts=False)


def deployed(case: Case) -> Played:
    """One observation at a time."""
    player = Deployed(hierarchy(case.level), deterministic=case.deterministic)
    return one_by_one(case, player, lambda: player.memory)


def one_by_one(
    case: Any, acts: Any, memory: Callable[[], Memory], seeds: Iterable[int] = range(21, 25)
) -> Played:  # fmt: skip
    """One observation at a time; ``acts``: of them."""
    found = Played()
    env = case.env()
    for seed in seeds:
        steps: list[Got] = []
        obs, info = env.reset(seed=seed)
        acts.reset()
        reward, over = 0.0, False
        while not over:
            action = acts.act(obs, reward=reward, info=info)
            remembered = {k: np.atleast_1d(v)[0].tolist() for k, v in flat(memory()).items()}
            obs, reward, terminated, truncated, info = env.step(action)
            steps.append(Got(plain(action), plain(obs), float(np.float32(reward)), remembered))
            over = terminated or truncated
        found.episodes.append((seed, steps))
    return found


# OptionsEnv -------------------------------------------------------------------------------------


def options_env(case: Case) -> Played:
    """The case's selector chooses the actions of an ordinary vector of environments."""
    skills = skill_set(case.level, policies_of(case.level))
    env = OptionsEnv(engine_of(case), skills, GAMMA)
    watch = Watch(seeds_of(SEED, N))
    watch.on(env.engine, lambda: env._memory)
    obs, info = env.reset(seed=SEED)
    selector = selector_of(case.level)
    greedy, memory = case.deterministic and case.level.greedy_selector, selector.start(N)
    columns: list[list[dict[str, Any]]] = [[] for _ in range(N)]
    for _ in range(case.steps // 3):
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
            columns[n].append({k: v[n] for k, v in rows.items()})
    return Played(watch.episodes, columns, missing=r"^selector\.")


# The exported runner ----------------------------------------------------------------------------


class Session:
    """Stands for an ONNX session; the file's content is the number of a policy."""

    known: list[tuple[Any, bool]] = []  # noqa: RUF012

    def __init__(self, content: bytes, who: str) -> None:
        self.policy, self.sampled = self.known[int(content)]

    def get_inputs(self) -> list[Any]:
        shapes = {"obs": ("float", self.policy.observation_space.shape[0])}
        if not isinstance(self.policy, Worth):
            shapes |= {"mask": ("bool", int(self.policy.action_space.n))}
            shapes |= {"memory": ("float", self.policy.size)} if self.policy.size else {}
        return [
            SimpleNamespace(name=name, type=f"tensor({kind})", shape=[1, n])
            for name, (kind, n) in shapes.items()
        ]

    def run(self, _: None, feeds: dict[str, Array]) -> list[Array]:
        if isinstance(self.policy, Worth):
            return [self.policy.heads(feeds["obs"])]
        memory = {"rnn": feeds["memory"]} if "memory" in feeds else {}
        action, after = self.policy.act(
            memory, feeds["obs"], feeds["mask"], deterministic=not self.sampled
        )  # fmt: skip
        return [action, *after.values()]

    @classmethod
    def graph(cls, policy: Any, sampled: Any, where: str = "") -> Any:
        cls.known.append((policy, sampled is True))
        file = b"%d" % (len(cls.known) - 1)
        if isinstance(policy, Worth):
            return file
        sees, acts = space_of(policy.observation_space), space_of(policy.action_space)
        return leaves.Network(file, sees, acts, int(policy.action_space.n), policy.size)


@contextmanager
def stand_ins(session: Any) -> Iterator[None]:
    """Let networks be written and opened by ``session``."""
    with (
        patch.object(compile, "agent_graph", session.graph),
        patch.object(compile, "worth_graph", session.graph),
        patch.object(leaves, "open_session", session),
    ):
        yield


def exported(case: Case) -> Played:
    """The runner; its networks are those of the case."""
    pytest.importorskip("onnxruntime")
    with tempfile.TemporaryDirectory() as folder, stand_ins(Session):
        export = write_export(Path(folder), hierarchy(case.level), "walk")
        runner = Runner(folder, export.functions)
        return one_by_one(case, runner, lambda: runner.memory)


def drawn_by_automata(level: LevelCase) -> bool:
    """An automaton would draw its choices if the skills of this level sampled."""
    return any(below.selector == "automaton" for below in level.below)


def can_be_exported(case: Case) -> bool:
    """Its policies are networks and functions, and its guides restrict."""
    levels = [*case.level.all]
    paid = any(s.policy == "paid" for level in levels for s in level.skills)
    restrict = all(level.guide is None or level.guide_restricts for level in levels)
    return case.deterministic and restrict and not paid


USERS: dict[str, tuple[Callable[[Case], Played], Callable[[Case], bool]]] = {
    "player": (alone, lambda case: True),
    "decisions": (decisions, lambda case: True),
    "joint": (joint, lambda case: True),
    "evaluation": (evaluated, lambda case: True),
    "deployment": (deployed, lambda case: True),
    "OptionsEnv": (options_env, lambda case: not case.level.ready and case.level.guide is None),
    "start states": (
        leads_to_starts,
        lambda case: case.level.guide is None and not drawn_by_automata(case.level),
    ),
    "exported": (exported, can_be_exported),
}
"""By name, what plays a case, and whether it can play this one."""
