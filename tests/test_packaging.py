"""The package as users install it: names, version, types and extras."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import skillweave
from scripts import versions
from skillweave.cli import main

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]


def test_the_command_prints_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"skillweave {skillweave.__version__}\n"
    with pytest.raises(SystemExit):
        main(["--help"])
    assert "--version" in capsys.readouterr().out


def test_the_version_is_the_same_everywhere():
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)
    (latest, *_) = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert cited == latest == skillweave.__version__


def packages_of(extra: str) -> set[str]:
    """Return the packages that an extra installs, those of the extras in it included."""
    packages: set[str] = set()
    for requirement in EXTRAS[extra]:
        inner = re.fullmatch(r"skillweave\[(.*)\]", requirement)
        if inner is None:
            packages.add(requirement)
            continue
        for name in inner[1].split(","):
            packages |= packages_of(name)
    return packages


def test_all_has_every_extra_for_users_and_dev_has_everything():
    for extra in set(EXTRAS) - {"docs", "bench", "dev"}:
        assert packages_of(extra) <= packages_of("all"), extra
    for extra in EXTRAS:
        assert packages_of(extra) <= packages_of("dev"), extra


def test_the_page_about_installing_names_every_extra():
    page = (ROOT / "docs/install.md").read_text()
    table = page.split("## Extras")[1].split("\n## ")[0]
    named = {
        name
        for line in table.splitlines()
        if line.startswith("| `")
        for name in re.findall(r"`([\w]+)`", line.split(" | ")[0])
    }
    assert named == set(EXTRAS)


def test_the_wheel_says_that_it_has_types_and_has_every_file_of_the_package(tmp_path):
    pytest.importorskip("hatchling")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel"]
    subprocess.run([*command, "--directory", str(tmp_path)], cwd=ROOT, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith("/METADATA"))
        described = archive.read(metadata).decode()
    assert f"Version: {skillweave.__version__}" in described.splitlines()
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "skillweave").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert "skillweave/py.typed" in files
    assert files == {name for name in names if name.startswith("skillweave/")}


def test_the_versions_that_are_tried_are_those_that_are_promised():
    core = {re.split(r"[\[>=<]", r)[0] for r in PROJECT["dependencies"]}
    lowest = dict(pin.split("==") for pin in versions.asked("lowest"))
    assert core - set(versions.LINKED) <= {name.partition("[")[0] for name in lowest}
    for requirement in versions.requirements():
        name, least = re.match(r"([\w.\[\]-]+)>=([\w.]+)", requirement).groups()  # type: ignore[union-attr]
        assert lowest[name] == least
        assert requirement in versions.asked("newest")


def test_the_tests_of_versions_are_there():
    assert [path for path in versions.TESTS if not (ROOT / path).exists()] == []
    with pytest.raises(ValueError, match="names no lowest version"):
        versions.lowest("numpy<3")
