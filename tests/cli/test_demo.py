"""``skillweave demo``: a tiny one end to end, and that what it quotes is of the same steps."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from skillweave import recipes
from skillweave.cli import commands, main
from skillweave.demo.commands import DemoCommand
from skillweave.demo.demo_command import FLAT_RESULTS, MISSION, NEW_SELECTOR_STEPS, complete, shares
from skillweave.recipes import lander_missions as missions


@pytest.mark.slow
def test_a_tiny_demo_trains_scores_films_and_says_what_came_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("Box2D", "PIL", "jinja2", "vl_convert"):
        pytest.importorskip(module)
    out = tmp_path / "demo"
    assert main(["demo", "--scale", "0.01", "--out", str(out), "--quiet"]) == 0
    told = capsys.readouterr().out
    for sentence in (
        r"1\. Land softly",
        r"16,200 steps in \d+ s\. Mean return over 2 new episodes: -?\d+",
        r"Skills, by the share of steps in which they act: stabilize \d+%, center \d+%, landing",
        r"One flat agent, without skills, lands as well: \d+ with 1,620,000 steps \(recorded: ",
        r"2\. A mission: fly left, fly right, land",
        r"3,000 steps in \d+ s\. Whole missions done: \d+%",
        r"A flat agent with as many: 3,000 steps in \d+ s\. Whole missions done: \d+%",
        r"A flat agent with all steps, those of the skills included \(3,600,000\): \d+%",
        r"That took \d+ s\.",
    ):
        assert re.search(sentence, told), sentence
    for film in ("lunar-lander.gif", "mission.gif"):
        assert (out / film).read_bytes().startswith(b"GIF89a")
    assert "<html" in (out / "mission.html").read_text()
    assert all((out / run / "run.json").exists() for run in ("lunar-lander", "mission"))


def test_the_recorded_flat_agents_have_all_steps_of_the_hierarchies() -> None:
    recorded: dict[str, dict[str, Any]] = json.loads(FLAT_RESULTS.read_text())
    skills_and_selector = missions.declare().total_steps
    assert recorded["lunar-lander"]["steps"] == recipes.load("lunar-lander").total_steps
    assert recorded[MISSION]["steps"] == skills_and_selector + NEW_SELECTOR_STEPS
    assert missions.with_skills(MISSION, dict.fromkeys(names(), _still)).total_steps == (
        NEW_SELECTOR_STEPS
    )


def names() -> list[str]:
    return [skill().name for skill in missions.SKILLS]


def _still(obs: Any) -> Any:
    return obs[:, 0].astype(int) * 0


def test_words_for_numbers() -> None:
    assert shares({"left": 0.4, "land": 0.6}) == "left 40%, land 60%"
    score: Any = SimpleNamespace(returns=(1.0, 0.6667, 0.9999, 0.0))
    assert complete(score) == 0.5
    assert commands.name_of(DemoCommand) == "demo"
