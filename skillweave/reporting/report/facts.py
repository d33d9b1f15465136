"""Facts of a run's files in words: its settings, its stages, and the unfinished ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skillweave.policies.core import flat
from skillweave.reporting.report.numbers import number
from skillweave.runs.command_words import command_words
from skillweave.runs.comparison import best_words, comparison_words
from skillweave.runs.directory import RunDirectory

LEFT_OUT = {"status", "final", "sha256", "policies", "metrics_bytes", "lineage_bytes", "winner"}
MADE = {
    "steps",
    "seconds",
    "steps_per_second",
    "evaluation_steps",
    "reached",
    "kept",
    "workers",
    "succeeded",
    "compared",
    "greedy_judged",
    "stopped",
    "best",
    "continued",
}
"""Fields of a stage's entry that training wrote, or that follow from the hierarchy's settings."""


def name_of(run: RunDirectory) -> str:
    """Return the name of a run's directory."""
    return run.path.resolve().name


def facts(run: RunDirectory) -> list[tuple[str, str]]:
    """Return facts about the training, by name."""
    manifest = run.manifest
    rows = [("Environment", manifest["env"])]
    if manifest["env_kwargs"]:
        rows.append(("Made with", plain(manifest["env_kwargs"])))
    rows.append(("Recipe", manifest.get("recipe") or "declared in Python"))
    rows += [("Seed", str(manifest["seed"])), ("Made", manifest["created"].replace("T", " "))]
    if manifest["kind"] == "hierarchy":
        rows.append(("Skills", ", ".join(s["name"] for s in manifest["skills"])))
        rows.append(("A call lasts", _call_length(manifest)))
        selector = manifest.get("selector")
        rows.append(("Selector", f"ready: {selector['kind']}" if selector else "trained"))
        rows.append(("Learning", manifest.get("learn", "apart")))
        if manifest.get("interrupt") is not None:
            rows.append(("Calls are cut at", f"{manifest['interrupt']} deviations"))
        if manifest.get("reflexes"):
            rows.append(("Reflexes", ", ".join(manifest["reflexes"])))
    return rows


def _call_length(manifest: Mapping[str, Any]) -> str:
    if "call_lengths" in manifest:
        return f"{plain(manifest['call_lengths'])} steps at most, as the selector chooses"
    most = manifest["call_steps"]
    if most is None:
        return "until the skill stops"
    return "1 step" if most == 1 else f"at most {most:,} steps"


def stage_rows(run: RunDirectory, steps: Mapping[str, int]) -> list[dict[str, str]]:
    """Return a row for each stage; ``steps``: by stage, the steps of its last metrics."""
    rows = []
    for entry in run.manifest["stages"]:
        final = (entry.get("final") or {}).get("return")
        notes = []
        if continued := entry.get("continued"):
            notes.append(f"continued after {', '.join(f'{k:,}' for k in continued)} steps")
        if reached := entry.get("reached"):
            notes.append(f"target reached after {reached['steps']:,} steps")
        if stopped := entry.get("stopped"):
            notes.append(f"a callback ended it after {stopped['steps']:,} steps")
        if best := entry.get("best"):
            notes.append(best_words(best))
        if kept := entry.get("kept"):
            notes.append(comparison_words(kept))
        if winner := entry.get("winner"):
            notes.append(f"winner: member {winner['member']}, fitness {winner['fitness']:.1f}")
        done = entry["status"] == "done"
        far = f"{steps.get(entry['name'], 0):,} of {entry['budget']:,}"
        rows.append(
            {
                "name": entry["name"],
                "kind": entry["kind"],
                "algorithm": entry["algorithm"].get("algorithm", "?"),
                "status": entry["status"],
                "steps": f"{entry['steps']:,}" if done else far,
                "seconds": f"{entry['seconds']:,.1f}" if done else "–",
                "speed": f"{entry['steps_per_second']:,.0f}"
                if "steps_per_second" in entry
                else "–",
                "return": number(final),
                "notes": "; ".join(notes),
            }
        )
    return rows


def missing_stages(run: RunDirectory, steps: Mapping[str, int]) -> list[str]:
    """Return a sentence for each unfinished stage; ``steps``: by stage, at its last metrics."""
    sentences = []
    for entry in run.manifest["stages"]:
        name = entry["name"]
        budget = entry["budget"]
        if entry["status"] == "waiting":
            sentences.append(f"The stage {name!r} has not begun.")
        elif entry["status"] == "training":
            far = f"after {steps[name]:,}" if name in steps else "before the first line of metrics"
            sentences.append(
                f"The stage {name!r} is not finished: it stands {far} of {budget:,} steps."
            )
    if sentences:
        sentences.append(
            "Only a finished run can be played, so there are no episodes and no film. To finish "
            f"it: {command_words('resume', run)}"
        )
    return sentences


def settings(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return every setting in a run's manifest by its dotted name, without seed and results."""
    values: dict[str, Any] = {"env": manifest["env"]} | flat(manifest["env_kwargs"], "env_kwargs.")
    names = (
        "kind",
        "learn",
        "call_steps",
        "call_lengths",
        "interrupt",
        "greedy_skills",
        "greedy_selector",
        "start_calls",
        "search_steps",
        "episode_calls",
        "call_cost",
        "reflexes",
        "checkpoint_every",
        "eval_every",
        "eval_episodes",
        "keep",
    )
    values |= {k: manifest[k] for k in names if k in manifest}
    for skill in manifest.get("skills", ()):
        fields = {k: v for k, v in skill.items() if k != "name"}
        values |= flat(fields, f"skills.{skill['name']}.")
    for entry in manifest["stages"]:
        fields = {k: v for k, v in entry.items() if k not in LEFT_OUT | MADE | {"name", "starts"}}
        # From which run differs from seed to seed.
        fields |= {f"starts.{name}": "another run" for name in entry.get("starts", {})}
        values |= flat(fields, f"{entry['name']}.")
    return values


def plain(value: Any) -> str:
    """Return a value of a setting, for people."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(plain(v) for v in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{k}={plain(v)}" for k, v in value.items())
    return f"{value:g}" if isinstance(value, float) else str(value)
