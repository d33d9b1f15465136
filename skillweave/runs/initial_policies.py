"""A run's copies of policies: those that were ready when it began, and initial ones of other runs.

They are copied when the run begins, so it does not depend on other runs and files.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from skillweave._internal.paths import CRITIC, SELECTOR, decides, level_of, name_of
from skillweave._internal.policy_protocol import Policy
from skillweave.algorithms.agent_policy import AgentHeader, AgentPolicy
from skillweave.algorithms.base import Algorithm
from skillweave.errors import DeclarationError, RunError
from skillweave.policies.untrusted import checksum, read_file
from skillweave.runs.command_words import resume_words
from skillweave.runs.directory import RunDirectory, file_name
from skillweave.runs.files import (
    check_unchanged,
    make_directory,
    read_tensors,
    record_in,
    write_bytes,
)
from skillweave.runs.manifest import Manifest, SkillEntry, StageEntry, Start
from skillweave.skills.foreign_policy import Foreign, as_recorded


@dataclass(frozen=True)
class Learnt:
    """A learner's result in the finished stages of another run."""

    policy: AgentPolicy
    sha256: str
    """Checksum of its file there."""
    steps: int
    """Environment steps of its training."""
    where: str
    """The other run's directory, or a name."""
    run: str | None
    """The other run's ``id``."""
    chooses: Chooses
    """The options that it chooses among, if it is a selector or a critic of skills."""
    entry: SkillEntry | None = None
    """The entry of a skill of a run; else None."""
    code: dict[str, str] = field(default_factory=dict)
    """The other run's texts of its environment and skills."""
    critic: bool = True
    """Its critic was learnt with it."""


Chooses = tuple[tuple[str, ...], tuple[int, ...]]
"""Names of skills in order, and selectable lengths of calls."""


def learners_of_run(path: Path) -> dict[str, Learnt]:
    """Return the learners of a run by name, at the end of their latest finished stage.

    Raises:
        RunError: the directory holds no run, a file is damaged, or the comparison at the end of
            learning together is still missing.
    """
    run = RunDirectory.open(path)
    learnt = dict[str, Learnt]()
    if run.lacks_comparison and all(entry.done for entry in run.manifest.stages):
        raise RunError(
            f"start_from: {path} was stopped during the comparison at its end; finish it first: "
            f"{resume_words(run)}"
        )
    for entry in run.manifest.stages:
        if not entry.done or entry.undone:
            continue
        sums = entry.policies or {entry.name: str(entry.sha256)}
        for name, policy in run.load_policies(entry.name).items():
            sha256 = sums[name]
            steps = (entry.steps or 0) + (learnt[name].steps if name in learnt else 0)
            chooses = options_of(run.manifest, name)
            skill = run.manifest.by_path.get(name)
            of_run = run.manifest.id, chooses, skill, run.manifest.code
            learnt[name] = Learnt(policy, sha256, steps, str(path), *of_run)
    return learnt


def options_of(manifest: Manifest, name: str) -> Chooses:
    """Return by a run's manifest the options that a selector or a critic chooses among."""
    if not decides(name):
        return (), ()
    level = level_of(name)
    skills = tuple(name_of(path) for path in manifest.by_path if level_of(path) == level)
    lengths = manifest.levels[level].call_lengths if name_of(name) == SELECTOR else ()
    return skills, tuple(lengths)


def record_initial_policies(
    stages: list[StageEntry], learnt: Mapping[str, Learnt], where: str
) -> set[str]:
    """Record the initial policies in a new run's stages; return the names of their learners.

    Args:
        where: the other run, or runs, for messages.

    Raises:
        RunError: no learner of this run has learnt in the other one.
        DeclarationError: a population would begin with a learnt policy.
    """
    started: set[str] = set()
    for entry in stages:
        names = [name for name in entry.learns if name in learnt and name not in started]
        started |= set(names)
        if names and entry.evolution is not None:
            raise DeclarationError(
                f"start_from: stage {entry.name!r} evolves, and each member of a population "
                f"begins with its own settings and networks, not with policies of {where}. Omit "
                "start_from, or evolve only learners that are not in that run: evolve={...}"
            )
        if names:
            entry.starts = {
                name: Start((of := learnt[name]).sha256, of.steps, of.run, of.critic)
                for name in names
            }
    if not started:
        learners = sorted({name for entry in stages for name in entry.learns})
        raise RunError(
            f"start_from: no learner of this run has learnt in {where}: this run trains "
            f"{', '.join(learners)}, and that one has {', '.join(learnt) or 'no finished learner'}"
        )
    return started


def compare_with_given(stages: Sequence[StageEntry]) -> None:
    """Let stages in which all learn together be compared with the policies that all were given."""
    earlier: set[str] = set()
    for entry in stages:
        acts = {name for name in entry.learns if name_of(name) != CRITIC}
        if entry.kind == "together" and entry.starts and acts <= earlier | set(entry.starts):
            entry.compared = True
        earlier |= set(entry.learns)


def copy_initial_policies(run: RunDirectory, learnt: Mapping[str, Learnt]) -> None:
    """Copy the initial policies of a new run's stages into it: all, or nothing.

    The stages record the checksums of the copies.
    """
    try:
        for entry in run.manifest.stages:
            for name, start in entry.starts.items():
                tensors, header = learnt[name].policy.to_file()
                header = replace(header, starts=name)
                start.copy = run.write("starts", name, tensors, header, entry.name)
    except BaseException:
        shutil.rmtree(run.path / "starts", ignore_errors=True)
        raise


def initial_policy(
    run: RunDirectory, stage: str, name: str, algorithm: Algorithm
) -> tuple[AgentPolicy, int] | None:
    """Return the initial policy of ``name`` in a stage, and the steps of its training.

    None: it begins with fresh weights, or with those of an earlier stage.

    Raises:
        RunError: the run's copy is missing, damaged, or belongs to another run.
    """
    start = run.stage(stage).starts.get(name)
    if start is None:
        return None
    policy = _given(run, name, start)
    if policy.algorithm.weight_shapes() != algorithm.weight_shapes():
        raise RunError(
            f"{run.file('starts', name)} holds other networks than {name!r} has in this run"
        )
    return policy, start.steps


def given_policies(run: RunDirectory, stage: str) -> dict[str, AgentPolicy]:
    """Return the policies that a stage's learners were given, by name, while the run has copies.

    Raises:
        RunError: the run's copy of one is missing, damaged, or belongs to another run.
    """
    entry = run.stage(stage)
    starts = entry.starts if entry.needs_comparison and entry.kept is None else {}
    return {name: _given(run, name, start) for name, start in starts.items()}


def _given(run: RunDirectory, name: str, start: Start) -> AgentPolicy:
    """Return a run's copy of an initial policy."""
    path = run.file("starts", name)
    if not path.exists():
        raise RunError(
            f"{path} is missing: {name!r} needs it to begin. Restore the file, or train again"
        )
    tensors, header = read_tensors(path)
    run.must_be_ours(header.get("run"), path)
    if header.get("kind") != "agent" or header.get("starts") != name:
        raise RunError(f"{path} does not hold the initial policy of {name!r}")
    check_unchanged(path, header, start.copy)
    return AgentPolicy.from_file(tensors, record_in(AgentHeader, header, path), str(path))


def copy_ready_policy(run: RunDirectory, skill: str, policy: Policy) -> None:
    """Copy the content of a skill's ready policy into the run, if it has content to copy."""
    if isinstance(policy, Foreign) and (content := policy.content()) is not None:
        path = _copy_path(run, skill, policy)
        if not path.exists():  # a resumed run has it
            run.check()
            make_directory(path.parent)
            write_bytes(path, content, make_directories=False)


def copy_file(run: RunDirectory, skill: str, content: bytes) -> None:
    """Copy the file from which a skill learns on into the run, if it is the one recorded there."""
    path = file_path(run.path, skill)
    recorded = run.manifest.by_path[skill].policy
    right = recorded is not None and recorded.sha256 == checksum(content)
    if right and not path.exists():  # a resumed run has it
        run.check()
        make_directory(path.parent)
        write_bytes(path, content, make_directories=False)


def file_at_start(run: RunDirectory, skill: str) -> bytes:
    """Return a run's copy of the file from which a skill has learnt on.

    Raises:
        RunError: the copy is missing or damaged.
    """
    path = file_path(run.path, skill)
    if not path.exists():
        raise RunError(f"{path} is missing: it is the run's copy of the file of {skill!r}")
    content = read_file(path)
    recorded = run.manifest.by_path[skill].policy
    if recorded is None or checksum(content) != recorded.sha256:
        raise RunError(f"{path} is damaged: another checksum than the file of {skill!r} had")
    return content


def file_path(run: Path, skill: str) -> Path:
    """Return the path of a run's copy of the file from which a skill learns on."""
    return run / "policies" / f"{file_name(skill)}.onnx"


def policy_at_start(run: RunDirectory, skill: str, policy: Policy) -> Policy:
    """Return a skill's ready policy as it was when the run began.

    Raises:
        RunError: the policy has changed, and the run holds no copy.
    """

    def read() -> bytes | None:
        assert isinstance(policy, Foreign)
        path = _copy_path(run, skill, policy)
        return read_file(path) if path.exists() else None

    return as_recorded(
        policy, run.manifest.by_path[skill].policy, read, f"{run.path}: skill {skill!r}"
    )


def _copy_path(run: RunDirectory, skill: str, policy: Foreign) -> Path:
    return run.path / "policies" / f"{file_name(skill)}{policy.suffix}"
