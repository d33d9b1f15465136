import json
from pathlib import Path

import pytest

from skillweave import (
    Apart,
    Hierarchy,
    Skill,
)
from skillweave.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:.*precision lowered")


@pytest.mark.slow
def test_a_flat_agents_weights_file_scores_as_its_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = type("Any", (Skill,), {"name": "any"})
    h = Hierarchy(
        "CartPole-v1", [kind()], apart=Apart(skill_steps=4096, selector_steps=4096), learn="apart"
    )
    run = h.train(tmp_path / "run", flat=True, quiet=True)
    run.save_weights(tmp_path / "flat.safetensors")
    capsys.readouterr()
    scores = []
    for target in ("run", "flat.safetensors"):
        assert main(["evaluate", str(tmp_path / target), "--episodes", "5", "--json"]) == 0
        scores.append(json.loads(capsys.readouterr().out)["mean"])
    assert scores[0] == scores[1] == run.evaluate(5).mean
