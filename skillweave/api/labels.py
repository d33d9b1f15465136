"""Labels of a film: the acting skill's name and colour; apart, as they need skills and pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from skillweave.hierarchy.nesting import every_skill
from skillweave.hierarchy.policy import HierarchyPolicy, SkillAlone
from skillweave.reporting.palette import RGB, color_of
from skillweave.skills import Skill
from skillweave.training.plain_agent import AGENT
from skillweave.types import Memory, Policy


def labels_of(
    policy: Policy, skills: Sequence[Skill], alone: str | None
) -> Callable[[Memory], tuple[str, RGB]]:
    """Return a function from a policy's memory to the acting skill's name and colour.

    Args:
        skills: of the hierarchy that acts; none: a plain agent.
        alone: the skill that acts alone.
    """
    colors = {name: color_of(i, s.color) for i, (name, s) in enumerate(every_skill(skills))}

    def label(memory: Memory) -> tuple[str, RGB]:
        if not skills:
            return AGENT, color_of(len(colors), None)
        acting = policy.policy if isinstance(policy, SkillAlone) else policy
        below = acting.acts(memory) if isinstance(acting, HierarchyPolicy) else None
        name = "/".join(filter(None, (alone, below)))
        known = name
        while known not in colors:  # a run that is a ready skill has skills of its own
            known = known.rpartition("/")[0]
        return name, colors[known]

    return label
