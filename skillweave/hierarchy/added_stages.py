"""Stages that extensions add to a hierarchy's run, after its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from skillweave.extensions import fetch_from
from skillweave.hierarchy.policy import HierarchyPolicy
from skillweave.hierarchy.roles import Roles
from skillweave.runs.manifest import StageEntry
from skillweave.training.stage import Stage
from skillweave.training.trainer import Course


@dataclass(frozen=True)
class AddedStage:
    """A kind of stage that follows a hierarchy's own, and is judged at its end."""

    make: Callable[[Roles, StageEntry, Mapping[str, Any] | None], Stage]
    """Returns the stage of a run's entry. The events are those by which the user judges calls, as
    for ``handover``."""
    judge: Callable[[Roles, Course, StageEntry, HierarchyPolicy], bool]
    """Returns whether what the stage has trained, in the hierarchy, is kept; it records that in the
    run, once."""


def added_stage(kind: str) -> AddedStage:
    """Return a kind of stage.

    Raises:
        MissingExtra: its extension is not installed.
    """
    found: AddedStage = fetch_from("stage", kind)
    return found
