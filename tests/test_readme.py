"""README: its example runs, its commands exist, and it is short."""

import re
from pathlib import Path

import pytest
from pages import ROOT, run_page, train_briefly

README = ROOT / "README.md"
TEXT = README.read_text()


def test_the_readme_example_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("Box2D")
    pytest.importorskip("PIL")
    train_briefly(monkeypatch)
    monkeypatch.chdir(tmp_path)
    run_page(README, monkeypatch)
    assert "over 100 episodes" in capsys.readouterr().out
    assert (tmp_path / "lander.gif").read_bytes().startswith(b"GIF89a")
    assert (tmp_path / "runs/lander/run.json").exists()


def test_every_shell_command_of_the_readme_is_one_that_exists() -> None:
    from skillweave.cli.commands import COMMANDS, name_of

    known = {name_of(c) for c in COMMANDS}
    used = set(re.findall(r"^skillweave ([\w-]+)", TEXT, flags=re.M))
    assert used
    assert used <= known


def test_every_target_of_make_that_the_readme_names_exists() -> None:
    makefile = (ROOT / "Makefile").read_text()
    used = set(re.findall(r"`make ([\w-]+)`", TEXT, flags=re.M))
    assert {"demo", "test"} <= used
    assert [t for t in used if not re.search(rf"^{t}:", makefile, flags=re.M)] == []


def test_the_readme_is_short_and_its_links_lead_somewhere() -> None:
    assert len(TEXT.splitlines()) <= 110
    links = re.findall(r"\]\((?!http)([^)#]+)", TEXT)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_readme_installs_the_small_torch_before_anything_else() -> None:
    installs = re.findall(r"^pip install .*$", TEXT, flags=re.M)
    assert "download.pytorch.org/whl/cpu" in installs[0]
