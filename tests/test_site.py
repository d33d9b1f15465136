"""The documentation site: it builds without a warning, and needs nothing from the network."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from installed import HOMES
from pages import ROOT

pytestmark = pytest.mark.slow

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
EXTERNAL = (
    r"<(?:script|img|iframe|source|video)[^>]*\ssrc=\"(?:https?:)?//[^\"]*",
    r"<link[^>]*rel=\"(?:stylesheet|preconnect|preload|icon)\"[^>]*href=\"(?:https?:)?//[^\"]*",
    r"<link[^>]*href=\"(?:https?:)?//[^\"]*\"[^>]*rel=\"(?:stylesheet|preconnect|preload|icon)\"",
    r"url\([\"']?(?:https?:)?//[^)]*",
    r"@import[^;]*//[^;]*",
)
"""What a browser would fetch from elsewhere; links that a reader may click are none of these."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(module)
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=quiet, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_no_page_fetches_anything_from_elsewhere(site):
    files = [*site.rglob("*.html"), *site.rglob("*.css"), *site.rglob("*.svg")]
    assert len(files) > 30
    found = {
        str(path.relative_to(site)): hits
        for path in files
        if (hits := [h for p in EXTERNAL for h in re.findall(p, path.read_text())])
    }
    assert found == {}


def test_the_reference_has_every_public_name_with_plain_types_and_pages_have_pictures(site):
    text = "".join(page.read_text() for page in (site / "reference").glob("*.html"))
    places = [f"{module}.{name}" for module, homes in HOMES.items() for name in homes]
    assert [place for place in places if f'id="{place}"' not in text] == []
    skill = (site / "reference/skill.html").read_text()
    assert "always the true successor" in skill  # a comment beside a field of ``Step``
    concepts = (site / "concepts.html").read_text()
    assert concepts.count("<svg class=") >= 3  # drawn in the page, with its colours
    ppo = (site / "reference" / "ppo.html").read_text()
    assert "gae_lambda" in ppo
    checks = r"\b(?:Fraction|AtLeastOne|NonNegative|Annotated|LearningRate)\b"
    assert re.findall(checks, ppo) == []


def test_search_finds_pages_that_are_opened_from_the_disk(site):
    playwright = pytest.importorskip("playwright.sync_api")
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        pytest.skip("no browser here: apt-get install chromium")
    with playwright.sync_playwright() as started:
        window = started.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = window.new_page()
        page.goto((site / "index.html").as_uri())
        page.keyboard.press("/")
        page.keyboard.type("population")
        first = page.locator(".md-search-result__link").first
        first.wait_for(timeout=20_000)
        assert "evolution" in page.locator(".md-search-result__list").inner_text().lower()
        window.close()
