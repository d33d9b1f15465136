"""``skillweave demo``: a task that a flat agent learns, and one where skills pay.

The flat agents with all steps would take five minutes. ``python -m benchmarks.demo_flat`` trains
them and writes their scores to ``demo_flat.json``, which is quoted here.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skillweave._internal.messages import shown_path
from skillweave._internal.terminal import put_result
from skillweave.api import Hierarchy, Run
from skillweave.cli.output import Result, save_score
from skillweave.demo.commands import DemoCommand
from skillweave.errors import MissingExtra, RunError
from skillweave.recipes import lander_missions as missions, load
from skillweave.training.evaluation import Evaluation

MISSION = "tour"
"""Fly left, fly right, land."""
NEW_SELECTOR_STEPS = 300_000
EPISODES = {"lunar-lander": 100, MISSION: 50}
"""Episodes of each score; training uses other seeds."""
FLAT_RESULTS = Path(__file__).with_name("demo_flat.json")
COMPLETE = 0.999
"""A mission's return is the share of its legs that are done."""
MOSTLY = 0.75
"""Share of the steps from which on one skill does nearly all of a task."""


@dataclass
class Demo:
    """A demonstration that trains, scores and films two tasks and prints the results.

    Args:
        command: as it was given.
    """

    command: DemoCommand
    result: dict[str, Any] = field(default_factory=dict)
    """Everything as data, for ``--json``."""
    quoted: dict[str, dict[str, Any]] = field(
        default_factory=lambda: json.loads(FLAT_RESULTS.read_text("utf-8"))
    )
    """By task, the recorded flat agent with all steps."""

    def say(self, text: str = "") -> None:
        """Print a line at once, since the next one may take a minute."""
        if not self.command.json:
            put_result(text)

    def lander(self) -> None:
        """Learn LunarLander with the tutorial's three skills."""
        name = "lunar-lander"
        hierarchy = load(name)
        hierarchy.scale(self.command.scale)
        self.say("1. Land softly (LunarLander-v3): three skills and a selector learn from nothing.")
        run, score, seconds = self._learn(hierarchy, name, name)
        self.say(
            f"   {hierarchy.total_steps:,} steps in {seconds:.0f} s. Mean return over "
            f"{self._episodes(name)} new episodes: {score.mean:.0f}; 200 counts as solved."
        )
        usage = self.result[name]["skill_usage"]
        first = max(usage, key=usage.__getitem__)
        self.say(f"   Skills, by the share of steps in which they act: {shares(usage)}.")
        flat = self.quoted[name]
        self.say(
            f"   One flat agent, without skills, lands as well: {flat['mean']:.0f} with "
            f"{flat['steps']:,} steps (recorded: {flat['command']})."
        )
        if usage[first] >= MOSTLY:
            self.say(
                f"   Why {first} does nearly all of it: LunarLander pays in every step on the way "
                "to the pad,\n   so one policy can learn the whole task. Skills pay where the "
                "reward does not lead the way."
            )
        self._film(run, name)

    def mission(self) -> None:
        """Learn a mission over the shipped skills, beside a flat agent."""
        policy: Any = Hierarchy.pretrained("lander-missions").policy
        skills = dict(zip(policy.labels, policy.skills.policies, strict=True))
        hierarchy = missions.with_skills(MISSION, skills)
        hierarchy.scale(self.command.scale)
        steps = f"{hierarchy.total_steps:,} steps"
        self.say()
        self.say("2. A mission: fly left, fly right, land. It pays only where a part is done.")
        self.say(
            "   Four skills are ready (their weights are shipped). Only a selector learns: which "
            "skill, and when."
        )
        run, score, seconds = self._learn(hierarchy, MISSION, "mission")
        self.say(f"   {steps} in {seconds:.0f} s. Whole missions done: {complete(score):.0%}.")
        self.say(
            "   Skills, by the share of steps in which they act: "
            f"{shares(self.result['mission']['skill_usage'])}.\n"
            "   (This mission has no part for hover; others do: skillweave train "
            "lander-missions.)"
        )
        _, flat, seconds = self._learn(hierarchy, MISSION, "mission-flat", flat=True)
        self.say(
            f"   A flat agent with as many: {steps} in {seconds:.0f} s. Whole missions done: "
            f"{complete(flat):.0%}."
        )
        quoted = self.quoted[MISSION]
        self.say(
            f"   A flat agent with all steps, those of the skills included ({quoted['steps']:,}): "
            f"{quoted['complete']:.0%}\n   (recorded: {quoted['command']})."
        )
        self._film(run, "mission")
        self._report(run)

    def _learn(
        self, hierarchy: Hierarchy, task: str, name: str, flat: bool = False
    ) -> tuple[Run, Evaluation, float]:
        """Train and score; return the run, its score and the seconds of training."""
        started = time.perf_counter()
        quiet = self.command.quiet or self.command.json
        run = hierarchy.train(
            self.command.out / name, seed=self.command.seed, flat=flat, quiet=quiet
        )
        seconds = time.perf_counter() - started
        score = run.evaluate(self._episodes(task), quiet=True)
        save_score(run, score)
        self.result[name] = score.to_json() | {"run": str(shown_path(run.path)), "seconds": seconds}
        if task == MISSION:
            self.result[name]["complete"] = complete(score)
        return run, score, seconds

    def _film(self, run: Run, name: str) -> None:
        film = run.render(self.command.out / f"{name}.gif", seed=105, quiet=True)
        self.result[name]["film"] = film["path"]
        self.say(f"   Film: {film['path']}")

    def _report(self, run: Run) -> None:
        """Write a report, unless the library that draws its charts is not installed."""
        try:
            page = run.report(self.command.out / "mission.html", episodes=10, films=1)
        except MissingExtra as error:
            self.say(f"   No report: {error}")
            return
        self.result["mission"]["report"] = page["path"]
        self.say(f"   Report: {page['path']} (open it in a browser)")

    def _episodes(self, task: str) -> int:
        return max(2, round(EPISODES[task] * min(self.command.scale, 1.0)))


def shares(usage: dict[str, float]) -> str:
    """Return each skill's share of the steps, in words."""
    return ", ".join(f"{name} {share:.0%}" for name, share in usage.items())


def complete(score: Evaluation) -> float:
    """Return the share of episodes in which the whole mission is done."""
    return sum(one > COMPLETE for one in score.returns) / len(score.returns)


def demo(command: DemoCommand) -> Result:
    """Run the demonstration.

    Raises:
        RunError: the output folder exists already.
        DeclarationError: the scale is not positive.
    """
    if command.out.exists():
        raise RunError(f"{command.out} exists already: choose another folder (--out), or remove it")
    started = time.perf_counter()
    shown = Demo(command)
    shown.lander()
    shown.mission()
    shown.say()
    shown.say(
        f"That took {time.perf_counter() - started:.0f} s. Next: examples/key_door.py, your first "
        "own skills in 35 lines."
    )
    return shown.result, None
