"""Commands of the core as dataclasses: the parser is generated from these, and extensions' own.

Nothing here imports torch or gymnasium, so that help and argument errors are instant.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, UseAppendAction, arg

from skillweave._internal.messages import error_text
from skillweave._internal.notices import notice
from skillweave.errors import MissingExtra
from skillweave.extensions import fetch_from, names_of

Out = Annotated[Path, arg(aliases=["-o"])]
"""A place to write to."""
MaybeOut = Annotated[Path | None, arg(aliases=["-o"])]
"""A place to write to; None: a default place."""
Words = UseAppendAction[tuple[str, ...]]
"""Words of an option that may be given several times."""
Runs = Annotated[Positional[tuple[Path, ...]], arg(help_behavior_hint="(one or more)")]
"""Directories of runs, or of sweeps."""


@dataclass(frozen=True)
class Output:
    """The form of results."""

    quiet: bool = False
    """No progress."""
    json: bool = False
    """Print one JSON object on standard output, and nothing else there."""
    traceback: bool = False
    """Show the whole traceback of an error (also: SKILLWEAVE_TRACEBACK=1)."""


@dataclass(frozen=True)
class Coded(Output):
    """A command that may need the code of a hierarchy."""

    recipe: str | None = None
    """The file that declares the hierarchy, unless it is a shipped recipe."""


@dataclass(frozen=True)
class OfRun(Output):
    """A command about a run."""

    run: Positional[Path] = tyro.MISSING
    """The run's directory."""


@dataclass(frozen=True)
class Loaded(Coded):
    """A command that loads a policy."""

    target: Positional[str] = tyro.MISSING
    """A run's directory, a weights file, or with --pretrained a recipe's name."""
    pretrained: bool = False
    """Take the shipped weights of a shipped recipe."""


@dataclass(frozen=True)
class OfEpisodes(Output):
    """A command that plays episodes."""

    seed: int = 0
    """Picks the episodes."""
    deterministic: bool = True
    """Act greedily, or (--no-deterministic, --stochastic) sample."""


@dataclass(frozen=True)
class OnRay(Output):
    """A command that can run on Ray."""

    ray: str | None = None
    """Use Ray: --ray alone on this machine (or at RAY_ADDRESS), or --ray HOST:PORT, or
    --ray auto for the cluster that this machine is a part of."""


@dataclass(frozen=True)
class TrainCommand(OnRay):
    """Train a recipe: every skill, then the selector."""

    recipe: Positional[str] = tyro.MISSING
    """A shipped recipe (skillweave list), or a Python file that defines a Hierarchy."""
    out: MaybeOut = None
    """A new directory for the run; default: the next number of runs/NAME-N."""
    resume: bool = False
    """Continue the run in this directory, or start one; with more steps (--scale, --set steps=N)
    also a finished one."""
    overwrite: bool = False
    """Replace the run in this directory, also a finished one."""
    seed: int = 0
    """The root of every random stream."""
    flat: bool = False
    """Train one plain agent on the same number of steps instead: the baseline."""
    versus_flat: bool = False
    """Afterwards train the baseline too, on the same number of steps, and print which is better."""
    set: Words = ()
    """Change a setting, for example: --set selector.gamma=0.99 (skillweave info RECIPE)."""
    start_from: Words = ()
    """Another run: learners of the same names start with what they learnt there (not
    --versus-flat's agent). Several runs: --start-from left=RUN --start-from right=RUN."""
    keep: Literal["last", "best"] | None = None
    """best: end with the weights whose evaluation while training was best, not with the last ones
    (needs --set train.eval_every=STEPS, if the recipe does not set it)."""
    log_info: Words = ()
    """A key of info, for example: --log-info distance. Its mean at the ends of episodes is
    info/distance in metrics.jsonl and in trackers."""
    evolve: Words = ()
    """Evolve a population: --evolve population=8; of one agent: --evolve selector.population=8."""
    track: UseAppendAction[tuple[Literal["tensorboard", "wandb", "mlflow"], ...]] = ()
    """Send metrics to a tracker as well."""
    scale: float = 1.0
    """Multiply every training budget: 0.1 for a quick look."""
    evaluate: int = 100
    """Episodes of the final evaluation; 0: none."""
    render: bool = False
    """Write a captioned GIF into the run as well."""
    collectors: int | None = None
    """Processes, or with --ray actors, that step environments, or train the parts of a population;
    default: the recipe's, else measured. Results depend on their number, not on where they are."""


@dataclass(frozen=True)
class ResumeCommand(OnRay, Coded, OfRun):
    """Finish a run that was stopped; the end is the same as if it had not been."""

    evaluate: int = 100
    """Episodes of the final evaluation; 0: none."""


@dataclass(frozen=True)
class SweepCommand(OnRay):
    """Train a recipe with many seeds and settings; what is finished is not trained again."""

    recipe: Positional[str] = tyro.MISSING
    """A shipped recipe, or a Python file that defines a Hierarchy."""
    seeds: str = "0:5"
    """0:20 for 0 to 19, or 0,3,7."""
    set_each: Words = ()
    """Try each of these values: --set-each selector.gamma=0.99,0.995. Of several settings, all
    combinations."""
    set: Words = ()
    """Change a setting in all runs."""
    out: MaybeOut = None
    """A directory for the runs, old or new; default: runs/NAME-sweep. With --ray on several
    machines all must see it."""
    flat: bool = False
    """Train one plain agent on the same number of steps instead: the baseline."""
    scale: float = 1.0
    """Multiply every training budget."""
    evaluate: int = 100
    """Episodes of each run's evaluation."""
    jobs: int | None = None
    """Runs at once; default: one for each core, or for each CPU of the cluster."""


@dataclass(frozen=True)
class Watched(OfEpisodes, Loaded):
    """A command that loads a policy and lets it act."""

    skill: str | None = None
    """One skill alone, with the hierarchy's reflexes in force."""
    goal: str | None = None
    """Its goal, as JSON, such as --goal "[0.5, 0.8]"; default: its goals() draw one."""


@dataclass(frozen=True)
class EvaluateCommand(Watched):
    """Score a policy on Gymnasium's environment."""

    episodes: int = 100
    """Whole episodes."""
    num_envs: int | None = None
    """Environments that exist at once; default: at most as many as in training."""


@dataclass(frozen=True)
class RenderCommand(Watched):
    """Write a captioned GIF or MP4."""

    out: MaybeOut = None
    """A .gif or .mp4 file; default: NAME.gif here."""
    episodes: int = 1
    """Whole episodes."""


@dataclass(frozen=True)
class LogCommand(Coded, OfRun):
    """Let a run's skills act, and record their calls in the run: for info, report and plan."""

    steps: int = 20_000
    """Environment steps to record; they are joined with those that the run has."""
    choose: Literal["random", "explore"] = "random"
    """Choose skills at random, or where they were not tried yet."""
    info: Words = ()
    """Record this key of the environment's info, too, for tasks that read it."""
    seed: int | None = None
    """Seed of the environments and the choices; default: one that the run's log does not have."""


@dataclass(frozen=True)
class PlotCommand(Output):
    """Draw learning curves as PNG and SVG: of one run, or of many seeds with bands, for a paper.

    Of one run: how each agent learnt, or how its population evolved.
    """

    runs: Runs = tyro.MISSING
    """Runs or sweeps. Of several, those that differ by their seed alone are one line."""
    out: MaybeOut = None
    """Directory of the plots of one run (default: plots, in the run), or, of several runs, the
    files without their suffix (default: curves)."""
    metric: str | None = None
    """Metric to draw of several runs; default: eval_return where all have it, else return."""
    agent: str | None = None
    """Skill or selector to draw of several runs; default: the whole policy."""
    band: Literal["iqr", "range", "none"] = "iqr"
    """Band around a line of several seeds: 25th to 75th percentile, lowest to highest, or none."""
    label: Words = ()
    """Name of a line in the figure of several runs, once for each line, in their order."""
    width: float = 3.3
    """Width of the figure of several runs in inches; a column of a paper has 3.3."""


@dataclass(frozen=True)
class ListCommand(Output):
    """List the shipped recipes, and the runs under ./runs."""


@dataclass(frozen=True)
class InfoCommand(Output):
    """Show what a run holds, or a recipe's settings."""

    target: Positional[str] = tyro.MISSING
    """A run's directory, or a recipe."""


@dataclass(frozen=True)
class WeightsCommand(Coded, OfRun):
    """Write a run's policies into one weights file."""

    out: Out = Path("weights.safetensors")
    """The file to write."""


@dataclass(frozen=True)
class ExportCommand(Loaded):
    """Write a policy for machines without this library: ONNX files and a runner of one file."""

    onnx: bool = False
    """Choose ONNX, the only format so far; required, so that a later format is a choice, too."""
    out: MaybeOut = None
    """The folder to write; default: NAME-onnx here."""


@dataclass(frozen=True)
class PushCommand(OfRun):
    """Put a finished run on the Hugging Face Hub, with a page about it."""

    name: Positional[str] = tyro.MISSING
    """OWNER/NAME on the hub; made if it is not there. An older run there is replaced."""
    private: bool = False
    """Others may not read it."""
    calls: bool = False
    """With the log of calls, so that others can plan without recording one."""


@dataclass(frozen=True)
class PullCommand(Output):
    """Copy a run from the Hugging Face Hub into a new folder."""

    name: Positional[str] = tyro.MISSING
    """OWNER/NAME on the hub."""
    out: MaybeOut = None
    """A new directory for the run; default: runs/NAME, numbered if taken."""
    revision: str | None = None
    """A branch, a tag or a commit; default: the latest."""


CommandEntry = tuple[type[Output], str]
"""A command, and "module:function", which is given it and returns its ``Result``."""
OF_CORE: tuple[CommandEntry, ...] = (
    (TrainCommand, "skillweave.cli.training_commands:train"),
    (ResumeCommand, "skillweave.cli.training_commands:resume"),
    (SweepCommand, "skillweave.cli.sweep:sweep"),
    (EvaluateCommand, "skillweave.cli.execute:evaluate"),
    (RenderCommand, "skillweave.cli.execute:render"),
    (LogCommand, "skillweave.cli.execute:log"),
    (PlotCommand, "skillweave.cli.execute:plot"),
    (ListCommand, "skillweave.cli.execute:list_all"),
    (InfoCommand, "skillweave.cli.execute:info"),
    (WeightsCommand, "skillweave.cli.execute:weights"),
    (ExportCommand, "skillweave.cli.execute:export"),
    (PushCommand, "skillweave.cli.execute:push"),
    (PullCommand, "skillweave.cli.execute:pull"),
)
"""The commands of the core."""


def name_of(command: type) -> str:
    """Return the name of a command: import-agilerl for ImportAgilerlCommand."""
    return re.sub(r"(?<!^)(?=[A-Z])", "-", command.__name__.removesuffix("Command")).lower()


@cache
def all_commands() -> dict[str, CommandEntry]:
    """Return the commands of the core and of the extensions that are installed, by name."""
    entries = {name_of(entry[0]): entry for entry in OF_CORE}
    for name in names_of("command"):
        try:
            entries[name] = fetch_from("command", name)
        except MissingExtra:
            continue  # ``missing`` says so where it is called
        except Exception as error:  # of another package, which must not end all commands
            notice(f"the command {name!r} cannot be loaded: {error_text(error)}")
    return entries


def missing(words: Sequence[str]) -> str:
    """Return a sentence where words name a command of an extension that is not installed."""
    if not words or words[0] not in names_of("command"):
        return ""
    try:
        fetch_from("command", words[0])
    except MissingExtra as error:
        return str(error)
    return ""
