"""``skillweave train --versus-flat``: both are trained on as many steps, and compared in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cli.plain_recipe import PLAIN

from skillweave.cli import main, training_commands
from skillweave.cli.training_commands import _verdict


def told(mean: float, low: float, high: float) -> dict[str, Any]:
    return {"mean": mean, "ci95": [low, high]}


@pytest.mark.fast_cases(1)
@pytest.mark.parametrize(
    ("flat", "words"),
    [
        (told(1.0, 0.5, 1.5), "hierarchy 3.0, flat agent 1.0 with as many steps: the hierarchy is"),
        (told(5.0, 4.5, 5.5), "flat agent is better"),
        (told(3.5, 2.9, 4.1), "no clear difference"),
    ],
)
def test_the_verdict_says_who_is_better_if_intervals_are_apart(
    flat: dict[str, Any], words: str
) -> None:
    lines = _verdict(told(3.0, 2.5, 3.4), flat)
    assert words in lines[0]
    assert ("skillweave train lander-missions" in lines[-1]) == ("hierarchy is" not in words)


def test_both_are_trained_on_as_many_steps_and_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plain.py").write_text(PLAIN)
    common = ["train", str(tmp_path / "plain.py"), "-o", str(tmp_path / "run"), "--versus-flat"]
    assert main([*common, "--quiet", "--json", "--evaluate", "4"]) == 0
    found = json.loads(capsys.readouterr().out)
    (flat,) = found["flat"]["stages"]
    assert flat["budget"] == sum(s["budget"] for s in found["stages"])
    assert flat["budget"] <= flat["steps"] < flat["budget"] + 64  # of whole rollouts
    assert "hierarchy" not in found["flat"]
    assert found["flat"]["run"] == str(tmp_path / "run-flat")
    assert {found["evaluation"]["episodes"], found["flat"]["evaluation"]["episodes"]} == {4}
    assert main([*common, "--quiet"]) == 1, "the run is there already"
    assert "run-flat is there already" in capsys.readouterr().err


def test_what_the_hierarchy_scored_is_told_before_the_flat_agent_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plain.py").write_text(PLAIN)
    train = training_commands._trained

    def stopped(command: Any, hierarchy: Any, flat: bool, *more: Any, **named: Any) -> Any:
        if flat:
            raise KeyboardInterrupt("stopped")
        return train(command, hierarchy, flat, *more, **named)

    monkeypatch.setattr(training_commands, "_trained", stopped)
    asked = ["train", str(tmp_path / "plain.py"), "-o", str(tmp_path / "run"), "--versus-flat"]
    assert main([*asked, "--quiet", "--evaluate", "4"]) == 130
    assert "over 4 episodes" in capsys.readouterr().out
