"""The Python blocks of README and pages, and training that takes a moment in place of minutes."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from skillweave import Agent, Hierarchy, api

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```python\n(.*?)^```", flags=re.S | re.M)
INCLUDED = re.compile(r"^--8<--\n([\w/.]+)\n--8<--$", flags=re.M)
BUDGETS = ("steps", "skill_steps", "selector_steps")
STEPS = 1_000
"""Of each stage; those of an algorithm with replay are a little more than it waits."""


def blocks(page: Path) -> Iterator[str]:
    """The Python of a page: first the files that it shows, then its own blocks."""
    found = BLOCK.findall(page.read_text())
    shown = [name for block in found for name in INCLUDED.findall(block)]
    yield from ((ROOT / name).read_text() for name in shown)
    yield from (block for block in found if not INCLUDED.search(block))


def run_page(page: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run its blocks one after another as one module; the names in it."""
    module = ModuleType("page_under_test")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # where dataclasses look for it
    for number, code in enumerate(blocks(page), 1):
        where = f"{page.name}, block {number}"
        exec(compile(code, where, "exec", dont_inherit=True), vars(module))
    return vars(module)


def _sooner(config: Any) -> Any:
    if not hasattr(config, "learning_starts"):
        return config
    return replace(config, learning_starts=min(config.learning_starts, STEPS - 100))


def _smaller(search: Any) -> Any:
    return replace(search, generations=2, population=3, episodes=1)


def _shorter(group: Any) -> Any:
    """Return settings of a way of learning with budgets of at most ``STEPS``."""
    budgets = {f.name: getattr(group, f.name) for f in fields(group) if f.name in BUDGETS}
    return replace(group, **{k: min(v, STEPS) for k, v in budgets.items() if v is not None})


def train_briefly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut the budgets of everything that is trained, and keep it quiet."""
    train, train_alone, trains_alone = Hierarchy.train, Agent.train, api.train_agent

    def hierarchy(self: Hierarchy, *args: Any, **kwargs: Any) -> Any:
        self.steps = min(self.steps or STEPS, STEPS)
        self.apart, self.together = _shorter(self.apart), _shorter(self.together)
        for owner, name in [(self, "selector"), (self, "algorithm")]:
            setattr(owner, name, _sooner(getattr(owner, name)))
        for skill in self.skills:
            skill.algorithm = _sooner(skill.algorithm)
        if isinstance(evolve := kwargs.get("evolve"), dict):
            kwargs["evolve"] = {name: _smaller(search) for name, search in evolve.items()}
        return train(self, *args, **kwargs | {"quiet": True})

    def agent(self: Agent, *args: Any, **kwargs: Any) -> Any:
        self.steps, self.algorithm = min(self.steps, STEPS), _sooner(self.algorithm)
        if kwargs.get("evolve") is not None:
            kwargs["evolve"] = _smaller(kwargs["evolve"])
        return train_alone(self, *args, **kwargs | {"quiet": True})

    def function(env: Any, algorithm: Any, steps: int, *args: Any, **kwargs: Any) -> Any:
        how = kwargs | {"quiet": True}
        return trains_alone(env, _sooner(algorithm), min(steps, STEPS), *args, **how)

    monkeypatch.setattr(Hierarchy, "train", hierarchy)
    monkeypatch.setattr(Agent, "train", agent)
    monkeypatch.setattr(api, "train_agent", function)
