"""Lines of ``skillweave info`` about a run, for people. Apart from the command, for its tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skillweave.collecting.lengths import calls_from_json
from skillweave.runs.kept import best_words, kept_words
from skillweave.terminal import one_line
from skillweave.training.evaluation_file import SavedEvaluation


def run_lines(
    m: Mapping[str, Any], saved: Sequence[SavedEvaluation | None], target: object
) -> list[str]:
    """Return a run's manifest and its saved evaluations, as lines."""
    env, created = one_line(m["env"]), one_line(m["created"])
    lines = [f"{m['kind']} on {env}, seed {m['seed']}, made {created}"]
    calls = f", call_steps {calls_from_json(m)}" if m["kind"] == "hierarchy" else ""
    calls += f", ready selector: {m['selector']['kind']}" if "selector" in m else ""
    calls += f", guide: {m['guide']['kind']}" if "guide" in m else ""
    lines += [f"  recipe: {one_line(m.get('recipe') or '(declared in Python)')}{calls}"]
    lines += [
        f"  {'stage':<14} {'status':<9} {'steps':>10} {'seconds':>8} {'steps/s':>8} {'return':>8}"
    ]
    for p in m["stages"]:
        final = p.get("final", {}).get("return")
        lines.append(
            f"  {p['name']:<14} {p['status']:<9} {p.get('steps', 0):>10,} "
            f"{p.get('seconds', 0):>8.1f} {p.get('steps_per_second', 0):>8,.0f} "
            f"{'' if final is None else f'{final:.1f}':>8}"
        )
        for name, start in p.get("starts", {}).items():
            run = "" if start["run"] is None else f" {start['run']}"
            lines.append(f"    {name} starts from run{run}, after {start['steps']:,} steps there")
        if continued := p.get("continued"):
            lines.append(f"    continued after {', '.join(f'{k:,}' for k in continued)} steps")
        if reached := p.get("reached"):
            lines.append(
                f"    target reached after {reached['steps']:,} of {p['budget']:,} steps: "
                f"{p['target']['of']} {reached['value']:g}"
            )
        if stopped := p.get("stopped"):
            lines.append(
                f"    a callback ended it after {stopped['steps']:,} of {p['budget']:,} steps"
            )
        if best := p.get("best"):
            lines.append(f"    {best_words(best)}")
        if winner := p.get("winner"):
            lines.append(
                f"    winner: member {winner['member']} of generation {winner['generation'] + 1}, "
                f"fitness {winner['fitness']:.1f} (skillweave plot {target})"
            )
        if kept := p.get("kept"):
            lines.append(f"    {kept_words(kept)}")
    lines += ["  " + ", ".join(one_line(f"{k} {v}") for k, v in m["versions"].items())]
    for score in saved:
        if score is not None:
            how = "greedy" if score.deterministic else "sampled"
            lines.append(f"  evaluated {one_line(score.made)}, seed {score.seed}, {how}:")
            lines += [f"    {line}" for line in score.evaluation.for_people().splitlines()]
    return lines
