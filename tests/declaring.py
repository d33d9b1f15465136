"""Keyword arguments of ``Hierarchy`` for tests that vary single settings of any group."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.grouped import grouped
from skillweave import Together


def plainly(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return keyword arguments of ``Hierarchy`` for ``settings`` by bare names.

    Unless ``settings`` say otherwise, skills learn apart, and follow their own reward alone.
    """
    return grouped({"learn": "apart", "together": Together(task_weight=0.0)} | dict(settings))
