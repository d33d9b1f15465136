"""What the pages of the documentation say works: their code, their commands, their links."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path

import pytest
from hub_server import go_to, serve
from installed import HOMES
from pages import BLOCK, INCLUDED, ROOT, run_page, train_briefly

from skillweave.cli.commands import all_commands

README = ROOT / "README.md"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
NEEDS = {
    "docs/howto/start-from.md": ("stable_baselines3", "onnx", "onnxruntime", "onnxscript"),
    "docs/tutorials/first-hierarchy.md": ("Box2D",),
    "docs/tutorials/foreign-skills.md": ("stable_baselines3", "onnx", "onnxruntime"),
    "docs/howto/what-a-policy-needs.md": ("yaml", "onnx", "onnxruntime"),
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


@pytest.mark.needs("planning", "html_report", "demo", "compat")
def test_commands_and_modules_that_pages_tell_to_run_exist():
    known = set(all_commands())
    for page in (README, *PAGES):
        text = page.read_text()
        assert set(re.findall(r"^\s*skillweave ([\w-]+)", text, flags=re.M)) <= known, page
        for module in re.findall(r"python -m (benchmarks\.\w+)", text):
            place = ROOT / module.replace(".", "/")
            assert place.with_suffix(".py").is_file() or (place / "__main__.py").is_file(), page


def test_every_public_name_stands_in_the_reference_once():
    pages = sorted((ROOT / "docs/reference").glob("*.md"))
    shown = r"^::: (skillweave(?:\.\w+)?)\.(\w+)$"
    found = [place for p in pages for place in re.findall(shown, p.read_text(), flags=re.M)]
    names = [(module, name) for module, homes in HOMES.items() for name in homes]
    assert sorted(p for p in found if p[0] in HOMES) == sorted(names)


def test_every_page_about_a_suite_and_every_table_of_results_has_its_command():
    suites = sorted((ROOT / "docs/suites").glob("*.md"))
    assert [page for page in suites if "python -m benchmarks.pay" not in page.read_text()] == []
    sections = re.split(r"^## ", (ROOT / "docs/results.md").read_text(), flags=re.M)[1:]
    assert len(sections) >= 6
    assert [s.splitlines()[0] for s in sections if "python -m benchmarks." not in s] == []


# The README


def test_the_example_of_the_readme_is_one_of_the_examples():
    """``test_examples.py`` runs it."""
    (block,) = re.findall(r"^```python\n(.*?)^```", README.read_text(), flags=re.S | re.M)
    assert (ROOT / "examples/key_door.py").read_text().endswith(block)


def test_links_and_targets_of_make_in_the_readme_exist_and_it_installs_the_small_torch_first():
    text, makefile = README.read_text(), (ROOT / "Makefile").read_text()
    links = re.findall(r"\]\((?!http)([^)#]+)", text)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []
    used = set(re.findall(r"`make ([\w-]+)`", text, flags=re.M))
    assert {"demo", "test"} <= used
    assert [t for t in used if not re.search(rf"^{t}:", makefile, flags=re.M)] == []
    installs = re.findall(r"^pip install .*$", text, flags=re.M)
    assert "download.pytorch.org/whl/cpu" in installs[0]
