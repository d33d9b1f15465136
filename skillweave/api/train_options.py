"""The options of ``train``, ``resume`` and ``train_agent``: one list for all of them."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields
from functools import cache, wraps
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, get_type_hints, overload

import gymnasium as gym

from skillweave._internal.arguments import checked_names
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.api.starting import StartFrom
from skillweave.envs.make import EnvSpec
from skillweave.errors import DeclarationError
from skillweave.evolution.evolving import Evolve
from skillweave.runs.manifest import Manifest
from skillweave.schema import AtLeastOne, Count, fitted
from skillweave.training.callback import Callback, check_callback
from skillweave.training.options import CallReports, Continuing, Reports, Starting
from skillweave.workers.cluster import Ray


@dataclass(frozen=True, kw_only=True)
class Watched(Continuing):
    """Options of every training in Python, also of a repair.

    Raises:
        DeclarationError: one of them is wrong.
    """

    callback: Callback | None = None
    """A function that is called with a ``TrainEvent`` for each report of training and each
    checkpoint. Where it returns False, the stage ends with what it has learnt, as at a target, and
    the next one starts. An exception in it stops the training and leaves ``train`` unchanged; the
    run can be resumed from its last checkpoint. It is called in this process, and is not stored in
    the run."""

    def __post_init__(self) -> None:
        check_callback(self.callback)


@dataclass(frozen=True, kw_only=True)
class Going(Watched):
    """Options of a training that may run on a cluster, or evolve.

    Raises:
        DeclarationError: one of them is wrong.
    """

    evolve: Evolve = None
    """A population for every stage, or for some by name (a skill's, "selector", "agent"). Its
    budget is the stage's for each member, measuring fitness included. Skills and selector of a
    population cannot learn together yet: they learn apart. A run that continues needs it only where
    the population evolves by a selection of your own."""
    cluster: Ray | None = None
    """Run collectors, or parts of a population, on ``Ray``; None: here, in processes where it pays.
    A run that continues keeps their number."""

    def __post_init__(self) -> None:
        super().__post_init__()
        fitted(Ray | None, self.cluster, "cluster")


@dataclass(frozen=True)
class ResumeOptions(Going):
    """Options of ``resume``."""

    run_dir: str | Path
    """The run's directory."""


@dataclass(frozen=True)
class AgentOptions(Going, Reports, Starting):
    """Options of the training of a plain agent.

    Raises:
        DeclarationError: one of them is wrong, or two do not fit together.
    """

    run_dir: str | Path | None = None
    """A new directory; None: the next number of ``runs/<name>-<n>``, named after the recipe, the
    hierarchy or the environment. A run that has saved nothing yet is replaced, unless a process
    trains it; any other only with ``overwrite``."""
    _: KW_ONLY
    track: Sequence[str] = ()
    """Any of "tensorboard", "wandb" and "mlflow": one, or a list."""
    start_from: StartFrom = None
    """Another run, or its directory: a learner that has learnt there, by the same name, starts with
    its policy. Or several runs, by learner: ``{"left": run, "right": other}``; a run of a plain
    agent fits any name. The policy is copied (of PPO and DQN all networks, of SAC and TD3 the
    actor). The task may be another one; spaces, networks and the names of a selector's skills must
    be the same. In place of a run also ``from_sb3(..., learn=True)`` or ``from_torch``'s."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, kind in get_type_hints(Starting).items():
            kind = Count if name == "seed" else kind
            object.__setattr__(self, name, fitted(kind, getattr(self, name), name))
        track = fitted(str | Sequence[str], self.track, "track")
        for word in ("resume", "overwrite"):
            if getattr(self, word) and self.run_dir is None:
                raise DeclarationError(
                    f'{word}=True needs a run: name its directory, train("runs/a", {word}=True)'
                )
        if self.resume and self.overwrite:
            raise DeclarationError(
                "resume continues the run in run_dir, and overwrite replaces it: leave out one of "
                "them"
            )
        object.__setattr__(self, "track", (track,) if isinstance(track, str) else tuple(track))

    def for_manifest(self) -> dict[str, Any]:
        """Return the options that a run's manifest records as they are given, by name.

        Those on reports are in it already: the declaration's defaults complete them.
        """
        names = {f.name for f in fields(AgentOptions)} & {f.name for f in fields(Manifest)}
        names -= {f.name for f in fields(CallReports)}
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class TrainOptions(AgentOptions, CallReports):
    """Options of the training of a hierarchy."""

    flat: bool | AlgorithmConfig = False
    """Train one plain agent for the same number of steps instead: the baseline. True: with the
    settings of ``train_defaults``; or its settings."""


@dataclass(frozen=True)
class _Task:
    """The task of a plain agent: environment, algorithm and budget."""

    env: str | Callable[[], gym.Env[Any, Any]] | EnvSpec
    """A Gymnasium id, a function that makes an environment, or an ``EnvSpec``."""
    algorithm: AlgorithmConfig
    """Its settings, ``SAC()`` for example."""
    steps: int
    """Training budget in environment steps."""


@dataclass(frozen=True, kw_only=True)
class AgentTraining(AgentOptions, _Task):
    """Arguments of ``train_agent``."""

    target_return: float | None = None
    """Stop early at this mean return of the periodic evaluation."""
    target_success: float | None = None
    """Stop early at this share of episodes with a true ``info["success"]``, or
    ``info["is_success"]`` where that is missing."""


@dataclass(frozen=True)
class _Pair:
    """The handover that is repaired."""

    skill: str
    """The skill that fails, by its path."""
    _: KW_ONLY
    after: str
    """The skill after which it fails, of the same selector."""


@dataclass(frozen=True, kw_only=True)
class RepairOptions(Watched, _Pair):
    """Arguments of ``Run.repair``.

    Raises:
        DeclarationError: one of them is wrong.
    """

    steps: int | None = None
    """Environment steps of training; measuring takes more. None: 200,000."""
    run_dir: str | Path | None = None
    """A new directory; None: the next number of ``runs/<name>-repair-<n>``."""
    done: Mapping[str, Any] | None = None
    """By skill, the event that a call is for, in place of the skill's ``success``; as for
    ``planning.handover``."""
    calls: int = 200
    """Calls of the pair to measure at least, before and after; fewer where 500,000 steps do not
    hold them."""
    seed: int = 0
    """The root of every random stream."""
    resume: bool = False
    """Finish the repair in ``run_dir``, with its own steps and settings."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, kind in (("steps", AtLeastOne | None), ("calls", AtLeastOne), ("seed", Count)):
            object.__setattr__(self, name, fitted(kind, getattr(self, name), name))

    @property
    def training(self) -> AgentOptions:
        """The options of the training in it."""
        return AgentOptions(self.run_dir, seed=self.seed, quiet=self.quiet, callback=self.callback)


P = ParamSpec("P")
S = TypeVar("S")
Options = TypeVar("Options")
R = TypeVar("R")


class Takes(Generic[P, Options]):
    """A decorator of functions of an object with options: users give the options one by one.

    Signature and "Args:" are those of the options, and wrong arguments are named as by
    ``checked_names``.

    Args:
        options: their dataclass.
    """

    def __init__(self, options: Callable[P, Options]) -> None:
        self._options = options

    @overload
    def __call__(self, function: Callable[[Options], R]) -> Callable[P, R]: ...

    @overload
    def __call__(self, function: Callable[[S, Options], R]) -> Callable[Concatenate[S, P], R]: ...

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function with options as its arguments."""
        signature = inspect.signature(function)
        owner = list(signature.parameters.values())[:-1]
        taken = inspect.signature(self._options).parameters.values()

        @wraps(function)
        def taking(*args: Any, **named: Any) -> Any:
            own = args[: len(owner)]
            return function(*own, self._options(*args[len(owner) :], **named))

        public: Any = taking
        public.__signature__ = signature.replace(parameters=[*owner, *taken])
        whole, mark, rest = (inspect.getdoc(function) or "").partition("Returns:\n")
        listed = "\n".join(map(self._described, taken))
        public.__doc__ = f"{whole}Args:\n{listed}\n\n{mark}{rest}"
        return checked_names(taking)

    def _described(self, option: inspect.Parameter) -> str:
        """Return the text under the field of an option, as an entry of a docstring."""
        kinds: Any = self._options
        texts = (_texts(k.__module__).get(f"{k.__name__}.{option.name}") for k in kinds.__mro__)
        text = " ".join(next(filter(None, texts), "").split())
        text = f"{option.name}: {text[:1].lower()}{text[1:]}"
        return fill(text, 96, initial_indent=" " * 4, subsequent_indent=" " * 8)


@cache
def _texts(module: str) -> dict[str, str]:
    """Return the texts under the fields of a module's dataclasses; none where it has no source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return {}
    return {
        f"{kind.name}.{ast.unparse(field.target)}": ast.literal_eval(text.value)
        for kind in tree.body
        if isinstance(kind, ast.ClassDef)
        for field, text in pairwise(kind.body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)
    }
