"""``sweep``: many runs of a recipe, here in processes or on Ray, and a table of their results.

Each run is an ordinary run directory. A sweep that was stopped, or one of its runs, continues when
the same command is given again, with the same code.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import platform
import re
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import astuple, dataclass, replace
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, TypedDict

import numpy as np

from skillweave._internal.messages import error_text, short
from skillweave._internal.shipped import file_of
from skillweave._internal.terminal import say
from skillweave.api import Hierarchy
from skillweave.api.loading import finished_run
from skillweave.api.recipe_file import hierarchy_in, imported
from skillweave.api.running import existing_run
from skillweave.cli import commands
from skillweave.cli.jobs import ProcessEnded, Processes
from skillweave.cli.output import Result
from skillweave.cli.overrides import apply_overrides
from skillweave.envs.make import cores
from skillweave.errors import DeclarationError, RunError, SkillweaveError
from skillweave.hierarchy import training
from skillweave.policies.untrusted import shown
from skillweave.reporting.groups import over_seeds
from skillweave.runs.files import read_json, write_json
from skillweave.runs.manifest import Manifest
from skillweave.schema import AtLeastOne, fit, fitted
from skillweave.training.evaluation_file import load_evaluation
from skillweave.workers.cluster import Ray
from skillweave.workers.shipping import is_own_code, packed, unpacked

MOST = 10_000
"""Runs of a sweep."""
RETRIES = 20
"""Most restarts of a run whose machine was lost; it continues from its checkpoint."""
EVALUATION_SEED = 0
"""Picks the episodes of each run's evaluation, which is greedy."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    settings: str
    """Its settings beside the seed, as "selector.gamma=0.99"; may be empty."""
    seed: int
    path: Path
    flat: bool
    evaluate: int

    def run(self, code: bytes) -> float | str:
        """Train a run of a sweep, or what is left of it; return its mean return, or an error."""
        try:
            if not (self.path.parent / MARK).exists():
                raise RunError(
                    f"{self.path.parent} is not seen from the machine {platform.node()}: with "
                    "--ray on several machines, --out must be in a directory that all share"
                )
            hierarchy = unpacked(code)
            trained = finished_run(hierarchy, self._manifest(hierarchy), self.path)
            score = trained.evaluate(
                self.evaluate, seed=EVALUATION_SEED, deterministic=True, save=True, quiet=True
            )
            return float(score.mean)
        except SkillweaveError as error:
            return str(error)
        except Exception as error:
            return error_text(error)

    def known(self, hierarchy: Hierarchy) -> float | str | None:
        """Return the result of ``run`` where nothing is left to do; else None."""
        try:
            run = existing_run(hierarchy, self._manifest(hierarchy), self.path)
            if run is None or not run.finished:
                return None
            saved = load_evaluation(run)
        except SkillweaveError as error:
            return str(error)
        if saved is None:
            return None
        as_in_sweep = saved.deterministic and saved.seed == EVALUATION_SEED
        whole = len(saved.evaluation.returns) == self.evaluate
        return float(saved.evaluation.mean) if as_in_sweep and whole else None

    def _manifest(self, hierarchy: Hierarchy) -> Manifest:
        return training.manifest(hierarchy, seed=self.seed, flat=self.flat)


def sweep(command: commands.SweepCommand) -> Result:
    """Train all runs of a sweep; return the results as JSON and for people."""
    fitted(AtLeastOne, command.evaluate, "evaluate")
    fitted(AtLeastOne | None, command.jobs, "jobs")
    seeds = parse_seeds(command.seeds)
    choices = parse_choices(command.set_each)
    if len(seeds) * len(choices) > MOST:
        raise DeclarationError(
            f"{len(seeds)} seeds of {len(choices)} settings are {len(seeds) * len(choices):,} "
            f"runs; at most {MOST:,} are made"
        )
    name = Path(command.recipe).stem + ("-flat" if command.flat else "")
    out = (command.out or Path("runs") / f"{name}-sweep").absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"could not write {out}: {error.strerror}") from error
    results: dict[Job, float | str] = {}
    jobs = list[Job]()
    tasks = list[tuple[bytes, Job]]()
    for settings, hierarchy in _hierarchies(command, choices):
        code = packed(hierarchy, command.recipe)
        must_be_same_code(out, command.recipe)  # each time, as the recipe was read again
        for seed in seeds:
            path = out / _file_name(settings, seed)
            job = Job(settings, seed, path, command.flat, command.evaluate)
            jobs.append(job)
            if (known := job.known(hierarchy)) is None:
                tasks.append((code, job))
            else:
                results[job] = known
    run = _on_ray if command.ray is not None else _in_processes
    try:
        for job, result in run(tasks, command) if tasks else ():
            results[job] = result
            if not command.quiet:
                score = result if isinstance(result, str) else f"return {result:.1f}"
                line = f"{len(results)} of {len(jobs)}: {job.path.name}: {score}"
                say(line)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{len(results)} of {len(jobs)} runs are finished; the same command continues"
        ) from None
    return summary([(job, results[job]) for job in jobs], out)


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of a sweep that "0:20" or "0,3,7" names."""
    try:
        if ":" in text:
            first, last = (int(part) for part in text.split(":"))
            seeds = list(range(first, last))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise DeclarationError(
            f"--seeds {short(text)}: write 0:20 for 0 to 19, or 0,3,7: whole numbers, each once"
        )
    return seeds


def parse_choices(each: Sequence[str]) -> list[tuple[str, ...]]:
    """Return all combinations of the values of ``--set-each``; without any, one empty one."""
    names = set[str]()
    options = []
    for setting in each:
        name, sign, text = (part.strip() for part in setting.partition("="))
        values = [v.strip() for v in re.split(r",(?![^(\[]*[)\]])", text)]
        if not sign or not all(values) or len(set(values)) < len(values):
            raise DeclarationError(
                f"--set-each {short(setting)}: write name=value,value, each value once, for "
                "example selector.gamma=0.99,0.995"
            )
        if name in names:
            raise DeclarationError(f"--set-each {name} is given twice; write all values at once")
        names.add(name)
        options.append([f"{name}={value}" for value in values])
    return list(itertools.product(*options))


def _hierarchies(
    command: commands.SweepCommand, choices: Sequence[tuple[str, ...]]
) -> Iterator[tuple[str, Hierarchy]]:
    """Yield each choice of a sweep's settings by name, and the hierarchy with these."""
    for choice in choices:
        hierarchy = hierarchy_in(command.recipe, Hierarchy)
        apply_overrides(hierarchy, [*command.set, *choice])
        hierarchy.scale(command.scale)
        # Runs share the cores, so each has one process, or as many as the recipe sets: the same
        # number on every machine.
        hierarchy.env = replace(hierarchy.spec, workers=hierarchy.spec.workers or 1)
        yield ", ".join(choice), hierarchy


def _file_name(settings: str, seed: int) -> str:
    letters = re.sub(r"[^\w.=(),+-]", "", settings.replace(", ", "+"))
    return f"{letters}-s{seed}" if letters else f"s{seed}"


Tasks = Sequence[tuple[bytes, Job]]


def _in_processes(
    tasks: Tasks, command: commands.SweepCommand
) -> Iterator[tuple[Job, float | str]]:
    """Do each run of a sweep in a process, as many at once as there are cores."""
    with Processes(min(command.jobs or cores(), len(tasks))) as pool:
        due = {pool.submit(job.run, code): job for code, job in tasks}
        for future in as_completed(due):
            try:
                yield due[future], future.result()
            except ProcessEnded as error:
                message = f"{error}; the same command continues it (fewer at once: --jobs)"
                yield due[future], message


def _on_ray(tasks: Tasks, command: commands.SweepCommand) -> Iterator[tuple[Job, float | str]]:
    """Do each run of a sweep as a task of Ray; one whose machine is lost continues on another."""
    cluster = Ray(address=command.ray or None)
    with cluster.joined(command.jobs or cores()) as ray:
        from skillweave.workers.actors import LOST, check_versions

        kind = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_task())
        good = [(metadata.version("skillweave"), platform.python_version())]
        codes = {code: ray.put(code) for code in {code for code, _ in tasks}}
        waiting = list(reversed(tasks))
        due = dict[Any, tuple[bytes, Job]]()
        while waiting or due:
            while waiting and len(due) < (command.jobs or MOST):
                code, job = waiting.pop()
                due[kind.remote(astuple(job), codes[code], good)] = code, job
            (ref, *_), _ = ray.wait(list(due))
            code, job = due.pop(ref)
            try:
                versions, result = ray.get(ref)
            except LOST as error:
                yield job, f"its process was lost repeatedly: {error_text(error)}"
            except ray.exceptions.RayError as error:
                yield job, error_text(error)
            else:
                if versions is None:
                    yield job, result
                    continue
                check_versions(versions)  # Python's last digit may be another
                good.append((versions["Skillweave"], versions["Python"]))
                waiting.append((code, job))


def _task() -> Callable[..., Any]:
    """Return the function that does a sweep's run on a node of Ray.

    It returns the node's versions where they do not fit, else None; and the run's result. It is
    sent to the nodes as code, so that it can report a node without Skillweave.
    """
    from skillweave.workers.actor_host import actor_class

    place = actor_class()()

    def task(job: tuple[Any, ...], code: bytes, good: Sequence[tuple[str, str]]) -> Any:
        """Train one run of a sweep on a node of Ray; return its versions and the result."""
        versions = place.versions()
        if (versions["Skillweave"], versions["Python"]) not in good:
            return versions, None
        from skillweave.cli.sweep import Job

        return None, Job(*job).run(code)

    return task


def summary(results: Sequence[tuple[Job, float | str]], out: Path) -> Result:
    """Return a sweep as JSON, and as a table with a line for each choice of settings.

    Args:
        results: runs, each with its mean return or an error.
        out: the sweep's directory.
    """
    groups = list[dict[str, Any]]()
    failed = list[dict[str, str]]()
    runs = list[dict[str, Any]]()
    for settings, rows in itertools.groupby(results, lambda result: result[0].settings):
        returns = []
        for job, score in rows:
            run = {"run": str(job.path)}
            if isinstance(score, str):
                failed.append(run | {"error": score})
                continue
            returns.append(score)
            runs.append(run | {"settings": settings, "seed": job.seed, "return": score})
        group: dict[str, Any] = {"settings": settings or "as declared", "runs": len(returns)}
        if returns:
            over = over_seeds(np.array(returns))
            group |= {"iqm": float(over.mean), "median": statistics.median(returns)}
            group |= {"least": min(returns), "most": max(returns)} | over.bounds
        groups.append(group)
    result = {"out": str(out), "groups": groups, "runs": runs, "failed": failed}
    failures = [f"failed  {f['run']}: {f['error']}" for f in failed]
    return result, "\n".join([*_table(groups), *failures, f"runs    {out}"])


def _table(groups: Sequence[dict[str, Any]]) -> list[str]:
    """Return the lines of the table that ``sweep`` prints."""
    wide = max(len(g["settings"]) for g in groups)
    head = f"{'settings':<{wide}} {'runs':>5} {'return':>9} {'95 % interval':>20} {'median':>9}"
    lines = [f"{head} {'least to most':>20}"]
    for g in groups:
        line = f"{g['settings']:<{wide}} {g['runs']:>5}"
        if g["runs"]:
            interval = f"{g['low']:.1f} to {g['high']:.1f}" if "low" in g else "one seed"
            line += f" {g['iqm']:>9.1f} {interval:>20} {g['median']:>9.1f}"
            line += f" {g['least']:>9.1f} to {g['most']:.1f}".rjust(21)
        lines.append(line)
    return [*lines, "return: the interquartile mean over seeds of the runs' mean returns"]


MARK = ".sweep"
"""A file in the sweep's directory; a machine that can read it shares the directory."""


class Mark(TypedDict):
    """Content of a sweep's file: its recipe, and the checksum of its code."""

    recipe: str
    """The recipe, as the user named it."""
    code: str
    """A checksum of its code."""


def must_be_same_code(out: Path, recipe: str) -> None:
    """Write the checksum of the recipe's code into a sweep's directory, or compare with it.

    The recipe must be loaded, so that the modules that it imports are known. It may be mended where
    no run has learnt yet, for example where it failed at its first step.

    Raises:
        RunError: the runs there are trained by other code; or the directory cannot be
            written.
    """
    file = out / MARK
    code = _checksum(code_files(file_of(recipe)))
    learnt = any(out.glob("*/checkpoint*")) or any(out.glob("*/policies/*"))
    if not learnt or not file.exists():
        write_json(file, Mark(recipe=recipe, code=code))
        return
    mark: Mark = fit(Mark, read_json(file), str(file))
    if mark["code"] != code:
        raise RunError(
            f"{out} holds runs of the recipe {shown(mark['recipe'], 500)}, which were not trained "
            f"by the code of {recipe} as it is now: it is another recipe, or it was edited since, "
            "or a module of yours that it imports was. One table would mix both. Choose another "
            f"directory (--out), or delete {out}. If what was edited cannot change results, as a "
            f"comment cannot, delete {file} alone"
        )


def code_files(recipe: Path) -> dict[str, Path]:
    """Return the recipe's file of a sweep, and by name the user's modules that it imports.

    Of a shipped recipe these are its parts.
    """
    files = {"": recipe}
    due = [(recipe, "")]
    while due:
        file, package = due.pop()
        if file.suffix != ".py":  # compiled
            continue
        for name in imported(file.read_bytes(), package):
            module = sys.modules.get(name)
            if module is None or name in files or not _is_part(module):
                continue
            files[name] = Path(str(module.__file__))
            due.append((files[name], module.__package__ or ""))
    return files


def _checksum(files: Mapping[str, Path]) -> str:
    """Return a checksum of a recipe's modules: their names, and the contents of their files."""
    sums = {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
    return hashlib.sha256(json.dumps(sums, sort_keys=True).encode()).hexdigest()


def _is_part(module: ModuleType) -> bool:
    return is_own_code(module) or module.__name__.startswith("skillweave.recipes._")
