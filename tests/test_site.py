"""The documentation site: it builds without a warning, and needs nothing from the network."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT

import skillweave as sw

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


def test_no_page_fetches_anything_from_elsewhere(site: Path) -> None:
    files = [*site.rglob("*.html"), *site.rglob("*.css"), *site.rglob("*.svg")]
    assert len(files) > 30
    found = {
        str(path.relative_to(site)): hits
        for path in files
        if (hits := [h for p in EXTERNAL for h in re.findall(p, path.read_text())])
    }
    assert found == {}


def test_every_public_name_has_its_place_in_the_reference(site: Path) -> None:
    text = "".join(page.read_text() for page in (site / "reference").glob("*.html"))
    missing = [name for name in sw.__all__ if f'id="skillweave.{name}"' not in text]
    assert missing == []


def test_fields_and_pictures_are_in_the_pages(site: Path) -> None:
    declare = (site / "reference/declare.html").read_text()
    assert "always the true successor" in declare  # a comment beside a field of ``Step``
    concepts = (site / "concepts.html").read_text()
    assert concepts.count("<svg class=") >= 3  # drawn in the page, with its colours
