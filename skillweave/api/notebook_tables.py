"""Lines and tables about ``Hierarchy``, ``Agent`` and ``Run``, for notebooks; HTML stays here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from skillweave.algorithms.config import AlgorithmConfig
from skillweave.errors import SkillweaveError
from skillweave.hierarchy.roles import Roles
from skillweave.hierarchy.schedule import budgets_of
from skillweave.notebooks import Markup, facts, joined, paragraph, table
from skillweave.runs.directory import RunDirectory
from skillweave.skills.base import RecordedSkill, about, own_methods
from skillweave.terminal import printable
from skillweave.training.evaluation_file import load_evaluation
from skillweave.training.plain_agent import PlainAgent


def hierarchy_line(kind: str, skills: Iterable[str], env: str) -> str:
    """Return the ``repr`` of a hierarchy, from the names of its class, skills and environment."""
    return printable(f"<{kind} of {', '.join(skills)} on {env}>")


def agent_line(declared: PlainAgent) -> str:
    """Return the ``repr`` of a plain agent."""
    kind = _kind(declared.algorithm)
    return printable(f"<{type(declared).__name__} of {kind} on {declared.spec.name}>")


def hierarchy_html(roles: Roles, *, recorded: bool) -> str:
    """Return tables of a hierarchy, and of its skills at all levels.

    Args:
        recorded: it is of a run that was loaded without its code.
    """
    return joined([facts(hierarchy_facts(roles, recorded=recorded)), skills_table(roles)])


def agent_html(declared: PlainAgent) -> str:
    """Return a table of a plain agent."""
    return joined([facts(agent_facts(declared))])


def run_html(path: Path, known: Iterable[tuple[str, object]], *tables: Markup) -> str:
    """Return tables of a run: its declaration, its stages, and its latest saved evaluation.

    Args:
        known: the facts of the declaration.
        tables: further ones of the declaration.
    """
    kind = "run" if path.is_dir() else "weights"
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


def hierarchy_facts(roles: Roles, *, recorded: bool) -> Iterator[tuple[str, object]]:
    """Yield names and values of a hierarchy's settings, for its table."""
    level = roles.outermost
    yield "hierarchy on", roles.spec.name
    if not recorded:
        yield "selector", _kind(level.selector)
        yield "learns", level.learn
        yield "training steps", f"{sum(budgets_of(roles).values()):,}"
    if level.reflexes:
        yield "reflexes", ", ".join(str(reflex.name) for reflex in level.reflexes)


def agent_facts(declared: PlainAgent) -> Iterator[tuple[str, object]]:
    """Yield names and values of a plain agent's settings, for its table."""
    yield "agent on", declared.spec.name
    yield "algorithm", _kind(declared.algorithm)
    if not declared.recorded:
        yield "training steps", f"{declared.steps:,}"


def skills_table(roles: Roles) -> Markup:
    """Return a table of a hierarchy's skills; empty columns are left out."""
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
