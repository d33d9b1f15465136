"""What the pages of the documentation say works: their code, their commands, their links."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from hub_server import go_to, serve
from pages import BLOCK, INCLUDED, ROOT, run_page, train_briefly

from skillweave._internal.public import HOMES
from skillweave.cli.commands import COMMANDS, name_of

README = ROOT / "README.md"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
NEEDS = {
    "docs/tutorials/first-hierarchy.md": ("Box2D",),
    "docs/tutorials/foreign-skills.md": ("stable_baselines3", "onnx", "onnxruntime"),
    "docs/tutorials/sharing.md": ("huggingface_hub",),
    "docs/tutorials/other-libraries.md": ("stable_baselines3",),
}
"""What a page's code needs beside the core."""
LONG = ("docs/algorithms/dqn.md", "docs/algorithms/index.md")
"""Pages whose code takes ten times as long as that of the others beside them."""


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def with_code() -> list[Path]:
    """The pages with code, long ones last."""
    pages = [page for page in PAGES if BLOCK.search(page.read_text())]
    return sorted(pages, key=lambda page: name(page) in LONG)


@pytest.mark.filterwarnings("ignore:start from .* the dict kwargs")  # start-from.md says so
@pytest.mark.fast_cases(2)
@pytest.mark.parametrize("page", with_code(), ids=name)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    for module in NEEDS.get(name(page), ()):
        pytest.importorskip(module)
    train_briefly(monkeypatch)
    monkeypatch.chdir(tmp_path)
    with ExitStack() as stack:
        if "huggingface_hub" in NEEDS.get(name(page), ()):
            hub = stack.enter_context(serve())
            go_to(hub.url, tmp_path / "cache", monkeypatch)
        run_page(page, monkeypatch)


def test_pages_show_whole_files_that_exist():
    shown = [found for page in PAGES for found in INCLUDED.findall(page.read_text())]
    assert "examples/doorkey.py" in shown
    assert [path for path in shown if not (ROOT / path).is_file()] == []


@pytest.mark.parametrize("page", [README, *PAGES], ids=name)
def test_every_command_of_a_page_exists(page):
    used = set(re.findall(r"^\s*skillweave ([\w-]+)", page.read_text(), flags=re.M))
    assert used <= {name_of(c) for c in COMMANDS}


@pytest.mark.parametrize("page", [README, *PAGES], ids=name)
def test_modules_that_a_page_tells_to_run_exist(page):
    modules = re.findall(r"python -m (benchmarks\.\w+)", page.read_text())
    places = {m: ROOT / m.replace(".", "/") for m in modules}
    there = {m for m, p in places.items() if p.with_suffix(".py").is_file()}
    there |= {m for m, p in places.items() if (p / "__main__.py").is_file()}
    assert [m for m in modules if m not in there] == []


def test_every_public_name_stands_in_the_reference_once():
    pages = sorted((ROOT / "docs/reference").glob("*.md"))
    shown = r"^::: (skillweave(?:\.\w+)?)\.(\w+)$"
    found = [place for p in pages for place in re.findall(shown, p.read_text(), flags=re.M)]
    names = [(module, name) for module, homes in HOMES.items() for name in homes]
    assert sorted(p for p in found if p[0] in HOMES) == sorted(names)


@pytest.mark.parametrize("page", sorted((ROOT / "docs/suites").glob("*.md")), ids=name)
def test_a_page_about_a_suite_names_its_command(page):
    assert "python -m benchmarks.pay" in page.read_text()


def test_every_table_of_results_has_its_command():
    sections = re.split(r"^## ", (ROOT / "docs/results.md").read_text(), flags=re.M)[1:]
    assert len(sections) >= 6
    assert [s.splitlines()[0] for s in sections if "python -m benchmarks." not in s] == []
