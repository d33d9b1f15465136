"""The comparison of two populations."""

from __future__ import annotations

from pathlib import Path

from small_runs import assert_same


def assert_same_population(run: Path, reference: Path) -> None:
    """The same members in all generations, policies and metrics."""
    assert (run / "lineage.jsonl").read_text() == (reference / "lineage.jsonl").read_text()
    assert_same(run, reference)
