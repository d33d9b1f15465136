"""Evaluation: whole episodes in Gymnasium's own environments, each from its own seed.

A pool of environments is faster; all its episodes start from one seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace as replaced
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import short
from skillweave._internal.notebooks import joined, paragraph, table
from skillweave._internal.notices import notice
from skillweave._internal.policy_protocol import Policy
from skillweave._internal.seeding import Seeds, global_generators
from skillweave._internal.terminal import printable
from skillweave.calls.log import CallLog
from skillweave.envs.checked import longest_evaluation, time_limit
from skillweave.envs.engine import Engine, checksums
from skillweave.envs.env_infos import notice_odd_success, reported_success
from skillweave.envs.make import EngineName, EnvSpec, in_pool, make_engine
from skillweave.envs.pool import POOL_SEEDS
from skillweave.errors import DeclarationError, SkillweaveError
from skillweave.experience.play import PlayedStep, SeededEpisodes, play
from skillweave.policies.core import Array
from skillweave.policies.parts import OWN_GOAL
from skillweave.schema import UNSAVED, AtLeastOne, Count, fitted
from skillweave.skills import Skill
from skillweave.skills.foreign_policy import Foreign, check_spaces
from skillweave.skills.goals import goals_of
from skillweave.skills.ready import as_policy
from skillweave.skills.skill_set import skills_below
from skillweave.training.played_calls import PlayedCalls
from skillweave.training.skill_report import (
    TITLES,
    SkillReport,
    all_steps,
    call_line,
    cells_of,
    hints,
    reflex_lines,
    skill_reports,
    skill_rows,
    skill_table,
    weak_handovers,
)

FIRST_SEED = 1_000_000
"""Episode i of ``evaluate(seed=s)`` starts from Gymnasium seed ``FIRST_SEED·(s + 1) + i``."""
USUAL_ENVS = 16
"""Environments side by side in an evaluation where ``num_envs`` is not given."""
SEEMS_ENDLESS = 1_000
"""Steps of an episode without a known limit after which an evaluation says where it will be cut."""

ALIKE = "which are the same in every step: they count as one, without an interval"
"""Words on episodes that are all alike."""
NOT_LOGGED = "no calls were logged in this evaluation: evaluate(log_calls=True) logs them"
SCORE_ALONE = 'evaluate(skill="go_to") scores a skill alone'


@dataclass(frozen=True)
class Details:
    """Details of an evaluation beside its scores, which are not saved; None: it has none."""

    logs: dict[str, CallLog] | None = None
    """The calls of each level, by its path."""
    handovers: tuple[str, ...] = ()
    """Sentences on skills that seldom succeed after one other skill."""
    goals: Array | None = None
    """The goal of each episode, (episodes, …), where a skill acted alone."""
    reached: Array | None = None
    """The success of each episode's call, (episodes,) bool, where a skill acted alone."""


@dataclass(frozen=True)
class Evaluation:
    """Scores of whole episodes; ``str()`` is a line for people.

    Raises:
        DeclarationError: the numbers of returns and lengths differ, or there is no episode.
    """

    returns: tuple[float, ...]  # of each episode, in the environment's own reward
    lengths: tuple[AtLeastOne, ...]  # of each episode, in steps
    threshold: float | None  # the environment's reward_threshold
    skills: dict[str, SkillReport] = field(default_factory=dict)  # none: a plain agent
    cut: Count = 0  # episodes that were cut at the step limit without an end
    succeeded: Count | None = None
    """Episodes that succeeded by ``info["success"]`` (else ``info["is_success"]``) of their last
    step; None: without these keys."""
    succeeded_once: Count | None = None
    """Episodes that succeeded by these keys in some step; None: without these keys."""
    all_alike: bool = False
    """There are several episodes, and all are the same in every step: their number says nothing."""
    reflexes: dict[str, Count] = field(default_factory=dict)
    """Steps in which each reflex acted, by its path."""
    alone: str | None = None
    """The skill that acted alone, with one call in each episode; None: the whole policy acted."""
    details: Details = field(default=Details(), repr=False, compare=False, metadata=UNSAVED)
    """Logs, goals and hints, which ``calls``, ``goals`` and ``for_people`` tell."""

    def __post_init__(self) -> None:
        if not self.returns or len(self.returns) != len(self.lengths):
            raise DeclarationError(
                f"{len(self.returns)} returns and {len(self.lengths)} lengths; every episode has "
                "one of each, and there is at least one episode"
            )
        if self.alone is not None and self.alone not in self.skills:
            raise DeclarationError(f"no report of the skill that acted alone, {short(self.alone)}")

    @property
    def calls(self) -> CallLog:
        """The log of all calls, as of ``record_calls``; it is not saved.

        Raises:
            DeclarationError: no calls were logged.
        """
        return _known(self.details.logs, NOT_LOGGED)[""]

    @property
    def inner_calls(self) -> dict[str, CallLog]:
        """The logs of the calls within skills that are hierarchies, by the path of these.

        Raises:
            DeclarationError: no calls were logged.
        """
        return {path: log for path, log in _known(self.details.logs, NOT_LOGGED).items() if path}

    @property
    def goals(self) -> Array:
        """The goal of each episode, (episodes, …), of a skill that acted alone; it is not saved.

        Raises:
            DeclarationError: no skill with goals acted alone.
        """
        missing = "no skill with goals acted alone in this evaluation"
        return _known(self.details.goals, f"{missing}: {SCORE_ALONE}")

    @property
    def reached(self) -> Array:
        """The success of each episode's call, (episodes,) bool, of a skill that acted alone.

        It is not saved.

        Raises:
            DeclarationError: no skill that defines success acted alone.
        """
        missing = "no skill that defines success acted alone"
        return _known(self.details.reached, f"{missing}: {SCORE_ALONE}")

    def comparing(self, features: Any) -> Evaluation:
        """Return the evaluation with the ``features`` by which its logs compare calls."""
        logs = dict(self.details.logs or {})
        logs[""] = replaced(logs[""], features=features)
        return replaced(self, details=replaced(self.details, logs=logs))

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def skill_steps(self) -> dict[str, int]:
        """Steps of each skill."""
        return {name: report.steps for name, report in self.skills.items()}

    @property
    def skill_calls(self) -> dict[str, int]:
        """Calls of each skill."""
        return {name: report.calls for name, report in self.skills.items()}

    @property
    def solved_fraction(self) -> float | None:
        """Share of episodes at the environment's reward threshold or more; None: it has none."""
        if self.threshold is None:
            return None
        return float(np.mean(np.array(self.returns) >= self.threshold))

    @property
    def success_rate(self) -> float | None:
        """Share of episodes that succeeded; None: unknown."""
        return None if self.succeeded is None else self.succeeded / len(self.returns)

    @property
    def success_once_rate(self) -> float | None:
        """Share of episodes that succeeded in some step; None: unknown."""
        return None if self.succeeded_once is None else self.succeeded_once / len(self.returns)

    def to_json(self) -> dict[str, Any]:
        """Return the summary as plain JSON."""
        returns = np.array(self.returns)
        n = len(returns)
        std = float(returns.std(ddof=1)) if n > 1 else 0.0
        half = float(1.96 * std / np.sqrt(n))
        total = all_steps(self.skills)
        skills = {name: report.to_json(total) for name, report in self.skills.items()}
        summary = {
            "episodes": n,
            "mean": self.mean,
            "std": std,
            "ci95": None if self.all_alike else [self.mean - half, self.mean + half],
            "iqm": interquartile_mean(returns),
            "median": float(np.median(returns)),
            "min": float(returns.min()),
            "max": float(returns.max()),
            "threshold": self.threshold,
            "solved_fraction": self.solved_fraction,
            "success_rate": self.success_rate,
            "success_once_rate": self.success_once_rate,
            "all_alike": self.all_alike,
            "length_mean": float(np.mean(self.lengths)),
            "cut": self.cut,
            "skill_usage": {k: v["share"] for k, v in skills.items() if k != self.alone},
            "call_length_mean": {k: v["length_mean"] for k, v in skills.items() if v["calls"]},
            "skills": skills,
            "reflexes": {
                name: {"steps": steps, "share": steps / sum(self.lengths)}
                for name, steps in self.reflexes.items()
            },
        }
        return summary if self.alone is None else summary | {"skill": self.alone}

    def for_people(self) -> str:
        """Return ``str()``, and for a hierarchy a table of its skills and hints of mistakes."""
        skills = [skill_table(self.skills)] if self.skills else []
        reflexes = reflex_lines(self.reflexes, sum(self.lengths))
        return printable("\n".join([str(self), *skills, *reflexes, *self._hints()]))

    def _hints(self) -> list[str]:
        """Return hints of mistakes, and skills that seldom succeed after one other skill."""
        return [*hints(self.skills), *(f"{s}." for s in self.details.handovers)]

    def __repr__(self) -> str:
        return f"<Evaluation: {self}>"

    def _repr_html_(self) -> str:
        """Return the text of ``for_people`` as HTML, for notebooks."""
        rows = [*map(cells_of, skill_rows(self.skills))]
        tables = [table(TITLES, rows)] if rows else []
        lines = [*reflex_lines(self.reflexes, sum(self.lengths)), *self._hints()]
        return joined([paragraph(self), *tables, *map(paragraph, lines)])

    def __str__(self) -> str:
        """Return the line that an evaluation prints: return, success, shares of its skills."""
        j = self.to_json()
        digits = 2 if max(map(abs, self.returns)) < 10 else 1  # many are shares: 0 to 1
        n = len(self.returns)
        if self.all_alike:
            line = f"{self.mean:.{digits}f} over {n} episodes, {ALIKE}"
        else:
            mean, std, low, high, iqm = (
                f"{value:.{digits}f}" for value in (self.mean, j["std"], *j["ci95"], j["iqm"])
            )
            line = f"{mean} +/- {std} over {n} episodes (95 % CI {low} to {high}, IQM {iqm})"
        if self.solved_fraction is not None:
            line += f", {self.solved_fraction:.0%} at {self.threshold:g} or more"
        if self.success_rate is not None:
            line += f", {self.success_rate:.0%} succeed"
            if self.succeeded_once not in (None, self.succeeded):
                line += f" at the end ({self.success_once_rate:.0%} in some step)"
        line += f", {j['length_mean']:.0f} steps an episode"
        if self.cut:
            most = f"{max(self.lengths):,} steps (max_steps)"
            line += f"; {self.cut} never ended and were cut after {most}"
        if self.alone is not None:
            report = self.skills[self.alone]
            line += f"; {call_line(self.alone, report, len(self.lengths))}"
        elif self.skills:
            shares = ", ".join(f"{k} {v:.0%}" for k, v in j["skill_usage"].items())
            line += f"; skills: {shares}"
        return printable(line)


def interquartile_mean(values: Array) -> float:
    """Return the mean of the middle half (Agarwal et al. 2021); its ends count in part."""
    return float(interquartile_means(values))


def interquartile_means(values: Array) -> Array:
    """Return interquartile means of evaluations over the first axis of (n, …): (…)."""
    x = np.sort(np.asarray(values, float), axis=0)
    n = len(x)
    quarter = n / 4
    weight = np.clip(
        np.minimum(np.arange(1, n + 1) - quarter, n - quarter - np.arange(n)), 0.0, 1.0
    )
    means: Array = np.tensordot(weight, x, axes=1) / weight.sum()
    return means


@checked_names
def evaluate(
    policy: Policy | Callable[..., Any],
    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec,
    *,
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    num_envs: int | None = None,
    max_steps: int | None = None,
    watch: Callable[[PlayedStep], None] | None = None,
    engine: EngineName = "sync",
    log_calls: bool = False,
    info: Sequence[str] = (),
) -> Evaluation:
    """Play ``episodes`` whole episodes and score them by the environment's own reward.

    Args:
        policy: the acting policy; also a torch module, or a function of observations. One without
            spaces gets the environment's.
        env: a Gymnasium id, a function that makes an environment, or an ``EnvSpec``.
        seed: of the episodes; the same seed gives the same starts to every policy.
        deterministic: act greedily, else sample. Skills of a hierarchy that was chosen because
            they sample do so in any case. A step's random numbers are drawn for all environments
            together, so samples differ with ``num_envs``.
        num_envs: environments side by side, as many as exist at once; does not change the result
            of a greedy policy. None: ``USUAL_ENVS``. In a pool there is one for each episode, so
            at most 65,536.
        max_steps: an episode without an end by then is cut, and counted as such; None: the
            environment's own time limit, or 10,000 where none is known.
        watch: called with every step that is played.
        engine: "sync": Gymnasium's own environments; "envpool": a pool of EnvPool's; "auto": a
            pool where possible. A pool is faster, and plays other episodes.
        log_calls: record the calls of its skills, for ``Evaluation.calls``.
        info: keys of the environment's ``info`` to record with the calls.

    Returns:
        Returns, lengths, and a report of each skill.

    Raises:
        PolicyError: the policy was made for other spaces.
        DeclarationError: the policy cannot act; the engine does not exist; or calls are to be
            logged, of a policy without skills, of a skill that acts alone, or more than 4 GiB of
            them.
        EnvError: the environment cannot be made, or not in a pool, or sets no such key of ``info``.
    """
    policy = as_policy(policy, "evaluate(): policy")
    episodes = fitted(AtLeastOne, episodes, "episodes")
    seed = fitted(Count, seed, "seed")
    max_steps = fitted(AtLeastOne | None, max_steps, "max_steps")
    n = USUAL_ENVS if num_envs is None else fitted(AtLeastOne, num_envs, "num_envs")
    if log_calls:
        check_logged(policy, info)
    elif len(info):
        raise DeclarationError("info names keys to record with calls: set log_calls=True, too")
    spec = replaced(env if isinstance(env, EnvSpec) else EnvSpec(env), engine=engine)
    with global_generators(Seeds(seed) / "evaluation"):
        own_limit, threshold, pooled = _describe(spec)
        with closing(make_engine(spec, episodes if pooled else min(n, episodes))) as envs:
            spaces = envs.observation_space, envs.action_space
            policy = _fitted(policy, spaces, spec.name)
            seeds: Any = episode_seeds(seed, episodes)
            if pooled:  # its environments take no seeds of their own
                seeds = seeds[0] % POOL_SEEDS
            most = max_steps or longest_evaluation(own_limit)
            starts = SeededEpisodes(envs, seeds, most)
            first = starts.obs[:1].copy()
            rng = np.random.default_rng([seed, 1])
            moments = play(policy, starts, deterministic=deterministic, rng=rng, seed=seed)
            if max_steps is None and own_limit is None:
                moments = _with_notice(moments, spec.name, most)
            calls = PlayedCalls(
                policy,
                spaces,
                info=tuple(info),
                own_rewards=True,
                steps=log_calls,
                spec=spec if log_calls else None,
            )
            evaluation = _scored(policy, episodes, moments, watch, threshold, calls)
            if log_calls:
                logs = calls.logs([-1] * episodes if pooled else seeds)
                evaluation = replaced(evaluation, details=replaced(evaluation.details, logs=logs))
            if spec.check_seed and not pooled and episodes > envs.num_envs:
                _check_starts_again(envs, seeds[0], first, spec.name)
            return evaluation


def _fitted(policy: Policy, spaces: tuple[gym.Space[Any], gym.Space[Any]], name: str) -> Policy:
    """Return a policy for the spaces of the environment ``name``, tried out where it is foreign."""
    if isinstance(policy, Foreign):
        policy = policy.bind(*spaces, "the policy")
    check_spaces(policy, *spaces, "the policy", name)
    if isinstance(policy, Foreign):
        policy.try_out()
    return policy


def _describe(spec: EnvSpec) -> tuple[int | None, float | None, bool]:
    """Return an environment's time limit, reward threshold, and True if it is in a pool."""
    with closing(spec.make()) as env:
        threshold = env.spec.reward_threshold if env.spec else None
        return time_limit(env), threshold, in_pool(spec, env)


def _with_notice(moments: Iterator[PlayedStep], name: str, most: int) -> Iterator[PlayedStep]:
    """Yield played steps; give a notice once where an episode seems never to end.

    Args:
        name: of the environment.
        most: the steps after which an episode is cut.
    """
    said = False
    for played in moments:
        yield played
        if not said and played.step.elapsed[~played.over].max(initial=0) >= SEEMS_ENDLESS:
            said = True
            notice(
                f"{name}: an episode has run {SEEMS_ENDLESS:,} steps without an end, and no time "
                f"limit is known: the evaluation cuts episodes after {most:,} steps. Give it a "
                "smaller number, evaluate(max_steps=1000), or give the environment a limit: "
                "EnvSpec(..., wrappers=(lambda env: gymnasium.wrappers.TimeLimit(env, 1000),))"
            )


def _check_starts_again(envs: Engine, seed: int, first: Array, name: str) -> None:
    """Warn if the seed of the first episode does not start it again in a used environment.

    Args:
        first: its first observation (1, *obs_shape).
    """
    try:
        again = envs.reset_some(np.zeros(1, np.int64), [seed])
    except SkillweaveError:  # all episodes were played before
        return
    if checksums(again)[0] != checksums(first)[0]:
        notice(
            f"{name}: reset(seed={seed}) starts another episode than it did in the same "
            "environment before. Scores depend on how many episodes an environment has played "
            "already, and so on num_envs. Let reset() clear all state, and draw random numbers "
            "from self.np_random alone; or use one environment for each episode: "
            "num_envs=episodes"
        )


def check_logged(policy: Policy, info: Sequence[str]) -> None:
    """Raise a DeclarationError where the calls of a policy cannot be logged."""
    fitted(Sequence[str], info, "info")
    if isinstance(getattr(policy, "skill", None), Skill):
        raise DeclarationError(
            "a skill that acts alone is not called, so there are no calls to log: leave out skill, "
            "or leave out log_calls"
        )
    if skills_below(policy) is None:
        raise DeclarationError(
            "this policy has no skills, so there are no calls to log: leave out log_calls"
        )


def episode_seeds(seed: int, episodes: int) -> list[int]:
    """Return the seeds of an evaluation's episodes; training uses none of them."""
    return [FIRST_SEED * (seed + 1) + i for i in range(episodes)]


def _scored(
    policy: Any,
    episodes: int,
    moments: Iterator[PlayedStep],
    watch: Callable[[PlayedStep], None] | None,
    threshold: float | None,
    calls: PlayedCalls,
) -> Evaluation:
    """Play all episodes of an evaluation, and return their scores."""
    returns = np.zeros(episodes)
    lengths = np.zeros(episodes, np.int64)
    cut = 0
    success = np.zeros(episodes)
    skill = calls.alone
    goals = None
    success_known = False
    once = np.zeros(episodes, bool)
    alike = SameEpisodes()
    has_skills = skill is not None or bool(policy.labels)
    if (own := goals_of(skill)) is not None:
        goals = own.start(episodes)
    for played in moments:
        alike.see(played)
        returns[played.episode] += played.reward
        lengths[played.episode] += played.lasted
        cut += int(played.cut.sum())
        if has_skills:
            calls.add(played)
        if goals is not None:
            goals[played.episode] = played.memory[OWN_GOAL][played.rows]
        succeeded = reported_success(played.step.info, len(played.rows))
        if succeeded is not None:
            success_known = True
            success[played.episode[played.over]] = succeeded[played.over]
            once[played.episode[succeeded > 0]] = True
            if np.isnan(succeeded[played.over]).any():
                notice_odd_success(played.step.info, len(played.rows))
        if watch is not None:
            watch(played)
    reached = None
    if skill is not None and skill.defines("success"):
        rows = calls.recorders()[""].rows()
        reached = np.zeros(episodes, bool)
        reached[rows["episode"]] = rows["succeeded"]
    handovers = tuple(weak_handovers(calls)) if has_skills else ()
    success_known &= not np.isnan(success).any()
    return Evaluation(
        tuple(returns.tolist()),
        tuple(lengths.tolist()),
        threshold,
        skill_reports(calls) if has_skills else {},
        cut,
        succeeded=int(success.sum()) if success_known else None,
        succeeded_once=int(once.sum()) if success_known else None,
        all_alike=episodes > 1 and alike.so_far,
        reflexes=dict(calls.reflexes),
        alone=None if skill is None else policy.path,
        details=Details(None, handovers, goals, reached),
    )


class SameEpisodes:
    """A comparison of episodes that ends where the first step of one differs from the others."""

    def __init__(self) -> None:
        self.so_far = True
        """All episodes so far are the same in every step."""
        self._steps: list[int] = []  # a checksum of each

    def see(self, played: PlayedStep) -> None:
        """Compare the next step of some episodes."""
        if not self.so_far:
            return
        step, over = played.step, played.over
        columns = (step.obs, step.action, step.reward, step.next_obs, over)
        sums = zip(*(checksums(column).tolist() for column in columns), strict=True)
        for elapsed, found in zip(step.elapsed.tolist(), map(hash, sums), strict=True):
            if elapsed > len(self._steps):
                self._steps.append(found)
            elif self._steps[elapsed - 1] != found:
                self.so_far = False
                return


K = TypeVar("K")


def _known(value: K | None, missing: str) -> K:
    """Return a detail of an evaluation; None raises an error with the text ``missing``."""
    if value is None:
        raise DeclarationError(missing)
    return value
