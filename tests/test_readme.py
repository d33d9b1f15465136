"""README: its example is one of the examples, and its commands and links exist."""

import re

from pages import ROOT

README = ROOT / "README.md"
TEXT = README.read_text()


def test_the_example_of_the_readme_is_one_of_the_examples():
    """``test_examples.py`` runs it."""
    (block,) = re.findall(r"^```python\n(.*?)^```", TEXT, flags=re.S | re.M)
    assert (ROOT / "examples/key_door.py").read_text().endswith(block)


def test_every_target_of_make_that_the_readme_names_exists():
    makefile = (ROOT / "Makefile").read_text()
    used = set(re.findall(r"`make ([\w-]+)`", TEXT, flags=re.M))
    assert {"demo", "test"} <= used
    assert [t for t in used if not re.search(rf"^{t}:", makefile, flags=re.M)] == []


def test_the_links_of_the_readme_lead_somewhere():
    links = re.findall(r"\]\((?!http)([^)#]+)", TEXT)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_readme_installs_the_small_torch_before_anything_else():
    installs = re.findall(r"^pip install .*$", TEXT, flags=re.M)
    assert "download.pytorch.org/whl/cpu" in installs[0]
