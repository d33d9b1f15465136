"""The schemas of a run's files: ``run.json``, lines of metrics and of lineages, checkpoints.

To add a field, add a line; ``NotRequired`` if not every run has it.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, Self, TypedDict

from skillweave.algorithms.config import config_from_json
from skillweave.errors import RunError
from skillweave.paths import names_in
from skillweave.policies.files import shown
from skillweave.runs.comparison import Comparison
from skillweave.runs.files import read_json
from skillweave.schema import AtLeastOne, Check, Count, NonNegative, Positive, fit
from skillweave.skills.base import NAME
from skillweave.skills.foreign_policy import Source


def _is_path(text: str) -> bool:
    names = names_in(text)
    return 0 < len(names) <= MOST_NAMES and all(NAME.fullmatch(name) for name in names)


MOST_NAMES = 16
"""The most names in a path."""
NodePath = Annotated[
    str, Check("names of letters, digits, '_' and '-', with '/' between", _is_path)
]
"""A name behind the names of the hierarchies around it: ``inner/skill``."""


class NestedEntry(TypedDict):
    """The entry of a hierarchy, the run's or a skill's; its skills have entries, too."""

    call_steps: AtLeastOne | None
    call_lengths: NotRequired[list[AtLeastOne]]
    interrupt: NonNegative | None
    """The gain in value at which a new decision interrupts a call."""
    learn: Literal["apart", "together", "apart, then together"]
    greedy_skills: bool | None
    """None: measured at the end of learning together (``kept``)."""
    greedy_selector: bool | None
    selector: NotRequired[Source]
    """The source of a ready selector; absent if it is trained."""
    guide: NotRequired[Source]
    """The source of the ready selector that guides a trained one."""
    guide_restrict: NotRequired[bool]
    guide_kl: NotRequired[Positive | None]
    reflexes: list[str]
    start_calls: AtLeastOne | list[str] | None
    search_steps: AtLeastOne | None
    episode_calls: AtLeastOne
    call_cost: NonNegative


class SkillEntry(TypedDict):
    """The entry of a skill of the run, or of a hierarchy in it."""

    name: NodePath
    max_steps: AtLeastOne | None
    call_steps: NotRequired[AtLeastOne]
    ready: NotRequired[bool]
    policy: NotRequired[Source]
    goal_space: NotRequired[dict[str, Any]]
    """The space of its goals, if it has some."""
    sees: NotRequired[Any]
    """The part of observations that it sees, and, below, of actions that it writes."""
    acts: NotRequired[Any]
    rest: NotRequired[Any]
    """The other numbers of the action."""
    residual: NotRequired[Any]
    """The scale of a correction of ``policy``, which is ready, where the skill learns one."""
    hierarchy: NotRequired[NestedEntry]
    """Its parts, if the skill is a hierarchy."""


class Winner(TypedDict):
    """The member that won a population's stage."""

    member: Count
    fitness: float
    generation: Count
    generations: Count


class TargetEntry(TypedDict):
    """The target at which a stage may end before its budget is spent."""

    of: Literal["return", "success"]
    at_least: float


class Reached(TypedDict):
    """The steps and the value with which a stage reached its target."""

    steps: Count
    value: float


class Stopped(TypedDict):
    """The steps at which a callback ended a stage."""

    steps: Count


class Best(TypedDict):
    """The evaluation whose weights a stage ended with."""

    steps: Count
    of: Literal["return", "success"]
    value: float


@dataclass(frozen=True)
class BestSoFar:
    """The best evaluation so far of a stage in training."""

    steps: Count
    metrics: dict[str, float]


class Start(TypedDict):
    """The policy of another run with which a learner begins a stage."""

    sha256: str
    """Checksum of its file in the other run."""
    steps: Count
    """Environment steps of its training there."""
    run: str | None
    """The other run's ``id``."""
    copy: str
    """Checksum of this run's copy."""


class Matrix(TypedDict):
    """Counts of calls, and of those that were done, by the skill before (``Handover``)."""

    skills: list[str]
    calls: list[list[Count]]
    done: list[list[Count]]
    cut: list[Count]
    by_itself: list[str]
    """Skills whose calls were done if they ended by themselves."""


class RepairEntry(TypedDict):
    """The repair of a skill after another one, at the end of a run that repairs."""

    skill: NodePath
    after: NodePath
    calls: AtLeastOne
    """Calls of the pair that are measured at least, before and after."""
    done: list[str]
    """Skills whose calls were judged by an event that the caller gave."""
    blame: str
    """A sentence on the reason of the failure."""
    bonus: NotRequired[NonNegative]
    """Additional reward of each step in which the event that a call is for holds."""
    rehearsal: NotRequired[str]
    """Checksum of the file of its rehearsal's observations."""
    before: Matrix
    later: NotRequired[Matrix]


class StageEntry(TypedDict):
    """A stage: its learners, the policy that decides, its budget and its progress."""

    name: NodePath
    kind: Literal["agent", "skill", "selector", "together"]
    learns: Annotated[list[NodePath], Check("at least one name", bool)]
    """Names of the learners: "agent", "selector" or a skill's name."""
    decides: NodePath | None
    """The policy that chooses among the skills; None: one policy acts all the time."""
    budget: AtLeastOne
    algorithm: dict[str, Any]
    status: Literal["waiting", "training", "done"]
    workers: NotRequired[AtLeastOne]
    evolution: NotRequired[dict[str, Any] | None]
    target: NotRequired[TargetEntry | None]
    reached: NotRequired[Reached]
    stopped: NotRequired[Stopped]
    best: NotRequired[Best]
    metrics_bytes: NotRequired[Count]
    lineage_bytes: NotRequired[Count]
    steps: NotRequired[Count]
    evaluation_steps: NotRequired[Count]
    seconds: NotRequired[NonNegative]
    steps_per_second: NotRequired[float]
    final: NotRequired[dict[str, float | None]]
    winner: NotRequired[Winner]
    succeeded: NotRequired[bool]
    """True if any call of the skill succeeded in training or evaluation; absent: unknown."""
    sha256: NotRequired[str]
    """Checksum of its policy's file."""
    policies: NotRequired[dict[NodePath, str]]
    """With several learners: checksums of their policies' files by name."""
    together: NotRequired[dict[str, Any]]
    """Settings of skills and selector learning together."""
    algorithms: NotRequired[dict[NodePath, dict[str, Any]]]
    """Settings of the skills that learn together with the selector."""
    task_weights: NotRequired[dict[NodePath, NonNegative]]
    """The weights of skills whose ``task_weight`` differs from the one of ``together``."""
    guide_kl: NotRequired[Positive]
    """The largest KL of the selector to its guide."""
    compared: NotRequired[bool]
    """Keep the jointly learnt weights only if they are better than the earlier ones."""
    greedy_judged: NotRequired[bool]
    """At its end, evaluate whether skills and selector should act greedily or sample."""
    kept: NotRequired[Comparison]
    """The result of the comparison at its end."""
    continued: NotRequired[list[Count]]
    """Steps after which the stage had ended, before its budget was raised."""
    starts: NotRequired[dict[NodePath, Start]]
    """Initial policies from other runs, by learner."""
    repair: NotRequired[RepairEntry]
    """The stage repairs a skill that has learnt before."""


class Manifest(TypedDict):
    """``run.json``."""

    kind: Literal["hierarchy", "agent"]
    env: Annotated[str, Check("a text of at most 300 characters", lambda x: len(x) <= 300)]
    env_kwargs: dict[str, Any]
    code: NotRequired[dict[str, str]]
    """Texts of the environment and the skills, to be compared (``collecting/user_code.py``)."""
    seed: Count
    checkpoint_every: AtLeastOne
    needs_recipe: bool
    stages: list[StageEntry]
    created: str
    versions: dict[str, str]
    id: str
    eval_every: AtLeastOne | None
    eval_episodes: AtLeastOne
    keep: NotRequired[Literal["last", "best"]]
    """The weights that stages end with."""
    log_info: NotRequired[list[str]]
    """Logged keys of ``info``."""
    log_calls: NotRequired[AtLeastOne]
    """Steps of the log of calls."""
    log_calls_info: NotRequired[list[str]]
    """Keys of ``info`` in it."""
    resume_needs_recipe: bool
    recipe: NotRequired[str | None]
    track: NotRequired[list[str]]


class HierarchyManifest(Manifest, NestedEntry):
    """``run.json`` of a hierarchy."""

    skills: list[SkillEntry]


MetricsLine = TypedDict(
    "MetricsLine",
    {
        "stage": NotRequired[NodePath],
        "update": NotRequired[Count],
        "steps": NotRequired[Count],
        "seconds": NotRequired[NonNegative],
        "return": NotRequired[float],
    },
)
"""A line of ``metrics.jsonl``: an update, with further numbers of its algorithm."""


# Populations


@dataclass(frozen=True)
class Origin:
    """The origin of a member: its parent, and the old and new values of changed settings."""

    parent: Count | None = None
    mutation: str = "start"
    changes: dict[str, tuple[Any, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class MemberEntry:
    """A member of a population, in a checkpoint's header."""

    number: Count
    steps: Count
    config: dict[str, Any]
    origin: Origin


@dataclass(frozen=True)
class BestEntry:
    """The best member of a population so far."""

    fitness: float
    number: Count
    generation: Count
    policy: dict[str, Any]


class LineageLine(TypedDict):
    """A line of ``lineage.jsonl``: a member in a generation."""

    stage: NodePath
    generation: Count
    member: Count
    parent: Count | None
    mutation: str
    changes: dict[str, tuple[Any, Any]]
    fitness: float | None
    best: bool
    settings: dict[str, Any]


@dataclass(frozen=True)
class Generation:
    """A population, in a checkpoint's header."""

    fitness_steps: Count
    generation: Count
    rounds: Count
    next_number: Count
    members: Annotated[list[MemberEntry], Check("at least one member", bool)]
    best: BestEntry | None


# Checkpoints


@dataclass
class Checkpoint:
    """A checkpoint's header: the progress of a stage in training."""

    stage: NodePath
    update: Count
    steps: Count
    evaluation_steps: Count
    seconds: NonNegative
    metrics: dict[str, float]
    metrics_bytes: Count | None = None
    lineage_bytes: Count | None = None
    run: str | None = None
    kept_best: BestSoFar | None = None
    """The best evaluation so far, if the best weights are kept."""
    population: Generation | None = None

    @classmethod
    def start(cls, stage: str) -> Self:
        """Return the header of a stage before its first update."""
        return cls(stage, 0, 0, 0, 0.0, {})


# Reading and writing ``run.json``


def check_manifest(data: Mapping[str, Any], file: str) -> None:
    """Raise a RunError that names the file and the field where a manifest is wrong."""
    manifest = fit(Manifest, data, file)
    if manifest["kind"] == "hierarchy":
        manifest = fit(HierarchyManifest, data, file)
    for kind in ("skills", "stages"):
        names = [entry["name"] for entry in manifest.get(kind, [])]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise RunError(f"{file}: {kind}[{i}].name is {shown(name)}, a second time")
    if manifest["kind"] == "agent" and len(manifest["stages"]) != 1:
        raise RunError(
            f"{file}: stages has {len(manifest['stages'])} entries, but a plain agent has one"
        )
    for i, stage in enumerate(manifest["stages"]):
        where = f"stages[{i}]"
        config_from_json(stage["algorithm"], file, f"{where}.algorithm")
        if stage["status"] == "done" and not {"steps", "seconds"} <= set(stage):
            raise RunError(f"{file}: {where} is done, but has no field 'steps' or 'seconds'")
    if "sha256" not in data:
        raise RunError(f"{file} is damaged: no field 'sha256', the checksum of its content")


def read_manifest(run: Path) -> dict[str, Any]:
    """Return the checked content of a run's ``run.json``."""
    file = run / "run.json"
    return read_json(file, lambda data: check_manifest(data, str(file)))


OF_NO_WEIGHT = ("recipe", "track", "log_info", "log_calls", "log_calls_info", "code")
"""Entries that do not change what is learnt, or are compared by themselves."""


def identity(manifest: Mapping[str, Any]) -> str:
    """Return 16 letters that identify a new run.

    Runs that must end with the same weights have the same.
    """
    settings = {k: v for k, v in manifest.items() if k not in OF_NO_WEIGHT}
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[
        :16
    ]


def versions() -> dict[str, str]:
    """Return the versions of Skillweave, Python and dependencies, and the platform."""
    version_of = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("skillweave", "torch", "gymnasium", "numpy", "envpool"):
        try:
            version_of[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return version_of
