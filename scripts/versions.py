"""Tests with the lowest and with the newest versions that ``pyproject.toml`` allows.

    python -m scripts.versions            both
    python -m scripts.versions lowest     one of them

Each gets a virtual environment of its own in ``.venv/versions``, in which a quick share of the
tests runs. PyTorch is large, so both use the one of the environment that runs this.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLACE = ROOT / ".venv" / "versions"
KINDS = ("lowest", "newest")
EXTRAS = ("video", "tensorboard", "plot", "hub", "report")
"""Extras that are quickly installed; what needs another one is not tried here."""
LINKED = ("torch",)
"""Packages that are taken from the environment that runs this, with their parts."""
PARTS = ("torch", "torchgen", "functorch", "nvidia", "triton")
TOOLS = (
    "pytest>=8",
    "pytest-xdist>=3.5",
    "jaxtyping",
    "beartype",
    "hypothesis",
    "hatchling>=1.24",
    "gymnasium[classic-control]",
)
TESTS = (
    "tests/algorithms/test_ppo.py",
    "tests/calls",
    "tests/cli/test_cli.py",
    "tests/experience/test_skill_rows.py",
    "tests/envs/test_engine.py",
    "tests/envs/test_make.py",
    "tests/hierarchy/test_options.py",
    "tests/reporting/test_curves_figure.py",
    "tests/reporting/test_progress.py",
    "tests/html_report/test_report_data.py",
    "tests/reporting/test_video.py",
    "tests/runs/test_directory.py",
    "tests/runs/test_trackers.py",
    "tests/sharing/test_hub.py",
    "tests/test_nesting.py",
    "tests/test_packaging.py",
    "tests/test_spaces.py",
    "tests/test_terminal.py",
    "tests/test_together.py",
    "tests/test_torch_modes.py",
)
WITHOUT = "not Lander and not lander"
"""Box2D has to be compiled for the lowest versions."""
_REQUIREMENT = re.compile(r"([\w.-]+)(\[[\w,-]+\])?(.*)")


def requirements() -> list[str]:
    """Return what the core and the extras need, as ``pyproject.toml`` says it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    found = list(project["dependencies"])
    for extra in EXTRAS:
        found += project["optional-dependencies"][extra]
    return [r for r in found if not r.startswith("skillweave") and _name(r) not in LINKED]


def lowest(requirement: str) -> str:
    """Return ``name==1.2`` for ``name>=1.2,<3``.

    Raises:
        ValueError: the requirement names no lowest version.
    """
    name, extra, versions = _parts(requirement)
    least = re.search(r">=\s*([\w.]+)", versions)
    if least is None:
        raise ValueError(f"{requirement} names no lowest version")
    return f"{name}{extra}=={least[1]}"


def asked(kind: str) -> list[str]:
    """Return what is installed for ``lowest`` or ``newest``."""
    if kind == "newest":
        return requirements()
    return [lowest(r) for r in requirements()]


def _parts(requirement: str) -> tuple[str, str, str]:
    found = _REQUIREMENT.fullmatch(requirement)
    assert found is not None, requirement
    return found[1], found[2] or "", found[3]


def _name(requirement: str) -> str:
    return _parts(requirement)[0]


def _needs_of_linked() -> list[str]:
    """Return what the linked packages need beside their own parts."""
    needs = []
    for package in LINKED:
        for text in importlib.metadata.requires(package) or ():
            if "extra ==" not in text and not _name(text).startswith(PARTS):
                needs.append(text)
    return needs


def _linked_paths() -> Iterator[Path]:
    """Yield the folders of the linked packages, and of what is known about them."""
    (folder,) = {Path(str(importlib.metadata.distribution(p).locate_file(""))) for p in LINKED}
    for path in folder.iterdir():
        if path.name in PARTS or (path.suffix == ".dist-info" and path.name.startswith(PARTS)):
            yield path


def make(kind: str) -> Path:
    """Make the environment, and return its interpreter."""
    place = PLACE / kind
    shutil.rmtree(place, ignore_errors=True)
    _run([sys.executable, "-m", "venv", str(place)])
    python = place / "bin" / "python"
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    library = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    for path in _linked_paths():
        (Path(library.stdout.strip()) / path.name).symlink_to(path)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    _run([*pip, "--no-compile", *asked(kind), *_needs_of_linked(), *TOOLS])
    _run([*pip, "--no-deps", "-e", str(ROOT)])
    return python


def main(kinds: Sequence[str]) -> int:
    """Make the environments and run the tests; 0 where all pass."""
    failed = []
    for kind in kinds or KINDS:
        began = time.perf_counter()
        python = make(kind)
        made = time.perf_counter()
        print(f"{kind}: {', '.join(asked(kind))}", flush=True)
        # A test that needs an extra which is not here is skipped.
        env = {k: v for k, v in os.environ.items() if k != "SKILLWEAVE_TESTS_NEED_ALL"}
        command = [str(python), "-m", "pytest", "-p", "no:cacheprovider", "-m", "not slow"]
        command += ["-n", str(os.cpu_count() or 1), "-k", WITHOUT, *TESTS]
        if subprocess.run(command, cwd=ROOT, env=env, check=False).returncode:
            failed.append(kind)
        done = time.perf_counter()
        print(f"{kind}: installed in {made - began:.0f} s, tested in {done - made:.0f} s")
    if failed:
        print(f"failed with the {' and the '.join(failed)} versions", file=sys.stderr)
    return 1 if failed else 0


def _run(command: Sequence[str]) -> None:
    subprocess.run(command, check=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
