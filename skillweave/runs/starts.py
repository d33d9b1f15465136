"""What learners of a run begin with, where they have learnt in another run before.

It is copied into the run when that begins, so a run needs no other one to go on.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.policy import AgentPolicy
from skillweave.errors import DeclarationError, RunError
from skillweave.runs.command_words import resume_words
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import (
    check_unchanged,
    make_directory,
    read_signed,
    remove,
    write_tensors,
)


@dataclass(frozen=True)
class Learnt:
    """What one has learnt in the finished stages of another run."""

    policy: AgentPolicy
    sha256: str
    """Of its file there."""
    steps: int
    """Environment steps that it learnt from."""
    run: str | None
    """That run's ``id``."""
    chooses: Chooses
    """From what it chooses, if it is a selector or a critic of skills."""


Chooses = tuple[tuple[str, ...], tuple[int, ...]]
"""Names of skills in their order, and lengths of calls that may be chosen."""


def learnt_in(path: Path) -> dict[str, Learnt]:
    """By name, who has learnt in a run, as they were at the end of their latest finished stage.

    Raises:
        RunError: there is no run, a file of it is damaged, or nobody has found out yet
            whether what it learnt together is better than what was there before.
    """
    run, found = RunDirectory.open(path), dict[str, Learnt]()
    if run.unjudged and all(entry["status"] == "done" for entry in run.manifest["stages"]):
        raise RunError(
            f"start_from: {path} was stopped before its end, while what it learnt was compared "
            f"with what was there before; finish it first: {resume_words(run)}"
        )
    for entry in run.manifest["stages"]:
        if entry["status"] != "done" or entry.get("kept", {}).get("kept") == "before":
            continue
        sums = entry.get("policies") or {entry["name"]: entry.get("sha256")}
        for name, policy in run.load_policies(entry["name"]).items():
            sha256 = sums[name]
            steps = entry["steps"] + (found[name].steps if name in found else 0)
            chooses = chosen_from(run.manifest, name)
            found[name] = Learnt(policy, sha256, steps, run.manifest.get("id"), chooses)
    return found


def chosen_from(manifest: Mapping[str, Any], name: str) -> Chooses:
    """From what one who learns in a run chooses, if it is a selector or a critic of skills."""
    node, _, own = name.rpartition("/")
    if own not in ("selector", "skill_critic"):
        return (), ()
    within = f"{node}/" if node else ""
    told: Mapping[str, Any] = manifest
    if node:
        told = next(s for s in manifest["skills"] if s["name"] == node)["hierarchy"]
    names = [s["name"] for s in manifest["skills"] if s["name"].startswith(within)]
    skills = tuple(k for k in (name.removeprefix(within) for name in names) if "/" not in k)
    return skills, tuple(told.get("call_lengths", ())) if own == "selector" else ()


def begin_with(stages: list[dict[str, Any]], learnt: Mapping[str, Learnt], where: str) -> set[str]:
    """Write into the entries of a new run's stages who begins with what; their names.

    Args:
        where: the other run, or runs, for messages.

    Raises:
        RunError: no learner of this run has learnt in the other one.
        DeclarationError: a population is to begin with what was learnt.
    """
    begun: set[str] = set()
    for entry in stages:
        own = [name for name in entry["learns"] if name in learnt and name not in begun]
        begun |= set(own)
        if own and entry.get("evolution") is not None:
            raise DeclarationError(
                f"start_from: stage {entry['name']!r} evolves, and members of a population begin "
                f"with settings and networks of their own, not with what {where} holds. Leave out "
                "start_from, or evolve only who has not learnt there: evolve={...}"
            )
        if own:
            entry["starts"] = {
                name: {k: getattr(learnt[name], k) for k in ("sha256", "steps", "run")}
                for name in own
            }
    if not begun:
        here = sorted({name for entry in stages for name in entry["learns"]})
        raise RunError(
            f"start_from: nobody who learns here has learnt in {where}: here learn "
            f"{', '.join(here)}, and there {', '.join(learnt) or 'nobody was finished'}"
        )
    return begun


def same_shapes(one: Algorithm, other: Algorithm) -> bool:
    """Return whether the weights of both have the same names and shapes."""
    return one.weight_shapes() == other.weight_shapes()


def keep_starts(run: RunDirectory, learnt: Mapping[str, Learnt]) -> None:
    """Copy into a new run what its stages say that their learners begin with: all, or nothing.

    The stages then say the checksums of the copies.
    """
    try:
        for entry in run.manifest["stages"]:
            for name, told in entry.get("starts", {}).items():
                tensors, header = learnt[name].policy.to_file()
                path = _path(run, name)
                make_directory(path.parent)
                header |= {"starts": name} | run.place(entry["name"])
                told["copy"] = write_tensors(path, tensors, header, make_directories=False)
    except BaseException:
        shutil.rmtree(run.path / "starts", ignore_errors=True)
        raise


def start_of(
    run: RunDirectory, stage: str, name: str, algorithm: Algorithm
) -> tuple[AgentPolicy, int] | None:
    """What ``name`` begins a stage with, and from how many steps it learnt that.

    None: it begins afresh, or with what an earlier stage taught.

    Raises:
        RunError: the run's copy is not there, damaged, or belongs elsewhere.
    """
    told = run.stage(stage).get("starts", {}).get(name)
    if told is None:
        return None
    path = _path(run, name)
    if not path.exists():
        raise RunError(
            f"{path} is not there: {name!r} was to begin with it. Put it back, or train anew"
        )
    tensors, header, sha256 = read_signed(path)
    run.must_be_ours(header, path)
    if header.get("kind") != "agent" or header.get("starts") != name:
        raise RunError(f"{path} does not hold what {name!r} is to begin with")
    check_unchanged(path, sha256, told["copy"])
    policy = AgentPolicy.from_file(tensors, header, str(path))
    if not same_shapes(policy.algorithm, algorithm):
        raise RunError(f"{path} holds other networks than {name!r} has in this run")
    return policy, told["steps"]


def drop_starts(run: RunDirectory, stage: str) -> None:
    """Remove what the learners of a stage that is done began with."""
    for name in run.stage(stage).get("starts", {}):
        remove(_path(run, name))
    with suppress(OSError):  # it holds others still, or never was there
        (run.path / "starts").rmdir()


def _path(run: RunDirectory, name: str) -> Path:
    return run.path / "starts" / f"{file_name(name)}.safetensors"
