"""``record_calls``: skills act in an environment, and every call is written down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.interrupts import deferred, requested
from skillweave._internal.messages import short
from skillweave._internal.policy_protocol import is_policy
from skillweave._internal.seeding import Seeds, global_generators
from skillweave.calls.log import CallLog
from skillweave.calls.recorder import Recorder, TraceFeed, calls_in, check_size, goals_in
from skillweave.envs.engine import Engine, GymnasiumEngine, episode_seed
from skillweave.envs.make import EnvSpec, make_engine
from skillweave.errors import DeclarationError, Interrupted
from skillweave.experience.play import EngineEpisodes, PlayedStep, play
from skillweave.extensions import fetch
from skillweave.policies.core import (
    Around,
    Array,
    CallEnd,
    Memory as InPlaceMemory,
    RowPolicy,
    Turn,
)
from skillweave.policies.parts import GOAL
from skillweave.schema import AtLeastOne, fitted
from skillweave.skills import ReadySelector, ready_selector
from skillweave.skills.goal_spaces import blank_choices
from skillweave.skills.skill_set import SkillSet, acting_policy, in_place, skills_below
from skillweave.spaces import same_space


class RandomChoice(RowPolicy):
    """A selector for ``record_calls`` that chooses uniformly among what may start.

    Args:
        choices: the number of choices.
    """

    def __init__(self, choices: int) -> None:
        self.choices = choices

    def act(self, memory: InPlaceMemory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return choices (k,)."""
        assert turn.world.rng is not None
        score = turn.world.rng.random((len(obs), self.choices))
        best = score if turn.mask is None else np.where(turn.mask, score, -1.0)
        return np.asarray(best.argmax(1))


class RecordingSelector(RowPolicy):
    """A selector for ``record_calls`` that learns from the calls so far."""

    every: int
    """The steps after which it learns again."""

    def begin(self, choices: int) -> None:
        """Prepare for a recording; ``choices``: of a selector, skills times lengths."""
        raise NotImplementedError

    def learn(self, log: CallLog) -> None:
        """Learn from the calls so far."""
        raise NotImplementedError

    def decide(
        self, obs: Array, mask: Array | None, rng: np.random.Generator
    ) -> tuple[Array, dict[str, tuple[Array, Array]]]:
        """Return choices (n,), and goals of logged calls that are made again.

        Args:
            mask: (n, choices) bool, what may start; None: all.

        Returns:
            Choices, and by skill with goals the rows (k,) with the numbers of their goals (k, G).
            All other calls are new, and need new goals.
        """
        raise NotImplementedError

    def act(self, memory: InPlaceMemory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return choices (k,)."""
        assert turn.world.rng is not None
        return self.decide(obs, turn.mask, turn.world.rng)[0]


@checked_names
def record_calls(
    env: Any,
    skills: Any,
    steps: int,
    *,
    choose: Any = "random",
    num_envs: int = 16,
    seed: int = 0,
    info: Sequence[str] = (),
) -> CallLog:
    """Let skills act in an environment, and return the log of their calls.

    Once the steps are spent no call starts, and those that run are completed, as a log without its
    longest calls would be wrong. So the log has a few steps more.

    Args:
        env: an ``EnvSpec``, a Gymnasium id, or a function that makes an environment.
        skills: a ``HierarchyPolicy`` (``run.policy``), or its ``skills``.
        steps: environment steps to record.
        choose: "random" (uniformly among the skills that may start); "explore" (``Explorer()``); or
            a selector: any policy over the skills, a ready selector, or an ``Explorer``.
        num_envs: environments side by side.
        seed: of the environments and of all that is sampled.
        info: keys of the environment's ``info`` to record, so that tasks may read them.

    Raises:
        DeclarationError: an argument is wrong, or the log would have more than 4 GiB.
        EnvError: the environment cannot be made, or sets no such key of ``info``.
        SkillError: no skill may start in an observation.
    """
    return with_returns(env, skills, steps, choose, num_envs, seed, info, own_rewards=False)[0]


def with_returns(
    env: Any,
    skills: Any,
    steps: int,
    choose: Any,
    num_envs: int,
    seed: int,
    info: Sequence[str] = (),
    *,
    own_rewards: bool = True,
    keep: Callable[[CallLog], None] | None = None,
) -> tuple[CallLog, Array]:
    """Return the log of ``record_calls``, and ``own_return`` of the recorder's rows, (C,).

    Args:
        own_rewards: compute them; else there are none, (0,).
        keep: saves the log, also one that Ctrl-C has stopped.

    Raises:
        Interrupted: Ctrl-C has stopped the recording; the message says what was kept.
    """
    steps, num_envs = fitted(AtLeastOne, steps, "steps"), fitted(AtLeastOne, num_envs, "num_envs")
    skill_set = skills if isinstance(skills, SkillSet) else skills_below(skills)
    if skill_set is None:
        raise DeclarationError(
            f"record_calls(): {short(skills)} has no skills; give a run's policy, run.policy"
        )
    fitted(Sequence[str], info, "info")
    if isinstance(choose, str):
        if choose == "random":
            choose = RandomChoice(skill_set.choices)
        elif choose == "explore":
            choose = fetch("explore")()
    skill_set = replace(skill_set, interruption=None)  # it belongs to a selector that is left out
    spec = env if isinstance(env, EnvSpec) else EnvSpec(env)
    seeds = Seeds(seed) / "calls"
    with global_generators(seeds), closing(make_engine(spec, num_envs)) as engine:
        selector = _selector(choose, skill_set, engine)
        spaces = engine.observation_space, engine.action_space
        check_size(steps, spaces)
        recorder = Recorder(
            skill_set, spaces, num_envs, info=info, own_rewards=own_rewards, spec=spec
        )
        policy = acting_policy(skill_set, selector)
        rng = (seeds / "choices").numpy()
        episodes = RecordedEpisodes(engine, steps, seeds.integer())
        # Without `keep` an interrupt may be one of the training around.
        until, stops = (nullcontext(), bool) if keep is None else (deferred("now"), requested)
        stopped = False
        try:
            with until:
                _record(recorder, episodes, policy, choose, rng, stops)
        except KeyboardInterrupt:
            if keep is None:
                raise
            stopped = True
        log = recorder.log()
        log = replace(log, seed=np.array(episodes.seeds)[log.episode])
        if keep is not None and len(log):
            keep(log)
        if stopped:
            raise Interrupted(
                f"stopped: {len(log):,} calls ({log.steps:,} steps) were recorded and are kept"
            )
        return log, recorder.rows()["own_return"] if own_rewards else np.zeros(0)


class WithDrawnGoals(Around):
    """A selector of skills alone, with goals that are drawn as for practice.

    One that learns while it records also repeats goals of logged calls.

    Args:
        selector: chooses skills.
        skills: of which some have goals.
        space: of choices with goals.
    """

    def __init__(self, selector: Any, skills: SkillSet, space: gym.Space[Any]) -> None:
        super().__init__(in_place(selector, "the selector's act()"))
        self._selector = selector
        self._skills = skills
        self._space = space
        self._goals = goals_in(skills)

    def act(self, memory: InPlaceMemory, rows: Array, obs: Array, turn: Turn) -> Array:
        """Return choices (k,) with goals."""
        rng = turn.world.rng
        again = dict[str, tuple[Array, Array]]()
        assert rng is not None
        if isinstance(self._selector, RecordingSelector):
            number, again = self._selector.decide(obs, turn.mask, rng)
        else:
            number = super().act(memory, rows, obs, turn)
        choice = blank_choices(self._space, number)
        skill = self._skills.skill_of(number)
        for i, (name, goals) in self._goals.items():
            mine = np.flatnonzero(skill == i)
            if len(mine):
                choice[GOAL][name][mine] = goals.draw(obs[mine], rng)
            if name in again:
                at, numbers = again[name]
                choice[GOAL][name][at] = goals.space.of_numbers(numbers)
        return choice


def _selector(choose: Any, skills: SkillSet, engine: Engine) -> Any:
    """Return the acting selector that ``choose`` means, for the skills in an engine."""
    names = tuple(s.name for s in skills.skills)
    choices = skills.choice_space
    if isinstance(choose, RecordingSelector):
        choose.begin(skills.choices)
    if isinstance(choose, RowPolicy):
        return WithDrawnGoals(choose, skills, choices) if goals_in(skills) else choose
    if isinstance(choose, ReadySelector) or not is_policy(choose):
        if (ready := ready_selector(choose, names)) is not None:
            return ready.bind(engine.observation_space, choices, "selector")
    else:
        space = getattr(choose, "action_space", choices)
        if not same_space(space, choices):
            raise DeclarationError(
                f"choose is a policy with the actions {space}, but it has to choose among "
                f"{len(names)} skills ({', '.join(names)}): give a policy over the skills, "
                "run.policy.selector for example"
            )
        return choose
    raise DeclarationError(
        f"choose is {short(choose)}; it must be 'random', 'explore', an Explorer, a function of "
        "observations that returns names of skills, another ready selector, or a policy over the "
        "skills"
    )


class RecordedEpisodes(EngineEpisodes):
    """Episodes until enough steps are made, and then until the open calls are over.

    Args:
        steps: enough of them.
        seed: of all episodes.
    """

    def __init__(self, engine: Engine, steps: int, seed: int) -> None:
        super().__init__(engine)
        self.seeds: list[int] = []
        """Those of episodes as they start; −1: unknown, of EnvPool."""
        self.steps = steps
        self._made = 0
        self._seed = seed
        self._started = np.zeros(self.num_envs, np.int64)  # episodes of each environment
        self.obs = np.array(self._begin(self.rows))

    def advance(self, played: PlayedStep) -> Array:
        """Start episodes where others are over; return these environments (m,)."""
        self._made += len(played.rows)
        over = played.rows[played.over]
        if len(over):
            self.obs[over] = self._begin(over)
            self.elapsed[over] = 0
        if self._made >= self.steps:
            self.rows = self.rows[played.memory["end"][self.rows] == CallEnd.RUNNING]
        return over

    def _begin(self, rows: Array) -> Array:
        """Begin episodes in environments ``rows``; return observations."""
        each = [episode_seed(self._seed, i, int(self._started[i])) for i in rows.tolist()]
        fresh = not self._started.any()
        self._started[rows] += 1
        if isinstance(self.engine, GymnasiumEngine):
            self.seeds += each
            return self.engine.reset_some(rows, each)
        self.seeds += [-1] * len(rows)
        return self.engine.reset(self._seed) if fresh else self.engine.reset_some(rows)


def _record(
    recorder: Recorder,
    episodes: RecordedEpisodes,
    policy: RowPolicy,
    choose: Any,
    rng: np.random.Generator,
    stops: Callable[[], bool],
) -> None:
    """Record the calls of a policy in episodes.

    Args:
        choose: its selector; one that learns meanwhile does so.
        rng: of all that is sampled.
        stops: returns whether to stop at once.
    """
    feed = TraceFeed([recorder])
    goals = goals_in(recorder.skills)
    greedy = not isinstance(choose, RandomChoice)
    made = learnt = 0
    try:
        for played in play(policy, episodes, deterministic=greedy, rng=rng):
            feed.add(played.rows, played.step, {"": calls_in(played.memory, goals, played.rows)})
            made += len(played.rows)
            learns = isinstance(choose, RecordingSelector) and made < episodes.steps
            if learns and made - learnt >= choose.every:
                learnt = made
                feed.flush()
                if recorder.calls:
                    choose.learn(recorder.log())
            if stops():
                break
    finally:
        feed.flush()
