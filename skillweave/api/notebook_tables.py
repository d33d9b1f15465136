"""Lines and tables about ``Hierarchy``, ``Agent`` and ``Run``, for notebooks; HTML stays here."""

from __future__ import annotations

from pathlib import Path

from skillweave._internal.notebooks import Markup, facts, joined, paragraph, table
from skillweave._internal.terminal import printable
from skillweave.algorithms.config import AlgorithmConfig
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.declaration import Declaration
from skillweave.hierarchy.roles import Roles, roles_of
from skillweave.hierarchy.schedule import budgets_of
from skillweave.runs.directory import RunDirectory
from skillweave.skills.base import RecordedSkill, about, own_methods
from skillweave.training.evaluation_file import load_evaluation
from skillweave.training.plain_agent import PlainAgent


def declared_line(declared: PlainAgent | Declaration) -> str:
    """Return the ``repr`` of a hierarchy or a plain agent."""
    if isinstance(declared, PlainAgent):
        what = _kind(declared.algorithm)
    else:
        what = ", ".join(skill.name for skill in declared.skills)
    return printable(f"<{type(declared).__name__} of {what} on {declared.spec.name}>")


def declared_html(declared: PlainAgent | Declaration) -> str:
    """Return tables of a plain agent, or of a hierarchy and its skills at all levels."""
    known, tables = _declared(declared)
    return joined([facts(known), *tables])


def run_html(path: Path, declared: PlainAgent | Declaration) -> str:
    """Return tables of a run: its declaration, its stages, and its latest saved evaluation."""
    kind = "run" if path.is_dir() else "weights"
    known, tables = _declared(declared)
    shown = [facts([(kind, path), *known]), *tables]
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


def _declared(declared: PlainAgent | Declaration) -> tuple[list[tuple[str, object]], list[Markup]]:
    """Return the names and values of settings for a notebook, with the table of skills."""
    known: list[tuple[str, object]]
    if isinstance(declared, PlainAgent):
        known = [("agent on", declared.spec.name), ("algorithm", _kind(declared.algorithm))]
        return known + ([] if declared.recorded else [_steps(declared.steps)]), []
    roles = roles_of(declared)
    level = roles.outermost
    known = [("hierarchy on", roles.spec.name)]
    if not declared.recorded:
        known += [("selector", _kind(level.selector)), ("learns", level.learn)]
        known.append(_steps(sum(budgets_of(roles).values())))
    if level.reflexes:
        known.append(("reflexes", ", ".join(str(reflex.name) for reflex in level.reflexes)))
    return known, [_skills_table(roles)]


def _steps(steps: int) -> tuple[str, str]:
    return "training steps", f"{steps:,}"


def _skills_table(roles: Roles) -> Markup:
    """Return a table of a hierarchy's skills for a notebook."""
    head = ["skill", "policy", "defines", "about", "max_steps"]
    rows = []
    for path, skill in roles.skills.items():
        limit = "" if skill.max_steps is None else f"{skill.max_steps:,}"
        defines = ", ".join(own_methods(skill))
        rows.append([path, _learns_by(roles, path), defines, about(skill), limit])
    used = [i for i in range(len(head)) if any(row[i] for row in rows)]
    shown = [[row[i] for i in used] for row in rows]
    return table([head[i] for i in used], shown, left=sum(i < 4 for i in used))


def _learns_by(roles: Roles, path: str) -> str:
    """Return the source of a skill's policy: learnt, ready, a hierarchy or an algorithm."""
    role = roles[path]
    if isinstance(role.skill, RecordedSkill):
        return "learnt"
    if path in roles.levels:
        return "hierarchy"
    return "ready" if role.config is None else _kind(role.config)


def _stages(run: RunDirectory) -> Markup:
    """Return a table of a run's stages for a notebook."""
    rows = []
    for stage in run.manifest.stages:
        final = stage.final
        steps, seconds = stage.steps, stage.seconds
        rows.append(
            (
                stage.name,
                stage.status,
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
