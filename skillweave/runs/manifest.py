"""The schemas of a run's files: ``run.json``, lines of metrics and of lineages, checkpoints.

To add a field, add a line; with a default, if not every run has it. Fields of ``run.json`` are
settings, which reports list and a resumed run compares, or they are marked as ``NoSetting``.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    Self,
    TypeAlias,
    TypedDict,
    TypeVar,
    get_args,
)

from skillweave._internal.paths import level_of, names_in
from skillweave.algorithms.agent_policy import AgentHeader
from skillweave.algorithms.config import config_from_json
from skillweave.errors import EnvError, RunError
from skillweave.policies.core import flat
from skillweave.policies.untrusted import shown
from skillweave.runs.comparison import Comparison
from skillweave.runs.files import read_json, record_in
from skillweave.schema import (
    AtLeastOne,
    Check,
    Count,
    NonNegative,
    Positive,
    Threads,
    annotations_of,
    as_json,
)
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

T = TypeVar("T")
NO_SETTING = "no setting"
"""The mark of a ``NoSetting``, in the field's annotation."""
NoSetting: TypeAlias = Annotated[T, NO_SETTING]
"""A field of ``run.json`` that is no setting (see ``settings_of``).

Training writes it, it follows from settings, or it does not change what is learnt.
"""


@dataclass(frozen=True)
class GuideEntry:
    """The entry of a guide: its source and its settings."""

    source: Source
    restrict: bool
    target_kl: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class LevelEntry:
    """The entry of a hierarchy, the outermost one or a skill: its settings, without its skills."""

    learn: Literal["apart", "together", "apart, then together"]
    call_steps: AtLeastOne | None
    call_lengths: tuple[AtLeastOne, ...] = ()
    """Lengths that the selector chooses from; empty: it chooses none."""
    interrupt: NonNegative | None
    """The gain in value at which a new decision interrupts a call."""
    greedy_skills: bool | None
    """None: measured at the end of learning together (``kept``)."""
    greedy_selector: bool | None
    start_calls: AtLeastOne | tuple[str, ...] | None
    search_steps: AtLeastOne | None
    episode_calls: AtLeastOne
    deliberation_cost: NonNegative
    reflexes: list[str]
    selector: Source | None = None
    """The source of a ready selector; None: it is trained."""
    guide: GuideEntry | None = None
    """The ready selector that guides a trained one."""


@dataclass(frozen=True)
class SkillEntry:
    """The entry of a skill of the run, or of a hierarchy in it; what is None is absent there."""

    name: NoSetting[NodePath]
    max_steps: AtLeastOne | None
    ready: bool = False
    call_steps: AtLeastOne | None = None
    fade: AtLeastOne | dict[str, AtLeastOne] | None = None
    """The steps in which the skill before acts on, perhaps by its name."""
    goal_space: dict[str, Any] | None = None
    """The space of its goals, if it has some."""
    sees: Any = None
    """The part of observations that it sees, and, below, of actions that it writes."""
    acts: Any = None
    rest: Any = None
    """The other numbers of the action."""
    residual: Any = None
    """The scale of a correction of ``policy``, which is ready, where the skill learns one."""
    learns_on: Any = None
    """The mapping of a file from which the skill learns on, and the names of its input and output;
    ``policy`` is the file."""
    policy: Source | None = None
    hierarchy: LevelEntry | None = None
    """Its settings, if the skill is a hierarchy."""


@dataclass(frozen=True)
class Winner:
    """The member that won a population's stage."""

    member: Count
    fitness: float
    generation: Count
    generations: Count


@dataclass(frozen=True)
class Target:
    """An entry of ``run.json``: the evaluation's value at which a stage ends early."""

    of: Literal["return", "success"]
    """The criterion: the mean return, or the share of episodes that succeed."""
    at_least: float
    """The smallest value that reaches the target."""

    def reached(self, evaluation: Mapping[str, float], stage: str) -> float | None:
        """Return the value of an evaluation that reaches the target, else None.

        Args:
            evaluation: its metrics; empty: no evaluation.
            stage: the stage's name, for messages.

        Raises:
            EnvError: the environment does not report which episodes succeed.
        """
        if not evaluation:
            return None
        if (value := evaluation.get(f"eval_{self.of}")) is None:
            raise EnvError(
                f"stage {stage!r} has target_success, but its environment does not report which "
                "episodes succeed: set info['success'] in an episode's last step"
            )
        return value if value >= self.at_least else None


@dataclass(frozen=True)
class Reached:
    """The steps and the value with which a stage reached its target."""

    steps: Count
    value: float


@dataclass(frozen=True)
class Stopped:
    """The steps at which a callback ended a stage."""

    steps: Count


@dataclass(frozen=True)
class Best:
    """An entry of ``run.json``: the evaluation whose weights a stage ended with."""

    steps: Count
    of: Literal["return", "success"]
    value: float

    def __str__(self) -> str:
        """Return a sentence on it (``keep="best"``)."""
        what = "mean return" if self.of == "return" else "share of successes"
        if not self.steps:
            return (
                f"kept the policy that was given, whose evaluation was best ({what} "
                f"{self.value:.4g}): learning on made it no better. Smaller steps may help "
                "(learning_rate), or more of them"
            )
        return (
            f"kept the weights of step {self.steps:,}, whose evaluation was best: "
            f"{what} {self.value:.4g}"
        )


@dataclass(frozen=True)
class BestSoFar:
    """The best evaluation so far of a stage in training."""

    steps: Count
    metrics: dict[str, float]


@dataclass(frozen=True)
class GivenScore:
    """The score of the policy that a stage was given, in a checkpoint's header."""

    rounds: AtLeastOne
    """Rounds of episodes, one in each environment."""
    longest: AtLeastOne
    """Steps after which an episode was cut."""
    returns: list[float]
    """Of each episode."""
    success: list[float]
    """1 where an episode succeeded; empty: unknown."""
    sampled: list[float]
    """Returns of episodes in which the policy sampled; empty: there are none."""
    length: NonNegative
    """Mean steps of an episode."""


@dataclass
class Start:
    """The policy of another run with which a learner begins a stage."""

    sha256: str
    """Checksum of its file in the other run."""
    steps: Count
    """Environment steps of its training there."""
    run: str | None
    """The other run's ``id``."""
    critic: bool = True
    """Its critic was learnt with it."""
    copy: str | None = None
    """Checksum of this run's copy; None: it is not written yet."""


@dataclass(frozen=True)
class Matrix:
    """Counts of calls and done ones in ``run.json``, by the skill before (``Handover``)."""

    skills: list[str]
    calls: list[list[Count]]
    done: list[list[Count]]
    began_late: list[list[Count]]
    """Calls that are left out, as they began too late."""
    by_itself: list[str]
    """Skills whose calls were done if they ended by themselves."""
    time_limit: Count = 0
    needed: list[list[Count]] | None = None
    """Steps of an episode in which half of the calls that began too late would have counted."""


@dataclass
class RepairEntry:
    """The repair of a skill after another one, at the end of a run that repairs."""

    skill: NodePath
    after: NodePath
    calls: AtLeastOne
    """Calls of the pair that are measured at least, before and after."""
    done: list[str]
    """Skills whose calls were judged by an event that the caller gave."""
    blame: str
    """A sentence on the reason of the failure."""
    before: Matrix
    bonus: NonNegative = 0.0
    """Additional reward of each step in which the event that a call is for holds."""
    rehearsal: str | None = None
    """Checksum of the file of its rehearsal's observations; None: without rehearsal."""
    later: Matrix | None = None
    """The matrix after the repair; None: not measured yet."""


@dataclass
class StageEntry:
    """A stage: its learners, the policy that decides, its budget and its progress.

    What is None or empty by default is absent in ``run.json`` then.
    """

    name: NoSetting[NodePath]
    kind: Literal["agent", "skill", "selector", "together"]
    learns: Annotated[list[NodePath], Check("at least one name", bool)]
    """Names of the learners: "agent", "selector" or a skill's name."""
    decides: NodePath | None
    """The policy that chooses among the skills; None: one policy acts all the time."""
    budget: AtLeastOne
    algorithm: Annotated[
        dict[str, Any],
        Check('the settings of an algorithm, among them "num_envs"', lambda x: "num_envs" in x),
    ]
    target: Target | None
    """A target at which it ends early; None: without target."""
    status: NoSetting[Literal["waiting", "training", "done"]]
    together: dict[str, Any] | None = None
    """Settings of skills and selector learning together; None: one learner, or a population."""
    algorithms: dict[NodePath, dict[str, Any]] = field(default_factory=dict)
    """Settings of the skills that learn together with the selector."""
    task_weights: dict[NodePath, NonNegative] = field(default_factory=dict)
    """The weights of skills whose ``task_weight`` differs from the one of ``together``."""
    guide_kl: Positive | None = None
    """The largest KL of the selector to its guide."""
    compared: NoSetting[bool | None] = None
    """Keep the jointly learnt weights only if they are better than the earlier ones."""
    greedy_judged: NoSetting[bool | None] = None
    """At its end, evaluate whether skills and selector should act greedily or sample."""
    evolution: (
        Annotated[
            dict[str, Any],
            Check('the settings of a population, with "population"', lambda x: "population" in x),
        ]
        | None
    ) = None
    """Settings of its population."""
    workers: NoSetting[Threads] = 1
    """Processes for its environments; parts of its population."""
    starts: NoSetting[dict[NodePath, Start]] = field(default_factory=dict)
    """Initial policies from other runs, by learner."""
    repair: RepairEntry | None = None
    """The stage repairs a skill that has learnt before."""
    extended: NoSetting[AtLeastOne | None] = None
    """The budget that it had in place of its own, as its skill acts seldom."""
    continued: NoSetting[list[Count]] = field(default_factory=list)
    """Steps after which the stage had ended, before its budget was raised."""
    careful: NoSetting[bool] = False
    """Its evaluations had become better when it was continued, so it learns on by small steps."""
    metrics_bytes: NoSetting[Count | None] = None
    lineage_bytes: NoSetting[Count | None] = None
    reached: NoSetting[Reached | None] = None
    stopped: NoSetting[Stopped | None] = None
    best: NoSetting[Best | None] = None
    steps: NoSetting[Count | None] = None
    """Environment steps of the training; None until it is done, as are the next three."""
    evaluation_steps: NoSetting[Count | None] = None
    seconds: NoSetting[NonNegative | None] = None
    steps_per_second: NoSetting[float | None] = None
    final: NoSetting[dict[str, float | None]] = field(default_factory=dict)
    """The last metrics."""
    winner: NoSetting[Winner | None] = None
    succeeded: NoSetting[bool | None] = None
    """True if any call of the skill succeeded in training or evaluation; None: unknown."""
    sha256: NoSetting[str | None] = None
    """Checksum of its policy's file."""
    policies: NoSetting[dict[NodePath, str]] = field(default_factory=dict)
    """With several learners: checksums of their policies' files by name."""
    kept: NoSetting[Comparison | None] = None
    """The result of the comparison at its end."""

    @property
    def done(self) -> bool:
        """True after its training."""
        return self.status == "done"

    @property
    def has_begun(self) -> bool:
        """True if it has trained, perhaps to an end, before its budget was raised."""
        return self.status != "waiting" or bool(self.continued)

    @property
    def shares(self) -> bool:
        """True if a skill learns apart here from its own steps and those of earlier ones."""
        alone = self.kind == "skill" and self.evolution is None and self.repair is None
        return alone and bool(self.algorithm.get("shared_replay"))

    @property
    def members(self) -> int:
        """The number of members of its population; 1 without one."""
        return 1 if self.evolution is None else int(self.evolution["population"])

    @property
    def num_envs(self) -> int:
        """The number of its training environments."""
        return int(self.algorithm["num_envs"])

    def forget_end(self) -> None:
        """Wait again, without the results that training writes when it has continued."""
        self.status = "waiting"
        self.stopped = self.best = self.steps = self.seconds = self.steps_per_second = None
        self.succeeded = self.sha256 = self.kept = None
        self.final, self.policies = {}, {}

    def forget_files(self) -> None:
        """Forget what belongs to files of the run that it was trained in."""
        self.metrics_bytes = self.lineage_bytes = self.sha256 = None
        self.policies = {}
        self.starts = {}
        self.continued = []

    @property
    def needs_comparison(self) -> bool:
        """True if it must end with the best of several hierarchies."""
        return self.repair is not None or bool(self.compared or self.greedy_judged)

    @property
    def undone(self) -> bool:
        """True if the weights before it were better, and were kept."""
        return self.kept is not None and self.kept.kept == "before"


@dataclass(kw_only=True)
class Recorded:
    """A declaration in a file: in ``run.json``, or in the header of a hierarchy's weights."""

    env: Annotated[str, Check("a text of at most 300 characters", lambda x: len(x) <= 300)]
    env_kwargs: dict[str, Any]
    code: NoSetting[dict[str, str]] = field(default_factory=dict)
    """Texts of the environment and the skills, to be compared (``runs/user_code.py``)."""
    recipe: NoSetting[str | None] = None
    hierarchy: LevelEntry | None = None
    """The outermost hierarchy; None: a plain agent."""
    skills: list[SkillEntry] = field(default_factory=list)
    """The skills of all levels; those of a hierarchy follow it."""

    @property
    def by_path(self) -> dict[str, SkillEntry]:
        """The skills by path."""
        return {skill.name: skill for skill in self.skills}

    @property
    def levels(self) -> dict[str, LevelEntry]:
        """The hierarchies by path; the outermost one has the path ""."""
        entries = {"": self.hierarchy} | {skill.name: skill.hierarchy for skill in self.skills}
        return {path: entry for path, entry in entries.items() if entry is not None}


@dataclass(kw_only=True)
class Manifest(Recorded):
    """``run.json``."""

    seed: NoSetting[Count]
    stages: list[StageEntry]
    checkpoint_every: AtLeastOne
    eval_every: AtLeastOne | None
    eval_episodes: AtLeastOne
    keep: Literal["last", "best"] | None = None
    """The weights that stages end with; None: the last, or the best where a policy was given."""
    data: NoSetting[str | None] = None
    """The name of the data from which learners with a replay learn, too; None: there are none."""
    log_info: NoSetting[tuple[str, ...]]
    """Logged keys of ``info``."""
    log_calls: NoSetting[AtLeastOne | None] = None
    """Steps of the log of calls."""
    log_calls_info: NoSetting[tuple[str, ...]] = ()
    """Keys of ``info`` in it."""
    track: NoSetting[tuple[str, ...]] = ()
    needs_recipe: NoSetting[bool]
    resume_needs_recipe: NoSetting[bool]
    created: NoSetting[str] = ""
    """The time at which the run was made; empty, as the next two, before that."""
    versions: NoSetting[dict[str, str]] = field(default_factory=dict)
    id: NoSetting[str] = ""

    @property
    def kind(self) -> Literal["hierarchy", "agent"]:
        """The kind of what learns."""
        return "agent" if self.hierarchy is None else "hierarchy"


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
    """The origin of a member, in a run's files: its parent, and changed settings."""

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
    policy: AgentHeader


@dataclass(frozen=True)
class LineageLine:
    """A line of ``lineage.jsonl``: a member in a generation."""

    stage: NodePath
    generation: Count
    member: Count
    parent: Count | None
    """Its number in the generation before; its own where it continued."""
    mutation: str
    changes: dict[str, tuple[Any, Any]]
    fitness: float | None
    diverged: bool
    best: bool
    """It was the best so far."""
    steps: Count
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
    given: GivenScore | None = None
    """The score of the policy that the stage was given."""
    budget: AtLeastOne | None = None
    """The steps of a skill that acts seldom; None: those of its entry."""

    @classmethod
    def start(cls, stage: str) -> Self:
        """Return the header of a stage before its first update."""
        return cls(stage, 0, 0, 0, 0.0, {})


# Reading and writing ``run.json``

ADDED = ("evaluation", "evaluation_sampled", "handover")
"""Fields that ``Run.info`` adds to a manifest."""


def manifest_in(data: Mapping[str, Any], file: str = "") -> Manifest:
    """Return a manifest from JSON; a RunError names the file and the field where it is wrong.

    Fields that ``Run.info`` adds are left out.
    """
    own = {k: v for k, v in data.items() if k not in ADDED}
    manifest: Manifest = record_in(Manifest, own, file)
    for kind, entries in (("skills", manifest.skills), ("stages", manifest.stages)):
        names = [entry.name for entry in entries]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise RunError(f"{file}: {kind}[{i}].name is {shown(name)}, a second time")
    for path in manifest.levels:
        if not any(level_of(name) == path for name in manifest.by_path):
            of = f"of the hierarchy {path!r}" if path else "at all"
            raise RunError(": ".join(filter(None, [file, f"skills has no skill {of}"])))
    if manifest.hierarchy is None and len(manifest.stages) != 1:
        raise RunError(
            f"{file}: stages has {len(manifest.stages)} entries, but a plain agent has one"
        )
    for i, stage in enumerate(manifest.stages):
        where = f"stages[{i}]"
        config_from_json(stage.algorithm, file, f"{where}.algorithm")
        for name, algorithm in stage.algorithms.items():
            config_from_json(algorithm, file, f"{where}.algorithms[{name!r}]")
        if stage.done and None in (stage.steps, stage.seconds):
            raise RunError(f"{file}: {where} is done, but has no field 'steps' or 'seconds'")
    return manifest


def read_manifest(run: Path) -> Manifest:
    """Return the checked content of a run's ``run.json``."""
    file = run / "run.json"

    def checked(data: dict[str, Any]) -> Manifest:
        manifest = manifest_in(data, str(file))
        if "sha256" not in data:
            raise RunError(f"{file} is damaged: no field 'sha256', the checksum of its content")
        return manifest

    manifest: Manifest = read_json(file, checked)
    return manifest


def settings_of(manifest: Manifest) -> dict[str, Any]:
    """Return every setting in a manifest by its dotted name, without the seed.

    Runs that differ by their seed alone have equal settings.
    """
    values: dict[str, Any] = {"env": manifest.env}
    values |= flat(manifest.env_kwargs, "env_kwargs.")
    values["kind"] = manifest.kind
    if manifest.hierarchy is not None:
        # Its ready selector and its guide are compared by themselves, as code is.
        values |= _settings_in(replace(manifest.hierarchy, selector=None, guide=None))
    for name in _setting_names(Manifest):
        if name not in ("env", "env_kwargs", "hierarchy", "skills", "stages"):
            values[name] = getattr(manifest, name)
    for skill in manifest.skills:
        values |= flat(_settings_in(skill), f"skills.{skill.name}.")
    for stage in manifest.stages:
        values |= flat(_settings_in(stage), f"{stage.name}.")
        # Which run it starts from differs from seed to seed.
        values |= {f"{stage.name}.starts.{name}": "another run" for name in stage.starts}
    return values


def _settings_in(entry: LevelEntry | SkillEntry | StageEntry) -> dict[str, Any]:
    """Return the settings in an entry, as JSON."""
    names = _setting_names(type(entry))
    return {name: value for name, value in as_json(entry).items() if name in names}


def _setting_names(kind: type) -> tuple[str, ...]:
    """Return the fields of a class that are not marked as ``NoSetting``."""
    return tuple(k for k, hint in annotations_of(kind).items() if NO_SETTING not in get_args(hint))


OF_NO_WEIGHT = ("recipe", "track", "log_info", "log_calls", "log_calls_info", "code")
"""Fields that do not change what is learnt, or are compared by themselves."""
OF_A_RUN = ("id", "created", "versions")
"""Fields that a run gets when it is made."""


def identity(manifest: Manifest) -> str:
    """Return 16 letters that identify a new run.

    Runs that must end with the same weights have the same.
    """
    left_out = (*OF_NO_WEIGHT, *OF_A_RUN)
    settings = {k: v for k, v in as_json(manifest).items() if k not in left_out}
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[
        :16
    ]


def versions() -> dict[str, str]:
    """Return the versions of Skillweave, Python and dependencies for ``run.json``."""
    version_of = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("skillweave", "torch", "gymnasium", "numpy", "envpool"):
        try:
            version_of[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return version_of
