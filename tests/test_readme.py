import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import skillweave
from skillweave import Agent, Hierarchy

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_readme_examples_run_as_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("Box2D")
    pytest.importorskip("PIL")
    code = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert len(code) == 4
    train = Hierarchy.train

    def train_briefly(self: Hierarchy, *args: Any, **kwargs: Any) -> Any:
        self.skill_steps, self.selector_steps = 1_000, 1_000
        self.flat_steps = None if self.flat_steps is None else 1_000
        for owner, field in [(self, "selector"), *((x, "algorithm") for x in (self, *self.skills))]:
            if hasattr(config := getattr(owner, field), "learning_starts"):
                setattr(owner, field, replace(config, learning_starts=900))
        if kwargs.get("evolve"):
            small = {"generations": 2, "population": 3, "episodes": 1}
            kwargs["evolve"] = {k: replace(v, **small) for k, v in kwargs["evolve"].items()}
        return train(self, *args, **kwargs | {"quiet": True})

    train_alone = Agent.train

    def train_alone_briefly(self: Agent, *args: Any, **kwargs: Any) -> Any:
        self.steps = min(self.steps, 5_500)  # a little more than learning_starts
        return train_alone(self, *args, **kwargs | {"quiet": True})

    monkeypatch.setattr(Hierarchy, "train", train_briefly)
    monkeypatch.setattr(Agent, "train", train_alone_briefly)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "readme"}
    exec(compile(code[0], "README.md", "exec"), names)
    assert "over 100 episodes" in capsys.readouterr().out
    assert (tmp_path / "lander.gif").read_bytes().startswith(b"GIF89a")
    assert (tmp_path / "runs/lander/run.json").exists()

    exec(compile(code[1], "README.md", "exec"), names)
    assert (tmp_path / "runs/sac/run.json").exists()
    assert names["hierarchy"].selector.noisy
    names["hierarchy"].check_spaces()

    exec(compile(code[2], "README.md", "exec"), names)
    stages = names["run"].info()["stages"]
    assert [p["name"] for p in stages if "winner" in p] == ["land"]

    made: list[Any] = []  # the files of foreign skills are tested where they are made
    for name in ("from_sb3", "from_onnx"):
        monkeypatch.setattr(skillweave, name, lambda *a, **k: made.append((a, k)), raising=False)
    names |= {"glide": lambda obs: obs[:, 0], "network": torch.nn.Linear(8, 4)}
    exec(compile(code[3], "README.md", "exec"), names)
    assert made == [(("dock.zip", "ppo"), {"trust": True}), (("hop.onnx",), {})]


def test_every_shell_command_of_the_readme_is_one_that_exists() -> None:
    from skillweave.cli.commands import COMMANDS, name_of

    known = {name_of(c) for c in COMMANDS}
    used = set(re.findall(r"^skillweave ([\w-]+)", README, flags=re.M))
    assert used
    assert used <= known
