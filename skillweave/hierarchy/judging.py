"""Which hierarchy a run ends with, of those that it could: found out by episodes of all of them.

They are played by the engine that it was trained with, in one process: in a pool, where there is
one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.hierarchy.assembly import assembled
from skillweave.hierarchy.declaration import TOGETHER, Declaration
from skillweave.hierarchy.nesting import below, copied, every_hierarchy
from skillweave.runs.directory import RunDirectory
from skillweave.runs.kept import EPISODES, kept_words, to_be_judged
from skillweave.training.evaluation import evaluate
from skillweave.training.stage import Policies
from skillweave.training.stage_log import Listener

SEEDS = 1_000
"""Seeds of these episodes begin here: people take smaller ones."""


def judged(
    declaration: Declaration,
    run: RunDirectory,
    listeners: tuple[Listener, ...],
    before: Policies,
    after: Policies,
    nodes: tuple[str, ...] = (),
) -> Policies:
    """The best of what a hierarchy was before and after learning together; the run says which.

    Args:
        nodes: the names on the way to the hierarchy, where it is a skill of another one.
    """
    entry = run.stage("/".join((*nodes, TOGETHER)))
    if "kept" not in entry and to_be_judged(entry, run.manifest):
        found = {"after": assembled(with_skills(declaration, greedy=True), _inside(after, nodes))}
        if entry.get("greedy_judged"):
            sampled = with_skills(declaration, greedy=False)
            found["sampled"] = assembled(sampled, _inside(after, nodes))
        if entry.get("compared", True):
            earlier = settled(declaration, run, nodes)
            found["before"] = assembled(earlier, _inside(before, nodes))
        for listener in listeners:
            listener.message(f"{entry['name']}: {len(found)} times {EPISODES} episodes are played")
        seed, spec = SEEDS + int(run.manifest["seed"]), declaration.spec
        scores = {
            name: evaluate(policy, spec, episodes=EPISODES, seed=seed, engine=spec.engine)
            for name, policy in found.items()
        }
        means = {name: score.mean for name, score in scores.items()}
        entry["kept"] = means | {"kept": max(means, key=means.__getitem__)}  # of equals the first
        entry["evaluation_steps"] += sum(sum(score.lengths) for score in scores.values())
        run.save()
        for listener in listeners:
            listener.message(f"{entry['name']}: {kept_words(entry['kept'])}")
    return before if entry.get("kept", {}).get("kept") == "before" else after


def settled(
    declaration: Declaration, run: RunDirectory, nodes: tuple[str, ...] = ()
) -> Declaration:
    """A copy that says for all in it whether skills are greedy, as far as the run has come.

    Args:
        nodes: the names on the way to the hierarchy, where it is a skill of another one.
    """
    found = copied(declaration)
    for path, own in every_hierarchy(found):
        if own.greedy_skills is None:
            own.greedy_skills = _is_greedy(run, (*nodes, *(path.split("/") if path else ())))
    return found


def with_skills(declaration: Declaration, *, greedy: bool) -> Declaration:
    """A copy in which skills are greedy, or sample, wherever the declaration does not say it."""
    found = copied(declaration)
    for _, own in every_hierarchy(found):
        if own.greedy_skills is None:
            own.greedy_skills = greedy
    return found


def _is_greedy(run: RunDirectory, names: tuple[str, ...]) -> bool:
    """What the latest stage says in which this hierarchy learnt as a whole."""
    stages: dict[str, Mapping[str, Any]] = {s["name"]: s for s in run.manifest["stages"]}
    for depth in range(len(names) + 1):
        entry = stages.get("/".join((*names[:depth], TOGETHER)))
        if entry is None or entry["status"] != "done":
            continue
        if "kept" not in entry:
            if to_be_judged(entry, run.manifest):
                continue
            return False  # nobody can tell: they act as they did while the selector learnt
        if (kept := entry["kept"]["kept"]) != "before":
            return bool(kept != "sampled")
    return True


def _inside(policies: Policies, nodes: tuple[str, ...]) -> Policies:
    """Those of a hierarchy below."""
    for name in nodes:
        policies = below(policies, name)
    return policies
