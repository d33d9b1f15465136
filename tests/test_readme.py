import re
from pathlib import Path
from typing import Any

import pytest

from skillweave import Hierarchy

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_readme_example_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("Box2D")
    pytest.importorskip("PIL")
    code = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert len(code) == 1
    train = Hierarchy.train

    def train_briefly(self: Hierarchy, *args: Any, **kwargs: Any) -> Any:
        self.scale(0.01)
        return train(self, *args, quiet=True, **kwargs)

    monkeypatch.setattr(Hierarchy, "train", train_briefly)
    monkeypatch.chdir(tmp_path)
    exec(compile(code[0], "README.md", "exec"), {"__name__": "readme"})
    assert "over 100 episodes" in capsys.readouterr().out
    assert (tmp_path / "lander.gif").read_bytes().startswith(b"GIF89a")
    assert (tmp_path / "runs/lander/run.json").exists()


def test_every_shell_command_of_the_readme_is_one_that_exists() -> None:
    from skillweave.cli.commands import COMMANDS

    known = {c.__name__.lower() for c in COMMANDS}
    used = set(re.findall(r"^skillweave (\w+)", README, flags=re.M))
    assert used
    assert used <= known
