"""A stage as data: its learners, its decider, algorithms and budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from skillweave._internal.notices import notice
from skillweave._internal.paths import SELECTOR, join, level_of
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import make_algorithm
from skillweave.algorithms.config import (
    AlgorithmConfig,
    config_from_json,
    config_to_json,
    is_offline,
    own_encoders,
)
from skillweave.algorithms.schedules import own_schedules
from skillweave.envs.make import EnvSpec, cores, workers_for
from skillweave.errors import DeclarationError, SkillweaveError, reworded
from skillweave.ops.device import resolve_device
from skillweave.runs.manifest import StageEntry, Target
from skillweave.schema import AtLeastOne, Fraction, NonNegative, Positive, settings
from skillweave.training.learning_task import LearningTask
from skillweave.training.replay_learner import judge_of, store_of, try_judge
from skillweave.training.role import Role
from skillweave.workers.start_methods import cannot_be_sent, runs_again, why_no_processes

TOGETHER = "together"
"""Name of the stage in which all learn together."""


Policies = Mapping[str, Policy]
"""Policies by path: ready skills, and those that earlier stages trained."""


def target_of(
    target_return: float | None, target_success: float | None, where: str
) -> Target | None:
    """Return the target of a stage, of two settings of which one may be given.

    Args:
        where: the stage or skill, for messages.

    Raises:
        DeclarationError: both are given.
    """
    if target_return is not None and target_success is not None:
        raise DeclarationError(f"{where}: give target_return or target_success, not both")
    if target_return is not None:
        return Target("return", float(target_return))
    return None if target_success is None else Target("success", float(target_success))


@settings
class Together:
    """Settings of a selector and skills that learn from the same steps.

    Raises:
        DeclarationError: a value is out of its range.
    """

    steps: AtLeastOne | None = None
    """Training steps of this stage; None: its share of ``Hierarchy.steps``."""
    interrupt: bool = False
    """The selector interrupts a call where a new decision is worth clearly more (``margin``); also
    where the selector learns apart."""
    task_weight: NonNegative = 1.0
    """Weight of the task's advantage beside a skill's own, which has weight 1. It grows linearly
    from 0. A skill can set its own (``Skill.task_weight``; 0: its own reward alone). For skills
    that learn by PPO; skills with other algorithms follow their own reward alone."""
    epsilon: Fraction = 1.0
    """Least share of calls chosen uniformly from the allowed ones, at the start. A selector with an
    ``epsilon`` of its own also uses its own ``epsilon_final`` and ``epsilon_fraction``."""
    epsilon_final: Fraction = 0.1
    """The value that epsilon falls to, linearly."""
    epsilon_fraction: Fraction = 1.0
    """Share of the budget over which epsilon falls."""
    margin: NonNegative = 0.2
    """Interrupt a call where a new decision is worth this much more, in standard deviations of the
    return."""
    reference_kl: Positive | None = 0.05
    """Keep skills that PPO trained before within this KL of their earlier policy; None disables
    this. A skill whose calls succeeded in a share p of its own stage, at its end, may move 1/p
    times as far."""
    quota: Fraction = 0.25
    """A skill learns when it has acted in this share of a rollout's rows, or more."""


@dataclass(frozen=True)
class Stage:
    """A task of training: its environment, algorithm and budget."""

    name: str
    """The path of its learner, or of the stage in which a level learns together."""
    kind: Literal["agent", "skill", "selector", "together"]
    config: AlgorithmConfig
    """The algorithm's settings."""
    budget: int
    """Environment steps."""
    learning_task: Callable[[Policies], LearningTask]
    """Makes the task in which it learns, from the policies so far."""
    target: Target | None = None
    """A target at which it ends early; None: without target."""
    beside: Mapping[str, AlgorithmConfig] = field(default_factory=dict)
    """Algorithms of the learners beside the selector, by path."""
    together: Together | None = None
    """Settings of learning together; None: a single learner."""
    task_weights: Mapping[str, float] = field(default_factory=dict)
    """Weights of skills that differ from ``together.task_weight``, by path."""
    ready: bool = False
    """True if the selector is ready: ``config`` then only sets the number of environments."""
    guide_kl: float | None = None
    """Keep the selector within this KL of its guide; None disables this."""
    level: str = ""
    """The path of the level that learns here."""
    compared: bool = False
    """Keep the result only if it is better than the policies before."""
    greedy_judged: bool = False
    """At its end, evaluate whether skills and selector should act greedily or sample."""
    learner: str | None = None
    """The path of the learner, where the stage has another name: it has learnt before."""

    @property
    def acts_by_code(self) -> bool:
        """True if a policy of the stage can be loaded only with the user's code."""
        return any(own_encoders(config) for config in (self.config, *self.beside.values()))

    @property
    def learns_by_code(self) -> bool:
        """True if the stage can be trained only with functions of the user in its settings."""
        configs = (self.config, *self.beside.values())
        return self.acts_by_code or any(own_schedules(config) for config in configs)

    def entry(self) -> StageEntry:
        """Return the manifest's entry before training."""
        first = join(self.level, SELECTOR) if self.together else self.learner or self.name
        judged = self.kind == "together"
        return StageEntry(
            name=self.name,
            kind=self.kind,
            learns=[*([] if self.ready else [first]), *self.beside],
            decides=first if self.kind in ("selector", "together") else None,
            budget=self.budget,
            algorithm=config_to_json(self.config),
            target=self.target,
            status="waiting",
            together=None if self.together is None else asdict(self.together),
            algorithms={k: config_to_json(v) for k, v in self.beside.items()},
            task_weights=dict(self.task_weights),
            guide_kl=self.guide_kl,
            compared=self.compared if judged else None,
            greedy_judged=self.greedy_judged if judged else None,
        )


def check_stages(
    entries: Sequence[StageEntry], eval_every: int | None, keep: str | None = None
) -> None:
    """Raise a DeclarationError where the settings of a manifest's stages do not fit together."""
    alone = any(entry.evolution is None for entry in entries)
    if keep == "best" and eval_every is None and alone:
        raise DeclarationError(
            "keep is 'best', but nothing is evaluated while it trains: set eval_every to the "
            "environment steps between evaluations"
        )
    _check_sharing(entries)
    for entry in entries:
        where = f"stage {entry.name!r}"
        evolves = entry.evolution is not None
        try:
            resolve_device(entry.algorithm.get("device", "cpu"))
        except SkillweaveError as error:
            raise reworded(error, f"{where}: {error}") from error
        starts = entry.algorithm.get("learning_starts", 0)
        budget = entry.budget // entry.members
        offline = _online(entry.algorithm) < 1.0
        if budget <= starts and not offline:
            each = " for each member" if entry.members > 1 else ""
            raise DeclarationError(
                f"{where}: its budget is {budget:,} steps{each}, but it begins to learn only after "
                f"{starts:,} (learning_starts). Give it more steps, or start earlier"
            )
        for name, algorithm in entry.algorithms.items():
            starts = algorithm.get("learning_starts", 0)
            if budget <= starts and _online(algorithm) == 1.0:
                raise DeclarationError(
                    f"{where}: its budget is {budget:,} steps, but {name!r} begins to learn only "
                    f"after {starts:,} (learning_starts). Give the stage more steps, or start "
                    "earlier"
                )
        target = entry.target
        if target is not None and evolves and target.of != "return":
            raise DeclarationError(
                f"{where}: it evolves, and members are compared by their mean return, so its "
                "target must be target_return"
            )
        if target is not None and not evolves and eval_every is None:
            raise DeclarationError(
                f"{where}: it has a target_{target.of}, but is not evaluated while it trains: "
                "set eval_every to the environment steps between evaluations"
            )


def check_data(entries: Sequence[StageEntry], roles: Mapping[str, Role], *, given: bool) -> None:
    """Raise a DeclarationError where learners cannot learn from data as their settings say.

    Args:
        entries: of a new run.
        roles: of its learners, by path.
        given: there are data.
    """
    for entry in entries:
        for name in entry.learns:
            config = config_from_json(entry.algorithms.get(name, entry.algorithm))
            kind = type(config).__name__
            who = f"stage {entry.name!r}: {name!r} learns by {kind}"
            shares = getattr(config, "shared_replay", 0.0)
            if roles[name].kind == "agent" and shares and not given and not is_offline(config):
                raise DeclarationError(
                    f"{who} with shared_replay, but a plain agent has no skills beside it that "
                    "could share their steps: give steps of others, data=..., or leave out "
                    "shared_replay"
                )
            if not is_offline(config):
                continue
            if not given:
                raise DeclarationError(
                    f"{who}, which learns from recorded steps: give them, data=... (a Dataset), or "
                    f"let it step the environment alone, {kind}(online=1.0, shared_replay=0.0)"
                )
            if entry.kind == "together" or entry.evolution is not None:
                how = "a population" if entry.evolution else "skills that learn together"
                other = "leave out evolve" if entry.evolution else 'learn="apart"'
                raise DeclarationError(
                    f"{who}, which learns from data alone first, and {how} cannot: {other}"
                )


def check_room(entries: Sequence[StageEntry], room: Callable[[int], int]) -> None:
    """Check that replay buffers have the room for data.

    Args:
        room: returns the room that the data need in a buffer, given the number of environments.

    Raises:
        DeclarationError: a buffer is smaller.
    """
    for entry in entries:
        config: Any = config_from_json(entry.algorithm)
        if not getattr(config, "shared_replay", 0.0) or _steps_nothing(entry):
            continue
        slots = room(config.num_envs)
        size, all_steps = config.buffer_size, slots + entry.budget
        if size < slots:
            raise DeclarationError(
                f"stage {entry.name!r}: buffer_size is {size:,}, but the data take {slots:,} of "
                f"its places: give buffer_size={all_steps:,}, for the data and the stage's steps"
            )
        if size < all_steps:
            notice(
                f"stage {entry.name!r}: buffer_size is {size:,}, so its own steps replace the "
                f"{slots:,} of the data before its budget of {entry.budget:,} is spent; "
                f"buffer_size={all_steps:,} holds all"
            )


def _check_sharing(entries: Sequence[StageEntry]) -> None:
    """Raise a DeclarationError where skills that learn apart cannot begin with earlier steps."""
    levels: dict[str, list[StageEntry]] = {}
    for entry in entries:
        if entry.shares:
            levels.setdefault(level_of(entry.name), []).append(entry)
        offline = _online(entry.algorithm) < 1.0
        if entry.evolution is not None and entry.algorithm.get("shared_replay") and not offline:
            raise DeclarationError(
                f"stage {entry.name!r}: it evolves, and its algorithm has shared_replay, which is "
                "not for populations: leave out one of them"
            )
    for level in levels.values():
        for entry in level if len(level) > 1 else ():
            if not entry.algorithm["save_buffer"]:
                raise DeclarationError(
                    f"stage {entry.name!r}: its algorithm has shared_replay, and skills that learn "
                    "apart hand their steps on in files, but save_buffer is False: leave it out"
                )
            if entry.num_envs != level[0].num_envs:
                raise DeclarationError(
                    f"stage {entry.name!r}: it learns from steps of {level[0].name!r} "
                    f"(shared_replay), so num_envs must be equal, but is {entry.num_envs} and "
                    f"{level[0].num_envs}"
                )


ONE = "one collector (EnvSpec(workers=1), --collectors 1, Ray(collectors=1))"
"""Advice of messages where a stage cannot have several collectors."""


def assign_workers(entries: Sequence[StageEntry], spec: EnvSpec, sent: Any = None) -> None:
    """Write into each stage's entry how many processes step its environments in training.

    For a population it is the number of parts into which its members are split; without a declared
    number they stay in this process. A measured number is lowered to one that divides ``num_envs``,
    or to 1 where processes cannot be started.

    Args:
        sent: the object that processes receive beside the environment.

    Raises:
        DeclarationError: a declared number does not divide ``num_envs``, or a population whose
            members learn on a GPU is to be split.
    """
    measured = any(entry.evolution is None and not _steps_nothing(entry) for entry in entries)
    workers = workers_for(spec) if measured else 1
    if workers > 1 and spec.workers is None:
        reason = why_no_processes() or runs_again() or cannot_be_sent((spec, sent))
        if reason:
            workers = 1
            notice(
                f"{spec.name} is slow enough that several processes would step it faster, but "
                f"{reason}. All environments stay in one process; EnvSpec(workers=1) ends this "
                f"message, EnvSpec(workers={cores()}) uses processes"
            )
    for entry in entries:
        num_envs = entry.num_envs
        if entry.evolution is not None:
            entry.workers = workers_of(entry, spec.workers or 1)
            if entry.workers > 1 and entry.algorithm.get("device") == "cuda":
                raise DeclarationError(
                    f"stage {entry.name!r}: device is 'cuda', but the parts of a population "
                    f"learn on processors alone: set device='cpu', or have {ONE}"
                )
        elif spec.workers is None:
            fitting = (k for k in range(workers, 0, -1) if num_envs % k == 0)
            entry.workers = next(fitting)
        elif num_envs % workers:
            raise DeclarationError(
                f"stage {entry.name!r}: num_envs is {num_envs}; it must be a multiple of "
                f"workers, {workers}, so that each has as many environments; or have {ONE}"
            )
        else:
            entry.workers = workers


def _steps_nothing(entry: StageEntry) -> bool:
    """Return whether a stage learns from data alone."""
    return _online(entry.algorithm) == 0.0


def _online(algorithm: Mapping[str, Any]) -> float:
    """Return the share of a stage's steps that are made in the environment."""
    return float(algorithm.get("online", 1.0))


def workers_of(entry: StageEntry, requested: int) -> int:
    """Return a stage's number of workers for a requested one: at most one for each member."""
    if entry.evolution is None or requested <= 1:
        return requested
    return min(requested, entry.members)


def check_replay(entry: StageEntry, role: Role) -> None:
    """Raise a DeclarationError where the replay buffer of a stage's learner cannot be made.

    A buffer that is larger than the free memory is a TrainingError.

    Args:
        entry: the manifest's.
    """
    config = config_from_json(entry.algorithm)
    algorithm = make_algorithm(config, *role.spaces)
    if algorithm.store != "replay":
        return
    members = entry.members
    if members > 1 and entry.workers > 1:
        raise DeclarationError(
            f"stage {entry.name!r}: it evolves, and all members of {type(config).__name__} "
            f"learn from one replay buffer, so they cannot be split into {entry.workers} parts. "
            f"Have {ONE}, take PPO, or name other stages: evolve={{...}}"
        )
    try:  # unwritten slots take no memory
        judge = judge_of(config, role)
        store_of(algorithm, config.num_envs * members, members, shared=members > 1, judge=judge)
        recorded = role.kind == "agent" and _steps_nothing(entry)  # so are its rewards
        if judge is not None and not recorded:
            try_judge(judge, config, role.spec)
    except SkillweaveError as error:
        raise reworded(error, f"stage {entry.name!r}: {error}") from error
