"""The benefit of learning together on chains of skills, against flat agents.

    python -m benchmarks.together [CASE …] [--task 8x8] [--seeds 0 1 2 3 4] [--steps 500000]

Tasks: ``8x8`` and ``16x16``, MiniGrid's DoorKey, and ``unlock-pickup``, its room with a box behind
the door (``examples/doorkey.py``); ``bridge``, a longer chain (``examples/bridge.py``); ``yard``,
one with continuous actions (``examples/yard.py``); ``lander``, the recipe ``lunar-lander`` apart,
then together, measured with ``--steps 1620000``. Every case has the same number of environment
steps in all; one that would be the same as another on a task is refused. Scores are 100 episodes
with seeds that training never saw: the share that is solved by a selector that samples, or on
``lander`` the mean return of a greedy one. MiniGrid's rooms are scored in its own environments;
training steps EnvPool's, or with ``--engine sync`` Gymnasium's. Two runs go side by side
(``--processes``), so the seconds are those of a busy machine.

Flat agents: ``flat`` (F0), ``"skill rewards x 0.1"`` and other weights (F1), ``bonus`` (F2). With
``--f4`` the skills of each hierarchy are also scored without its selector: random choices, and each
alone. F2 trains in MiniGrid's own environment. (F3, fine-tuned from another task, does not exist
here: there is one task.)
"""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from benchmarks.chains import TASKS, Task
from benchmarks.common import cases_asked, median, report, table, workers
from benchmarks.grouped import PLACES, act_by, regroup
from benchmarks.pay.agents import by_lot
from benchmarks.pay.flat import Flat
from benchmarks.pay.suite import Seldom, Shaped
from skillweave import PPO, Hierarchy, Lengths, Run, Skill, SkillweaveError, Step
from skillweave.hierarchy.roles import roles_of
from skillweave.hierarchy.training import manifest
from skillweave.types import Array

EPSILONS = {"epsilon": 0.1, "epsilon_final": 0.0}
"""Of a selector over skills that are trained already: with a high or constant epsilon, it never
 learns what it does by itself."""


def together(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Train skills and selector from the same steps, from nothing."""
    single = {name: how.pop(name) for name in PLACES.keys() & how.keys()}
    found = task.declare(steps, workers=1, **how)  # runs go side by side
    regroup(found, **single)
    return found


def otherwise(task: Task, steps: int, changed: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Train together with other settings (fields of ``Together``)."""
    own = together(task, steps).together
    return together(task, steps, together=replace(own, **changed), **how)


def apart(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Train skills apart, each after calls of those before, then the selector."""
    *each, last = [steps * part // sum(task.parts) for part in task.parts]
    asked: dict[str, Any] = {
        "learn": "apart",
        "start_calls": 8,
        "selector": task.algorithm(**EPSILONS),
        "selector_steps": last,
    }
    hierarchy = together(task, steps, **asked | dict(task.apart) | how)
    for skill, own in zip(hierarchy.skills, each, strict=True):
        skill.steps = own
    if task.last_skill is not None:
        hierarchy.skills[-1].algorithm = task.last_skill
    return hierarchy


def then(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Train the first half of the steps apart, the second together."""
    return apart(task, steps // 2, learn="apart, then together", together_steps=steps // 2, **how)


def then_otherwise(task: Task, steps: int, changed: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Train as ``then`` with other settings of learning together (fields of ``Together``)."""
    own = then(task, steps).together
    return then(task, steps, together=replace(own, **changed), **how)


def limit_ends(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Let a skill's value end where its call reaches the limit, as if nothing came after it."""
    usual = together(task, steps, **how)
    if usual.learn != "together":
        raise SkillweaveError("limit ends: skills that learn apart have no calls that end it")
    level = roles_of(usual).outermost
    untrained: dict[str, Any] = dict.fromkeys(level.skills)
    calls = level.skill_set(untrained)
    for i, skill in enumerate(usual.skills):
        if (limit := calls.limit(i)) is not None:
            skill.__class__ = _ended_after(limit, type(skill))
    return usual


def _ended_after(limit: int, kind: type[Skill]) -> type[Skill]:
    """Return the skill with an end of its own after ``steps``; its success stays."""
    usual = kind()

    class Ended(kind):  # type: ignore[misc, valid-type]
        name = kind.name

        def termination(self, step: Step) -> Array:
            ended: Array = usual.termination(step) | (step.elapsed >= limit)
            return ended

        def success(self, step: Step) -> Array:
            return usual.success(step)

    return Ended


def learnt_otherwise(task: Task, steps: int, changed: Mapping[str, Any], **how: Any) -> Hierarchy:
    """Train skills and selector with other settings of their algorithms."""
    found = together(task, steps, **how)
    skills: list[tuple[Any, str]] = [(skill, "algorithm") for skill in found.skills]
    for who, name in [*skills, (found, "algorithm"), (found, "selector")]:
        if (own := getattr(who, name)) is not None:
            setattr(who, name, replace(own, **changed))
    return found


def one_advantage_scale(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Keep all advantages in units of reward, not divided by their own deviation.

    Raises:
        SkillweaveError: skills learn from the task's advantage, too, which is always divided.
    """
    found = learnt_otherwise(task, steps, {"normalize_advantage": False}, **how)
    if found.together.task_weight > 0:
        raise SkillweaveError("one advantage scale: the task's advantage keeps one of its own here")
    return found


def no_imitation(task: Task, steps: int, who: tuple[str, ...], **how: Any) -> Hierarchy:
    """Whoever is in ``who`` learns by plain PPO: ``algorithm`` (the skills), ``selector``."""
    own = together(task, steps)
    if "algorithm" in who:
        _alike(own)
    asked = {w: {f.name: getattr(getattr(own, w), f.name) for f in fields(PPO)} for w in who}
    return together(task, steps, **{w: PPO(**plain) for w, plain in asked.items()}, **how)


def _alike(hierarchy: Hierarchy) -> Hierarchy:
    """Return the hierarchy with one algorithm for all skills, so that a case changes all."""
    for skill in hierarchy.skills:
        if skill.algorithm is not None:
            raise SkillweaveError(f"skill {skill.name!r} has an algorithm of its own: no such case")
    return hierarchy


def less_entropy(task: Task, steps: int, **how: Any) -> Hierarchy:
    """Apart, skills have no more entropy than together."""
    alike = replace(task, last_skill=None)
    less: Any = together(task, steps).algorithm
    own: Any = apart(alike, steps).algorithm
    return apart(alike, steps, algorithm=replace(own, ent_coef=less.ent_coef), **how)


def flat(task: Task, steps: int, weight: float = 0.0, bonus: float = 0.0, **how: Any) -> Flat:
    """Train one plain agent with the skills' settings, or the recipe's for a plain agent.

    Args:
        weight: of the skills' rewards, which it has beside the task's (F1).
        bonus: for the first visit of a cell (F2).
    """
    hierarchy = together(task, steps, **how)
    agent = Flat(hierarchy.spec, hierarchy.train_defaults.flat or hierarchy.algorithm, steps)
    if weight:
        weights = {skill.name: weight for skill in hierarchy.skills}
        agent.learns = Shaped(list(hierarchy.skills), weights, task_weight=1.0)
    if bonus:
        agent.learns = Seldom(task.cells, bonus)
    return agent


CASES: dict[str, Callable[..., Hierarchy | Flat]] = {
    "together": together,
    "apart": apart,
    "then": then,
    "one call an episode": functools.partial(apart, episode_calls=1),
    "less entropy": less_entropy,
    "no start calls": functools.partial(apart, start_calls=None, episode_calls=1),
    "large call cost": functools.partial(apart, deliberation_cost=0.01),
    "low epsilon": functools.partial(otherwise, changed={"epsilon": 0.3, "epsilon_final": 0.02}),
    # The critic's errors are made as large as a success, where hardly anything was won yet.
    "no least deviation": functools.partial(learnt_otherwise, changed={"min_advantage_std": 0.0}),
    "one advantage scale": one_advantage_scale,
    "no imitation": functools.partial(no_imitation, who=("algorithm", "selector")),
    "selector does not imitate": functools.partial(no_imitation, who=("selector",)),
    "no epsilon": functools.partial(otherwise, changed={"epsilon": 0.0, "epsilon_final": 0.0}),
    "no call cost": functools.partial(together, deliberation_cost=0.0),
    # As `together` on 8x8, and refused there; in the other rooms `no call cost` is.
    "small call cost": functools.partial(together, deliberation_cost=0.001),
    "task advantage": functools.partial(otherwise, changed={"task_weight": 1.0}),
    "no task advantage": functools.partial(otherwise, changed={"task_weight": 0.0}),
    "anchor": functools.partial(otherwise, changed={"reference_kl": 0.05}),
    "then, no anchor": functools.partial(then_otherwise, changed={"reference_kl": None}),
    "limit ends": limit_ends,
    "lengths": functools.partial(together, call_steps=Lengths(4, ..., 64)),
    "interrupt": functools.partial(together, interrupt=True),
    "flat": flat,
    **{f"skill rewards x {w}": functools.partial(flat, weight=w) for w in (1.0, 0.3, 0.1, 0.03)},
    "bonus": functools.partial(flat, bonus=0.1),
}
"""By name, the function that makes the learner of a task with a number of steps."""
BASES = ("together", "apart", "then")
"""Of these the others are variants."""


def check_case(case: str, task: str) -> None:
    """Raise a SkillweaveError where a case would be the same as another one on this task."""
    made = CASES[case](TASKS[task], 1_000)
    for other in BASES:
        base = CASES[other](TASKS[task], 1_000)
        if other != case and _settings(made) == _settings(base):
            raise SkillweaveError(f"{case!r} is the same as {other!r} on {task}: leave it out")


def _settings(learner: Hierarchy | Flat) -> Any:
    """Return all settings of a case."""
    if isinstance(learner, Flat):
        return learner
    # Of a skill that was changed, the class is another one.
    return manifest(learner, seed=0, flat=False), [str(type(s)) for s in learner.skills]


def one(case: str, task: str, steps: int, engine: str, f4: bool, seed: int) -> dict[str, Any]:
    """Train and score in this process."""
    started = time.perf_counter()
    declare = functools.partial(CASES[case], TASKS[task], steps)
    if TASKS[task].has_engines:
        declare = functools.partial(declare, engine=engine)
    with tempfile.TemporaryDirectory() as folder:
        learner, path = declare(), Path(folder) / "run"
        if isinstance(learner, Flat):
            run = learner.run(path, seed)
        else:
            run = learner.train(path, seed=seed, quiet=True)
        seconds = time.perf_counter() - started
        score, usage = TASKS[task].score(run)
        stages = run.info()["stages"]
        result = {"seed": seed, "score": score, "usage": usage, "seconds": seconds}
        if f4 and isinstance(same := declare(), Hierarchy):
            result["f4"] = without_selector(run, same, TASKS[task], Path(folder) / "lot", seed)
    result["steps"] = sum(s["steps"] + s["evaluation_steps"] for s in stages)
    kept = stages[-1].get("kept")
    return result | ({} if kept is None else {"kept": kept})


def without_selector(
    run: Run, same: Hierarchy, task: Task, path: Path, seed: int
) -> dict[str, float]:
    """Return F4: the score of the learnt skills chosen at random, and of each called alone."""
    policy: Any = run.policy
    for skill, learnt in zip(same.skills, policy.skills.policies, strict=True):
        act_by(skill, learnt)
    greedy = policy.skills.greedy
    regroup(same, greedy_skills=greedy)  # as in the run itself
    chosen = by_lot(same, seed).train(path, seed=seed, quiet=True)
    alone = {s.name: task.score(run, greedy, skill=s.name)[0] for s in same.skills}
    return {"at random": task.score(chosen)[0]} | alone


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", choices=TASKS, default="8x8")
    parser.add_argument("--engine", choices=("auto", "sync"), default="auto")
    parser.add_argument("--f4", action="store_true", help="score skills without the selector, too")
    asked = cases_asked(parser, CASES, steps=500_000)
    for case in asked.cases:  # before anything is trained
        check_case(case, asked.task)
    shown = TASKS[asked.task].shown
    rows: list[tuple[str, ...]] = []
    found: dict[str, list[dict[str, Any]]] = {}
    with workers(asked.processes) as pool:
        futures = {
            case: [
                pool.submit(one, case, asked.task, asked.steps, asked.engine, asked.f4, s)
                for s in asked.seeds
            ]
            for case in asked.cases
        }
        for case, pending in futures.items():
            found[case] = runs = []
            for future in pending:
                runs.append(future.result())
                result = runs[-1]
                said = f"{case}, seed {result['seed']}: {shown(result['score'])}"
                print(
                    said,
                    result["usage"],
                    *(result[k] for k in ("kept", "f4") if k in result),
                    flush=True,
                )
            scores = [r["score"] for r in runs]
            seconds = f"{median(r['seconds'] for r in runs):.0f}"
            steps = f"{median(r['steps'] for r in runs):,.0f}"
            each = " ".join(map(shown, scores))
            rows.append((case, shown(median(scores)), shown(min(scores)), steps, seconds, each))
            print(table(("case", "median", "worst", "steps", "s", "each"), rows), flush=True)
    report("together", {"task": asked.task, "seeds": asked.seeds, "cases": found})


if __name__ == "__main__":
    main()
