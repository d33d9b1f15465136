"""HierarchyPolicy acts as OptionsEnv does, and remembers each environment for itself."""

from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from declaring import plainly
from reference_calls import (
    EPISODE,
    POSITION,
    TAG,
    Counter,
    Counting,
    Left,
    Right,
    Scalar,
    T,
    Walk,
    Zigzag,
    one_step,
    scripted,
    seeds_of,
    shy,
)

from skillweave.algorithms.config import PPO
from skillweave.algorithms.policy import AgentPolicy, make_algorithm
from skillweave.api import Hierarchy, Run
from skillweave.collecting.calls import SkillSet
from skillweave.collecting.ends import CallEnd
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.options import OptionsEnv
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.seeding import Seeds
from skillweave.skills import Reflex, Skill
from skillweave.skills.scripted import ScriptedPolicy
from skillweave.training.evaluation import evaluate
from skillweave.types import Array, Step

torch.set_num_threads(1)
N = 6


class Chooser(ScriptedPolicy):
    """A selector: its choice among the allowed skills follows from the observation."""

    def __init__(self, count: int) -> None:
        super().__init__(None, Walk.observation_space, gym.spaces.Discrete(count))

    def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
        wish = obs[:, TAG] + 3 * obs[:, EPISODE] + 5 * obs[:, T] + 7 * obs[:, POSITION]
        mask = np.ones((len(obs), self.action_space.n), bool) if mask is None else mask
        chosen = [
            np.flatnonzero(allowed)[int(w) % allowed.sum()]
            for w, allowed in zip(wish, mask, strict=True)
        ]
        return np.array(chosen), memory


def skill_set(*kinds, call_steps=4, **more) -> SkillSet:
    skills = tuple(k() if isinstance(k, type) else k for k in kinds)
    return SkillSet(skills, tuple(s.policy for s in skills), call_steps=call_steps, **more)


def hierarchy(*kinds, **more) -> HierarchyPolicy:
    return HierarchyPolicy(Chooser(len(kinds)), skill_set(*kinds, **more))


def network(space, count: int, seed: int = 0) -> AgentPolicy:
    algorithm = make_algorithm(
        PPO(num_envs=1, n_steps=1, batch_size=1), space, gym.spaces.Discrete(count)
    )
    state = algorithm.init([Seeds(seed)])
    with torch.no_grad():
        state.params[:] = 5 * state.params
    return AgentPolicy.of(algorithm, state)


def play(policy, engine, seed: int, steps: int, **how) -> list:
    """As ``evaluate`` does, every environment at every step; yields what happened."""
    n = engine.num_envs
    obs, memory, happened = engine.reset(seed), policy.start(n), []
    elapsed = np.zeros(n, np.int64)
    for _ in range(steps):
        decides = memory.get("end", np.zeros(n, bool)).astype(bool)
        action, memory = policy.act(memory, obs, **how)
        acting = policy.acting(memory)
        happened.append((obs.copy(), decides, None if acting is None else acting.copy(), action))
        raw = engine.step(action)
        elapsed += 1
        step = Step(
            obs, action, raw.next_obs, raw.reward, raw.terminated, raw.truncated,
            np.zeros(n, bool), elapsed.copy(), raw.info,
        )  # fmt: skip
        memory = policy.observe(memory, step)
        obs, ended = raw.next_obs.copy(), np.flatnonzero(raw.terminated | raw.truncated)
        if len(ended):
            obs[ended] = engine.reset_some(ended)
            elapsed[ended] = 0
            for k, v in policy.start(n).items():
                memory[k][ended] = v[ended]
    return happened


class Counter2(Counter):
    """Another skill with a memory of its own."""


class Keeper:
    """Makes environments, keeps them, and their actions."""

    def __init__(self, make=Walk) -> None:
        self.make, self.made = make, []
        self.__name__ = "keeper"

    def __call__(self):
        self.made.append(Logged(self.make()))
        return self.made[-1]

    def actions(self, n: int) -> list[list[int]]:
        return [e.actions for e in self.made[-n:]]


class Logged(gym.Wrapper):
    def __init__(self, env) -> None:
        super().__init__(env)
        self.actions: list[int] = []

    def step(self, action):
        self.actions.append(int(action))
        return self.env.step(action)


class Push(Skill):
    max_steps = 2
    policy = ScriptedPolicy(lambda obs: np.zeros(len(obs), np.int64), None, gym.spaces.Discrete(2))


class Balance(Skill):
    policy = ScriptedPolicy(
        lambda obs: (obs[:, 2] + obs[:, 3] > 0).astype(int), None, gym.spaces.Discrete(2)
    )

    def initiation(self, obs: Array) -> Array:
        return obs[:, 3] < 0.3

    def termination(self, step: Step) -> Array:
        return np.abs(step.next_obs[:, 1]) > 0.4


def short_cartpole() -> gym.Env:
    return gym.make("CartPole-v1", max_episode_steps=23)


CASES = {
    "scripts on a walk": (Walk, lambda: Chooser(4), (Left, Right, Zigzag, Counter), {}),
    "with a reflex": (Walk, lambda: Chooser(2), (Left, Counter), {"reflexes": (shy(),)}),
    "long calls": (Walk, lambda: Chooser(3), (Left, Right, Zigzag), {"call_steps": 40}),
    "no limit": (Walk, lambda: Chooser(2), (Left, Counter), {"call_steps": None}),
    "a network on CartPole": (
        short_cartpole,
        lambda: network(gym.make("CartPole-v1").observation_space, 2),
        (Push, Balance),
        {"call_steps": 5},
    ),
}


@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("case", CASES)
def test_it_decides_and_acts_as_options_env_does_with_the_same_selector(case):
    make, selector, kinds, more = CASES[case]
    skills, selector = skill_set(*kinds, **more), selector()
    if case.startswith("a network"):  # where both may start, the network chooses
        skills = skill_set(Balance, Push, Push, **more)
        selector = network(short_cartpole().observation_space, 3)
    keeper = Keeper(make)
    spec = EnvSpec(keeper, engine="sync")
    env = OptionsEnv(make_engine(spec, N), skills, 0.99)
    obs, info = env.reset(seed=3)
    decisions: list[list] = [[] for _ in range(N)]
    for _ in range(60):
        choice, _ = selector.act({}, obs, info.get("action_mask"))
        for i in range(N):
            decisions[i].append((obs[i].tolist(), int(choice[i])))
        obs, *_, info = env.step(choice)
    trained = keeper.actions(N)

    policy = HierarchyPolicy(selector, skills)
    happened = play(policy, make_engine(spec, N), 3, 200)
    acted = keeper.actions(N)
    for i in range(N):
        mine = [(o[i].tolist(), int(a[i])) for o, decides, a, _ in happened if decides[i]]
        length = min(len(mine), len(decisions[i]))
        assert length > 30
        assert mine[:length] == decisions[i][:length]
        length = min(len(acted[i]), len(trained[i]))
        assert length > 60
        assert acted[i][:length] == trained[i][:length]
    assert len({c for d in decisions for _, c in d}) > 1, "the selector always chose the same"


# A scalar hierarchy, for nesting ---------------------------------------------------------------


class One:
    """A hierarchy in one environment, in plain Python; ``parts`` are Ones or plain policies."""

    def __init__(self, chooser, skills, parts, call_steps) -> None:
        self.chooser, self.skills, self.parts = chooser, skills, parts
        self.call_steps = call_steps
        self.start()

    def start(self) -> None:
        self.running = self.last = None

    def act(self, obs: Array) -> int:
        if self.running is None:
            mask = np.array([[bool(s.initiation(obs[None])[0]) for s in self.skills]])
            self.running = int(self.chooser.act({}, obs[None], mask)[0][0])
            self.elapsed = 0
            part = self.parts[self.running]
            if self.running == self.last:
                pass  # the same skill goes on, and remembers
            elif isinstance(part, One):
                part.start()
            else:
                self.memory = part.start(1)
            self.last = self.running
        part = self.parts[self.running]
        if isinstance(part, One):
            return part.act(obs)
        action, self.memory = part.act(self.memory, obs[None])
        return int(action[0])

    def observe(self, transition) -> None:
        self.elapsed += 1
        skill, part = self.skills[self.running], self.parts[self.running]
        step = one_step(*transition[:6], self.elapsed, skill, transition[6])
        if isinstance(part, One):
            part.observe(transition)
        else:
            self.memory = part.observe(self.memory, step)
        over = bool(skill.termination(step)[0])
        over |= skill.max_steps is not None and self.elapsed >= skill.max_steps
        over |= self.call_steps is not None and self.elapsed >= self.call_steps
        if over:
            self.running = None


def play_one(one: One, seeds: Iterator[int], steps: int) -> list[tuple[int, int]]:
    env, happened = Walk(), []
    obs, _ = env.reset(seed=next(seeds))
    for _ in range(steps):
        action = one.act(obs)
        happened.append((one.running, action))
        next_obs, reward, terminated, truncated, info = env.step(action)
        one.observe((obs, action, next_obs, reward, terminated, truncated, info))
        obs = next_obs
        if terminated or truncated:
            obs, _ = env.reset(seed=next(seeds))
            one.start()
    return happened


def nested() -> tuple[HierarchyPolicy, One]:
    """Three levels: top of (middle, Left); middle of (bottom, Zigzag); bottom of three scripts."""
    bottom_kinds, declared = (
        (Counter, Right, Left),
        Hierarchy(Walk, [Left(), Right()], learn="apart"),
    )
    bottom = hierarchy(*bottom_kinds, call_steps=2)
    as_bottom = Run(declared, None, bottom).as_skill("bottom", max_steps=3)
    middle = hierarchy(as_bottom, Zigzag, call_steps=5)

    def near(self, step: Step) -> Array:
        return step.next_obs[:, POSITION] == 1

    as_middle = Run(declared, None, middle).as_skill("middle", termination=near)
    top = hierarchy(as_middle, Left, call_steps=7)
    kinds = [k() for k in bottom_kinds]
    one = One(Chooser(3), kinds, [k.policy for k in kinds], 2)
    one = One(Chooser(2), [as_bottom, Zigzag()], [one, Zigzag.policy], 5)
    return top, One(Chooser(2), [as_middle, Left()], [one, Left.policy], 7)


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize("seed", range(3))
def test_a_hierarchy_of_hierarchies_acts_as_scalar_ones_side_by_side_do(seed):
    top, one = nested()
    happened = play(top, make_engine(EnvSpec(Walk, engine="sync"), N), seed, 150)
    chosen = set()
    for i, at in enumerate(seeds_of(seed, N)):
        one.start()
        mine = [(int(acting[i]), int(action[i])) for _, _, acting, action in happened]
        assert mine == play_one(one, at, 150)
        chosen |= set(mine)
    assert chosen == {(0, 0), (0, 1), (0, 2), (1, 0)}


def test_a_hierarchy_as_a_skill_of_options_env_acts_as_the_scalar_one():
    inner = hierarchy(Counter, Right, Left, call_steps=2)
    skill = Run(Hierarchy(Walk, [Left()], learn="apart"), None, inner).as_skill(
        "inner", max_steps=5
    )
    keeper = Keeper()
    engine = make_engine(EnvSpec(keeper, engine="sync"), N)
    env = OptionsEnv(engine, skill_set(skill, Left, call_steps=9), 0.99)
    env.reset(seed=1)
    for t in range(40):
        env.step((np.arange(N) + t) % 2)
    kinds = [Counter(), Right(), Left()]
    for i, at in enumerate(seeds_of(1, N)):

        class Inner:
            """The scalar hierarchy in a policy's clothes."""

            def start(self, n):
                self.one = One(Chooser(3), kinds, [k.policy for k in kinds], 2)
                return {}

            def act(self, memory, obs, deterministic=True):
                return np.array([self.one.act(obs[0])]), memory

            def observe(self, memory, s: Step):
                self.one.observe(
                    (s.obs[0], s.action[0], s.next_obs[0], s.reward[0], bool(s.terminated[0]),
                     bool(s.truncated[0]), s.info)
                )  # fmt: skip
                return memory

        logged = Logged(Walk())
        scalar = Scalar(logged, (skill, Left()), 9, 0.99, (), (Inner(), Left.policy))
        scalar.reset(at)
        for t in range(40):
            scalar.call((i + t) % 2)
        assert keeper.made[i].actions == logged.actions


# A skill alone ---------------------------------------------------------------------------------


class Remote(Skill):
    """As Counter, where it may start hardly anywhere: alone it is asked nevertheless."""

    max_steps = 6
    policy = Counting()

    def initiation(self, obs: Array) -> Array:
        return obs[:, POSITION] == 99


def alone(skill: Skill, others: tuple, **more) -> Run:
    """A run of a hierarchy in which a selector never chooses ``skill``, which comes last."""
    declared = Hierarchy(Walk, [*others, skill], **plainly(more))
    skills = declared.skill_set([s.policy for s in declared.skills])
    return Run(declared, Path("nowhere"), HierarchyPolicy(Chooser(len(skills.skills)), skills))


def always(skill: Skill, **more) -> HierarchyPolicy:
    """A selector that has no choice."""
    declared = Hierarchy(Walk, [skill], **plainly(more))
    return HierarchyPolicy(Chooser(1), declared.skill_set([skill.policy]))


@pytest.mark.parametrize("kind", [Counter, Zigzag, "nested"])
def test_a_skill_alone_acts_as_under_a_selector_that_chooses_no_other(kind):
    on = Reflex(lambda obs: obs[:, POSITION] == 1, action=2)
    more = {"reflexes": [on], "call_steps": 3}
    inner = hierarchy(Counter, Right, Left, call_steps=2)
    skill = alone(Left(), ()).as_skill("inner") if kind == "nested" else kind()
    if kind == "nested":
        type(skill).policy = inner
    found = alone(skill, (Left(), Right()), **more).evaluate(20, skill=skill.name, num_envs=20)
    wanted = evaluate(always(skill, **more), EnvSpec(Walk), episodes=20, num_envs=20)
    assert (found.returns, found.lengths) == (wanted.returns, wanted.lengths)
    bare = evaluate(skill.policy, EnvSpec(Walk), episodes=20, num_envs=20)
    assert found.returns != bare.returns, "the reflex never acted"
    assert next(iter(found.skills)) == found.alone == skill.name


def test_a_skill_alone_does_not_ask_where_it_may_start():
    run = alone(Remote(), (Left(),))
    found = run.evaluate(3, skill="remote")
    assert found.returns == evaluate(Remote.policy, EnvSpec(Walk), episodes=3).returns


def test_a_film_of_a_skill_alone_shows_its_reflexes_too(tmp_path):
    pytest.importorskip("PIL")

    class Shown(Walk):
        def __init__(self, render_mode=None):
            super().__init__()
            self.render_mode = render_mode

        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, float(action), *rest

        def render(self):
            return np.zeros((8, 8, 3), np.uint8)

    anywhere = Reflex(lambda obs: np.ones(len(obs), bool), action=2)
    declared = Hierarchy(Shown, [Left(), Zigzag()], reflexes=[anywhere], learn="apart")
    policy = HierarchyPolicy(Chooser(2), declared.skill_set([Left.policy, Zigzag.policy]))
    told = Run(declared, tmp_path / "run", policy).render(
        tmp_path / "a.gif", episodes=3, skill="left"
    )
    assert [e["return"] for e in told["episodes"]] == [2.0 * e["length"] for e in told["episodes"]]
    assert [e["skills"] for e in told["episodes"]] == [
        {"left": e["length"]} for e in told["episodes"]
    ]


# Memory ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", ["flat", "nested"])
def test_alone_an_environment_is_acted_in_as_among_others(make):
    policy = nested()[0] if make == "nested" else hierarchy(Left, Right, Zigzag, Counter)
    rng = np.random.default_rng(0)
    together = policy.start(N)
    alone = [policy.start(1) for _ in range(N)]
    for t in range(80):
        obs = np.stack([np.arange(N) * 31, np.full(N, 2), rng.integers(9, size=N),
                        rng.integers(-3, 4, size=N)], 1).astype(np.float32)  # fmt: skip
        action, together = policy.act(together, obs)
        for i in range(N):
            mine, alone[i] = policy.act(alone[i], obs[i : i + 1])
            assert mine.tolist() == [action[i]]
        flags = np.zeros((2, N), bool)
        step = Step(
            obs, action, obs + 1, rng.normal(size=N).astype(np.float32), *flags,
            np.zeros(N, bool), np.full(N, t + 1), {},
        )  # fmt: skip
        together = policy.observe(together, step)
        for i in range(N):
            one = slice(i, i + 1)
            part = Step(
                obs[one], action[one], obs[one] + 1, step.reward[one], flags[0][one],
                flags[1][one], np.zeros(1, bool), np.full(1, t + 1), {},
            )  # fmt: skip
            alone[i] = policy.observe(alone[i], part)
            acting = policy.acting(alone[i])
            assert acting.tolist() == [policy.acting(together)[i]]
            where = together["end"][i]
            assert alone[i]["end"].tolist() == [where]
    assert together.keys() == alone[0].keys()


def test_memory_rows_may_be_gathered_and_scattered_in_any_order():
    policy, spec = nested()[0], EnvSpec(Walk, engine="sync")
    expected = [a for *_, a in play(policy, make_engine(spec, N), 0, 30)]

    class Shuffled:
        """The policy, asked about its environments in another order every time."""

        labels, rng = policy.labels, np.random.default_rng(0)
        start, acting = policy.start, policy.acting

        def act(self, memory, obs):
            order = self.rng.permutation(N)
            back = np.argsort(order)
            action, memory = policy.act({k: v[order] for k, v in memory.items()}, obs[order])
            return action[back], {k: v[back] for k, v in memory.items()}

        def observe(self, memory, step):
            return policy.observe(memory, step)

    got = [a for *_, a in play(Shuffled(), make_engine(spec, N), 0, 30)]
    np.testing.assert_array_equal(got, expected)


def test_neither_act_nor_observe_changes_the_memory_given():
    policy = nested()[0]
    obs = np.zeros((N, 4), np.float32)
    obs[:, TAG] = np.arange(N)
    memory = policy.start(N)
    for _ in range(6):
        before = {k: v.copy() for k, v in memory.items()}
        action, after = policy.act(memory, obs)
        assert all((memory[k] == before[k]).all() for k in memory)
        kept = {k: v.copy() for k, v in after.items()}
        never = np.zeros(N, bool)
        step = Step(obs, action, obs + 1, np.ones(N), never, never, never, np.ones(N), {})
        memory = policy.observe(after, step)
        assert all((after[k] == kept[k]).all() for k in after)


def walk_obs(*positions: int) -> Array:
    return np.array([[0, 0, 0, x] for x in positions], np.float32)


def transition(obs: Array, action: Array, next_obs: Array) -> Step:
    n, never = len(obs), np.zeros(len(obs), bool)
    return Step(obs, action, next_obs, np.ones(n, np.float32), never, never, never, np.ones(n), {})


def test_a_skill_that_terminates_is_followed_by_a_decision_and_only_there():
    class Selector(Counting):
        pass

    selector = Selector(2)
    policy = HierarchyPolicy(selector, skill_set(Right, Zigzag, call_steps=40))
    memory = policy.start(2)
    obs = walk_obs(1, -5)
    action, memory = policy.act(memory, obs)
    assert action.tolist() == [2, 2]
    assert policy.acting(memory).tolist() == [0, 0]
    memory = policy.observe(memory, transition(obs, action, walk_obs(2, -4)))
    assert memory["end"].tolist() == [CallEnd.OWN, CallEnd.RUNNING]
    _, memory = policy.act(memory, walk_obs(2, -4))
    assert policy.acting(memory).tolist() == [1, 0]
    assert memory["elapsed"].tolist() == [0, 1]
    assert memory["selector.acted"].tolist() == [2, 1], "the selector remembers its own decisions"


def test_a_call_lasts_as_many_steps_as_the_least_limit_says():
    for call_steps, lasts in ((1, 1), (2, 2), (3, 3), (9, 3), (None, 3)):
        policy = HierarchyPolicy(Chooser(1), skill_set(Left, call_steps=call_steps))
        memory, obs, decided = policy.start(1), walk_obs(0), []
        for _ in range(12):
            decided.append(bool(memory["end"][0]))
            action, memory = policy.act(memory, obs)
            memory = policy.observe(memory, transition(obs, action, obs))
        assert decided == [k % lasts == 0 for k in range(12)]


def test_call_steps_of_a_skill_count_instead_of_those_of_the_hierarchy():
    for own, lasts in ((2, 2), (5, 3), (None, 1)):
        skills = skill_set(Left, call_steps=1)
        skills.skills[0].call_steps = own
        policy = HierarchyPolicy(Chooser(1), skills)
        memory, obs, decided = policy.start(1), walk_obs(0), []
        for _ in range(12):
            decided.append(bool(memory["end"][0]))
            action, memory = policy.act(memory, obs)
            memory = policy.observe(memory, transition(obs, action, obs))
        assert decided == [k % lasts == 0 for k in range(12)], "Left itself stops after 3"


def test_a_skill_that_is_called_again_at_once_goes_on_with_its_memory():
    policy = HierarchyPolicy(Chooser(1), skill_set(Counter, call_steps=4))
    memory, obs, actions = policy.start(1), walk_obs(0), []
    for _ in range(8):
        action, memory = policy.act(memory, obs)
        actions.append(int(action[0]))
        memory = policy.observe(memory, transition(obs, action, obs))
    # Counting: the number of its actions, plus 1 as soon as it was paid; modulo 3
    assert actions == [0, 2, 0, 1, 2, 0, 1, 2]
    assert memory["elapsed"].tolist() == [4], "the call's own time starts anew"


def test_a_skill_that_is_called_after_another_one_starts_with_a_fresh_memory():
    by_turns = ScriptedPolicy(
        lambda obs: obs[:, POSITION].astype(int), Walk.observation_space, gym.spaces.Discrete(2)
    )
    policy = HierarchyPolicy(by_turns, skill_set(Counter, Counter2, call_steps=2))
    memory, actions = policy.start(2), []
    # two environments: the first calls 0 0 1 0, the second 0 1 1 1
    for first, second in ((0, 0), (0, 1), (1, 1), (0, 1)):
        obs = walk_obs(first, second)
        for _ in range(2):
            action, memory = policy.act(memory, obs)
            actions.append(action.tolist())
            memory = policy.observe(memory, transition(obs, action, obs))
    assert [a for a, _ in actions] == [0, 2, 0, 1, 0, 2, 0, 2]
    assert [a for _, a in actions] == [0, 2, 0, 2, 0, 1, 2, 0]


def test_the_selector_chooses_only_among_skills_that_may_start():
    selector = network(Walk.observation_space, 2)
    obs = walk_obs(*range(-6, 7))
    free, _ = selector.act({}, obs)
    wish = int(free[-1])
    kinds = (Left, Right) if wish == 1 else (Right, Left)
    policy = HierarchyPolicy(selector, skill_set(*kinds))
    _, memory = policy.act(policy.start(len(obs)), obs)
    chosen = policy.acting(memory)
    may = obs[:, POSITION] < 2
    assert (chosen[~may] == 1 - wish).all()
    assert chosen[may].tolist() == free[may].tolist()


def test_where_no_skill_may_start_the_error_names_them():
    policy = hierarchy(Right)
    with pytest.raises(SkillweaveError, match=r"no skill may start.*'right'"):
        policy.act(policy.start(2), walk_obs(0, 2))


def test_where_no_skill_may_start_a_large_observation_is_told_in_part():
    class Never(Skill):
        def initiation(self, obs):
            return np.zeros(len(obs), bool)

    with pytest.raises(SkillweaveError, match="no skill may start") as found:
        skill_set(Never).mask(np.zeros((1, 7, 7, 3), np.uint8))
    assert len(str(found.value)) < 400
    assert "\n" not in str(found.value)


def test_deterministic_is_about_the_selector_and_greedy_about_the_skills():
    asked = []

    class Asked(ScriptedPolicy):
        def __init__(self, who, count):
            self.who = who
            super().__init__(None, Walk.observation_space, gym.spaces.Discrete(count))

        def act(self, memory, obs, mask=None, *, deterministic=True, rng=None):
            asked.append((self.who, deterministic, None if rng is None else rng.integers(100)))
            return np.zeros(len(obs), np.int64), memory

    for deterministic in (True, False):
        for greedy in (True, False):
            skills = SkillSet((Left(),), (Asked("skill", 3),), call_steps=2, greedy=greedy)
            policy = HierarchyPolicy(Asked("selector", 1), skills)
            asked.clear()
            rng = np.random.default_rng(5)
            policy.act(policy.start(1), walk_obs(0), deterministic=deterministic, rng=rng)
            assert [a[:2] for a in asked] == [("selector", deterministic), ("skill", greedy)]
            assert all(a[2] is not None for a in asked)


def test_it_has_the_spaces_of_selector_and_skills_and_names_them():
    policy = hierarchy(Left, Zigzag)
    assert policy.observation_space == Walk.observation_space
    assert policy.action_space == gym.spaces.Discrete(3)
    assert policy.labels == ("left", "zigzag")
    assert scripted(0).labels == ()
