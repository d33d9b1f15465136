"""What ``run.json`` and the headers of checkpoints hold: the schema that reading them goes by.

To add a field, add a line; ``NotRequired`` where not every run has it.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from skillweave.algorithms.config import config_from_json
from skillweave.errors import RunError
from skillweave.reading import fit, shown
from skillweave.runs.files import read_json
from skillweave.runs.kept import Kept
from skillweave.settings import AtLeastOne, Check, Count, NonNegative, Positive
from skillweave.skills.base import NAME
from skillweave.skills.foreign_policy import Source


def _is_path(text: str) -> bool:
    names = text.split("/")
    return len(names) <= MOST_NAMES and all(NAME.fullmatch(name) for name in names)


MOST_NAMES = 16
"""In a path."""
NodePath = Annotated[
    str, Check("names of letters, digits, '_' and '-', with '/' between", _is_path)
]
"""A name after those of the hierarchies that it is in: ``inner/skill``."""


class NestedEntry(TypedDict):
    """A hierarchy: the run's, or a skill of it or of another one; its skills have entries, too."""

    call_steps: AtLeastOne | None
    call_lengths: NotRequired[list[AtLeastOne]]
    interrupt: NonNegative | None
    """By how much a new decision must be worth more to interrupt a call."""
    learn: Literal["apart", "together", "apart, then together"]
    greedy_skills: bool | None
    """None: measured at the end of learning together, and written there (``kept``)."""
    greedy_selector: bool | None
    selector: NotRequired[Source]
    """Of a ready selector; absent where it is trained."""
    guide: NotRequired[Source]
    """Of the ready selector that a trained one keeps to."""
    guide_restrict: NotRequired[bool]
    guide_kl: NotRequired[Positive | None]
    reflexes: list[str]
    start_calls: AtLeastOne | None
    search_steps: AtLeastOne | None
    episode_calls: AtLeastOne
    call_cost: NonNegative


class SkillEntry(TypedDict):
    """A skill of the run, or of a hierarchy that is one."""

    name: NodePath
    max_steps: AtLeastOne | None
    call_steps: NotRequired[AtLeastOne]
    ready: NotRequired[bool]
    policy: NotRequired[Source]
    hierarchy: NotRequired[NestedEntry]
    """What it is made of."""


class Winner(TypedDict):
    """The member that a population's stage ended with."""

    member: Count
    fitness: float
    generation: Count
    generations: Count


class TargetEntry(TypedDict):
    """Where a stage may end before its budget is spent."""

    of: Literal["return", "success"]
    at_least: float


class Reached(TypedDict):
    """That a stage has reached its target: when, and with which value."""

    steps: Count
    value: float


class Stopped(TypedDict):
    """That a callback ended a stage."""

    steps: Count


class Best(TypedDict):
    """The evaluation whose weights a stage ended with."""

    steps: Count
    of: Literal["return", "success"]
    value: float


class BestSoFar(TypedDict):
    """The best evaluation of a stage that goes on."""

    steps: Count
    metrics: dict[str, float]


class Start(TypedDict):
    """What one begins a stage with, from another run."""

    sha256: str
    """Of its file there."""
    steps: Count
    """Environment steps that it learnt from there."""
    run: str | None
    """That run's ``id``."""
    copy: str
    """Checksum of this run's copy."""


class StageEntry(TypedDict):
    """A stage: who learns in it and who decides, for how many steps, and how far it is."""

    name: NodePath
    kind: Literal["agent", "skill", "selector", "together"]
    learns: Annotated[list[NodePath], Check("at least one name", bool)]
    """Whose weights the stage changes: "agent", "selector" or a skill's name."""
    decides: NodePath | None
    """Who chooses among the skills; None: one acts all the time."""
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
    """Any call of the skill, while it trained or was evaluated, as far as that is known."""
    sha256: NotRequired[str]
    """Of its policy's file."""
    policies: NotRequired[dict[NodePath, str]]
    """The same where several learn: by name, checksums of their policies' files."""
    together: NotRequired[dict[str, Any]]
    """How skills and selector learn together."""
    algorithms: NotRequired[dict[NodePath, dict[str, Any]]]
    """Of the skills that learn together with the selector."""
    task_weights: NotRequired[dict[NodePath, NonNegative]]
    """Of skills whose ``task_weight`` is not that of ``together``."""
    guide_kl: NotRequired[Positive]
    """The KL within which the selector stays of its guide."""
    compared: NotRequired[bool]
    """What is learnt together is kept only if it is better than what was there before."""
    greedy_judged: NotRequired[bool]
    """At its end, evaluate whether skills and selector should act greedily or sample."""
    kept: NotRequired[Kept]
    """What was found out at its end."""
    continued: NotRequired[list[Count]]
    """Steps after which the stage had ended, and was then given more."""
    starts: NotRequired[dict[NodePath, Start]]
    """By name, who begins with what it has learnt in another run."""


class Manifest(TypedDict):
    """``run.json``."""

    kind: Literal["hierarchy", "agent"]
    env: Annotated[str, Check("a text of at most 300 characters", lambda x: len(x) <= 300)]
    env_kwargs: dict[str, Any]
    seed: Count
    checkpoint_every: AtLeastOne
    needs_recipe: bool
    stages: list[StageEntry]
    created: str
    versions: dict[str, str]
    id: NotRequired[str]
    eval_every: AtLeastOne | None
    eval_episodes: AtLeastOne
    keep: NotRequired[Literal["last", "best"]]
    """What stages end with."""
    log_info: NotRequired[list[str]]
    """Keys of ``info`` that are logged."""
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
"""A line of ``metrics.jsonl``: an update, with numbers of its algorithm's own."""


class Checkpoint(TypedDict):
    """A checkpoint's header."""

    stage: NodePath
    update: Count
    steps: Count
    evaluation_steps: Count
    seconds: NonNegative
    metrics: dict[str, float | None]
    metrics_bytes: Count
    lineage_bytes: NotRequired[Count]
    run: NotRequired[str]
    kept_best: NotRequired[BestSoFar]
    """Where the best weights are kept."""


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
    if "id" in data and "sha256" not in data:
        raise RunError(f"{file} is damaged: no field 'sha256', the checksum of it all")


def read_manifest(run: Path) -> dict[str, Any]:
    """Return the content of a run's ``run.json``, checked."""
    file = run / "run.json"
    return read_json(file, lambda data: check_manifest(data, str(file)))


def identity(manifest: Mapping[str, Any]) -> str:
    """What distinguishes a new run from others, in 16 letters.

    Runs that are bound to end with the same weights have the same.
    """
    settled = {k: v for k, v in manifest.items() if k not in ("recipe", "track", "log_info")}
    return hashlib.sha256(json.dumps(settled, sort_keys=True, default=str).encode()).hexdigest()[
        :16
    ]


def versions() -> dict[str, str]:
    """Of Skillweave, Python, what it stands on, and the machine."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("skillweave", "torch", "gymnasium", "numpy", "envpool"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
