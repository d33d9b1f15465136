"""Sections of the report that other packages add."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from skillweave._internal.arguments import checked_names
from skillweave._internal.messages import error_text, short
from skillweave._internal.policy_protocol import Policy
from skillweave.calls.log import CallLog
from skillweave.envs.make import EnvSpec
from skillweave.errors import MissingExtra
from skillweave.extensions import names_of, resolve
from skillweave.html_report.page import Page
from skillweave.runs.directory import RunDirectory
from skillweave.training.evaluation import Evaluation


@dataclass(frozen=True)
class Reported:
    """What a section of a report is about."""

    run: RunDirectory
    """Of the run; ``run.path`` is its folder."""
    policy: Policy | None
    """The trained policy; None: the run is not finished, or needs code that was not given."""
    spec: EnvSpec | None
    """Its environment; None: as ``policy``."""
    score: Evaluation | None
    """Of the episodes that the report has played; None: none were."""
    calls: CallLog | None
    """The run's log of calls; None: there is none."""


@checked_names
@dataclass(frozen=True)
class Section:
    """A section of a report, which follows the learning curves."""

    title: str
    """Its heading."""
    html: str
    """Its content, which becomes part of the page as it is: escape what is not your own."""


MakeSection = Callable[[Reported], Section | None]
"""A function that makes a section of a report; None: it has nothing to say about this run."""


def add_sections(page: Page, about: Reported) -> None:
    """Put the sections of other packages into a page; one that fails is said to be missing."""
    page.context["more"] = []
    for name, place in names_of("section").items():
        try:
            make: MakeSection = resolve(place)
            section = make(about)
            if not isinstance(section, Section | None):
                raise TypeError(f"it must return a Section or None, not {short(section)}")
        except MissingExtra:
            continue  # of an own extension that is not installed, which wrote nothing either
        except Exception as error:  # of another package: the report is written in any case
            page.missing.append(f"There is no section {name!r}: {error_text(error)}.")
            continue
        if section is not None:
            page.context["more"].append({"id": f"more-{name}", "section": section})
