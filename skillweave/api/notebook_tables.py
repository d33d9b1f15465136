"""Lines and tables about ``Hierarchy``, ``Agent`` and ``Run``, for notebooks; HTML stays here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.nesting import every_skill, inner_of
from skillweave.notebooks import Markup, facts, joined, paragraph, table
from skillweave.runs.directory import RunDirectory
from skillweave.skills.base import RecordedSkill, Skill, about, own_methods
from skillweave.terminal import printable
from skillweave.training.evaluation_file import load_evaluation
from skillweave.training.plain_agent import PlainAgent


def hierarchy_line(declared: Declaration) -> str:
    """Return the ``repr`` of a hierarchy."""
    names = ", ".join(s.name for s in declared.skills)
    return printable(f"<{type(declared).__name__} of {names} on {declared.spec.name}>")


def agent_line(declared: PlainAgent) -> str:
    """Return the ``repr`` of a plain agent."""
    kind = _kind(declared.algorithm)
    return printable(f"<{type(declared).__name__} of {kind} on {declared.spec.name}>")


def hierarchy_html(declared: Declaration) -> str:
    """Return tables of a hierarchy, and of its skills at all levels."""
    return joined([facts(_hierarchy_facts(declared)), _skills(declared)])


def agent_html(declared: PlainAgent) -> str:
    """Return a table of a plain agent."""
    return joined([facts(_agent_facts(declared))])


def run_html(path: Path, declared: Declaration | PlainAgent) -> str:
    """Return tables of a run: its declaration, its stages, and its latest saved evaluation."""
    if isinstance(declared, PlainAgent):
        rows, skills = list(_agent_facts(declared)), []
    else:
        rows = list(_hierarchy_facts(declared))
        skills = [_skills(declared)]
    kind = "run" if path.is_dir() else "weights"
    shown = [facts([(kind, path), *rows]), *skills]
    try:
        run = RunDirectory.open(path) if path.is_dir() else None
        saved = None if run is None else load_evaluation(run)
    except SkillweaveError as error:
        return joined([*shown, paragraph(error)])
    if run is not None:
        shown.append(_stages(run))
    if saved is not None:
        shown.append(paragraph(f"evaluation: {saved}"))
    return joined(shown)


def _hierarchy_facts(declared: Declaration) -> Iterator[tuple[str, object]]:
    yield "hierarchy on", declared.spec.name
    if not declared.recorded:
        yield "selector", _kind(declared.selector)
        yield "learns", declared.learn
        yield "training steps", f"{declared.total_steps:,}"
    if declared.reflexes:
        yield "reflexes", ", ".join(str(reflex.name) for reflex in declared.reflexes)


def _agent_facts(declared: PlainAgent) -> Iterator[tuple[str, object]]:
    yield "agent on", declared.spec.name
    yield "algorithm", _kind(declared.algorithm)
    if not declared.recorded:
        yield "training steps", f"{declared.steps:,}"


def _skills(declared: Declaration) -> Markup:
    """Return a table of a hierarchy's skills; empty columns are left out."""
    head = ["skill", "policy", "defines", "about", "max_steps"]
    rows = []
    for path, skill in every_skill(declared.skills):
        node = path.rpartition("/")[0]
        owner = inner_of(declared.skill(node)) if node else declared
        limit = "" if skill.max_steps is None else f"{skill.max_steps:,}"
        defines = ", ".join(own_methods(skill))
        rows.append([path, _learns_by(owner or declared, skill), defines, about(skill), limit])
    used = [i for i in range(len(head)) if any(row[i] for row in rows)]
    shown = [[row[i] for i in used] for row in rows]
    return table([head[i] for i in used], shown, left=sum(i < 4 for i in used))


def _learns_by(owner: Declaration, skill: Skill) -> str:
    """Return the source of a skill's policy: learnt, ready, a hierarchy or an algorithm."""
    if isinstance(skill, RecordedSkill):
        return "learnt"
    if inner_of(skill) is not None:
        return "hierarchy"
    if skill.policy is not None:
        return "ready"
    return _kind(skill.algorithm or owner.algorithm)


def _stages(run: RunDirectory) -> Markup:
    """Return a table of a run's stages."""
    rows = []
    for stage in run.manifest["stages"]:
        final = stage.get("final", {})
        steps, seconds = stage.get("steps"), stage.get("seconds")
        rows.append(
            (
                stage["name"],
                stage["status"],
                "" if steps is None else f"{steps:,}",
                "" if seconds is None else f"{seconds:,.0f}",
                "" if final.get("return") is None else f"{final['return']:,.1f}",
            )
        )
    return table(("stage", "status", "steps", "seconds", "return"), rows, left=2)


def _kind(algorithm: object) -> str:
    """Return the name of an algorithm, or of a ready selector."""
    if isinstance(algorithm, AlgorithmConfig):
        return type(algorithm).__name__
    return f"ready: {getattr(algorithm, '__name__', type(algorithm).__name__)}"
