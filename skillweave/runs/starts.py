"""What learners of a run begin with, where they have learnt in another run before.

It is copied into the run when that begins, so a run needs no other one to go on.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skillweave.algorithms.base import Algorithm
from skillweave.algorithms.policy import AgentPolicy
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import make_directory, read_signed, read_tensors, remove, write_tensors
from skillweave.types import SkillweaveError


@dataclass(frozen=True)
class Learnt:
    """What one has learnt in a finished stage of another run."""

    policy: AgentPolicy
    sha256: str
    """Of its file there."""
    steps: int
    """Environment steps that it learnt from."""


def learnt_in(path: Path) -> dict[str, Learnt]:
    """By name, who has learnt in a run, as they were at the end of their latest finished stage.

    Raises:
        SkillweaveError: there is no run, or a file of it is damaged.
    """
    run, found = RunDirectory.open(path), dict[str, Learnt]()
    for entry in run.manifest["stages"]:
        if entry["status"] != "done" or entry.get("kept", {}).get("kept") == "before":
            continue
        sums = entry.get("policies") or {entry["name"]: entry.get("sha256")}
        for name, policy in run.load_policies(entry["name"]).items():
            # Runs of older versions do not say the checksum.
            sha256 = sums[name] or read_signed(run.policy_path(entry["name"], name))[2]
            before = found[name].steps if name in found else 0
            found[name] = Learnt(policy, sha256, before + entry["steps"])
    return found


def begin_with(stages: list[dict[str, Any]], learnt: Mapping[str, Learnt], where: Path) -> set[str]:
    """Write into the entries of a new run's stages who begins with what; their names.

    Args:
        where: the other run.

    Raises:
        SkillweaveError: nobody who learns here has learnt there, or a population is to begin.
    """
    begun: set[str] = set()
    for entry in stages:
        own = [name for name in entry["learns"] if name in learnt and name not in begun]
        begun |= set(own)
        if own and entry.get("evolution") is not None:
            raise SkillweaveError(
                f"start_from: stage {entry['name']!r} evolves, and members of a population begin "
                f"with settings and networks of their own, not with what {where} holds. Leave out "
                "start_from, or name other stages: evolve={...}"
            )
        if own:
            entry["starts"] = {
                name: {"sha256": learnt[name].sha256, "steps": learnt[name].steps} for name in own
            }
    if not begun:
        here = sorted({name for entry in stages for name in entry["learns"]})
        raise SkillweaveError(
            f"start_from: nobody who learns here has learnt in {where}: here learn "
            f"{', '.join(here)}, and there {', '.join(learnt) or 'nobody was finished'}"
        )
    return begun


def check_start(name: str, algorithm: Algorithm, learnt: Learnt, where: Path) -> None:
    """Raise a SkillweaveError where one cannot begin with what it has learnt in another run."""
    before = learnt.policy.algorithm
    kinds = [type(a.config).__name__ for a in (before, algorithm)]
    if before.weight_shapes() == algorithm.weight_shapes():
        return
    what = (
        f"it learnt by {kinds[0]} there, and is to learn by {kinds[1]} here"
        if kinds[0] != kinds[1]
        else "its networks have other shapes: observations, what it chooses from (a selector: its "
        "skills and lengths), network or normalize_obs differ"
    )
    raise SkillweaveError(
        f"start_from: {name!r} cannot begin with what it learnt in {where}: {what}"
    )


def keep_starts(run: RunDirectory, learnt: Mapping[str, Learnt]) -> None:
    """Copy into a new run what its stages say that their learners begin with."""
    for entry in run.manifest["stages"]:
        for name in entry.get("starts", {}):
            tensors, header = learnt[name].policy.to_file()
            path = _path(run, name)
            make_directory(path.parent)
            header |= {"starts": name} | run.place(entry["name"])
            write_tensors(path, tensors, header, make_directories=False)


def start_of(run: RunDirectory, stage: str, name: str) -> Learnt | None:
    """What ``name`` begins a stage with; None: afresh, or with what an earlier stage taught.

    Raises:
        SkillweaveError: the run's copy is not there, damaged, or belongs elsewhere.
    """
    told = run.stage(stage).get("starts", {}).get(name)
    if told is None:
        return None
    path = _path(run, name)
    if not path.exists():
        raise SkillweaveError(
            f"{path} is not there: {name!r} was to begin with it. Put it back, or train anew"
        )
    tensors, header = read_tensors(path)
    run.must_be_ours(header, path)
    if header.get("kind") != "agent" or header.get("starts") != name:
        raise SkillweaveError(f"{path} does not hold what {name!r} is to begin with")
    return Learnt(AgentPolicy.from_file(tensors, header, str(path)), told["sha256"], told["steps"])


def drop_starts(run: RunDirectory, stage: str) -> None:
    """Remove what the learners of a stage that is done began with."""
    for name in run.stage(stage).get("starts", {}):
        remove(_path(run, name))
    with suppress(OSError):  # it holds others still, or never was there
        (run.path / "starts").rmdir()


def _path(run: RunDirectory, name: str) -> Path:
    return run.path / "starts" / f"{file_name(name)}.safetensors"
