"""``sweep``: many runs of a recipe, here in processes or on Ray; the table of what came out.

Each run is an ordinary run directory. So whoever is stopped, the sweep or one of its runs, goes on
where it stood when the same command is given again.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import platform
import re
import signal
import statistics
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skillweave import recipes
from skillweave.api.training import finish
from skillweave.cli import commands
from skillweave.cli.overrides import apply_overrides
from skillweave.collecting.cluster import Ray
from skillweave.collecting.shipping import packed, unpacked
from skillweave.envs.make import cores
from skillweave.hierarchy import training
from skillweave.messages import short, told, whole_number
from skillweave.reporting.report.seeds import over_seeds
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation_file import load_evaluation
from skillweave.types import SkillweaveError

MOST = 10_000
"""Runs of a sweep."""
MARK = ".sweep"
"""An empty file in the sweep's directory, by which a machine knows that it sees it."""
RETRIES = 20
"""How often Ray begins a run again whose machine was lost; it goes on from its checkpoint."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    settings: str
    """What it differs in from the others, beside the seed: "selector.gamma=0.99"; may be empty."""
    seed: int
    path: Path
    flat: bool
    evaluate: int

    def run(self, code: bytes) -> float | str:
        """Train it, or what is left of it, and evaluate it: its mean return, or what went wrong."""
        try:
            if not (self.path.parent / MARK).exists():
                raise SkillweaveError(
                    f"{self.path.parent} is not seen from the machine {platform.node()}: with "
                    "--ray on several machines, --out must be in a directory that all share"
                )
            hierarchy = unpacked(code)
            content = training.manifest(hierarchy, seed=self.seed, flat=self.flat)
            trained = finish(hierarchy, content, self.path)
            saved = load_evaluation(RunDirectory.open(self.path))
            if saved is not None and len(saved.evaluation.returns) == self.evaluate:
                return float(saved.evaluation.mean)
            return float(trained.evaluate(self.evaluate, save=True).mean)
        except SkillweaveError as error:
            return str(error)
        except Exception as error:
            return told(error)


def sweep(command: commands.Sweep) -> tuple[dict[str, Any], str]:
    """Train all runs of a sweep; what came out, as JSON and for people."""
    whole_number(command.evaluate, "evaluate", 1)
    if command.jobs is not None:
        whole_number(command.jobs, "jobs", 1)
    seeds, choices = parse_seeds(command.seeds), parse_choices(command.set_each)
    if len(seeds) * len(choices) > MOST:
        raise SkillweaveError(
            f"{len(seeds)} seeds of {len(choices)} settings are {len(seeds) * len(choices):,} "
            f"runs; at most {MOST:,} are made"
        )
    name = Path(command.recipe).stem + ("-flat" if command.flat else "")
    out = (command.out or Path("runs") / f"{name}-sweep").absolute()
    tasks = [
        (
            code,
            Job(settings, seed, out / _file_name(settings, seed), command.flat, command.evaluate),
        )
        for settings, code in _codes(command, choices)
        for seed in seeds
    ]
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARK).touch()
    except OSError as error:
        raise SkillweaveError(f"could not write {out}: {error.strerror}") from error
    found: dict[Job, float | str] = {}
    run = _on_ray if command.ray is not None else _in_processes
    try:
        for job, result in run(tasks, command):
            found[job] = result
            if not command.quiet:
                says = result if isinstance(result, str) else f"return {result:.1f}"
                line = f"{len(found)} of {len(tasks)}: {job.path.name}: {says}"
                print(line, file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{len(found)} of {len(tasks)} runs are finished; the same command goes on"
        ) from None
    return _summary([(job, found[job]) for _, job in tasks], out)


def parse_seeds(text: str) -> list[int]:
    """The seeds that "0:20" or "0,3,7" names."""
    try:
        if ":" in text:
            first, last = (int(part) for part in text.split(":"))
            seeds = list(range(first, last))
        else:
            seeds = [int(part) for part in text.split(",")]
    except ValueError:
        seeds = []
    if not seeds or min(seeds) < 0 or len(set(seeds)) < len(seeds):
        raise SkillweaveError(
            f"--seeds {short(text)}: write 0:20 for 0 to 19, or 0,3,7: whole numbers, each once"
        )
    return seeds


def parse_choices(each: Sequence[str]) -> list[tuple[str, ...]]:
    """All combinations of the values of ``--set-each``, as settings; one without any if none."""
    names, options = set[str](), []
    for setting in each:
        name, sign, text = (part.strip() for part in setting.partition("="))
        values = [v.strip() for v in re.split(r",(?![^(\[]*[)\]])", text)]
        if not sign or not all(values) or len(set(values)) < len(values):
            raise SkillweaveError(
                f"--set-each {short(setting)}: write name=value,value, each value once, for "
                "example selector.gamma=0.99,0.995"
            )
        if name in names:
            raise SkillweaveError(f"--set-each {name} is given twice; write all values at once")
        names.add(name)
        options.append([f"{name}={value}" for value in values])
    return list(itertools.product(*options))


def _codes(
    command: commands.Sweep, choices: Sequence[tuple[str, ...]]
) -> Iterator[tuple[str, bytes]]:
    """For each choice its name, and the hierarchy with these settings, packed."""
    for choice in choices:
        hierarchy = recipes.load(command.recipe)
        apply_overrides(hierarchy, [*command.set, *choice])
        hierarchy.scale(command.scale)
        # Runs share the cores, so each has one; and it is the same whichever machine it is on.
        hierarchy.env = replace(hierarchy.spec, workers=1)
        yield ", ".join(choice), packed(hierarchy, command.recipe)


def _file_name(settings: str, seed: int) -> str:
    kept = re.sub(r"[^\w.=(),+-]", "", settings.replace(", ", "+"))
    return f"{kept}-s{seed}" if kept else f"s{seed}"


Tasks = Sequence[tuple[bytes, Job]]


def _in_processes(tasks: Tasks, command: commands.Sweep) -> Iterator[tuple[Job, float | str]]:
    """Each run in a process of its own, so many at once as there are cores."""
    with processes(min(command.jobs or cores(), len(tasks))) as pool:
        due = {pool.submit(job.run, code): job for code, job in tasks}
        for future in as_completed(due):
            try:
                yield due[future], future.result()
            except BrokenProcessPool:
                raise SkillweaveError(
                    "a run's process was ended, perhaps because memory ran out; runs that are "
                    "finished are kept, and the same command goes on (fewer at once: --jobs)"
                ) from None


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes that end when this one does, however it ends."""
    start = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, start, initializer=_end_with_parent, max_tasks_per_child=1)
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    pool.shutdown()


def _end_with_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_ray(tasks: Tasks, command: commands.Sweep) -> Iterator[tuple[Job, float | str]]:
    """Each run as a task of Ray; one whose machine is lost goes on elsewhere."""
    cluster = Ray(address=command.ray or None)
    with cluster.joined(command.jobs or cores()) as ray:
        kind = ray.remote(num_cpus=1, max_retries=RETRIES, max_calls=1)(_run)
        codes = {code: ray.put(code) for code in {code for code, _ in tasks}}
        waiting, due = list(reversed(tasks)), dict[Any, Job]()
        while waiting or due:
            while waiting and len(due) < (command.jobs or MOST):
                code, job = waiting.pop()
                due[kind.remote(job, codes[code])] = job
            (ref, *_), _ = ray.wait(list(due))
            job = due.pop(ref)
            try:
                yield job, ray.get(ref)
            except ray.exceptions.RayError as error:
                yield job, f"its process was lost again and again: {told(error)}"


def _run(job: Job, code: bytes) -> float | str:
    return job.run(code)


def _summary(results: Sequence[tuple[Job, float | str]], out: Path) -> tuple[dict[str, Any], str]:
    """The table: a line for each choice of settings, over its seeds."""
    groups, failed = [], []
    for settings, own in itertools.groupby(results, lambda result: result[0].settings):
        returns = []
        for job, result in own:
            if isinstance(result, str):
                failed.append({"run": str(job.path), "error": result})
            else:
                returns.append(result)
        group: dict[str, Any] = {"settings": settings or "as declared", "runs": len(returns)}
        if returns:
            found = over_seeds(np.array(returns))
            group |= {"iqm": float(found.mean), "median": statistics.median(returns)}
            group |= {"least": min(returns), "most": max(returns)}
            if found.low is not None and found.high is not None:
                group |= {"low": float(found.low), "high": float(found.high)}
        groups.append(group)
    runs = [
        {"run": str(j.path), "settings": j.settings, "seed": j.seed, "return": r}
        for j, r in results
        if not isinstance(r, str)
    ]
    result = {"out": str(out), "groups": groups, "runs": runs, "failed": failed}
    return result, "\n".join([*_table(groups), *_failures(failed), f"runs    {out}"])


def _table(groups: Sequence[dict[str, Any]]) -> list[str]:
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


def _failures(failed: Sequence[dict[str, str]]) -> list[str]:
    return [f"failed  {f['run']}: {f['error']}" for f in failed]
